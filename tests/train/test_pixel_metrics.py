"""Scores of pixels against torchmetrics and NumPy."""

import math

import numpy as np
import pytest
import torch
from helpers import refused
from torchmetrics.classification import MulticlassJaccardIndex

from darswin.train.distance import METRICS, DistanceSums
from darswin.train.pixel_metrics import Zones
from darswin.train.segmentation import LabelSums, iou_and_recall


def numpy_iou(predicted, labels, weights, classes):
    """IoU of each class, NaN where it occurs nowhere."""
    found = []
    for k in range(classes):
        both = weights[(predicted == k) & (labels == k)].sum()
        either = weights[(predicted == k) | (labels == k)].sum()
        found.append(both / either if either else np.nan)
    return np.array(found)


def counted(sums, *pixels, parts=3):
    """What a metric has after the pixels came in parts."""
    for k in range(parts):
        sums.update(*(values[k::parts] for values in pixels))
    return sums.compute()


@pytest.mark.parametrize("left_out", [None, 0, 3])
def test_scores_of_labels(left_out):
    rng = np.random.default_rng(0)
    classes, zones = 6, 3  # class 5 occurs nowhere, class 4 is only said
    labels, zone = rng.integers(0, 4, 2000), rng.integers(0, zones, 2000)
    predicted = np.where(rng.random(2000) < 0.6, labels, rng.integers(0, 5, 2000))
    area = rng.random(2000)
    known = labels != left_out
    pixels = [torch.from_numpy(v[known]) for v in (predicted, labels, zone, area)]
    counts, areas = counted(LabelSums(classes, zones), *pixels)
    assert counts.dtype == torch.int64 and counts.sum() == known.sum()

    def check(found, weights, where):
        overall = LabelSums(classes, zones, left_out).scores(found)
        iou, recall = iou_and_recall(found)
        p, t, w = predicted[known & where], labels[known & where], weights[known & where]
        expected = numpy_iou(p, t, w, classes)
        np.testing.assert_allclose(iou.numpy(), expected, rtol=1e-12)
        mean = np.nanmean(np.delete(expected, [] if left_out is None else left_out))
        assert overall["miou"] == pytest.approx(mean)
        assert overall["accuracy"] == pytest.approx(w[p == t].sum() / w.sum())
        right = [w[(t == k) & (p == k)].sum() / w[t == k].sum() for k in range(3) if k != left_out]
        assert [recall[k].item() for k in range(3) if k != left_out] == pytest.approx(right)

    everywhere = np.ones(2000, bool)
    check(counts.sum(0), np.ones(2000), everywhere)
    check(areas.sum(0), area, everywhere)
    for number in range(zones):
        check(counts[number], np.ones(2000), zone == number)
        check(areas[number], area, zone == number)


def test_miou_is_torchmetrics():
    """It leaves out classes that occur nowhere, and counts those that are only said as 0."""
    labels = torch.randint(0, 4, (500,))
    predicted = torch.where(torch.rand(500) < 0.5, labels, torch.randint(0, 5, (500,)))
    counts, _ = counted(LabelSums(7, 1), predicted, labels, torch.zeros(500).long(), labels)
    expected = MulticlassJaccardIndex(7)(predicted, labels).item()
    assert LabelSums(7, 1).scores(counts[0])["miou"] == pytest.approx(expected)


def test_scores_of_distances():
    rng = np.random.default_rng(0)
    distance = rng.uniform(0.5, 50, 3000).astype(np.float32)
    predicted = (distance * np.exp(rng.normal(0.1, 0.4, 3000))).astype(np.float32)
    zone, area = rng.integers(0, 3, 3000), rng.random(3000)
    pixels = [torch.from_numpy(v) for v in (predicted, distance, zone, area)]
    counts, areas = counted(DistanceSums(3), *pixels)
    assert counts.dtype == torch.float64
    p, d = predicted.astype(np.float64), distance.astype(np.float64)

    def expected(where, weights):
        def mean(values):
            return np.average(values[where], weights=weights[where])

        g, larger = np.log(p) - np.log(d), np.maximum(p / d, d / p)
        return (
            mean(abs(p - d) / d), mean((p - d) ** 2 / d), math.sqrt(mean((p - d) ** 2)),
            math.sqrt(mean(g**2)), 100 * math.sqrt(mean(g**2) - mean(g) ** 2),
            *(mean(larger < 1.25**k) for k in (1, 2, 3)),
        )  # fmt: skip

    for weights, sums in ((np.ones(3000), counts), (area, areas)):
        found = DistanceSums(1).scores(sums.sum(0))
        assert tuple(found) == METRICS
        every = expected(np.ones(3000, bool), weights)
        assert list(found.values()) == pytest.approx(every, rel=1e-9)
        for number in range(3):
            found = DistanceSums(1).scores(sums[number])
            assert list(found.values()) == pytest.approx(expected(zone == number, weights))
    assert 0.2 < found["delta1"] < found["delta2"] < found["delta3"] < 1


def test_sums_of_processes_add_up():
    """As torchmetrics joins processes: by the reduction that each state says."""
    labels, predicted = torch.randint(0, 3, (2, 300))
    zone, area = torch.randint(0, 2, (300,)), torch.rand(300)
    distances = [labels + 1.0, predicted + 1.0]
    for make, values in ((lambda: LabelSums(3, 2), [predicted, labels]),
                         (lambda: DistanceSums(2), distances)):  # fmt: skip
        whole, parts = make(), [make(), make()]
        whole.update(*values, zone, area)
        for k, part in enumerate(parts):
            part.update(*(v[k::2] for v in (*values, zone, area)))
        for name in ("counts", "areas"):
            joined = whole._reductions[name](torch.stack([getattr(p, name) for p in parts]))
            torch.testing.assert_close(joined, getattr(whole, name))


def test_many_pixels_lose_none():
    """float32 has no more whole numbers after 2²⁴ = 16.8 million pixels."""
    sums = DistanceSums(1)
    sums.counts += 2.0**25
    one = torch.ones(1)
    for _ in range(3):
        sums.update(one, one, one.long() * 0, one)
    assert sums.compute()[0][0, 0].item() == 2**25 + 3


def test_nothing_known_is_nan():
    overall = LabelSums(3, 1).scores(torch.zeros(3, 3))
    iou, _ = iou_and_recall(torch.zeros(3, 3))
    assert math.isnan(overall["miou"]) and math.isnan(overall["accuracy"]) and iou.isnan().all()
    assert all(math.isnan(value) for value in DistanceSums(1).scores(torch.zeros(9)).values())


def test_zones():
    zones = Zones([30, 60, 90])
    theta = torch.tensor([0.0, 29.9, 30.1, 89.9, 90.1, 140.0]).deg2rad()
    assert zones.of(theta).tolist() == [0, 0, 1, 2, 3, 3]
    border = torch.tensor([math.pi / 2], dtype=torch.float64)  # is in the outer zone
    assert zones.of(border).tolist() == [3]
    assert [(z["from_deg"], z["to_deg"]) for z in zones.ranges()] == [
        (0, 30), (30, 60), (60, 90), (90, None),
    ]  # fmt: skip
    assert len(Zones([])) == 1 and not Zones([]).of(theta).any()
    for wrong in ([0], [60, 30], [30, 30], [200], [math.nan]):
        refused("`zones` must be increasing", Zones, wrong)
