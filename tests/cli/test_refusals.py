"""Misuse of every command: one sentence on stderr, exit code 2, and no file has changed. And the
messages of the page about them."""

import json
import re
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lens_examples import FILES, FRONT

from darswin import create_model, lens, load_model
from darswin.cli.main import main
from darswin.lens import Polynomial, to_dict
from darswin.lens.rig import CUBES
from darswin.models.saving import ModelCard, save_model

# By the beginning of a command, its wrong continuations, and what is said of them.
REFUSED = {
    "": r"""
        train => there is no command 'train'. The commands are fit,
        models swin => unrecognized arguments: swin
        models --zzzzzz 2 => unrecognized arguments: --zzzzzz 2; see `darswin models --help`
        convert => the following arguments are required: source, target
        convert none.pth out.safetensors => ^darswin: none.pth: No such file or directory$
        convert a b --fast => unrecognized arguments: --fast
        quantize --run r --tolerence 2 => the nearest option is --tolerance; see
        quantize --run . --pictures 0 => --pictures must be at least 1, got 0
        quantize --run empty => no model in empty
        quantize --run began/checkpoints/best.ckpt => a file; this one belongs to the run began$
        quantize --run best.safetensors => the folder in which .* best.safetensors is a file$
    """,
    "predict": r"""
        none.png p.png a.mp4 --run . --lens lens.json => no file or folder none\.png, a\.mp4$
        p.png --model m.safetensors --lens lens.json => ^darswin: m\.safetensors: No such file
        none.png --lens lens.json => give either --run, .* or --model, a safetensors file or one of
        p.png --model digits --run . => or --model, a safetensors file or one of digits
        p.png --model digits --view mercator => --view is an option of --network$
        p.png --model digits --labels l.txt => --labels is an option of --network
        --lens lens.json --run . => missing pictures or videos
        checkpoints --run . --lens lens.json => no pictures or videos in checkpoints
        x.png --calib_lenses x --evry 2 => the nearest option is --every; see
        x.png --lenz x --evry=2 => the nearest option is --lens, --every; see
    """,
    "predict p.png --run .": r"""
        => missing --lens: give the camera.*, because \. has no config.yaml
        --lens {} => or a "model" of darswin
        --lens none.json => there is no calibration file none\.json
        --lens 170 => --lens 170 is a number, but must be a calib.*"fov_deg": 170
        --lens other.json => other\.json: (?!.*must name).*its entries are '?name
        --lens cameras.txt => choose one with --camera: '1', '2'
        --lens kd.json => give --coefficients "fisheye" or "pinhole"
        --lens checkpoints => no calibration in .*: checkpoints/p\.json
        --lens checkpoints --camera 1 => --camera 1 chooses a camera of a file
        --lens lens.json --out p.png => --out p\.png would replace p\.png, which this
        --lens lens.json --out ./lens.json => would replace lens\.json
        --lens lens.json --every 0 => --every must be at least 1, got 0
        --lens lens.json --top 0 => --top must be at least 1, got 0
        --lens lens.json --task distance => --task is distance, but .*best\.safe
    """,
    "predict p.png": r"""
        --run checkpoints/best.safetensors --lens lens.json => the folder .* a file. --model takes
        --network n.onnx => missing --lens
        --network n.onnx --lens lens.json => missing --out
        --network n.onnx --model digits => --model does not go with --network$
        --netw n.onnx --run=r => --run does not go with --network$
        --network n.onnx --channels grb => --channels must be one of rgb, bgr, got grb
        --network n.onnx --fov_deg wide => --fov_deg must be a number, got wide
    """,
    "predict p.png --lens lens.json --out new --network": r"""
        n.onnx --out even.png => --out must be a folder, but even.png is a file
        n.onnx --view fish => --view must be one of .*, mercator, .* got fish
        n.onnx --view polar => --view polar shows no picture to a network
        n.onnx --view mercator:3 => 'mercator' has no option 'count'; it has fov,
        n.onnx --view tiles:x => --view must be NAME or NAME:COUNT, .* got tiles:x
        n.onnx --view tiles:3 => count must be from 4 to 9, got 3
        n.onnx --view none --fov_deg 90 => 'none' has no option 'fov'
        n.onnx --fov_deg 0 => --fov_deg must be above 0° and at most 360° for a
        n.onnx --std 58.395,57.12,57.375 => parts of 255, .* 0.229,0.224,0.225\), got 58.395
        n.onnx --mean 0.1,0.2 => mean.*per channel
        n.onnx --std 0 => --std must be above 0
        n.onnx --std nan => --std must be finite, got nan
        n.onnx --top 2 => --top is for the classes of pictures, but n.onnx is a model
        n.onnx --size 32,64 => --size must be 64,64 for n.onnx, got 32,64
        n.onnx --threshold nan => --threshold must be from 0 to 1, as scores are, got nan
        n.onnx --task distance => --task does not go with --network
        maps.onnx --form pose => --form must be one that its outputs may have, numbers, got pose
        n.onnx --height 2 => --height needs --up, the direction away from gravity
        n.onnx --radius 1 => --radius must be given with --height, got 1.0
        n.onnx --height 2 --radius -1 --up=0,-1,0 => --radius must be at least 0 m
        n.onnx --height 2 --up=0,-1,0 --view square => no .*up
        maps.onnx --height 2 --up=0,-1,0 => --height is for boxes, but maps.onnx gives
        maps.onnx --format coco => --format is for detections, but maps.onnx is a network for maps
        free.onnx --size 0,64 => --size must be at least 1,1, got \(0, 64\)
        bytes.onnx --std 0.2 => bytes.onnx takes pixels of uint8: leave --mean and --std
        gone.onnx => there is no file gone.onnx
    """,
    "warp deep/set/instances.json --out new": r"""
        --to wide.json => missing --lens: .*instances.json has no calibration
    """,
    "warp set/instances.json --out new": r"""
        --to wide.json --lens wide.json --processes 0 => --processes must be at least 1, got 0
        --to wide.json --lens wide.json --size 0,5 => --size must be at least 1,1
        --to wide.json --lens wide.json --up 0,1,0 => --up must be left out unless --to is a view
        --to nowhere.json --lens wide.json => --to nowhere.json is neither a file nor a view:
        --to bare.json --lens wide.json => bare.json has no image_size: give --size
        --to {"model":"Perspective","fov_deg":70} --lens wide.json => needs the image_size
        --to tiles:x --lens wide.json => --to must be NAME or NAME:COUNT, such as tiles:5
        --to none --lens wide.json => --to none shows the picture as it is
        --to mercator --lens wide.json --up 0,1 => --up must be three finite numbers
    """,
    "warp --to mercator --lens wide.json": r"""
        lone --out lone/new => --out must be a folder outside of lone, got lone/new
        set/instances.json --out more => --out more holds other files
        set/instances.json --out p.png => --out must be a folder, but p.png is a file
        lists.json --out new => lists.json.* must have the lists "images"
        form.json --out new => is not in COCO's form: expected str
        set/outside.json --out new => outside of the folder set/images, .*p.png: name them relative
        two --out new => 2 files of labels: give one of them.*other.json
    """,
    "rig": r"""
        turn cube:8 => invalid choice: 'turn'
        show front.json => front.json: it has no poses: files of rigs are those of Kalibr
        show poses.json => which way its poses go: give --direction, camera_to
        show poses.json --direction camera_to_rig => which way is up in its frame: give --up$
        show cube:big => a cube is cube:SIDE, with the side of its pictures in px, got cube:big
        show cube:8 --height 2 => --height must be left out for a cube, got 2.0
        show cube:8 --out rig.gif => must end in one of \.png
        show cube:8 in => ^darswin: in/p.png is of no camera: they are front, right, ba
        show cube:8 in cube => in must be NAME=PATH, or a folder that is given alone
        show cube:8 p.png => p.png must be a folder with a picture of each camera
        show cube:8 gone => no file or folder gone
        show cube:8 front=cube/up.png => there is no picture of the camera right$
        show cube:8 front=p.png front=in/p.png => p.png and in/p.png are both of the camera front
        show cube:8 front=p.png right=cubes/right => give either a picture or a folder of each
        show cube:8 cubes => the camera right has no frame 2, but others have
        show cube:8 cube --out cube/up.png => --out cube/up.png would replace cube/up.png, which
        check cube:8 cube --out cube/up.png => --out cube/up.png would replace cube/up.png, which
        check cube:8 cube => no two cameras see the same places
        stitch cube:8 --out new.png => missing pictures: give a folder
        stitch cube:8 two_faces --out new.png => no picture of the camera back in two_faces$
        stitch cube:9 cube --out new.png => cube/front.png must be of 9 × 9 px .*, got 8 × 8 px
        stitch cube:8 cube --out new.gif => --out must be a file that ends in one of .bmp
        stitch cube:8 cube --out cube/up.png => --out cube/up.png would replace
    """,
    "rig stitch cube:8 cube --out new.png": r"""
        --view ground => below all cameras: give --height, in metres
        --view square => --view must be one of ground, cylindrical, .* got square
        --span 3 => --span must be left out unless the view is the ground, got 3.0
        --size 0,4 => --size must be at least 2,2
        --seam soft => --seam must be one of hard, narrow, wide, got soft
        --distance 0 => --distance must be above
        --view perspective --fov_deg 200 => --fov_deg must be above 0° and at most 179.9°
    """,
    "rig fisheye": r"""
        cube --to wide.json => required: --out
        gone --to wide.json --out new => no file or folder gone
        cube --to bare.json --out new => bare.json has no image_size: give --size
        cube --to wide.json --out cube/new => --out must be a folder outside of cube, got cube/new
        cube --to wide.json --out more => --out more holds other files
        cube --to wide.json --out new --faces opengl => back.png is of no camera: they are \+x, -x
        cube --to wide.json --out new --depth_unit 0 => --depth_unit must be a finite number of met
        kinds --to wide.json --out new => missing --depth_unit: .* such as kinds/depth/front.png
        lone_depth --to wide.json --out new => no folder lone_depth/colour beside lone_depth/depth
        apart --to wide.json --out new => colour and labels do not both have the frame 1
    """,
    "lens": r"""
        draw front.json => invalid choice: 'draw'
        show => arguments are required: calib, image
        show front.json none.png => ^darswin: cannot read none.png: No such file[^(]*$
        show front.json front.png --out front.png => --out front.png would replace front.png
        info wrong.json => wrong.json
        info front.json --image_size 960 => 2 whole numbers, got .*: height and width of .* 960,12
        info front.json --coeficients x => the nearest option is --coefficients; see `darswin
        convert front.json front.json --model Mei => --out front.json would replace front.json
        convert front.json p.png => --out p.png would replace a file that is no calibration
        crop front.json ./front.json --box 0,0,9,9 => --out ./front.json would replace
        crop front.json new.json --box 0,0,9,9 --size 0,9 => --size must be from 1 to .*, got 0
        crop front.json new.json --box 0,0,0,9 => --box must be from 1 to 1000000 px, got 0
        crop front.json new.json => missing --box or --size
        crop front.json new.json --box=966,0,9,9 => --box must be a part of the picture of 966 × 1
        crop front.json new.json --box=0,-9,9,9 => --box must be a part of the picture
        crop front.json new.json --box=1,2,3 => --box must be 4 whole numbers
        crop bare.json new.json --image_size 0,9 --size 9,9 => --image_size must be from 1 to 1000
    """,
    "lens show front.json front.png": r"""
        --fov_deg 0 => --fov_deg must be above 0° and at most 179.9° for a perspective view
        --fov_deg=180 => --fov_deg must be above 0° and at most 179.9° .*, got 180
        --view=stereographic --fov_deg=341 => at most 340° for a stereographic view
        --view=panorama --fov_deg=90 => --fov_deg must be 360° for a panorama view, got 90
        --view=square --pitch_deg=9 => --pitch_deg must be 0 for a square view, which
        --up=0,0,0 => --up must be three finite .*, got \(0.0, 0.0, 0.0\)
        --up=0,1e999,2 => --up must be three finite numbers
        --yaw_deg=inf => --yaw_deg must be from -360° to 360°, got inf
        --theta_max_deg=0 => --theta_max_deg must be above 0° and at most 180°, got 0
        --rings=100000000 => --rings must be from 1 to 1024, got 100000000
        --sectors=0 => --sectors must be from 1 to 4096, got 0
        --samples=300,2 => --samples must be from 1 to 256, got 300
        --samples=200,200 => must be at most 4194304 samples, got 40960000
        --out=lens.gif => must end in one of \.png, \.jpg, .*, got 'lens.gif'
    """,
    "lens undistort --coefficients=fisheye kd.json": r"""
        in --view=square --up=0,-1,0 --out=out => --up must be left out for a square view
        in --view=fisheye --out=out => --view must be one of cylindrical, equirectangular
        in --theta_max_deg=0 --out=out => --theta_max_deg must be above 0°
        in --size=0,9 --out=out => --size must be at least 2,2
        in --size=100000,100000 --out=out => --size must be at least 2,2 and at most
        in --view=square --size=40,41 --out=out => --size must be square for this view
        --out=out => missing pictures or videos
        nothing --out=out => there is no file or folder nothing$
        in --out=/proc/x => --out must be a folder that can be written, got /proc/x
        in --out=. => --out must be a folder without the originals, but has in
        in --out=in => --out must be a folder without the originals, but has in
        in/p.png --out=in => --out must be a folder without the originals, but has in/p.png
        in out/p.png --out=out => must be a folder without the originals, but has out/p.png
        more --out=more/own => no pictures or videos in more, apart from those of --out
        in --out=more => --out more holds other files
        in --out=out --yaw_degree 3 => the nearest option is --yaw_deg; see
    """,
    "lens undistort . front.json --out new": " => \\. is a folder, but must be a calibration file",
    "lens calibrate boards": r"""
        --board=9 --square=1 => --board must be columns and rows from 3 to 100, such as
        --board=2x6 --square=1 => --board must be columns and rows from 3 to 100
        --board=9x6 --square=0 => --square must be positive, got 0
        --board=9x6 => required: --square
    """,
    "lens calibrate --board=6x5 --square=0.03 --model=Mei": r"""
        => missing pictures
        empty => no pictures or videos in empty
        none => no file or folder none
        boards --kind=round => --kind must be one of chessboard, charuco, april
        boards --kind=charuco => --kind charuco needs --marker
        boards --kind=april => --kind april needs --gap
        boards --marker=0.1 => --kind chessboard has no --marker
        boards --dictionary=4X4_50 => --kind chessboard has no --dictionary
        boards --kind=charuco --marker=0.1 => --marker must be below the square of 0.03
        boards --kind=charuco --marker=0.02 --gap=0.1 => --kind charuco has no --gap
        boards --kind=charuco --marker=0.02 --first_tag=3 => --kind charuco has no --first_tag
        boards --kind=charuco --marker=0.02 --dictionary=4X4_5 => did you mean 4X4_50\?
        boards --model=KanalaBrandt => --model: .*did you mean KannalaBrandt
        boards --picture=made.gif => must end in one of .png
        boards --square_pixels=no => --square_pixels must be true or false, got no
        boards --theta_max_deg=0 => --theta_max_deg must be above 0
        boards --out=boards => --out must be a file in a folder that can be written
        boards --report=boards/0.png/r.json => --report must be a file in a folder that can
        boards --out=a.json --report=./a.json => must be different files
        boards --out=boards/0.png => --out boards/0.png would replace
        boards --report=boards/0.png => --report boards/0.png would replace
    """,
    "lens estimate": r"""
        => missing pictures
        empty => no pictures or videos in empty
        films => no pictures in films
        nothing.png => there is no file or folder nothing.png
        boards --fov_deg 400 => --fov_deg must be above 0° and below 360°, got 400
        even.png --fov_deg 180 => no image circle is visible
        even.png --model Sphericl => unknown lens model 'Sphericl'
        even.png --out even.png => --out even.png would replace even.png
    """,
    "fit --run r": r"""
        --config elsewhere.yaml => no folder elsewhere
        --config none => none is neither a file nor a preset
        --config minute => did you mean minutes\? The presets are few, iccv2023, iccv2023_paper, min
        --task depth => --task must be one of classification, segmentation, distance, got
        --config two_cores --task segmentation => two_cores is for --task classification, not for s
        --config few --task distance => few is for --task classification, not for distance,
        --config scenes_minutes --task classification => is for --task segmentation or distance, not
        --config two_cores --task distance => distance, which has scenes_minutes
        --model darswin_a_small => is none; type --model.name darswin_a_small; `darswin fit --help`
        --model=darswin_a_small => darswin: --model takes a file of options, and darswin_a_small is
        --trainer 3 => --trainer takes a file of options, and 3 is none; `darswin fit
    """,
    "fit --config minutes --data.path digits --run": r"""
        => ^darswin fit: argument --run: expected one argument; see `darswin fit --help`$
        /proc/x => --run must be a folder that can be written, got /proc/x
        a.json => --run must be a folder, but a.json has the ending of a file: leave it out
        done => done holds a run already: continue it with --resume
        best.safetensors => --run names .* best.safetensors is a file\. --model.weights takes a mo
        began/checkpoints/best.ckpt => this one belongs to the run began\. --ckpt_path takes
        r --config speed.yaml => no option '--model.speed'
        r --data.batch_size 0 => --data.batch_size must be at least 1, got 0
        r --data.holdout 0 => none of its own; set --trainer.limit_val_batches 0 to train without
        r --data.train_lenses low --data.lens {} => --data.train_lenses warps pictures through
        r --data.test_lenses=low --data.lens {} => --data.test_lenses warps pictures through
        r --xi 0.3 --data.lens {} => --xi warps pictures through lenses, and --data.lens says
        r --data.lens kalibr_fov.yaml => choose one with --data.camera:
        r --model.options {"foo":1} => --model.options
        r --model.options {"embed_dim":1099511627776} => not enough memory: a smaller --data.batch
        r --model.name swin_unet_nano => swin_unet_nano is no model for --task classification
        r --trainer.overfit_batches 2 => overfit_batches shuffles otherwise: take --data.limit
        r --trainer.max_epochs many => error: --trainer.max_epochs:
        r --trainer.max_epochs -1 => cosine needs an end: set --trainer.max_epochs or
        r --checkpoint_steps 0 => --checkpoint_steps must be at least 1, got 0
        r --devices many => error: --devices:
        r --data.pth x => ^error: unrecognized arguments: --data.pth x; the nearest option is --data
        r --data.lmit 3 --batch_size 2 => the nearest option is --data.limit, --data.batch_size;
        r --data.xi 0.3 => the nearest option is --xi;
        r --zzzzzz 3 => unrecognized arguments: --zzzzzz 3; `darswin fit --help` lists the opt
    """,
    "fit --task segmentation --data.path scenes --model.name darswin_unet_a_nano --run r": r"""
        --data.max_distance 3 => unrecognized arguments: --data.max_distance 3
        --xi 0.3 => unrecognized arguments: --xi
        --model.loss silog => --model.loss
    """,
    "fit --config minutes": " => required: --data.path, --run",
    "validate --run": r"""
        began/checkpoints/best.ckpt => this one belongs to the run began\. --ckpt_path takes
    """,
    "test --run": r"""
        best.safetensors => --run names .* best.safetensors is a file\. --model.weights takes a mo
        r => there is no run in r
        began --task segmentation => began is a run of --task classification, not of segmentation
    """,
}
# These come before the slow imports of the parser.
EARLY = ("fit --run r", "fit --config minutes --data.path digits --run done")
ROWS = [
    (" ".join((command, *options.split())).strip(), said.strip())
    for command, rows in REFUSED.items()
    for options, said in (row.split("=>") for row in rows.strip().split("\n"))
]
# The rows of the page's tables: what is typed, and a part of what is said.
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "messages.md"
TOLD = re.findall(r"^\| `(?:darswin )?(.+?)` \| `(.+?)` \| .+ \|$", PAGE.read_text(), re.M)
OTHERS = [row for row in TOLD if "swapped" in row[0] or "(" in row[0]]  # calls, and what is done
ROWS += [(typed, re.escape(said)) for typed, said in TOLD if (typed, said) not in OTHERS]
COLMAP = "1 OPENCV_FISHEYE 96 64 40 40 48 32 0 0 0 0\n2 OPENCV_FISHEYE 96 64 30 30 48 32 0 0 0 0\n"
SET = {
    "images": [{"id": 0, "file_name": "0.png", "height": 64, "width": 96}],
    "annotations": [{"id": 1, "image_id": 0, "category_id": 1, "bbox": [40, 20, 9, 9]}],
    "categories": [{"id": 1, "name": "a"}],
}
FILES_OF_TEXT = {
    "lens.json": {"model": "Spherical", "xi": 0.5, "fov": 2.8},
    "wide.json": {"model": "Equidistant", "focal": 30, "theta_max": 1, "image_size": [64, 96]},
    "cameras.txt": COLMAP,
    "kd.json": dict(K=[30.0, 0, 47.5, 0, 30.0, 31.5, 0, 0, 1], D=[0.1, 0.02, 0, 0], w=96, h=64),
    "other.json": {"name": "A camera", "focal_mm": 2.1},
    "front.json": to_dict(FRONT),
    "bare.json": to_dict(Polynomial([300.0], 1.5)),
    "poses.json": {"cameras": {"left": to_dict(FRONT) | {"pose": np.eye(4).tolist()}}},
    "wrong.json": {"model": "Spherical"},
    "out/undistorted.json": [],
    "boards/0.png": "no picture",
    "set/instances.json": SET,
    "deep/set/instances.json": SET,
    "lone/instances.json": SET,
    "two/annotations/instances.json": SET,
    "two/annotations/other.json": SET,
    "lists.json": {"images": []},
    "form.json": SET | {"images": [{"id": 0, "file_name": 5}]},
    "set/swapped.json": SET | {"images": [SET["images"][0] | {"height": 96, "width": 64}]},
    "mm.json": {"model": "Equidistant", "focal": 2.1, "theta_max": 1.5},
    "yolo.pt": "",
    "set/outside.json": SET | {"images": [SET["images"][0] | {"file_name": "../../p.png"}]},
    "elsewhere.yaml": "data: {path: elsewhere}",
    "speed.yaml": "model: {speed: 3}",
    "began/config.yaml": "data: {path: digits}\n",
    "began/checkpoints/best.ckpt": "",
    "trained/config.yaml": "data: {path: digits}\n",
    "films/film.mp4": "no video",
    "done/checkpoints/last.ckpt": "",
    "best.safetensors": "",
    "empty/readme.txt": "",
}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with files of every kind that the commands read or must not replace."""
    folder = tmp_path_factory.mktemp("world")
    for name, content in FILES_OF_TEXT.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / name).write_text(text)
    noise = np.random.default_rng(0).integers(256, size=(64, 96, 3), dtype=np.uint8)
    pictures = dict.fromkeys(("p.png", "in/p.png", "out/p.png", "more/own/b.png"), noise)
    pictures |= {f"{name}/images/0.png": noise for name in ("set", "deep/set", "lone")}
    cubes = {"cube": "", "cubes": "/1", "kinds/colour": "", "kinds/depth": "", "two_faces": "",
             "lone_depth/depth": "", "apart/colour": "/1", "apart/labels": "/2"}  # fmt: skip
    for name, frame in cubes.items():
        faces = CUBES["carla"][: 2 if name == "two_faces" else 6]
        pictures |= {f"{name}/{face}{frame}.png": np.zeros((8, 8)) for face in faces}
    pictures["cubes/front/2.png"] = noise
    pictures |= {"even.png": np.full((90, 120, 3), 80, np.uint8)}
    sizes = {"front.png": (483, 640, 3), "turned.png": (640, 483, 3), "square.png": (40, 40, 3)}
    pictures |= {name: np.zeros(size) for name, size in sizes.items()}
    for name, picture in pictures.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), picture)
    card = ModelCard("darswin_a_nano", dict(num_classes=6), list("abcdef"), 32, 2.8)
    save_model(folder / "checkpoints" / "best.safetensors", card.create().state_dict(), card)
    shutil.copy(FILES / "kalibr_fov.yaml", folder)
    return folder


@pytest.fixture(scope="module")
def networks(world):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from graphs import write_constants, write_graph

    write_graph(world / "n.onnx", size=(64, 64))
    write_graph(world / "free.onnx")
    write_graph(world / "bytes.onnx", size=(64, 64), dtype="uint8")
    write_constants(world / "maps.onnx", (64, 64), maps=np.zeros((1, 2, 64, 64), np.float32))


@pytest.fixture(scope="module")
def scenes(world):
    from scenes import write_plain

    write_plain(world / "scenes", 8, size=(45, 60))


def state_of(folder):
    """Each file with its content, and each folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize(("command", "said"), ROWS)
def test_misuse_is_one_sentence(world, request, monkeypatch, capsys, command, said):
    for fixture, word in (("networks", ".onnx"), ("scenes", "scene")):
        if word in command:
            request.getfixturevalue(fixture)
    if command.startswith(EARLY):
        monkeypatch.setattr("darswin.cli.main.resolve_name", None)  # it imports the command
    monkeypatch.chdir(world)
    before = state_of(world)
    with pytest.raises(SystemExit) as end:
        main(command.split())
    printed = capsys.readouterr()
    assert end.value.code == 2 and not printed.out and "Traceback" not in printed.err
    line = printed.err.splitlines()[-1]  # after what a network is, and signs of life
    assert re.match("darswin|error: ", line) and re.search(said, line), line
    assert state_of(world) == before


@pytest.mark.parametrize(("typed", "said"), OTHERS)
def test_calls_and_commands_that_do_a_part_say_what_the_page_says(
    world, monkeypatch, capsys, typed, said
):
    monkeypatch.chdir(world)
    scope = dict(create_model=create_model, lens=lens, load_model=load_model, torch=torch)
    heard: list[str] = []
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            exec(typed, scope) if "(" in typed else main(typed.split())
        except (Exception, SystemExit) as error:
            heard.append(str(error))
    heard += [str(warning.message) for warning in given] + [capsys.readouterr().err]
    assert any(said in text for text in heard), heard
