"""Reading text files."""

import codecs

import pytest

from darswin.utils.text import read_text

TEXT = "dog\nKäfer\n"


@pytest.mark.parametrize(
    "data",
    [
        TEXT.encode(),
        TEXT.encode("utf-8-sig"),
        codecs.BOM_UTF16_LE + TEXT.encode("utf-16-le"),
        codecs.BOM_UTF16_BE + TEXT.encode("utf-16-be"),
        TEXT.replace("\n", "\r\n").encode(),
        TEXT.replace("\n", "\r").encode(),
    ],
)
def test_every_encoding_gives_the_same_text(data, tmp_path):
    file = tmp_path / "classes.txt"
    file.write_bytes(data)
    assert read_text(file) == TEXT


def test_other_bytes_are_an_error_that_names_the_file(tmp_path):
    file = tmp_path / "classes.txt"
    file.write_bytes(TEXT.encode("latin-1"))
    with pytest.raises(ValueError, match=r"classes\.txt: it must be text in UTF-8"):
        read_text(file)
