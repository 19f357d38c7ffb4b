"""Which way is up, in the extrinsics of calibration files."""

import json

import numpy as np
import pytest
from helpers import CALIBRATIONS
from scipy.spatial.transform import Rotation

from darswin.lens import load_up
from darswin.views import up_of


@pytest.mark.parametrize("name", ["woodscape.json", "synwoodscape.json"])
def test_up_of_a_vehicles_camera_is_that_of_its_rotation(name):
    content = json.loads((CALIBRATIONS / name).read_text())
    rotation = Rotation.from_quat(content["extrinsic"]["quaternion"]).as_matrix()
    up = load_up(CALIBRATIONS / name)
    assert up == pytest.approx(rotation.T @ [0, 0, 1])
    assert up == pytest.approx(up_of(extrinsics=rotation))
    assert up[1] < -0.5 and np.linalg.norm(up) == pytest.approx(1)  # the camera stands upright


def test_files_that_do_not_say_what_is_up(tmp_path):
    with pytest.raises(ValueError, match="Kalibr files do not say which way is up"):
        load_up(CALIBRATIONS / "kalibr_tumvi.yaml")
    content = json.loads((CALIBRATIONS / "woodscape.json").read_text())
    path = tmp_path / "camera.json"
    for extrinsic, message in (
        (dict(quaternion=[0, 0, 0, 0]), "extrinsic.quaternion must not be zero"),
        (dict(quaternion=[0, 0, 1]), r"extrinsic\.quaternion must be .*4"),
        (dict(), "quaternion"),
        (None, "extrinsic"),
    ):
        path.write_text(json.dumps(content | dict(extrinsic=extrinsic)))
        with pytest.raises(ValueError, match=message) as error:
            load_up(path)
        assert str(path) in str(error.value)
