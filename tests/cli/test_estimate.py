"""`darswin lens estimate` on drawn rooms."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from darswin import calibrate
from darswin import lens as lenses
from darswin.cli.main import main

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from rooms import Room

SIZE = (400, 480)


def draw_rooms(lens, folder: Path, count: int) -> None:
    """Pictures of rooms through a lens, with nine rays in each pixel."""
    side = torch.tensor([-1 / 3, 0, 1 / 3], dtype=torch.float64)
    y, x = torch.meshgrid(*(torch.arange(n).double() for n in SIZE), indexing="ij")
    rays = [lens.unproject_points(torch.stack((x + dx, y + dy), -1)[None])[0].numpy()
            for dx in side for dy in side]  # fmt: skip
    for k in range(count):
        room = Room(np.random.default_rng(k))
        colors = np.mean([room.colors(r.astype(np.float32)) for r in rays], 0)
        cv2.imwrite(f"{folder}/{k}.png", colors.astype(np.uint8)[..., ::-1])


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    focal = torch.tensor([160.0], dtype=torch.float64)
    lens = lenses.Stereographic(focal, image_size=SIZE)
    draw_rooms(lens, folder, 2)
    return folder, lens.unproject(200.0).item()


def test_a_lens_is_estimated_and_written(rooms, tmp_path, capsys, monkeypatch):
    folder, rim = rooms
    estimate, estimates = calibrate.estimate, []
    monkeypatch.setattr(
        calibrate, "estimate", lambda *a, **o: estimates.append(estimate(*a, **o)) or estimates[0]
    )
    out, report = tmp_path / "camera.json", tmp_path / "report.json"
    command = ["lens", "estimate", str(folder), "--out", str(out), "--report", str(report),
               "--model", "Spherical"]  # fmt: skip
    main(command)
    said, progress = capsys.readouterr()
    assert "straight curves over" in said and f"{out}: darswin, Spherical up to" in said
    assert "picture 2 of 2: " in progress
    assert lenses.load(out).unproject(200.0).item() == pytest.approx(rim, rel=0.01)
    content = json.loads(report.read_text())
    assert content["rim"] == pytest.approx(rim, rel=0.01) and len(content["pictures"]) == 2
    assert content["lens"]["model"] == "Spherical" and content["interval"][0] <= content["rim"]
    # One that may be another lens is written only on request.
    monkeypatch.setattr(calibrate, "estimate", lambda *arguments, **options: estimates[0])
    monkeypatch.setattr(calibrate.Estimate, "is_sure", False)
    out.unlink()
    report.unlink()
    with pytest.raises(SystemExit):
        main(command)
    said = capsys.readouterr().err
    assert "camera.json is not written, because the pictures allow very different" in said
    assert "--accept_doubts" in said and report.exists() and not out.exists()
    main([*command, "--accept_doubts", "true"])
    assert len(lenses.load(out)) == 1


@pytest.mark.slow
def test_pictures_turned_by_exif_give_the_lens_of_stored_pictures(rooms, tmp_path):
    from PIL import Image

    folder, rim = rooms
    image = Image.open(folder / "0.png")
    exif = image.getexif()
    exif[274] = 6
    image.save(tmp_path / "turned.jpg", exif=exif, quality=97)
    out = tmp_path / "camera.json"
    main(["lens", "estimate", str(tmp_path / "turned.jpg"), "--out", str(out)])
    found = lenses.load(out)
    assert found.image_size.tolist() == [list(SIZE)]
    assert found.unproject(200.0).item() == pytest.approx(rim, rel=0.02)
