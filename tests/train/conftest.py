import cv2
import numpy as np
import pytest
from lens_pictures import write_frames
from runs import DIGITS, PIXELS, checkpoint, fit, killed_fit
from scenes import write_plain

METRES = np.array([2.0, 5.0, 8.0])  # of the classes, so that a distance can be told from a colour


@pytest.fixture(scope="session")
def frames(tmp_path_factory):
    """Frames of digits, of one camera."""
    return write_frames(tmp_path_factory.mktemp("data") / "frames", count=90)


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """Scenes whose label is the colour's, and whose distance is the label's."""
    folder = write_plain(tmp_path_factory.mktemp("data") / "scenes", 60, size=(45, 60))
    for file in (folder / "labels").iterdir():
        labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        metres = (METRES[labels] * 256).astype(np.uint16)
        metres[20:24] = 0
        cv2.imwrite(str(folder / "distance" / file.name), metres)
        labels[20:24] = 255
        cv2.imwrite(str(file), labels)
    return folder


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A run on digits."""
    run = tmp_path_factory.mktemp("runs") / "whole"
    fit(run, *DIGITS)
    return run


@pytest.fixture(scope="session")
def killed(tmp_path_factory):
    """A run on digits that was killed in its second epoch; its last checkpoint is amid that."""
    run = tmp_path_factory.mktemp("runs") / "killed"
    with pytest.MonkeyPatch.context() as patch:
        killed_fit(patch, run, 19, *DIGITS)
    assert checkpoint(run)["global_step"] == 4
    return run


@pytest.fixture(scope="session")
def labelled(scenes, tmp_path_factory):
    """A run of a few seconds that learned labels."""
    run = tmp_path_factory.mktemp("runs") / "labelled"
    options = ["--data.path", scenes, *PIXELS, "--model.loss", "ce+dice"]
    few = ["--trainer.max_epochs", "4", "--checkpoint_steps", "100"]  # most of the time is saving
    fit(run, "--task", "segmentation", *options, *few)
    return run
