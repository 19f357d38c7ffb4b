"""Opening a data set: which kind a path is, and which part of it a split means."""

from pathlib import Path

from darswin.data import digits, idx
from darswin.data.folders import open_folder
from darswin.data.sources import Source
from darswin.data.splits import SPLITS, Split, read_classes

# The first that fits a path is taken; what fits none is a folder of images.
KINDS = (digits, idx)


def open_source(
    path: str | Path,
    split: Split,
    *,
    channels: int = 3,
    classes: str | Path | None = None,
    splits: str | Path | None = None,
    holdout: float = 0.1,
) -> Source:
    """The part of a data set that a split means.

    What `path` may be:

    - "digits": scikit-learn's 1797 scanned digits of 8×8 pixels;
    - a folder of IDX files, the MNIST family: `train-images-idx3-ubyte[.gz]` and its three
      companions. "test" is its test set, "val" the last `holdout` of its training set;
    - a folder of images, one folder a class; or `train/`, `val/` (also `valid/`, `validation/`)
      and `test/` folders of that kind. Links to folders are followed, hidden ones left out.

    Without a test set, "val" serves as one. What has neither, or no "val", gets `holdout` of each
    class of "train" for each, chosen by a hash of their names; at least one is left to train on.
    Pictures that are in no split are said as `darswin.data.folders.LeftOut` warnings.

    Args:
        channels: 3 or 1, of the images that come out.
        classes: a list of class names, as a text file with one a line or a JSON list: which
            folders to take and in which order. For IDX files and digits, the labels' names.
        splits: a JSON file `{"train": ["class/a.jpg", …], "val": …, "test": …}` with paths relative
            to `path`, or a folder of `train.txt`, `val.txt`, `test.txt` with one path a line. The
            first folder of a path is its class. A split without a list is held out.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: no such folder, or nothing in it. ValueError: folders whose meaning is
            not clear, and lists that do not fit them; it names them.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {SPLITS}, got {split!r}")
    if not 0 <= holdout < 0.5:
        raise ValueError(f"holdout must be in [0, 0.5), got {holdout}")
    names = None if classes is None else read_classes(classes)
    root = Path(path)
    kind = next((kind for kind in KINDS if kind.fits(root)), None)
    if kind is None:
        if not root.is_dir():
            raise FileNotFoundError(f"no folder {root}")
        return open_folder(root, split, channels, names, splits, holdout)
    if splits is not None:
        raise ValueError(f"--data.splits is for folders of images, and {path} is none")
    source = kind.open_split(root, split, channels, names, holdout)
    if not len(source):
        raise FileNotFoundError(
            f"no images for the {split!r} split of {path}: --data.holdout {holdout:g} leaves none"
        )
    return source
