import model
import pytest
import torch
from kit import candidates, tables, targets
from kit.memory import Memory
from kit.record import Record
from kit.timing import (
    COMPILED,
    FIXED_LENS,
    MATMULS,
    OURS,
    OURS_BFLOAT16,
    OURS_FLOAT32,
    REFERENCE,
)

from darswin.cli.arguments import run_command
from darswin.layers.linear import onednn_lack
from darswin.models import DarSwin


@pytest.mark.slow
def test_it_measures_and_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(model, "THREADS", [1])
    measured = set()

    def measure(mode, model, size, dtype, batch, name, threads):
        measured.add((mode, dtype, name))
        return Memory(f"{mode}, {dtype}", batch, name, 1, 2, 3)

    monkeypatch.setattr(model.memory, "measure", measure)
    options = "--model darswin_a_nano --size 32 --batches 1 2 --seconds 0.01 --compiled --out"
    run_command(model.bench, [*options.split(), str(tmp_path)], "model.py")
    (path,) = tmp_path.glob("model--*.json")
    assert path.with_suffix(".png").exists()
    record = Record.load(path)
    both = [(m, d) for m in ("inference", "training") for d in ("float32", "bfloat16")]
    modes = [*both, ("inference", "int8")]
    found: dict[tuple[str, int], set[str]] = {}
    for t in record.timings:
        assert (t.subject, t.setting, t.threads, t.target) == ("darswin_a_nano", "32×32", 1, None)
        assert t.runs >= 100 or t.batch == 2 or t.mode.startswith("training")
        found.setdefault((t.mode, t.batch), set()).add(t.name)
    expected = {}
    for mode, dtype in modes:
        names = {OURS, REFERENCE, MATMULS} | ({FIXED_LENS} if mode == "inference" else set())
        if dtype == "int8":
            bfloat16 = onednn_lack(torch.bfloat16) is None
            names |= {OURS_FLOAT32, OURS_BFLOAT16} if bfloat16 else {OURS_FLOAT32}
        expected |= {(f"{mode}, {dtype}", batch): names for batch in (1, 2)}
    assert found == expected
    assert measured == {(*both_of, name) for both_of in both for name in (OURS, REFERENCE)}
    printed = capsys.readouterr().out
    assert tables.models_table(record.timings) in printed and str(path) in printed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (dict(size=0), "`size` must be from 1 to 65536, got 0"),
        (dict(batches=[-1]), "`batches` must be from 1 to 65536, got -1"),
        (dict(batches=[]), "--batches must have at least one number"),
        (dict(seconds=float("nan")), "`seconds` must be above 0, got nan"),
        (dict(model="swan"), "unknown model 'swan'"),
    ],
)
def test_wrong_options_are_refused_before_any_work(monkeypatch, tmp_path, options, words):
    monkeypatch.setattr(model, "machine", lambda: pytest.fail("it was refused too late"))
    with pytest.raises(ValueError, match=words):
        model.bench(**options, out=tmp_path)


@pytest.mark.slow
def test_targets_are_for_all_threads(monkeypatch):
    monkeypatch.setattr(targets, "MODEL", "darswin_a_nano")
    monkeypatch.setattr(model, "THREADS", [1, 2])
    arguments = ("darswin_a_nano", 64, 8, 1e-3, False)
    with model.num_threads(2):
        found = model._measure("inference", "float32", *arguments)
    wanted = {t.name: t.target for t in found}
    assert wanted == {OURS: None, FIXED_LENS: None, MATMULS: 0.8, REFERENCE: 2.6}
    with model.num_threads(1):
        assert not any(t.target for t in model._measure("inference", "float32", *arguments))


@pytest.mark.parametrize("name", ["darswin_a_nano", "dat_nano"])
def test_the_matrix_products_are_all_of_the_model(name):
    net, lens = candidates.network(name, 32).eval(), candidates.lens_of(32)
    products = candidates.matmuls_of(net, torch.randn(2, 3, 32, 32), lens, torch.float32)
    layers = [m for m in net.modules() if isinstance(m, torch.nn.Linear)]
    sizes = sorted((m.in_features, m.out_features) for m in layers)
    assert sorted((x.shape[-1], product(x).shape[-1]) for product, x in products) == sizes
    if isinstance(net, DarSwin):
        # Tokens of the embedding, of three stages' blocks with twelve squares of their width each.
        tokens, widths, depths = (256, 64, 16), (24, 48, 96), (1, 2, 1)
        expected = 256 * 4 * 4 * 3 * 24 + 96 * 200
        expected += sum(12 * t * w * w * d for t, w, d in zip(tokens, widths, depths, strict=True))
        expected += sum(t * 4 * w * 2 * w for t, w in ((64, 24), (16, 48)))
        assert candidates.operations_of(name, 32) == 2 * expected


def test_candidates_that_disagree_are_not_timed():
    runs = {OURS: lambda: torch.ones(3), REFERENCE: lambda: torch.ones(3) + 1e-3}
    model._check(runs | {MATMULS: lambda: torch.zeros(1)}, 1e-2)
    with pytest.raises(RuntimeError, match="darswin differs from the reference"):
        model._check(runs, 1e-4)


def test_the_reference_is_compiled_with_freezing(monkeypatch):
    asked = []

    def compiled(model, **options):
        asked.append(options)
        return model

    monkeypatch.setattr(torch, "compile", compiled)
    runs = candidates.inference("darswin_a_nano", 32, torch.float32, 2, compiled=True)
    assert COMPILED in runs and asked == [dict(options={"freezing": True}, dynamic=False)]
    model._check(runs, 1e-4)
