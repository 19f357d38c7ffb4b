"""Reading text files."""

import codecs

import pytest

from darswin.utils.text import read_json, read_text

TEXT = "dog\nKäfer\n"


@pytest.mark.parametrize(
    "data",
    [
        TEXT.encode(),
        TEXT.encode("utf-8-sig"),
        codecs.BOM_UTF16_LE + TEXT.encode("utf-16-le"),
        codecs.BOM_UTF16_BE + TEXT.encode("utf-16-be"),
        codecs.BOM_UTF32_LE + TEXT.encode("utf-32-le"),
        codecs.BOM_UTF32_BE + TEXT.encode("utf-32-be"),
        codecs.BOM_UTF8 + TEXT.encode("utf-8-sig"),
        codecs.BOM_UTF16_LE * 2 + TEXT.encode("utf-16-le"),
        TEXT.replace("\n", "\r\n").encode(),
        TEXT.replace("\n", "\r").encode(),
    ],
)
def test_every_encoding_gives_the_same_text(data, tmp_path):
    file = tmp_path / "classes.txt"
    file.write_bytes(data)
    assert read_text(file) == TEXT


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (TEXT.encode("latin-1"), ": 'utf-8' codec can't decode byte 0xe4"),
        ("dog\n".encode("utf-16-le"),
         ", .* but has NUL characters, as UTF-16 without a byte order"),
        ("dog\n".encode("utf-16-be"),
         ", .* but has NUL characters, as UTF-16 without a byte order"),
        ("dog\n".encode("utf-32-le"), ", .* but has NUL characters"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("read", [read_text, read_json])
def test_other_bytes_are_an_error_that_names_the_file(data, reason, read, tmp_path):
    file = tmp_path / "classes.txt"
    file.write_bytes(data)
    with pytest.raises(ValueError, match=rf"classes\.txt.*: it must be text in UTF-8{reason}"):
        read(file)
