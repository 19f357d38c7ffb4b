"""Every block of code on README and the pages runs as it stands there.

Python runs, a page's blocks in order and in one namespace, those of README and answers.md each in
its own; so do commands of `darswin`, on few pictures for one epoch. What would install something or
take hours is checked against what declares it: the Makefile, pyproject.toml, the programs' own
parsers.
"""

import ast
import importlib.util
import json
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from helpers import fixture
from packaging.requirements import Requirement
from scenes import write_classes, write_outlines, write_plain, write_woodscape
from videos import write_video

from darswin import frames, lens
from darswin.cli.main import main
from darswin.lens.rig import CUBES
from darswin.viz.report import largest_offset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "studies"))


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
ALONE = ("README.md", "answers.md")  # each of their blocks runs without the ones before it
FENCE = re.compile(r"^(`{3,}|:{3,})(\S*)[^\n]*\n(.*?)^\1$", re.M | re.S)
DIRECTIVES = {"{toctree}", "{eval-rst}", "{include}", "{warning}"}  # Sphinx builds these
QUICK = [
    *("--data.limit", "40", "--data.batch_size", "8", "--data.workers", "0"),
    *("--trainer.max_epochs", "1", "--trainer.logger", "false"),
    *("--trainer.enable_progress_bar", "false"),
]


class Block(NamedTuple):
    language: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(match[2], match[3]) for match in FENCE.finditer(page.read_text())]


CODE = [page for page in PAGES if {block.language for block in blocks(page)} & {"python", "sh"}]


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_every_block_is_of_a_kind_that_is_checked():
    for page in PAGES:
        text, found = page.read_text(), blocks(page)
        for block in found:
            assert block.language in {"python", "sh", "json"} | DIRECTIVES, (page, block)
            if block.language == "json":
                json.loads(block.text)
        assert len(re.findall(r"^(?:```|:::)", text, re.M)) == 2 * len(found), page
    assert len(CODE) > 12


@pytest.fixture(scope="module")
def granted(tmp_path_factory):
    """A folder with what pages take for granted: a checkout's examples, photos, scenes, weights."""
    folder = tmp_path_factory.mktemp("granted") / "folder"
    folder.mkdir()
    for name in ("examples", "darswin", "studies"):
        (folder / name).symlink_to(ROOT / name)
    picture = write_classes(folder / "photos")
    for name in ("a.jpg", "b.jpg"):
        cv2.imwrite(str(folder / name), picture)
    (folder / "faces").mkdir()
    for name in CUBES["carla"]:
        cv2.imwrite(str(folder / "faces" / f"{name}.png"), cv2.resize(picture, (64, 64)))
    write_plain(folder / "garage", 20, split="train")
    write_plain(folder / "garage", 4, split="val")
    write_woodscape(folder / "woodscape", 20)
    write_outlines(folder / "objects")
    torch.save(fixture("polar")[1], folder / "checkpoint.pth")
    return folder


@pytest.fixture
def scratch(granted, tmp_path, monkeypatch):
    """A copy of it for each page, which runs there."""
    shutil.copytree(granted, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("page", CODE, ids=page_name)
def test_code_runs_as_it_stands(page, scratch, monkeypatch):
    scope, left = {}, []
    for block in blocks(page):
        if "import openvino" in block.text and importlib.util.find_spec("openvino") is None:
            continue  # it is in no extra
        if block.language == "python":
            scope = {} if page.name in ALONE else scope
            run_python(block.text, scope)
            left.append(scope.copy())
        elif block.language == "sh":
            for command in commands(block.text):
                PROGRAMS[command[0]](command[1:], monkeypatch)
    if page.stem in RESULTS:
        RESULTS[page.stem](*left)


def run_python(text: str, scope: dict) -> None:
    """Runs a block, and holds each `x = …  # (2, 3)` against the shape of x."""
    exec(compile(text, "<page>", "exec"), scope)
    lines, shapes = text.splitlines(), {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            said = re.search(r"# \((\d+(?:, \d+)*)\)", lines[node.end_lineno - 1])
            shapes[node.targets[0].id] = said and tuple(map(int, said[1].split(", ")))
    for name, shape in shapes.items():
        assert shape is None or tuple(scope[name].shape) == shape, name


def commands(text: str) -> list[list[str]]:
    """The words of each line, `\\` at the end of one joining it with the next."""
    return [shlex.split(line) for line in text.replace("\\\n", " ").splitlines() if line.strip()]


def run_darswin(arguments: list[str], monkeypatch) -> None:
    command, *options = arguments
    main([command, *options, *(QUICK if command == "fit" else ())])


def check_make(targets: list[str], monkeypatch) -> None:
    declared = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.M))
    assert set(targets) <= declared


def check_pip(arguments: list[str], monkeypatch) -> None:
    """Extras must be declared, and packages be what building or an extra asks for."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = content["project"]["optional-dependencies"]
    asked = [*content["build-system"]["requires"], *(p for e in extras.values() for p in e)]
    names = {Requirement(requirement).name for requirement in asked}
    assert arguments[0] == "install"
    for word in arguments[1:]:
        if word.startswith("."):
            assert {*filter(None, word[2:-1].split(","))} <= extras.keys(), word
        elif word not in ("--no-build-isolation", "-e", "-U"):
            assert Requirement(word).name in names, word


def check_export(arguments: list[str], monkeypatch) -> None:
    """The build must read the variable."""
    (name, value) = arguments[0].split("=")
    assert f'os.environ.get("{name}") == "{value}"' in (ROOT / "setup.py").read_text()


def check_study(arguments: list[str], monkeypatch) -> None:
    """Its own options are read as it reads them, the others as `darswin fit` does."""
    program, asked = importlib.import_module(Path(arguments[0]).stem), []
    monkeypatch.setattr(program, "run_all", lambda _, jobs, *rest: asked.extend(jobs) or [])
    monkeypatch.setattr(program, "collect", lambda *results: None)
    if program.__name__ == "dense":
        monkeypatch.setattr(program.dense_data, "make", lambda *pictures: None)
    program.main(arguments[1:])
    *_, options = asked[0]
    with pytest.raises(SystemExit) as end:
        main(["fit", "--run", "runs/parsed", "--data.path", "digits", *options, "--print_config"])
    assert end.value.code in (0, None)


def check_cmake(arguments: list[str], monkeypatch) -> None:
    """Tests of the deployment build what this block builds."""
    if arguments[0] == "-S":
        assert (ROOT / arguments[1] / "CMakeLists.txt").is_file() and arguments[2] == "-B"


def check_classify(arguments: list[str], monkeypatch) -> None:
    """The files were written by the page, and the answer is the one it prints."""
    assert all(Path(file).is_file() for file in arguments)
    package, picture = arguments
    pixels = torch.from_numpy(cv2.imread(picture, cv2.IMREAD_GRAYSCALE))[None, ..., None]
    probability, label = torch._inductor.aoti_load_package(package)(pixels).softmax(1).max(1)
    shown = f"class {label.item()}, probability {probability.item():.3f}"
    assert shown in (ROOT / "docs/tutorials/deploy.md").read_text()


def check_frame(arguments: list[str], monkeypatch) -> None:
    """The files were written by the page, and fit each other."""
    network, picture = arguments
    assert frames.Network(network)(cv2.imread(picture)[..., ::-1]).ndim == 1


def write_stand_in(file: str) -> None:
    """The stand-in of the tutorial, in place of the detector that its program would fetch."""
    page, scope = blocks(ROOT / "docs/tutorials/detector.md"), {}
    (text,) = (block.text for block in page if "class StandIn" in block.text)
    run_python(text, scope)
    torch.onnx.export(
        scope["StandIn"]().eval(), (torch.zeros(1, 3, 512, 512),), file, input_names=["images"],
        output_names=["boxes", "scores", "labels"], external_data=False,
    )  # fmt: skip


def check_opens(arguments: list[str], monkeypatch) -> None:
    """The page has written what its reader is to look at."""
    assert cv2.imread(*arguments) is not None


def run_program(arguments: list[str], monkeypatch) -> None:
    """Runs the program that the page names, on a few pictures or on a video of the camera."""
    program = arguments[0]
    if program == "studies/pretrained_detector.py":
        write_stand_in(arguments[1])
        return
    if program in ("studies/study.py", "studies/dense.py"):
        check_study(arguments, monkeypatch)
        return
    assert program in ("examples/camera.py", "examples/rooms.py", "studies/calibrate_boards.py")
    if program == "examples/camera.py":
        write_video(Path(arguments[1]), count=3, size=(966, 1280))
    few = ["--count", "12"] if program == "examples/rooms.py" else []
    monkeypatch.setattr(sys, "argv", [*arguments, *few])
    runpy.run_path(program, run_name="__main__")


PROGRAMS: dict[str, Callable] = {
    "build/classify/classify": check_classify,
    "build/cpp/frame": check_frame,
    "cmake": check_cmake,
    "darswin": run_darswin,
    "export": check_export,
    "make": check_make,
    "pip": check_pip,
    "python": run_program,
    "xdg-open": check_opens,
}


# -- the namespaces that the blocks of some pages leave, one for each ---------------------------


def check_sampling(*after: dict) -> None:
    """The drop-in gives the values of what it replaces."""
    scope = next(scope for scope in after if "polar" in scope)
    torch.testing.assert_close(scope["polar"], scope["by_mesh"], rtol=0, atol=1e-4)


def check_detector(*after: dict) -> None:
    """A detector finds the same with torch, without it and by the command."""
    *_, scope = after
    with_torch = scope["found"]["boxes"][scope["found"]["scores"] > 0.3]
    alone = scope["best"].boxes
    (entry,) = json.loads(Path("found/predictions.json").read_text())
    by_command = [found["box"] for found in entry["detections"]]
    assert len(by_command) > 3 and entry["detections"][0]["score"] > 0.5
    # At the border of what the lens sees, a plan ends where the last point of a box is in it.
    np.testing.assert_allclose(alone, with_torch, atol=1.5)
    np.testing.assert_allclose(by_command, with_torch, atol=0.02)
    drawn = [cv2.imread(name) for name in ("found.jpg", "without_torch.jpg")]
    assert all(np.abs(one - cv2.imread("examples/parking.jpg")).max() > 100 for one in drawn)


def check_yolo(*after: dict) -> None:
    """One command finds things on both cameras, and both data sets have labels in tiles."""
    pictures = json.loads(Path("found/predictions.json").read_text())
    assert len(pictures) == 2 and all(picture["detections"] for picture in pictures)
    for name in ("left", "right"):
        assert any(file.read_text() for file in Path(f"training/{name}/labels").rglob("*.txt"))


def check_answers(*answers: dict) -> None:
    """The answers have the numbers that their comments tell."""
    opencv, kitti, remap, woodscape, depth, grid, own = answers
    assert opencv["wrong"].flat[0] == pytest.approx(82, abs=0.5)
    assert opencv["right"][0, 0] == pytest.approx(1282, abs=0.5)
    assert opencv["view"].any((0, 2)).all()  # no column is black: 190° are all there
    assert kitti["error"].item() == pytest.approx(0.09, abs=0.005)
    exact = kitti["mei"]
    left_out = largest_offset(exact)
    assert left_out == pytest.approx(0.6, abs=0.05)
    for file, most in (("omnidir.yaml", 1e-3), ("fisheye.yaml", left_out + kitti["error"].item())):
        written = lens.load(file, theta_max=exact.theta_max.item())
        assert isinstance(written, lens.Mei if most < 0.01 else lens.KannalaBrandt)
        pixels = 1400 * torch.rand(1, 1000, 2)
        there = written.project_rays(*exact.unproject_pixels(pixels))
        assert (there - pixels).norm(dim=-1).nan_to_num().max() < most
    wrong = np.abs(remap["exact"].astype(int) - remap["rounded"]).max(-1)
    assert remap["worst"] == wrong.max() == 4 and 1 / 7 < (wrong > 0).mean() < 1 / 5
    assert woodscape["error"].item() == pytest.approx(0.22, abs=0.005)
    y, x, z = depth["y"], depth["x"], depth["z"][0]
    assert z[486, 641] == pytest.approx(2) and z[y, x] == pytest.approx(-0.35, abs=0.005)
    seen = lens.pixel_rays(depth["wide"], z.shape)[0].isfinite()
    torch.testing.assert_close(depth["back"][seen], torch.full((seen.sum(),), 2.0))
    torch.testing.assert_close(grid["polar"], grid["same"], rtol=0, atol=1e-5)
    with pytest.raises(NotImplementedError, match="not implemented for 'Byte'"):
        torch.nn.functional.grid_sample(
            grid["picture"].movedim(-1, 1), torch.zeros(1, 2, 2, 2), align_corners=False
        )
    assert len(own["lenses"]) == len(own["images"]) and own["images"].shape[1:] == (3, 32, 32)


RESULTS: dict[str, Callable] = {
    "answers": check_answers,
    "detector": check_detector,
    "sampling": check_sampling,
    "yolo": check_yolo,
}
