"""`darswin lens undistort` and `darswin lens crop`, with OpenCV as the oracle."""

import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from videos import turn_video, write_video

from darswin import lens as lenses
from darswin.cli import undistort as module
from darswin.cli.main import main
from darswin.data.cameras import Calibrations
from darswin.lens import Equidistant, to_dict
from darswin.utils.video import read_frames
from darswin.views import make_view

SIZE = (96, 128)  # of the calibration's pictures
K = np.array([[52.0, 0.0, 62.0], [0.0, 51.0, 49.5], [0.0, 0.0, 1.0]])
D = np.array([0.02, -0.005, 0.001, 0.0])


def picture(size=SIZE, channels=3):
    """A smooth picture, whose interpolation has no large error."""
    y, x = np.mgrid[: size[0], : size[1]]
    planes = (np.sin(x / 15), np.cos(y / 12), np.sin((x + 2 * y) / 20))
    return np.stack([128 + 100 * p for p in planes[:channels]], -1).astype(np.uint8)


def save(path, image, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image.squeeze()).save(path, **options)


def read(path):
    return np.array(Image.open(path))


@pytest.fixture
def folder(tmp_path):
    """A folder with a calibration of OpenCV's fisheye model and a picture."""
    file = cv2.FileStorage(str(tmp_path / "fisheye.yaml"), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", SIZE[1])
    file.write("image_height", SIZE[0])
    file.write("fisheye_model", 1)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", D)
    file.release()
    save(tmp_path / "in" / "a.png", picture())
    return tmp_path


def run(folder, *options, source="in", calib="fisheye.yaml", out="out"):
    calib, source, out = (str(folder / name) for name in (calib, source, out))
    if calib.endswith("fisheye.yaml"):
        options = (*options, "--coefficients=fisheye")
    main(["lens", "undistort", calib, source, "--out", out, *map(str, options)])
    return folder / "out"


def test_a_perspective_view_is_that_of_opencv(folder, capsys):
    out = run(folder, "--fov", 100)  # an unambiguous beginning of --fov_deg
    assert "1 of 1 files, perspective view, 100° across, 128 × 96 px" in capsys.readouterr().out
    camera = lenses.load(out / "lens.json", dtype=torch.float64)
    assert math.isclose(camera.focal.item(), 64 / math.tan(math.radians(50)))
    f, (x, y) = camera.focal.item(), camera.center_in()[0].tolist()
    assert math.isclose(camera.theta_max.item(), math.atan(math.hypot(64, 48) / f), rel_tol=1e-6)
    new = np.array([[f, 0, x], [0, f, y], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), new, SIZE[::-1], cv2.CV_32FC1)
    expected = cv2.remap(picture(), *maps, cv2.INTER_LINEAR)
    found = read(out / "a.png")
    assert found.shape == (*SIZE, 3)
    assert np.abs(found.astype(int) - expected).max() <= 3  # remap rounds places to 1/32 px
    assert np.abs(found.astype(int) - expected).mean() < 0.5


def rays_by_hand(view, size, fov):
    """Unit rays of a view, by formulas other than the package's."""
    height, width = size
    v, u = np.mgrid[:height, :width]
    step = fov / width
    across, down = (u - (width - 1) / 2) * step, (v - (height - 1) / 2) * step
    if view == "cylindrical":
        rays = np.stack((np.tan(across), down / np.cos(across), np.ones_like(across)), -1)
        return rays * np.sign(np.cos(across))[..., None]
    if view == "equirectangular":
        return np.stack((np.tan(across), np.tan(down) / np.cos(across), np.ones_like(down)), -1)
    if view == "mercator":
        return np.stack((np.tan(across), np.sinh(down) / np.cos(across), np.ones_like(down)), -1)
    if view == "stereographic":  # z is 1 - tan²(θ/2), over 1 + tan²(θ/2)
        right, below = (2 * math.tan(fov / 4) / fov * side for side in (across, down))
        return np.stack((2 * right, 2 * below, 1 - right**2 - below**2), -1)
    a, b = (2 * u + 1) / width - 1, (2 * v + 1) / height - 1  # Shirley and Chiu's four triangles
    right = np.abs(a) > np.abs(b)
    with np.errstate(all="ignore"):
        phi = np.where(right, math.pi / 4 * b / a, math.pi / 2 - math.pi / 4 * a / b)
    radius = np.where(right, a, b)
    theta = fov / 2 * radius
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def shown_by_hand(image, view, size, fov, turn):
    """A view by OpenCV's fisheye model, turned by the rotation vector `turn` in degrees."""
    rotation = cv2.Rodrigues(np.radians(turn))[0]
    rays = rays_by_hand(view, size, fov).reshape(-1, 1, 3) @ rotation.T
    places, _ = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), K, D)
    places = np.where(rays[:, :, 2:] > 0.02, places, -10)
    return cv2.remap(image, places.reshape(*size, 2).astype(np.float32), None, cv2.INTER_LINEAR)


TURNS = {
    "": (0.0, 0.0, 0.0),
    "--yaw_deg=20": (0.0, 20.0, 0.0),
    "--pitch_deg=-15": (-15.0, 0.0, 0.0),
    "--up=0.5,-0.8660254,0": (0.0, 0.0, 30.0),  # the picture's top leans to the left
}
CURVED = ("cylindrical", "equirectangular", "mercator", "stereographic")


@pytest.mark.parametrize(("view", "option"), [*itertools.product(CURVED, TURNS), ("square", "")])
def test_other_views_are_those_of_their_formulas(folder, view, option):
    size = (60, 60) if view == "square" else (40, 72)
    options = [option] if option else []
    out = run(folder, f"--view={view}", "--fov_deg=100", *options, "--size", *size)
    expected = shown_by_hand(picture(), view, size, math.radians(100), TURNS[option])
    found = read(out / "a.png")
    assert found.shape == (*size, 3) and (found.min(-1) > 0).mean() > 0.5
    off = np.abs(found.astype(int) - expected).max(-1)
    assert (off <= 3).mean() > 0.99 and off.mean() < 0.5
    assert not (out / "lens.json").exists()


@pytest.mark.parametrize("view", CURVED)
def test_small_views_are_means_of_areas(folder, view):
    stripes = np.zeros((*SIZE, 3), np.uint8)
    stripes[:, ::2] = 255
    save(folder / "in" / "a.png", stripes)
    found = read(run(folder, f"--view={view}", "--fov_deg=80", "--size=14,20") / "a.png")
    fine = shown_by_hand(stripes, view, (14 * 16, 20 * 16), math.radians(80), TURNS[""])
    means = fine.reshape(14, 16, 20, 16, 3).mean((1, 3))
    single = shown_by_hand(stripes, view, (14, 20), math.radians(80), TURNS[""])
    assert np.abs(found - means).mean() < np.abs(single - means).mean() / 3


def test_a_panorama_of_a_camera_that_looks_down(folder):
    out = run(folder, "--view=panorama", "--up=0,0,-1", "--size=40,100")
    lens = lenses.load(folder / "fisheye.yaml", coefficients="fisheye").with_theta_max(None)
    view = make_view("panorama", (40, 100), up=(0, 0, -1))
    found, expected = read(out / "a.png"), view.at(lens, picture().shape[:2])(picture())
    assert np.abs(found.astype(int) - expected).max() <= 3
    seen = (found.max(-1) > 0).mean(0)
    assert (seen > 0.4).all()  # in every direction around


def test_the_views_show_all_that_the_picture_shows_by_default(folder, capsys):
    lens = Equidistant(50.0, image_size=SIZE)  # 146.7° in the row of the principal point
    (folder / "own.json").write_text(json.dumps(to_dict(lens) | {"theta_max": 64 / 50}))
    for view, fov, size in (
        ("perspective", 100, "128 × 96 px"),
        ("cylindrical", 146.7, "128 × 64 px"),
        ("equirectangular", 146.7, "128 × 96 px"),
        ("mercator", 146.7, "128 × 96 px"),
        ("stereographic", 146.7, "128 × 96 px"),
        ("panorama", 360, "128 × 43 px"),
        ("square", 146.7, "96 × 96 px"),
    ):
        run(folder, f"--view={view}", calib="own.json", out=view)
        assert f"{view} view, {fov}° across, {size}" in capsys.readouterr().out


def black(image):
    """The share of black pixels."""
    return (image.max(-1) == 0).mean()


def test_corners_are_shown_unless_the_calibration_ends_before(folder):
    """The picture's sides end at 64 px and its corners at 80 px from the principal point."""
    lens = Equidistant(64.0, image_size=SIZE)
    described = to_dict(lens)
    for theta_max, options, whole in (
        (lens.theta_max.item(), (), True),  # of the model
        (1.0, (), True),  # of the picture's sides, as every other format has it
        (0.9, (), False),
        (1.0, ("--theta_max_deg=50",), False),
    ):
        (folder / "own.json").write_text(json.dumps(described | {"theta_max": theta_max}))
        found = read(run(folder, "--fov=100", *options, calib="own.json") / "a.png")
        assert (black(found) == 0) == whole


@pytest.fixture
def mixed(folder):
    """Pictures and videos of many kinds in subfolders."""
    source = folder / "in"
    save(source / "front" / "grey.png", picture(channels=1))
    save(source / "front" / "a.png", picture()[::-1])
    save(source / "large.bmp", cv2.resize(picture(), (256, 192)))
    save(source / "b.jpg", picture(), quality=95)
    save(source / "name.ppm", picture())
    (source / "broken.png").write_bytes(b"no picture")
    (source / "empty.mp4").write_bytes(b"no video")
    save(source / "wide.png", picture((96, 200)))  # of another shape than the calibration
    write_video(source / "front" / "drive.mp4", 4, size=SIZE)
    write_video(source / "clip.mkv", 3, size=SIZE)
    return folder


def test_folders_are_undistorted_and_what_is_broken_is_named(mixed, capsys):
    with pytest.raises(SystemExit) as end:
        run(mixed)
    assert end.value.code == 2
    out, printed = mixed / "out", capsys.readouterr()
    assert "8 of 11 files, perspective view, in several sizes; their cal" in printed.out
    for name in ("broken.png", "empty.mp4", "wide.png"):
        assert name in printed.err
    assert "the calibration is for 128×96 (W×H) but the picture is 200×96" in printed.err
    files = {file.relative_to(out).as_posix() for file in out.rglob("*") if file.is_file()}
    assert files == {
        "a.png", "b.jpg", "large.bmp", "name.ppm.png", "clip.mkv", "front/a.png",
        "front/grey.png", "front/drive.mp4", "lens.json", "undistorted.json",
    }  # fmt: skip
    assert read(out / "front" / "grey.png").shape == SIZE
    np.testing.assert_array_equal(read(out / "front" / "grey.png"), read(out / "a.png")[..., 0])
    assert read(out / "large.bmp").shape == (192, 256, 3)
    small = cv2.resize(read(out / "large.bmp"), SIZE[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small[2:-2, 2:-2].astype(int) - read(out / "a.png")[2:-2, 2:-2]).mean() < 3
    cameras = Calibrations(out / "lens.json", out)
    for name, size in (("large.bmp", (192, 256)), ("front/a.png", SIZE), ("clip.mkv", SIZE)):
        camera = cameras.lens_of(out / name, size)
        assert math.isclose(
            camera.focal.item(), size[1] / 2 / math.tan(math.radians(50)), rel_tol=1e-5
        )


def test_pictures_turned_by_exif_are_turned_with_their_lens(folder):
    """The view of an upright picture is the turned view of the stored one."""
    for orientation in (1, 3, 6, 8):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        save(folder / "in" / f"{orientation}.png", picture(), exif=exif)
    out = run(folder, "--fov=80", "--size=64,64")
    plain = read(out / "1.png").astype(int)
    for orientation, turns in ((3, 2), (6, 3), (8, 1)):
        found = read(out / f"{orientation}.png")
        assert np.abs(np.rot90(plain, turns) - found).max() <= 1


def test_frames_of_videos_are_undistorted_as_pictures(folder):
    frames = write_video(folder / "in" / "drive.mp4", 5, size=(96, 128))
    for k, frame in enumerate(frames):
        save(folder / "in" / f"{k}.png", frame)
    out = run(folder, "--fov=100", "--size=71,91")
    found = list(read_frames(out / "drive.mp4"))
    assert [frame.number for frame in found] == [*range(5)] and math.isclose(found[2].time, 0.2)
    for k, frame in enumerate(found):
        assert frame.image.shape == (70, 90, 3)  # even
        expected = cv2.resize(read(out / f"{k}.png"), (90, 70))
        assert np.abs(frame.image.astype(int) - expected).mean() < 6


def test_turned_videos_are_undistorted_upright(folder):
    frames = write_video(folder / "in" / "turned.mp4", 2, size=SIZE)
    turn_video(folder / "in" / "turned.mp4", 90)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    save(folder / "in" / "turned.png", frames[1], exif=exif)
    out = run(folder)
    *_, last = read_frames(out / "turned.mp4")
    expected = read(out / "turned.png")
    assert last.image.shape == expected.shape == (128, 96, 3)
    assert np.abs(last.image.astype(int) - expected).mean() < 6


def test_of_a_video_that_is_cut_off_the_beginning_is_written(folder, capsys):
    path = folder / "in" / "cut.avi"
    write_video(path, 60, size=SIZE, codec="MJPG")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(SystemExit):
        run(folder)
    printed = capsys.readouterr()
    assert "cut.avi is damaged or cut off" in printed.err and "2 of 2 files" in printed.out
    assert 20 < len(list(read_frames(folder / "out" / "cut.avi"))) < 40


def test_an_interrupted_video_leaves_no_file(folder, monkeypatch):
    write_video(folder / "in" / "drive.mp4", 5, size=SIZE)
    (folder / "in" / "a.png").unlink()

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    real = module._Views.of
    calls = []

    def third(self, *arguments, **options):
        calls.append(arguments)
        return interrupted() if len(calls) == 3 else real(self, *arguments, **options)

    monkeypatch.setattr(module._Views, "of", third)
    with pytest.raises(SystemExit, match="130"):
        run(folder)
    assert [file.name for file in (folder / "out").iterdir()] == ["undistorted.json"]


def test_a_second_run_replaces_the_first_and_nothing_else(folder, capsys):
    out = run(folder)
    (out / "notes.txt").write_text("mine")
    first = read(out / "a.png")
    run(folder, "--view=square")
    assert read(out / "a.png").shape == (96, 96, 3) != first.shape
    assert (out / "notes.txt").exists() and not (out / "lens.json").exists()


def test_one_plan_serves_all_pictures_of_one_size(mixed, monkeypatch):
    planned = []
    real = module._Views._planned
    monkeypatch.setattr(module._Views, "_planned", lambda *a: planned.append(a[2:]) or real(*a))
    with pytest.raises(SystemExit):
        run(mixed)
    assert sorted(planned) == [(SIZE, False), (SIZE, True), ((192, 256), False)]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["in", "--fov=180"], "--fov_deg must be above 0° and at most 179.9° for a pers"),
        (["in", "--view=square", "--fov=361"], "at most 360° for a square view"),
        (
            ["in", "--view=square", "--yaw_deg=20"],
            "--yaw_deg must be 0 for a square view, which looks along the optical axis, got 20",
        ),
        (["in", "--view=square", "--up=0,-1,0"], "--up must be left out for a square view"),
        (["in", "--view=panorama", "--fov=300"], "--fov_deg must be 360° for a panorama view"),
        (["in", "--view=fisheye"], "--view must be one of cylindrical, equirectangular"),
        (["in", "--yaw_deg=400"], "--yaw_deg must be from -360° to 360°, got 400"),
        (["in", "--theta_max_deg=0"], "--theta_max_deg must be above 0°"),
        (["in", "--size=0,9"], "--size must be at least 2,2"),
        (["in", "--size=100000,100000"], "--size must be at least 2,2 and at most"),
        (["in", "--view=square", "--size=40,41"], "--size must be square for this view"),
        ([], "missing pictures or videos"),
        (["nothing"], "nothing"),
        (
            ["in/a.png", "--out=in"],
            "--out must be a folder without the originals, but has in/a.png",
        ),
        (["in", "--out=/proc/x"], "--out must be a folder that can be written, got /proc/x"),
        (["in", "--out=."], "--out must be a folder without the originals, but has in"),
        (["in", "--out=in"], "--out must be a folder without the originals, but has in"),
        (["more", "--out=more/own"], "no pictures or videos in more, apart from those of --out"),
        (["in", "--out=more"], "--out more holds other files"),
        (["in", "out/a.png"], "--out must be a folder without the originals, but has out/a.png"),
    ],
)
def test_misuse_is_refused_before_any_work(folder, capsys, monkeypatch, options, said):
    monkeypatch.chdir(folder)
    save(Path("out/a.png"), picture())
    (folder / "out" / "undistorted.json").write_text("[]")
    save(Path("more/own/b.png"), picture())
    before = (folder / "out" / "a.png").read_bytes()
    if not any(option.startswith("--out") for option in options):
        options = [*options, "--out=out"]
    with pytest.raises(SystemExit):
        main(["lens", "undistort", "fisheye.yaml", *options, "--coefficients=fisheye"])
    assert said in capsys.readouterr().err
    assert (folder / "out" / "a.png").read_bytes() == before


def test_options_may_stand_between_the_arguments(folder):
    main(["lens", "undistort", str(folder / "fisheye.yaml"), "--out", str(folder / "out"),
          "--coefficients", "fisheye", str(folder / "in")])  # fmt: skip
    assert (folder / "out" / "a.png").exists()


# -- crop -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--box=3,10,80,90"], lambda lens: lens.cropped(3, 10, 80, 90)),
        (["--box", "-8", "-8", "112", "144"], lambda lens: lens.cropped(-8, -8, 112, 144)),
        (["--size=48,64"], lambda lens: lens.resized((48, 64))),
        (["--box=0,16,96,96", "--size=32,32"],
         lambda lens: lens.cropped(0, 16, 96, 96).resized((32, 32))),
    ],
)  # fmt: skip
@pytest.mark.parametrize("out", ["new.json", "new.yaml"])
def test_crop_writes_the_lens_of_cropped_pictures(folder, capsys, options, expected, out):
    calib, new = str(folder / "fisheye.yaml"), folder / out
    main(["lens", "crop", calib, str(new), *options, "--coefficients=fisheye"])
    assert "KannalaBrandt" in capsys.readouterr().out
    exact = dict(dtype=torch.float64)
    lens = expected(lenses.load(calib, coefficients="fisheye", **exact))
    found = lenses.load(new, theta_max=lens.theta_max.item(), **exact)
    assert torch.equal(found.image_size, lens.image_size)
    theta = torch.linspace(0, 1, 9, dtype=torch.float64)
    torch.testing.assert_close(found.project_rays(theta, 0.3), lens.project_rays(theta, 0.3))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "missing --box or --size"),
        (["--box=0,0,0,9"], "--box must be from 1 to 1000000 px"),
        (["--box=96,0,9,9"], "--box must be a part of the picture of 128 × 96 px (W × H)"),
        (["--box=0,-9,9,9"], "--box must be a part of the picture"),
        (["--size=0,9"], "--size must be from 1 to 1000000 px"),
        (["--box=1,2,3"], "--box must be 4 whole numbers"),
    ],
)
def test_wrong_crops_are_refused(folder, capsys, options, said):
    arguments = [str(folder / "fisheye.yaml"), str(folder / "new.json")]
    with pytest.raises(SystemExit):
        main(["lens", "crop", *arguments, *options, "--coefficients=fisheye"])
    assert said in capsys.readouterr().err and not (folder / "new.json").exists()
