import gzip

import numpy as np
import pytest

from darswin.data.pictures import open_source, read_idx


def write_idx(path, array):
    head = b"\0\0\x08" + bytes([array.ndim]) + np.array(array.shape, ">u4").tobytes()
    data = head + array.tobytes()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)


@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_idx_files(tmp_path, suffix):
    rng = np.random.default_rng(0)
    arrays = {}
    for part, count in (("train", 20), ("t10k", 5)):
        arrays[part] = rng.integers(256, size=(count, 28, 28), dtype=np.uint8)
        write_idx(tmp_path / f"{part}-images-idx3-ubyte{suffix}", arrays[part])
        labels = (np.arange(count) % 10).astype(np.uint8)
        write_idx(tmp_path / f"{part}-labels-idx1-ubyte{suffix}", labels)
    train, val, test = (open_source(tmp_path, s, channels=1) for s in ("train", "val", "test"))
    assert (len(train), len(val), len(test)) == (18, 2, 5) and len(train.classes) == 10
    image, label = val[1]
    assert np.array_equal(image[..., 0], arrays["train"][19]) and label == 9
    assert np.array_equal(test[4][0][..., 0], arrays["t10k"][4])
    assert open_source(tmp_path, "test")[0][0].shape == (28, 28, 3)


def test_the_classes_of_idx_files_are_those_of_training(tmp_path):
    for part, labels in (("train", [0, 1, 2, 0]), ("t10k", [1, 0])):
        write_idx(tmp_path / f"{part}-images-idx3-ubyte", np.zeros((len(labels), 2, 2), np.uint8))
        write_idx(tmp_path / f"{part}-labels-idx1-ubyte", np.array(labels, np.uint8))
    parts = [open_source(tmp_path, split) for split in ("train", "val", "test")]
    assert [part.classes for part in parts] == [["0", "1", "2"]] * 3
    (tmp_path / "names.txt").write_text("zero\none\n")
    with pytest.raises(
        ValueError, match=r"labels up to 2 for the 'train' split.*\['zero', 'one'\]"
    ):
        open_source(tmp_path, "train", classes=tmp_path / "names.txt")
    write_idx(tmp_path / "t10k-labels-idx1-ubyte", np.array([7, 0], np.uint8))
    with pytest.raises(ValueError, match="labels up to 7 for the 'test' split"):
        open_source(tmp_path, "test")


def test_a_cut_idx_file_is_named(tmp_path):
    write_idx(tmp_path / "a", np.zeros((4, 3, 3), np.uint8))
    whole = (tmp_path / "a").read_bytes()
    (tmp_path / "a").write_bytes(whole[:-1])
    with pytest.raises(ValueError, match=r"a says it holds \[4, 3, 3\] bytes, but holds 35"):
        read_idx(tmp_path / "a")
    (tmp_path / "a.gz").write_bytes(gzip.compress(whole)[:-12])
    with pytest.raises(ValueError, match=r"a\.gz is no whole gzip file"):
        read_idx(tmp_path / "a.gz")
    (tmp_path / "a").write_bytes(b"GIF89a")
    with pytest.raises(ValueError, match="a is no IDX file"):
        read_idx(tmp_path / "a")
