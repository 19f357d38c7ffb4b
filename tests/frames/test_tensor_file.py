"""The files of plans and networks: by hand, by the library safetensors, damaged, and hostile."""

import contextlib
import json
import os
import re
import resource
import struct
import zlib
from itertools import pairwise
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import safetensors.numpy
from frame_samples import ROUND, model_of, network_of, random_frame
from safetensors import safe_open

from darswin import frames
from darswin.deploy import camera
from darswin.frames.compiled import frames as compiled
from darswin.frames.tensor_file import write_tensors
from darswin.models import load_model

# Damaged files of each kind: in `make test`, and in `make fuzz`.
DAMAGED = 2000 if hypothesis.settings().max_examples <= 30 else 100_000
COPY, SIZE = 3, (4, 6)
PAGE = Path(__file__).parents[2] / "docs/reference/files.md"


def whole(content: bytes) -> bytes:
    """A file with the right checksum."""
    return content[:-4] + struct.pack("<I", zlib.crc32(content[:-4]))


def file_of(header: str | bytes, data: bytes) -> bytes:
    text = header.encode() if isinstance(header, str) else header
    text += b" " * (-len(text) % 8)
    return whole(struct.pack("<Q", len(text)) + text + data)


def plan_parts(places=(2, 3)):
    """The arrays and texts of a plan of a gray image, and of nothing but places inside."""
    arrays = dict(
        size=np.array(SIZE), mean=np.zeros(1), std=np.ones(1) / 255, supersampling=np.array(1),
        columns=np.full(places, 2, np.int16), rows=np.full(places, 1, np.int16),
        right=np.full(places, 0.5, np.float32), lower=np.zeros(places, np.float32),
    )  # fmt: skip
    return arrays, {"darswin_plan": "5", "output": "image"}


def program(*instructions, inputs=(6,), buffers=(6,), outputs=((0, 2, 3),)):
    """The words of a program."""
    words = [len(inputs), *inputs, len(buffers), *buffers, len(outputs)]
    for buffer, *shape in outputs:
        words += [buffer, len(shape), *shape]
    for opcode, *arguments in instructions:
        words += [opcode, len(arguments), *arguments]
    return np.array(words, np.int64)


THROUGH = (COPY, 0, 1, 0, 0, 1, 1, 1, 1, 6, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)


def network_parts(**changes):
    """The arrays and texts of a network that returns the six samples of a frame."""
    arrays, _ = plan_parts()
    arrays = {f"plan.{name}": array for name, array in arrays.items()} | dict(
        reads_frame=np.array(0), program=program(THROUGH), constants=np.zeros(0, np.float32),
        weights=np.zeros(100, np.int32),
    )  # fmt: skip
    return arrays | changes, {
        "darswin_network": "2.0", "plan.output": "image", "finish": "array"
    }  # fmt: skip


PARTS = {frames.Plan.load: plan_parts, frames.Network: network_parts}
KINDS = pytest.mark.parametrize("read", PARTS, ids=["plan", "network"])


def refused(read, path, words=""):
    """Checks that a file is a ValueError, and that its reason has these words."""
    with pytest.raises(ValueError, match="is no") as caught:
        read(path)
    kind = "network" if read is frames.Network else "plan"
    start, reason = f"{path} is no {kind} that darswin.frames can read: ", str(caught.value)
    assert reason.startswith(start) and re.search(words, reason.removeprefix(start)), reason


def test_the_plan_on_the_page_is_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1], {})
    assert capsys.readouterr().out == "[[ 85 220]]\n"


def test_a_network_by_hand_runs(tmp_path):
    """From the page alone."""
    header, data = {"__metadata__": network_parts()[1] | {"label.0": "ä", "label.1": "\n"}}, b""
    for name, array in network_parts()[0].items():
        kind = {"i": "I", "f": "F"}[array.dtype.kind] + str(8 * array.itemsize)
        offsets = [len(data), len(data) + array.nbytes]
        header[name] = dict(dtype=kind, shape=list(array.shape), data_offsets=offsets)
        data += array.tobytes()
    header["crc32"] = dict(dtype="U8", shape=[4], data_offsets=[len(data), len(data) + 4])
    path = tmp_path / "camera.safetensors"
    path.write_bytes(file_of(json.dumps(header, indent=1), data + bytes(4)))
    network, frame = frames.Network(path), random_frame(*SIZE)
    assert network.labels == ["ä", "\n"]
    expected = (frame[1, 2] / 2 + frame[1, 3] / 2) * np.ones((2, 3))
    np.testing.assert_allclose(network(frame), expected, rtol=1e-6)


@KINDS
def test_the_library_safetensors_reads_and_writes_the_same_files(read, tmp_path):
    path, (arrays, texts) = tmp_path / "camera.safetensors", PARTS[read]()
    write_tensors(path, arrays, texts)
    found = safetensors.numpy.load_file(path)
    assert {name for name in found if not name.startswith("padding")} == {*arrays, "crc32"}
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        np.testing.assert_array_equal(found[name], array)
    with safe_open(path, "np") as file:
        assert file.metadata() == texts
    content = safetensors.numpy.save(arrays | {"crc32": np.zeros(4, np.uint8)}, texts)
    path.write_bytes(whole(content))
    again, same_texts = compiled.read_tensors(os.fsencode(path))
    assert same_texts == texts
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array)
    read(path)


def test_arrays_lie_where_the_page_says(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "a.safetensors"
    kinds = [np.uint8, np.int16, np.int32, np.int64, np.float32, np.float64]
    arrays = {
        f"{k}": rng.integers(0, 99, rng.integers(0, 40)).astype(kinds[rng.integers(6)])
        for k in range(100)
    } | {"number": np.array(7), "nothing": np.zeros((0, 3))}
    write_tensors(path, arrays, {"a": 'b "\\\n\x00ä𝄞'})
    found, texts = compiled.read_tensors(os.fsencode(path))
    assert texts == {"a": 'b "\\\n\x00ä𝄞'}
    content = path.read_bytes()
    begin = 8 + int.from_bytes(content[:8], "little")
    assert begin % 64 == 0 and zlib.crc32(content) == 0x2144DF1C
    header = json.loads(content[8:begin])
    del header["__metadata__"]
    for name, array in arrays.items():
        line = 64 if array.nbytes >= 64 else array.itemsize
        assert header[name]["data_offsets"][0] % line == 0
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    places = [entry["data_offsets"] for entry in header.values()]
    assert places[0][0] == 0 and places[-1][1] == len(content) - begin
    assert all(one[1] == other[0] for one, other in pairwise(places))


def test_what_no_file_may_hold_is_not_written(tmp_path):
    arrays, texts = plan_parts()
    for given, words in (
        ((tmp_path / "a.npz", arrays, texts), r"must end in \.safetensors, got '.*npz'"),
        ((tmp_path / "a.safetensors", arrays, {"a": "b" * 2**21}), "bytes of names and texts"),
    ):
        with pytest.raises(ValueError, match=words):
            write_tensors(*given)
    assert not list(tmp_path.iterdir())


@KINDS
def test_a_file_of_weights_is_something_else(read, tmp_path):
    path = tmp_path / "camera.safetensors"
    safetensors.numpy.save_file({"weight": np.ones(3)}, path)
    refused(read, path, "it is damaged, or of another kind")
    write_tensors(path, *PARTS[read]())
    with pytest.raises(ValueError, match=r"camera\.safetensors"):
        load_model(path)
    other = next(one for one in PARTS if one != read)
    refused(other, path, "'darswin_.*' is missing")
    other = tmp_path / "other.npz"
    np.savez(other, darswin_plan=4)
    refused(read, other, "it is damaged, or of another kind")


ENTRY = '{"dtype":"U8","shape":[4],"data_offsets":[0,4]}'
LARGE = 2**62
HOSTILE = [
    ("", "header"), ("[]", "header"), ("{", "header"), ("nul", "header"), ("1", "header"),
    ('{"crc32":' + ENTRY, "header"), ('{"crc32":' + ENTRY + "}}", "header"),
    ('{"crc32":' + ENTRY + ",}", "header"), ('{crc32:' + ENTRY + "}", "header"),
    ('{"a":' * 5000, "header"), ("[" * 100_000, "header"),
    ('{"crc32":' + "[" * 100_000, "header"), ('{"__metadata__":' * 9, "header"),
    ('{"crc32":' + ENTRY + ',"crc32":' + ENTRY + "}", "header"),
    ('{"__metadata__":{},"__metadata__":{},"crc32":' + ENTRY + "}", "header"),
    ('{"__metadata__":{"a":"b","a":"c"},"crc32":' + ENTRY + "}", "header"),
    ('{"__metadata__":{"a":1},"crc32":' + ENTRY + "}", "header"),
    ('{"__metadata__":[],"crc32":' + ENTRY + "}", "header"),
    ('{"__metadata__":{"a":["b"]},"crc32":' + ENTRY + "}", "header"),
    *((f'{{"__metadata__":{{"a":"{text}"}},"crc32":{ENTRY}}}', "header")
      for text in ("\n", "\\x", "\\", "\\u12", "\\u123g", "\\ud834", "\\ud834\\u0041", "\\udd1e",
                   "ä", "\\u-123")),
    *((f'{{"crc32":{entry}}}', words) for entry, words in [
        ("[]", "header"), ("{}", "header"), ("null", "header"), ("4", "header"),
        ('{"dtype":"U8","shape":[4]}', "header"), (ENTRY[:-1] + ',"more":1}', "header"),
        ('{"dtype":"U9","shape":[4],"data_offsets":[0,4]}', ""),
        ('{"dtype":["U8"],"shape":[4],"data_offsets":[0,4]}', "header"),
        *((f'{{"dtype":"U8","shape":{shape},"data_offsets":[0,4]}}', "") for shape in (
            "4", "[3]", "[5]", "[-4]", "[4.0]", "[4e0]", '["4"]', "[true]", "[null]", "[[4]]",
            "[4,", "[4,]", "[2,2", "[]", "{}", '"4"', f"[{LARGE}]", f"[4,{LARGE},{LARGE}]",
            f"[0,{LARGE}]", f"[{LARGE},4,0]", f"[{2**64 + 4}]", "[" + "9" * 5000 + "]",
            "[4" + ",1" * 8 + "]")),
        *((f'{{"dtype":"U8","shape":[4],"data_offsets":{offsets}}}', "") for offsets in (
            "[0,3]", "[0,5]", "[1,4]", "[1,5]", "[4,0]", "[-4,0]", "[0]", "[]", "[0,4,4]", "4",
            f"[0,{LARGE}]", f"[{LARGE},{LARGE}]", f"[0,{2**64 + 4}]", "[0.0,4]", "null")),
    ]),
    ('{"a":{"dtype":"U8","shape":[3],"data_offsets":[0,3]},'
     '"crc32":{"dtype":"U8","shape":[1],"data_offsets":[2,3]}}', ""),
    ('{"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]},'
     '"b":{"dtype":"I16","shape":[1],"data_offsets":[1,3]},'
     '"crc32":{"dtype":"U8","shape":[1],"data_offsets":[3,4]}}', ""),
]  # fmt: skip


@KINDS
@pytest.mark.parametrize(("header", "words"), HOSTILE, ids=lambda text: text[:40])
def test_hostile_headers_are_refused(read, header, words, tmp_path):
    path = tmp_path / "camera.safetensors"
    path.write_bytes(file_of(header, bytes(4)))
    refused(read, path, words)


@KINDS
def test_a_header_may_be_written_in_other_ways(read, tmp_path):
    """The table above is not refused for its spaces, or because nothing is read."""
    path = tmp_path / "camera.safetensors"
    spaced = ' { "__metadata__" :\t{"a" : "\\u00e4\\ud834\\udd1e\\/\\b"},\r\n"crc32":' + ENTRY + "}"
    path.write_bytes(file_of(spaced, bytes(4)))
    refused(read, path, "darswin_.*' is missing")
    assert compiled.read_tensors(os.fsencode(path))[1] == {"a": "ä𝄞/\b"}


@KINDS
def test_files_whose_ends_are_wrong_are_refused(read, tmp_path):
    path, (arrays, texts) = tmp_path / "camera.safetensors", PARTS[read]()
    write_tensors(path, arrays, texts)
    content, before = path.read_bytes(), len(os.listdir("/proc/self/fd"))
    for length in range(0, len(content), 31):
        path.write_bytes(content[:length])
        refused(read, path, "short|damaged")
    for other in (content + b"x", b"x" + content, content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(other)
        refused(read, path, "damaged")
    for length in (0, 1, 8, len(content) - 8, len(content) - 7, 2**21 + 8, 2**63, 2**64 - 8):
        path.write_bytes(whole(struct.pack("<Q", length) + content[8:]))
        refused(read, path, "header")
    path.write_bytes(whole(content[:-4] + bytes(8)))  # more than the arrays
    refused(read, path)
    with open(path, "wb") as file:
        file.truncate(2**40)  # and takes no room
    refused(read, path, "too long")
    assert len(os.listdir("/proc/self/fd")) == before


@KINDS
def test_what_is_no_file_is_told(read, tmp_path):
    missing = tmp_path / "missing.safetensors"
    with pytest.raises(FileNotFoundError) as caught:
        read(missing)
    assert caught.value.filename == str(missing)
    with pytest.raises(IsADirectoryError):
        read(tmp_path)
    os.mkfifo(tmp_path / "pipe.safetensors")
    for path in (tmp_path / "pipe.safetensors", "/dev/zero", "/dev/null"):
        refused(read, path)


@KINDS
def test_values_that_do_not_fit_are_refused(read, tmp_path):
    path, (arrays, texts) = tmp_path / "camera.safetensors", PARTS[read]()
    write_tensors(path, arrays | dict(more=np.zeros(3)), texts | dict(more="text"))
    read(path)  # as a later minor version may
    for name, array in arrays.items():
        for other in (array.astype(np.uint8), array.astype(np.float32 if array.dtype.kind == "i"
                      else np.int64), array.ravel()[1:], np.append(array, array)):  # fmt: skip
            if name in ("weights", "constants") and other.dtype == array.dtype:
                continue  # more weights do no harm
            write_tensors(path, arrays | {name: other}, texts)
            refused(read, path)
        write_tensors(path, {one: arrays[one] for one in arrays if one != name}, texts)
        refused(read, path, f"'{name}' is missing")
    for name in texts:
        write_tensors(path, arrays, {one: texts[one] for one in texts if one != name})
        refused(read, path, f"'{name}' is missing")
        write_tensors(path, arrays, texts | {name: "sigmoid"})
        refused(read, path)
    version = next(iter(texts))
    for number, words in (("6.0", "newer"), ("6", "newer"), ("1", "older"), ("-1", ""), ("", "")):
        write_tensors(path, arrays, texts | {version: number})
        refused(read, path, words if read is frames.Network or "." not in number else "")


# opcode, arguments, the words of the error; input 0 has 6 numbers, and so has buffer 1.
MANY, FEW, LAYER = 2**40, 2**20, "reads beyond its weights|out of range"
HOSTILE_STEPS = [
    ((0, 0, 1, MANY, 0, 6, 0, 0, -1, 0), "out of range"), ((0, 0, 1, 6, 1, 1, 90, 0, -1, 0), LAYER),
    ((0, 0, 1, 6, 1, MANY, 0, 0, -1, 0), "too large"), ((0, 0, 1, 0, 6, 6, 0, 0, -1, 0), "range"),
    ((1, 0, 1, MANY, 0, 0), "out of range"), ((1, 0, 1, 1, 6, 99), LAYER),
    ((2, 0, 1, 1, 6, *[1] * 19), "does not have"), ((2, 1, 1, 1, 6, 0, *[1] * 18), "wrong sizes"),
    ((3, 0, 1, 0, 0, *[MANY] * 5, *[0] * 5, *[0] * 5), "twice|large"),
    ((3, 0, 1, 0, 0, *[FEW] * 5, *[0] * 5, *[0] * 5), "twice|large"),
    ((3, 0, 1, 0, 0, 1, 1, 1, 1, 7, *[0] * 5, *[0] * 5), "twice"),
    ((3, 0, 1, 0, 0, 1, 1, 1, 1, 0, *[0] * 5, *[0] * 5), "out of range"),
    ((3, 0, 1, 1, 0, 1, 1, 1, 1, 6, *[1] * 5, *[1] * 5), "beyond"),
    ((3, 0, 1, 0, 0, 1, 1, 1, 1, 2, *[MANY] * 5, *[1] * 5), "beyond"),
    ((3, 0, 1, 0, 0, 1, 1, 1, 1, 2, *[-1] * 5, *[1] * 5), "beyond"),
    ((4, 0, 0), "still reads|does not have"), ((4, 0, 2), "does not have"),
    ((5, 0, 1, MANY, 0), "out of range"), ((5, 0, 1, 0, 6), "out of range"),
    ((6, 0, 1), "does not have"), ((6, 2, 1), "does not have"), ((6, -1, 1), "does not have"),
    *(((6, 1, other), "unknown function") for other in (-1, 0, 3, 4)),
    ((7, 0, 1, 2, 3, 1, 1, 0, 3), "unknown function|beyond its weights"),
    ((7, 0, 1, 2, 0, 1, 6, 0, 0), "out of range"), ((7, 0, 1, 2, 3, 1, 1, 0, 9), LAYER),
    ((7, 0, 1, 2, 3, 1, 1, 90, 0), LAYER), ((7, 0, 1, MANY, MANY, MANY, 6, 0, 0), "too large"),
    ((8, 0, 1, MANY, 0, 1, 6, 1), "out of range"), ((8, 0, 1, 2, 3, MANY, MANY, 0), "range"),
    ((9, 0, 1, 2, 3, 2, 3, 1, 0), "another size"), ((9, 0, 1, 0, 0, 2, 3, 1, 0), "out of range"),
    ((10, 0, 1, 0, 0, MANY, MANY, 6, 0), "out of range"), ((11, 0, 0), "does not have"),
    ((12, 0, 1, 2, 3, 1), "another size"), ((12, 0, 1, 0, 3, 1), "out of range"),
    ((12, 0, 1, MANY, MANY, 1), "too large"), ((12, 1, 1, 2, 3, 1), "still reads"),
    ((13, 0), "unknown instruction"), ((-1, 0), "unknown instruction"), ((6,), "unknown"),
    ((6, LARGE, 1), "out of range"), ((6, -LARGE, 1), "out of range"),
]  # fmt: skip


@pytest.mark.parametrize(("step", "words"), HOSTILE_STEPS, ids=str)
def test_hostile_instructions_are_refused(step, words, tmp_path):
    path = tmp_path / "camera.safetensors"
    for other in ([step], [THROUGH, step]):
        arrays, texts = network_parts(program=program(*other))
        write_tensors(path, arrays, texts)
        refused(frames.Network, path, f"program of a network .*({words})")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ([], "ends too early"), ([1], "ends too early"), ([1, 6, 1, 6, 1, 0], "ends too early"),
        ([-1], "count"), ([2**62, 6], "count"), ([1, 6, 2**14 + 1], "count"),
        ([1, 0, 1, 6, 1, 0, 2, 2, 3], "size out of range"),
        ([1, 2**41, 1, 6, 1, 0, 2, 2, 3], "size out of range"),
        ([1, 6, 1, 0, 1, 0, 2, 2, 0], "size out of range"),
        ([1, 6, 1, 6, 1, 0, 3, 6, 2**40, 2**40], "too large"),
        ([1, 6, 1, 6, 1, 1, 2, 2, 3], "without a buffer"),
        ([1, 6, 1, 6, 2, 0, 1, 6, 0, 1, 6], "two outputs"),
        ([3, 6, 2**40, 2**40, 1, 6, 1, 0, 1, 6], "more memory"),
        ([1, 6, 2**14, 6, *[2**40] * (2**14 - 1), 1, 0, 1, 6], "more memory"),
        ([1, 6, 2, 6, 2**24, 1, 0, 1, 6], "more memory"),
        ([1, 6, 1, 6, 1, 0, 1, 6, *[6, 1, 1] * 2**17], "too long"),
    ],
    ids=lambda value: str(value)[:40],
)  # fmt: skip
def test_hostile_programs_are_refused(words, error, tmp_path):
    path = tmp_path / "camera.safetensors"
    write_tensors(path, *network_parts(program=np.array(words, np.int64)))
    refused(frames.Network, path, f"program of a network .*{error}")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The bytes of a small network and of its plan, by the function that reads them."""
    options = dict(rings=2, sectors=8, samples=(2, 2), embed_dim=8, depths=(1, 1), num_heads=(1, 2))
    folder = tmp_path_factory.mktemp("small")
    model = model_of(**options)
    network_of(model, folder, labels=list("abcdefghij"))
    camera.plan(model, ROUND, (70, 80)).save(folder / "plan.safetensors")
    return {
        frames.Network: (folder / "camera.safetensors").read_bytes(),
        frames.Plan.load: (folder / "plan.safetensors").read_bytes(),
    }


NUMBERS = [-1, 0, 1, 2, 7, 255, 2**20, 2**31, 2**40, 2**62, -(2**63)]


def damaged(content, rng):
    """A file with something wrong in its header or its arrays, mostly with the right checksum."""
    begin = 8 + int.from_bytes(content[:8], "little")
    header, data = bytearray(content[8:begin].rstrip()), bytearray(content[begin:])
    part = header if rng.random() < 0.5 else data
    place = int(rng.integers(len(part)))
    match rng.integers(6):
        case 0:
            part[place] ^= 1 << int(rng.integers(8))
        case 1:
            part[place : place + 4] = rng.bytes(rng.integers(4))
        case 2:
            part[place : place + 8] = bytes([255]) * 8
        case 3:  # another digit
            digits = np.flatnonzero(np.isin(header, bytearray(b"0123456789")))
            header[rng.choice(digits)] = ord("0") + int(rng.integers(10))
        case 4:  # another number
            place -= place % 8
            data[place : place + 8] = struct.pack("<q", NUMBERS[rng.integers(len(NUMBERS))])
        case 5:  # something again, or missing
            other = int(rng.integers(len(part)))
            part[place:place] = part[min(place, other) : max(place, other)]
            if rng.random() < 0.5:
                del part[place:other]
    file = file_of(bytes(header), bytes(data))
    return file if rng.random() < 0.9 else file[:-4] + rng.bytes(4)


def test_programs_that_were_not_written_do_no_harm(small, tmp_path):
    path, rng, frame = tmp_path / "a", np.random.default_rng(0), random_frame(70, 80, 3)
    content, refused = small[frames.Network], 0
    begin = 8 + int.from_bytes(content[:8], "little")
    first, last = json.loads(content[8:begin])["program"]["data_offsets"]
    words = np.frombuffer(content[begin + first : begin + last], np.int64)
    for k in range(DAMAGED // 2):
        changed = words.copy()
        changed[rng.integers(len(words))] = rng.choice(NUMBERS) if k % 2 else rng.integers(64)
        path.write_bytes(
            whole(content[: begin + first] + changed.tobytes() + content[begin + last :])
        )
        try:
            frames.Network(path)(frame)
        except (ValueError, MemoryError):
            refused += 1
    assert refused > DAMAGED / 8


@KINDS
def test_damaged_files_are_refused_or_do_no_harm(read, small, tmp_path):
    """And they take no memory to speak of."""
    path, rng, frame = tmp_path / "a", np.random.default_rng(0), random_frame(70, 80, 3)
    opened, before = 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    file = path.open("wb", buffering=0)
    for _ in range(DAMAGED):
        content = damaged(small[read], rng)
        os.pwrite(file.fileno(), content, 0)
        file.truncate(len(content))
        try:
            run = read(path)
        except ValueError as error:
            assert f"{path} is no " in str(error)
            continue
        opened += 1
        # It may be for frames of another size, or a plan whose parts do not fit together.
        with contextlib.suppress(ValueError, MemoryError):
            (run if read is frames.Network else frames.Sampler(run))(frame)
    file.close()
    assert DAMAGED / 100 < opened < DAMAGED / 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # kB
