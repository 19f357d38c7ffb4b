import json
import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from darswin.__main__ import main
from darswin.lens import Mei, Polynomial, Spherical, from_dict, to_dict
from darswin.lens.report import best_spacing, describe, largest_offset, patches, pixels_per_degree

WOODSCAPE = Polynomial(
    [339.749, -31.988, 48.275, -7.201], math.radians(95), [643.442, 479.407],
    image_size=(966, 1280),
)  # fmt: skip
KITTI_360 = Mei(
    2.2134047507854890, 1336.3220825849971, (0.016798235660113681, 1.6548773243373522),
    math.radians(102), (716.943235, 705.764983), image_size=(1400, 1400),
    tangential=(4.2223943394772046e-4, 4.2462134260997584e-4),
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "front.json").write_text(json.dumps(to_dict(WOODSCAPE)))
    picture = np.random.default_rng(0).integers(256, size=(483, 640, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "front.png"), picture)
    return tmp_path


def test_show_writes_a_figure(folder, capsys):
    calib, picture = str(folder / "front.json"), str(folder / "front.png")
    out = folder / "new" / "figure.png"
    main(["lens", "show", calib, picture, "--out", str(out), "--rings=4", "--sectors=8",
          "--samples=[3,2]", "--view=cylindrical", "--yaw_deg=20", "--spacing=g"])  # fmt: skip
    assert capsys.readouterr().out == f"{out}\n"
    assert cv2.imread(str(out)).shape == (1080, 1800, 3)


def test_show_takes_a_picture_of_the_same_shape_only(folder):
    calib = str(folder / "front.json")
    cv2.imwrite(str(folder / "square.png"), np.zeros((400, 400, 3), np.uint8))
    with pytest.raises(SystemExit, match="pictures of 966×1280 px, and 400×400 is"):
        main(["lens", "show", calib, str(folder / "square.png")])
    with pytest.raises(SystemExit, match=r"^darswin: cannot read none.png: No such file[^(]*$"):
        main(["lens", "show", calib, "none.png"])


def test_info_prints_what_the_lens_is(folder, capsys):
    main(["lens", "info", str(folder / "front.json")])
    printed = capsys.readouterr().out
    assert "1280 × 966 px" in printed and "339.749, -31.988" in printed
    main(["lens", "info", str(folder / "front.json"), "--theta_max_deg=60", "--rings=8"])
    printed = capsys.readouterr().out
    assert "60.00° (1.04720 rad)" in printed and "of 8 × 64 tokens" in printed


def test_convert_fits_and_writes(folder, capsys):
    out = folder / "kb.json"
    main(["lens", "convert", str(folder / "front.json"), str(out), "--model", "KannalaBrandt"])
    printed = capsys.readouterr().out
    fitted = json.loads(out.read_text())
    assert fitted["model"] == "KannalaBrandt" and "KannalaBrandt up to 95.00°, at most" in printed
    lens = from_dict(fitted)
    theta = torch.linspace(0, math.radians(95), 20)
    torch.testing.assert_close(lens.project(theta), WOODSCAPE.project(theta), rtol=0, atol=0.5)
    main(["lens", "convert", str(folder / "front.json"), str(out)])
    assert json.loads(out.read_text())["model"] == "Polynomial"


def test_errors_are_one_line(folder):
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*$"):
        main(["lens", "info", str(folder / "none.json")])
    (folder / "wrong.json").write_text('{"model": "Spherical"}')
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*$"):
        main(["lens", "info", str(folder / "wrong.json")])
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*model[^\n]*$"):
        main(["lens", "convert", str(folder / "front.json"), "out.json", "--model", "Sfera"])


def test_it_does_not_need_lightning(folder):
    script = (
        "import sys\n"
        "for name in ('lightning', 'torchmetrics', 'tensorboard', 'sklearn'):\n"
        "    sys.modules[name] = None\n"
        "from darswin.__main__ import main\n"
        f"main(['lens', 'info', {str(folder / 'front.json')!r}])\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_pixels_per_degree_are_those_between_neighbours():
    lens = KITTI_360.to(torch.float64)
    theta = torch.tensor([0.0, 0.5, 1.7], dtype=torch.float64)
    along, around = pixels_per_degree(lens, theta)
    step = math.radians(1e-4)
    torch.testing.assert_close(
        along, (lens.project(theta + step) - lens.project(theta - step)) / 2e-4, rtol=1e-5, atol=0
    )
    # Two rays that are a small angle apart on a cone of half angle θ.
    torch.testing.assert_close(around[0], along[0])
    apart = lens.project(theta)[1:] * step / (torch.sin(theta[1:]) * step * 180 / math.pi)
    torch.testing.assert_close(around[1:], apart)


def test_field_of_view_and_sides():
    text = describe(WOODSCAPE)
    sides = WOODSCAPE.to(torch.float64).side_angles()[0].rad2deg().tolist()
    assert f"{sides[0] + sides[2]:.2f}° across, {sides[1] + sides[3]:.2f}° down" in text
    for side, angle in zip(("left", "top", "right", "bottom"), sides, strict=True):
        assert f"{side} {angle:.2f}°" in text
    assert "between the corners" in text
    assert "the lens ends before the corners" in describe(KITTI_360)
    with pytest.raises(ValueError, match="needs the image_size"):
        describe(Spherical(0.5, 100.0))
    assert "640 × 480 px" in describe(Spherical(0.5, 100.0), (480, 640))


def test_tangential_size():
    assert largest_offset(WOODSCAPE) == 0 and "tangential" not in describe(WOODSCAPE)
    theta = KITTI_360.theta_max
    azimuth = torch.linspace(0, 2 * math.pi, 721)
    radial = KITTI_360.replace(tangential=None)
    apart = KITTI_360.project_rays(theta, azimuth) - radial.project_rays(theta, azimuth)
    largest = apart.norm(dim=-1).max().item()
    assert largest_offset(KITTI_360) == pytest.approx(largest, rel=1e-3)
    assert f"{largest:.2f} px at most, by tangential" in describe(KITTI_360)


def test_spacings():
    text = describe(WOODSCAPE)
    assert "tan θ ends at 90°" in text
    narrow = Spherical.from_fov(0.5, 2.0, 100.0, image_size=(200, 200))
    assert "tan θ ends" not in describe(narrow)
    # Equal steps of the radius: the areas of the rings are as 1, 3, 5, …
    found = patches(narrow, "radius", 16, 64)
    assert found.ratio == pytest.approx(31, rel=1e-3)
    assert found.width == pytest.approx((100 / 16, 100 / 16), rel=1e-3)
    assert found.area[0] == pytest.approx(math.pi * (100 / 16) ** 2 / 64, rel=1e-3)
    ratios = {s: patches(narrow, s, 16, 64).ratio for s in ("theta", "tan", "g")}
    assert best_spacing(narrow, 16, 64) == min(ratios, key=ratios.get)
    halved = narrow.replace(affine=torch.tensor([[[1.0, 0.0], [0.0, 0.5]]]))
    assert patches(halved, "theta", 16, 64).area[0] == pytest.approx(
        patches(narrow, "theta", 16, 64).area[0] / 2
    )
