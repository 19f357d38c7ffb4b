"""Command lines but for `darswin lens`, `fit`, `test` and `predict`, which have their own tests."""

import functools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from darswin.cli import bench as command
from darswin.cli.arguments import with_lists
from darswin.cli.main import main


def test_only_numbers_after_the_option_are_its_list():
    argv = ["--mean", ".5", "-1e-3", "a.png", "--std", "x", "--other", "1", "2", "--mean"]
    expected = ["--mean=[.5,-1e-3]", "a.png", "--std", "x", "--other", "1", "2", "--mean"]
    assert with_lists(argv, ("mean", "std")) == expected


def test_words_after_the_option_are_its_list():
    for argv in (["--paths", "a b", "c"], ["--paths=a b", "c"]):
        assert with_lists([*argv, "--x", "1"], (), ["paths"]) == [
            '--paths=["a b", "c"]',
            "--x",
            "1",
        ]
    for argv in (
        ["--paths", "null", "--x"],
        ["--paths", '["a"]'],
        ["--paths=null"],
        ["--pathsx", "a"],
    ):
        assert "=".join(with_lists(argv, (), ["paths"])) == "=".join(argv)
    assert with_lists(["--paths"], (), ["paths"]) == ["--paths"]


def refused(capsys, *argv):
    """What is said of arguments that end a command with exit code 2."""
    with pytest.raises(SystemExit) as end:
        main(list(argv))
    assert end.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    "argv, said",
    [
        (["models", "swin"], "unrecognized arguments: swin"),
        (["convert"], "the following arguments are required: source, target"),
        (["convert", "none.pth", "out.safetensors"], "No such file or directory: 'none.pth'"),
        (["convert", "a", "b", "--fast"], "unrecognized arguments: --fast"),
        (["bench", "--size", "0"], "--size must be from 1 to 65536, got 0"),
        (["bench", "--size=-1"], "--size must be from 1 to 65536, got -1"),
        (["bench", "--batches", "1,x"], "--batches must be whole numbers, such as 1,8, got 1,x"),
        (["bench", "--batches"], "--batches must be one number at least"),
        (["bench", "--seconds", "nan"], "--seconds must be above 0, got nan"),
        (["bench", "--model", "swan"], "unknown model 'swan'"),
        (["bench", "--out", __file__], "File exists"),
        (["train"], "no command 'train'; there are fit, "),
    ],
)
def test_misuse_ends_with_a_sentence_before_any_work(capsys, monkeypatch, argv, said):
    monkeypatch.setattr(command, "machine", lambda: pytest.fail("it was refused too late"))
    assert said in refused(capsys, *argv)


@pytest.mark.parametrize("typed", [["1", "8"], ["1,8"], ["[1,8]"], ["[1,", "8]"]])
def test_bench_takes_lists_as_people_type_them(monkeypatch, typed):
    found = []
    bench = functools.update_wrapper(lambda **options: found.append(options), command.bench)
    bench.__kwdefaults__ = command.bench.__kwdefaults__
    monkeypatch.setattr(command, "bench", bench)
    main(["bench", "--batches", *typed, "--compiled"])
    main(["bench", "--compiled", *typed])
    assert [options["batches"] for options in found] == [[1, 8], (1, 8, 32)]
    assert [options["compiled"] for options in found] == [[], [1, 8]]


WORDS = st.sampled_from(
    ["models", "bench", "convert", "--size", "--batches", "--compiled", "--seconds", "--out",
     "--model", "--config", "--foo", "-x", "-", "--", "", "0", "-1", "9" * 5000, "1e300", "nan",
     "[", "[]", "1,,2", ",", "x", ".", "/dev/null", "\ud800", "²", "source", "=", "--size="]
)  # fmt: skip


def stop():
    raise OSError("the benchmark would begin")


@given(st.sampled_from(["models", "bench", "convert"]), st.lists(WORDS, max_size=5))
def test_any_arguments_end_with_an_answer_or_a_sentence(tmp_path_factory, name, words):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.getbasetemp())
        patch.setattr(command, "machine", stop)
        try:
            main([name, *words])
        except SystemExit as end:
            assert end.code in (0, 2)
