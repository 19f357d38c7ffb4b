"""The content of a YAML, JSON, XML, .npz or plain text file. Nothing in a file is executed, and
large files end in an error instead of a long wait."""

import base64
import io
import json
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from darswin.lens.files.fields import is_number, listed
from darswin.utils.text import mapping, parse_json, to_text

# A mapping from YAML, JSON or XML; or rows of words, from a plain table.
Content = Mapping | list[list[str]]

MAX_BYTES = 16 << 20
MAX_TABLE = 4 << 20
MAX_YAML = 128 << 10  # the parser reads about 100 KB per second
MAX_XML = 256 << 10
MAX_DEPTH = 16
MAX_OPEN = 100  # unclosed brackets in YAML
MAX_ARRAY = 64 << 10  # bytes of an array in an .npz file: a matrix or coefficients
MAX_ARRAYS = 256

# The corner points of a calibration, in YAML and in XML: megabytes of numbers that no lens needs.
_POINTS = re.compile(r"\[[\s\d.,eE+-]{2048,}\]|(?<=>)[\s\d.eE+-]{2048,}(?=<)")
# A matrix of OpenCV in base64, in JSON, YAML and XML: 24 bytes that name its type, then numbers.
_BASE64 = re.compile(
    r'"\$base64\$([^"]*)"|!!binary \|((?:\s+[\w+/]+=*(?=\s|\Z))*)|(?<=type_id="binary">)([^<]*)'
)
_TYPES = dict(zip("ucwsihfd", ("u1", "i1", "<u2", "<i2", "<i4", "<f2", "<f4", "<f8"), strict=True))
_SENSOR = re.compile(r"^[^,\n#]*,[^,\n]*, *camera *,", re.MULTILINE)  # of kapture
# mrcal's models hold the state of their calibration, which is large.
_STATE = re.compile(r"(?<=: )b'[^'\n]*'")

# The first bytes of files that are given in place of a calibration. None begins a cameras.bin.
_OTHERS = {
    "a picture": (
        rb"\x89PNG|\xff\xd8\xff|GIF8|BM.{4}\0{4}|II[*+]\0|MM\0[*+]|RIFF.{4}WEBP|8BPS|v/1\x01"
        rb"|\0.{3}(jP  |JXL |ftyp(avif|hei|mif|msf|crx))|P[1-7]\s+\d+\s+\d+\s|\0\0\x01\0"
    ),
    "a video": (
        rb"\0.{3}(ftyp|moov|mdat|free|wide|skip)|RIFF.{4}AVI |\x1a\x45\xdf\xa3|FLV\x01|OggS"
        rb"|\0\0\x01[\xb3\xba]|0&\xb2u"
    ),
    "an archive": (
        rb"\x1f\x8b|BZh\d|\xfd7zXZ|7z\xbc\xaf|Rar!|\(\xb5/\xfd|.{257}ustar|PK(?!\x03\x04)"
    ),
    "a PDF document": rb"%PDF",
    "a file of MATLAB or HDF5": rb"MATLAB 5|\x89HDF",
    "a ROS bag or a database": rb"#ROSBAG V|\x89MCAP0|SQLite format 3\0",
    "one array of NumPy (np.savez writes several with their names)": rb"\x93NUMPY",
    "a pickle, which may run code": rb"\x80[\x02-\x05][^\0]",
}  # fmt: skip
_WANTED = "but must be a calibration: text in YAML, JSON or XML, a table, or np.savez's .npz"


def read_bytes(path: str | os.PathLike) -> bytes:
    """The bytes of a file. Raises ValueError for a directory or device, for a large file, and for
    a picture, a video, an archive and the like."""
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError("it must be a file")
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    for kind, mark in _OTHERS.items():
        if re.match(mark, data, re.DOTALL):
            raise ValueError(f"it is {kind}, {_WANTED}")
    if len(data) > MAX_BYTES:
        raise ValueError(f"it must be at most {MAX_BYTES >> 20} MiB large")
    return data


def decoded(data: bytes) -> str:
    """The text of a file, or the arrays of `np.savez`'s zip archive as JSON."""
    if data.startswith(b"PK\x03\x04"):
        return _from_npz(data)
    return to_text(data)


def _from_npz(data: bytes) -> str:
    """Skips large arrays. Arrays of objects, which would have to be unpickled, become a text that
    says so, for the error about an entry that should hold numbers."""
    arrays: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
            small = [entry for entry in entries if entry.file_size <= MAX_ARRAY]
            for entry in small[:MAX_ARRAYS]:
                array = io.BytesIO(archive.read(entry))
                try:
                    value = np.load(array, allow_pickle=False).tolist()
                except ValueError:
                    value = "dtype object"
                arrays[entry.filename.removesuffix(".npy")] = value
        text = json.dumps(arrays)
    except Exception as error:  # zipfile, zlib and NumPy raise a dozen kinds for broken files
        raise ValueError("it must be an undamaged .npz file with arrays of numbers") from error
    if not entries:  # np.savez did not write it
        raise ValueError(f"it is a zip archive, {_WANTED}")
    return text


def parse(text: str) -> Content:
    """The mapping or table in a text. Its first characters tell the notation."""
    text = _BASE64.sub(_from_base64, text)
    start = text.lstrip()
    if not start:
        raise ValueError("it must not be empty")
    try:
        if start[0] == "<":
            return _parse_xml(start)
        if start[0] == "{" and start[1:].lstrip()[:1] not in ("'", "#"):  # mrcal writes Python
            return _parse_json(text)
        if _SENSOR.search(text):
            return _parse_sensors(text)
        lines = (line.strip() for line in text.splitlines())
        first = next((line for line in lines if line and line[0] != "#"), "-")
        if first == "[image]":
            return _parse_ost(text)
        return _parse_table(text) if is_number(first.split()[0]) else _parse_yaml(text)
    except RecursionError as error:
        raise ValueError("its entries are nested too deeply") from error


def _parse_json(text: str) -> Mapping:
    try:
        return parse_json(text)
    except ValueError as error:
        raise ValueError(f"it is not valid JSON: {error}") from error


def _parse_table(text: str) -> list[list[str]]:
    rows = (line.split() for line in _limited("a table", text, MAX_TABLE).splitlines())
    return [row for row in rows if row and row[0][0] != "#"]


def _parse_sensors(text: str) -> list[list[str]]:
    """The cameras of kapture's sensors.txt, as rows of COLMAP."""
    lines = _limited("a table", text, MAX_TABLE).splitlines()
    rows = ([word.strip() for word in line.split(",")] for line in lines if line[:1] != "#")
    return [[row[0], *row[3:]] for row in rows if row[2:3] == ["camera"]]


def _parse_ost(text: str) -> Mapping:
    """ROS's ost.txt: names, each with numbers in the lines below. A pair repeats the size, and its
    sections tell the side."""
    side, blocks = "", [("", list[str]())]
    for words in _parse_table(text):
        if words[0][0] == "[":
            side = words[0].strip("[]").partition("/")[2]
        elif is_number(words[0]):
            blocks[-1][1].extend(words)
        else:
            blocks.append((" ".join(words) + side, []))
    return mapping({str(block): block for block in blocks}.values())


def _parse_yaml(text: str) -> Mapping:
    """Parses YAML. Scalars stay text, and tags such as !!opencv-matrix are ignored. Of several
    documents, as `rostopic echo` writes them, all must be the same but for their header."""
    # OpenCV begins its files with %YAML:1.0, which is not valid YAML.
    text = _STATE.sub("''", re.sub(r"\A%YAML[^\n]*\n", "", text))
    text = _limited("YAML", text, MAX_YAML)
    lines = text.split("\n")
    while lines and lines[-1].strip() in ("", "---", "..."):  # `ros2 topic echo` ends like this
        lines.pop()
    if text.count("[") + text.count("{") > text.count("]") + text.count("}") + MAX_OPEN:
        raise RecursionError  # the parser takes a second until it raises this
    try:
        # An empty document is an empty text.
        documents = [*filter(None, yaml.load_all("\n".join(lines), _Loader))]
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f"line {mark.line + 1}: "
        problem = str(getattr(error, "problem", error)).splitlines()[0]
        raise ValueError(f"it is not valid YAML: {where}{problem}") from error
    if not documents or not all(isinstance(content, Mapping) for content in documents):
        raise ValueError("it must be a mapping (YAML, JSON or XML) or a table of numbers")
    first, *others = documents
    for number, other in enumerate(others, 2):
        names = dict.fromkeys((*first, *other))
        if apart := [n for n in names if n != "header" and first.get(n) != other.get(n)]:
            raise ValueError(
                f"it is not valid YAML of one camera: the documents 1 and {number}, with --- "
                f"between them, differ in {listed(apart)}: keep one of them"
            )
    return first


class _Loader(yaml.BaseLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        super().construct_mapping(node, deep)  # raises for invalid names
        return mapping(
            (self.construct_object(name), self.construct_object(value))
            for name, value in node.value
        )


def _parse_xml(text: str) -> Mapping:
    text = _limited("XML", text, MAX_XML)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("an XML file must not have a DOCTYPE or an ENTITY")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not valid XML: {error}") from error
    content = _element(root, MAX_DEPTH, root.tag == "opencv_storage")
    if not isinstance(content, Mapping):
        raise ValueError("an XML file must have elements in its root")
    return content


def _element(element: ElementTree.Element, depth: int, is_opencv: bool) -> Mapping | list | str:
    """OpenCV's notation: the elements of a sequence are named _, all others have names. In files
    of other programs, elements with the same name make a sequence."""
    if depth == 0:
        raise ValueError(f"XML must be at most {MAX_DEPTH} elements deep")
    children = [(child.tag, _element(child, depth - 1, is_opencv)) for child in element]
    if not children:
        return (element.text or "").strip().strip('"')
    if all(tag == "_" for tag, _ in children):
        return [value for _, value in children]
    if is_opencv:
        return mapping(children)
    found: dict[str, list] = {}
    for tag, value in children:
        found.setdefault(tag, []).append(value)
    return {tag: values[0] if len(values) == 1 else values for tag, values in found.items()}


def _from_base64(match: re.Match) -> str:
    """The numbers of a matrix as text; the match if it is none, or one that no lens needs."""
    words = next(group for group in match.groups() if group is not None)
    try:
        data = base64.b64decode("".join(words.split()), validate=True)
        kind = _TYPES[data[:24].decode().strip().lstrip("0123456789")]
        numbers = np.frombuffer(data[24:], kind).tolist()
    except (ValueError, KeyError):
        return match[0]
    text = " ".join(map(repr, numbers)) if len(data) <= MAX_ARRAY else "many numbers"
    return text if match[3] is not None else f'"{text}"'


def _limited(notation: str, text: str, most: int) -> str:
    """Text of limited length. In a longer text, long lists of numbers are replaced first."""
    if len(text) > most:
        text = _POINTS.sub("many numbers", text)
    if len(text) > most:
        raise ValueError(f"{notation} must be at most {most >> 10} KiB large")
    return text
