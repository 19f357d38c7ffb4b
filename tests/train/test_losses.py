"""Losses of pixels against torch's own and NumPy, and what must not change them."""

import math
from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from darswin.data import IGNORE
from darswin.train.distance import distance_loss
from darswin.train.segmentation import label_loss

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
