"""Calibration files with random changes: each gives the lens that it describes, or an error."""

import math
import random
import re
from pathlib import Path

import hypothesis
import pytest
import torch
from helpers import few_calls
from hypothesis import strategies as st
from lens_examples import FILES

from darswin.lens import load

# A camera of each file, and the place of its numbers in the file.
CAMERAS = [
    ("woodscape.json", None, r'"intrinsic": .*?}'),
    ("kitti360_02.yaml", None, r"mirror_parameters.*"),
    ("camodocal_kb.yaml", None, r"projection_parameters.*"),
    ("camodocal_pinhole.yaml", None, r"distortion_parameters.*"),
    ("camodocal_scaramuzza.yaml", None, r"p0: -2.8.*?(?=inv_poly)|affine_parameters.*"),
    ("kalibr_tumvi.yaml", "cam1", r"cam1:.*?(?=resolution)"),
    ("kalibr_fov.yaml", "cam0", r"cam0:.*?(?=resolution)"),
    ("kalibr_fov.yaml", "cam2", r"cam2:.*?(?=resolution)"),
    ("kalibr_omni.yaml", None, r"cam0:.*?(?=resolution)"),
    ("kalibr_ds.yaml", None, r"cam0:.*?(?=resolution)"),
    ("ros_fisheye.yaml", None, r"camera_matrix.*?(?=rectification)"),
    ("ros_plumb_bob.yaml", None, r"camera_matrix.*"),
    ("ros2_echo.yaml", None, r"\nd:.*?(?=\nr:)"),
    ("opencv_fisheye.yaml", None, r"camera_matrix.*?(?=avg)"),
    ("opencv_omnidir.xml", None, r"<camera_matrix.*"),
    ("opencv_stereo.json", "2", r'"M2".*(?="R")'),
    ("ocamcalib.txt", None, r"(?<=5 )-2.885.*?\n|#center.*?(?=#image size)"),
    ("colmap.txt", None, r"OPENCV_FISHEYE.*"),
    ("colmap_all.txt", "12", r"(?<=12 RAD_TAN_THIN_PRISM_FISHEYE 640 480 ).*?\n"),
    ("colmap_all.txt", "17", r"(?<=17 DIVISION 640 480 ).*?\n"),
    ("nerfstudio.json", None, r'"fl_x".*?(?="camera_model")'),
    ("nerfstudio_frames.json", "images/3.png", r'"k1".*?(?="frames")|(?<=3.png", ).*?(?="w")'),
    ("basalt.json", "cam3", r'"kb4".*?}'),
    ("basalt.json", "cam4", r'"pinhole-radtan8".*?(?="rpmax")'),
    ("ours.json", None, r'"radial".*?(?="image_size")'),
    ("ours_degrees.json", None, r'"xi": .*?,|"center".*?(?="image_size")'),
    ("instant_ngp.json", None, r'"fl_x".*?(?="p1")|"cx".*?(?="w")'),
]  # fmt: skip
# 5 in `make test`; 4,000 in `make fuzz`, 100,000 in all.
FILES_A_CAMERA = n // 6 if (n := hypothesis.settings().max_examples) <= 30 else 2 * n
IDS = [f"{name}-{camera}" for name, camera, _ in CAMERAS]
NUMBER = re.compile(rb"(?<![\w.])[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?![\w.])")


def tokens(data: bytes) -> list[re.Match]:
    """The numbers of a text, without its comments."""
    blank = re.sub(rb"(?m)(^|\s)#.*$|(?s:<!--.*?-->)", lambda m: b" " * len(m[0]), data)
    return list(NUMBER.finditer(blank))


def of_camera(name: str, place: str) -> tuple[bytes, list[re.Match]]:
    """A file, and its camera's distinctive numbers: not 0, and with at least two digits."""
    data = FILES.joinpath(name).read_bytes()
    blocks = re.finditer(place.encode(), data, re.DOTALL)
    found = [m for block in blocks for m in NUMBER.finditer(data, *block.span())]
    told = [m for m in found if float(m[0]) and len(re.sub(rb"e.*|\D", b"", m[0]).strip(b"0")) > 1]
    return data, told


def numbers_of(lens) -> torch.Tensor:
    """All numbers of a lens, in our convention and in those of the files."""
    values = lens._tensors()
    found = [value[0] for value in values.values()]
    center = lens.center_in((1, 1))[0]
    found += [center + 0.5]
    if lens.image_size is not None:
        found += [center + 0.5 - lens.image_size[0].flip(0) / 2]
    if lens.affine is not None and "focal" in values:
        found += [lens.focal[0] * lens.affine[0]]
    if "beta" in values:
        found += [lens.beta[0] / -4]  # COLMAP's division model
    return torch.cat([value.reshape(-1) for value in found])


def in_message(data: bytes) -> list[bytes]:
    """The numbers of a ROS message for binning and the region of interest."""
    return NUMBER.findall(data[data.find(b"binning_x") :]) if b"binning_x" in data else []


def missing(lens, expected: list[float]) -> list[float]:
    found = numbers_of(lens)
    return [x for x in expected if not ((found - x).abs() <= 1e-9 * abs(x) + 1e-13).any()]


def read(path: Path, camera: str | None):
    """The lens, or None after an error in one line; with little work."""
    try:
        with few_calls(1_000_000):
            return load(path, camera=camera, dtype=torch.float64)
    except ValueError as error:
        message = str(error)
        assert f"calibration {path}: " in message and len(message) < 1200 and "\n" not in message
        return None


@pytest.mark.parametrize(("name", "camera", "place"), CAMERAS, ids=IDS)
def test_every_number_of_a_camera_counts(name, camera, place, tmp_path):
    data, told = of_camera(name, place)
    path = tmp_path / "file"
    path.write_bytes(data)
    assert len(told) > 2 and not missing(read(path, camera), [float(m[0]) for m in told])
    for matches in (told, *([match] for match in told)):  # all at once, or else one by one
        wrong, others = data, [f"{float(match[0]) * 1.0137:.9g}".encode() for match in matches]
        for match, other in reversed([*zip(matches, others, strict=True)]):
            wrong = wrong[: match.start()] + other + wrong[match.end() :]
        path.write_bytes(wrong)
        changed = read(path, camera)
        assert changed is None or not missing(changed, [float(other) for other in others])
        if changed is not None and matches is told:
            return


VALUES = (
    "abc", "NaN", ".nan", "Infinity", "-.inf", "-1", "0", "1e308", "-1e308", "1e-308", "1e30",
    "1e6", "9" * 400, "-" + "9" * 5000, "[]", "{}", "[[1]]", "[" * 50, '{"a": 1}', "null", "~",
    "true", '""', "''", "!!python/object/apply:os.system [ls]", "&a", "*a", "\x00", "é", "1 2",
    "1,2", "0x10", "1_000", "٣.٥",
)  # fmt: skip
NAMES = ("x", "k", "K", "D", "k1", "k7", "p1", "coeffs", "D0", "dist", "camera_model", "model",
         "intrinsics", "xi", "abcdef", "image_size", "data", "rows")  # fmt: skip
NOTATIONS = (
    lambda text: text.encode("utf-16"), lambda text: text.encode("utf-8-sig"),
    lambda text: ("é" + text).encode("latin-1", "replace"),
    lambda text: text.replace("\n", "\r\n").encode(), lambda text: text.replace("-", "−").encode(),
    lambda text: text.replace(" ", "\t").encode(), lambda text: text.replace(".", ",").encode(),
    lambda text: (text + text).encode(), lambda text: (text + "\n---\n").encode(),
)  # fmt: skip


def scaled(old, rng):
    """The text with every number multiplied by one factor."""
    factor = rng.choice((-1, 0.1, 10, 1e3, 1e-3, 1e9)) * rng.uniform(0.9, 1.1)
    return NUMBER.sub(lambda match: f"{float(match[0]) * factor:.9g}".encode(), old)


def digit(old, rng):
    place = rng.randrange(len(old))
    return old[:place] + str(rng.randrange(10)).encode() + old[place + 1 :]


def nested(old, rng):
    left, right = rng.choice(((b"[", b"]"), (b'"', b'"'), (b"[[", b"]]"), (b'{"a": ', b"}")))
    return left + old + right


def renamed(old, rng):
    return rng.choice((rng.choice(NAMES).encode(), old + b"2", old[1:], old.upper(), b"_" + old))


def repeated(old, rng):
    """Nothing, or the text twice, perhaps with other numbers."""
    return rng.choice((b"", old + old, old + b" " + scaled(old, rng)))


NAME, LINE = rb"[A-Za-z_]\w*(?=\"?\s*[:>])", rb".*\n"
ENTRY, PIECE = rb"[\"\w]+\s*:\s*" + NUMBER.pattern + rb",?", rb"(?s).{1,20}"
# A pattern, and a function that changes one match of it.
MUTATIONS = (
    (NUMBER, lambda old, rng: rng.choice(VALUES).encode()), (NUMBER, scaled), (NUMBER, scaled),
    (NUMBER, digit), (NUMBER, digit), (NUMBER, nested), (NAME, renamed), (NAME, renamed),
    (LINE, repeated), (ENTRY, repeated), (PIECE, repeated),
    (rb"(?s).", lambda old, rng: bytes([old[0] ^ (1 << rng.randrange(8))])),
    (rb"(?s).+", lambda old, rng: old[: rng.randrange(len(old))]),
    (rb"(?s).+", lambda old, rng: rng.choice(NOTATIONS)(old.decode(errors="replace"))),
)  # fmt: skip


def mutated(data: bytes, rng: random.Random) -> bytes:
    """A file with one change, or sometimes several."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        pattern, new = rng.choice(MUTATIONS)
        if places := list(re.finditer(pattern, data)):
            match = rng.choice(places)
            data = data[: match.start()] + new(match[0], rng) + data[match.end() :]
    return data


@pytest.mark.parametrize(("name", "camera", "place"), CAMERAS, ids=IDS)
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
@hypothesis.settings(max_examples=FILES_A_CAMERA)
def test_a_mutated_file_gives_the_lens_that_it_says_or_a_clear_error(
    name, camera, place, tmp_path_factory, seed
):
    data, told = of_camera(name, place)
    wrong = mutated(data, random.Random(seed))
    path = tmp_path_factory.getbasetemp() / "mutated"
    path.write_bytes(wrong)
    lens = read(path, camera)
    if lens is None:
        return
    assert 0 < lens.theta_max.item() <= math.pi
    theta = lens.theta_max * torch.linspace(0, 1, 9, dtype=torch.float64)
    assert lens.project_rays(theta, torch.linspace(-3, 3, 9), (9, 9)).isfinite().all()
    if in_message(wrong) != in_message(data):  # they change the other numbers
        return
    # The camera's numbers that are still in the file, and the new one of a changed number.
    before, after = ([match[0] for match in tokens(text)] for text in (data, wrong))
    if len(after) > len(before):  # a copied number may have a name without a meaning
        return
    expected = [m[0] for m in told if after.count(m[0]) >= before.count(m[0])]
    if len(before) == len(after):
        changed = [i for i, pair in enumerate(zip(before, after, strict=True)) if len({*pair}) > 1]
        starts = {match.start() for match in told}
        if len(changed) == 1 and tokens(data)[changed[0]].start() in starts:
            expected.append(after[changed[0]])
    numbers = [float(number) for number in expected]
    assert not missing(lens, [x for x in numbers if x and math.isfinite(x)]), wrong.decode()
