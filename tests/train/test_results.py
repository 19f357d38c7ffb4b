"""What a test says: the number of pictures, intervals, and whether a model is better than one
answer for all pictures."""

from types import SimpleNamespace

import pytest
import torch
from scipy.stats import binomtest

from darswin.models.saving import ModelCard
from darswin.train.classification import Classification, ClassMetrics, wilson
from darswin.train.results import WriteResults


@pytest.mark.parametrize(("right", "n"), [(0, 1), (1, 1), (7, 12), (96, 96), (0, 40), (500, 1000)])
def test_the_interval_is_wilson_s(right, n):
    expected = binomtest(right, n).proportion_ci(0.95, "wilson")
    assert wilson(right / n, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.fixture
def tested(tmp_path, capsys, monkeypatch):
    """A function: labels and the share of right answers of each test set → the task, and what is
    printed of its results."""

    def make(sets):
        task = Classification("darswin_a_nano")
        task.card = task.trained = ModelCard("darswin_a_nano", {}, list("abc"), 32, 2.8)
        data = SimpleNamespace(test_names=list(sets), train_lenses=None)
        monkeypatch.setattr(Classification, "data", data)
        task.test_metrics = torch.nn.ModuleList(ClassMetrics(3) for _ in sets)
        for metrics, (labels, right) in zip(task.test_metrics, sets.values(), strict=True):
            truth = torch.tensor(labels, dtype=torch.int64)
            answers = (truth + (torch.arange(len(truth)) >= right)) % 3
            metrics.update(torch.nn.functional.one_hot(answers, 3).float(), truth)
        task.on_test_epoch_end()
        WriteResults(tmp_path).on_test_end(None, task)
        return task.results, capsys.readouterr().out, task.results_figure()

    return make


def test_a_test_says_how_many_pictures_and_how_sure_it_is(tested):
    labels = [0] * 14 + [1] * 6 + [2] * 4
    rows, said, figure = tested({"0": (labels, 20), "0.5": (labels, 14)})
    assert [row["n"] for row in rows] == [24, 24]
    assert rows[0]["most_frequent"] == pytest.approx(14 / 24)
    assert (rows[0]["top1_low"], rows[0]["top1_high"]) == pytest.approx(wilson(20 / 24, 24))
    heads, first, second = said.strip().splitlines()[:3]
    for word in ("n", "top1 (%)", "95 % interval", "most frequent class (%)"):
        assert word in heads
    assert "64.1–93.3" in first and "58.33" in second and "24" in first
    assert "On 0.5, the accuracy is not certainly above that of always" in said
    axes = figure.axes[0]
    assert axes.get_title() == "n = 24"
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"95 % interval", "most frequent class"} <= {*names}


def test_other_test_sets_are_bars_and_may_be_empty(tested):
    rows, said, figure = tested({"polynomial": ([0, 1, 2] * 20, 60), "low": ([], 0)})
    assert rows[1]["n"] == 0 and rows[1]["loss"] is rows[1]["top1_low"] is None
    assert "certainly" not in said
    assert figure.axes[0].get_title() == "n = 0–60"
