"""Losses and scores of pixels against torch, torchmetrics and NumPy; what must not change them."""

import math
from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import refused
from torchmetrics.classification import MulticlassJaccardIndex

from darswin.data import IGNORE
from darswin.train.distance import METRICS, DistanceSums, distance_loss
from darswin.train.pixel_metrics import Zones
from darswin.train.segmentation import LabelSums, iou_and_recall, label_loss

f64 = torch.float64
LABELS, DISTANCES = ("ce", "dice", "ce+dice"), ("silog", "l1", "log_l1")
every_loss = pytest.mark.parametrize("kind", LABELS + DISTANCES)


def case(kind, shape=(3, 7, 6)):
    """A loss, predictions, targets, and which targets are not known. No pixel has class 4."""
    unknown = torch.rand(shape) < 0.3
    if kind in LABELS:
        predicted = torch.randn(shape[0], 5, *shape[1:], dtype=f64)
        target = torch.where(unknown, IGNORE, torch.randint(0, 4, shape))
        return partial(label_loss, kind=kind), predicted, target, unknown
    predicted = 0.5 + 5 * torch.rand(shape[0], 1, *shape[1:], dtype=f64)
    target = torch.where(unknown, 0, 0.5 + 5 * torch.rand(shape, dtype=f64))
    return partial(distance_loss, kind=kind), predicted, target, unknown


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
@pytest.mark.parametrize("weighted", [False, True])
def test_cross_entropy_is_torch_s(smoothing, weighted):
    loss, logits, labels, _ = case("ce")
    weights = torch.rand(5, dtype=f64) if weighted else None
    found = loss(logits, labels, class_weights=weights, label_smoothing=smoothing)
    expected = F.cross_entropy(
        logits, labels, weights, ignore_index=IGNORE, label_smoothing=smoothing
    )
    torch.testing.assert_close(found, expected)


def numpy_dice(logits, labels, pixels, classes):
    """Class by class."""
    probability, known = logits.softmax(1).numpy(), labels != IGNORE
    losses, counts = [], []
    for k in range(probability.shape[1]):
        share, right = pixels[known], labels[known] == k
        p = probability[:, k][known]
        if right.any():
            both, either = (share * p * right).sum(), (share * p + share * right).sum()
            losses.append(classes[k] * (1 - 2 * both / either))
            counts.append(classes[k])
    return sum(losses) / sum(counts)


@pytest.mark.parametrize("weighted", [False, True])
def test_dice_is_numpy_s(weighted):
    loss, logits, labels, _ = case("dice")
    pixels, classes = torch.rand(3, 7, 6, dtype=f64), torch.rand(5, dtype=f64)
    given = dict(weights=pixels, class_weights=classes) if weighted else {}
    if not weighted:
        pixels, classes = torch.ones_like(pixels), torch.ones_like(classes)
    found = loss(logits, labels, **given)
    expected = numpy_dice(logits, *(t.numpy() for t in (labels, pixels, classes)))
    assert found.item() == pytest.approx(expected)
    both = label_loss(logits, labels, "ce+dice", **given)
    torch.testing.assert_close(both, found + label_loss(logits, labels, "ce", **given))


@pytest.mark.parametrize("kind", DISTANCES)
@pytest.mark.parametrize("weighted", [False, True])
def test_distances_are_numpy_s(kind, weighted):
    loss, predicted, distance, unknown = case(kind)
    weights = torch.rand(3, 7, 6, dtype=f64) if weighted else None
    found = loss(predicted, distance, weights=weights).item()
    p, d = predicted[:, 0][~unknown].numpy(), distance[~unknown].numpy()
    w = np.ones_like(p) if weights is None else weights[~unknown].numpy()
    g = np.log(p) - np.log(d)
    expected = {
        "silog": 10 * math.sqrt(
            np.average(g**2, weights=w) - 0.85 * np.average(g, weights=w) ** 2 + 1e-6) - 1e-2,
        "l1": np.average(abs(p - d), weights=w),
        "log_l1": np.average(abs(g), weights=w),
    }  # fmt: skip
    assert found == pytest.approx(expected[kind])


@every_loss
def test_a_right_prediction_costs_nothing_and_has_a_gradient(kind):
    loss, predicted, target, unknown = case(kind)
    if kind in LABELS:
        known = torch.where(unknown, 0, target)
        predicted = 100 * F.one_hot(known, 5).permute(0, 3, 1, 2).double()
    else:
        predicted = torch.where(unknown, 1, target)[:, None]
    found = loss(predicted.requires_grad_(), target)
    found.backward()
    assert found.item() == pytest.approx(0, abs=1e-9) and predicted.grad.isfinite().all()


@every_loss
def test_unknown_pixels_change_nothing(kind):
    loss, predicted, target, unknown = case(kind)
    loss(predicted.requires_grad_(), target).backward()
    unknown = unknown[:, None].expand_as(predicted)
    assert not predicted.grad[unknown].any() and predicted.grad[~unknown].any()
    other = torch.where(unknown, 1e3, predicted.detach())
    assert loss(other, target).item() == loss(predicted, target).item()


@every_loss
def test_nothing_known_costs_nothing(kind):
    loss, predicted, target, _ = case(kind)
    more = dict(class_weights=torch.rand(5, dtype=f64)) if kind in LABELS else {}
    nothing = torch.full_like(target, IGNORE if kind in LABELS else 0)
    found = loss(predicted.requires_grad_(), nothing, weights=torch.rand(3, 7, 6), **more)
    found.backward()
    assert found.item() == 0 and predicted.grad.isfinite().all() and not predicted.grad.any()


@every_loss
def test_gradients(kind):
    loss, predicted, target, _ = case(kind, (2, 2, 3))
    weights = torch.rand(2, 2, 3, dtype=f64)
    assert torch.autograd.gradcheck(
        lambda x: loss(x, target, weights=weights), predicted.requires_grad_()
    )


# -- scores ---------------------------------------------------------------------------------


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
