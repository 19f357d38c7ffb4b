"""Losses of pixels against torch's own and NumPy, and what must not change them."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from darswin.data import IGNORE
from darswin.train.losses import distance_loss, label_loss

f64 = torch.float64


@pytest.fixture
def labelled():
    logits = torch.randn(3, 5, 7, 6, dtype=f64)
    labels = torch.randint(0, 4, (3, 7, 6))  # none of class 4
    labels[torch.rand(3, 7, 6) < 0.3] = IGNORE
    return logits, labels


@pytest.fixture
def measured():
    predicted = 0.5 + 5 * torch.rand(3, 1, 7, 6, dtype=f64)
    distance = 0.5 + 5 * torch.rand(3, 7, 6, dtype=f64)
    distance[torch.rand(3, 7, 6) < 0.3] = 0
    return predicted, distance


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
@pytest.mark.parametrize("weighted", [False, True])
def test_cross_entropy_is_torch_s(labelled, smoothing, weighted):
    logits, labels = labelled
    weights = torch.rand(5, dtype=f64) if weighted else None
    found = label_loss(logits, labels, "ce", class_weights=weights, label_smoothing=smoothing)
    expected = F.cross_entropy(
        logits, labels, weights, ignore_index=IGNORE, label_smoothing=smoothing
    )
    torch.testing.assert_close(found, expected)


def numpy_dice(logits, labels, pixels, classes):
    """Class by class, in loops."""
    probability = logits.softmax(1).numpy()
    losses, counts = [], []
    for k in range(probability.shape[1]):
        both = predicted = truth = 0.0
        for b, y, x in np.ndindex(*labels.shape):
            if labels[b, y, x] == IGNORE:
                continue
            share, p = pixels[b, y, x].item(), probability[b, k, y, x]
            right = float(labels[b, y, x] == k)
            both, predicted, truth = (
                both + share * p * right,
                predicted + share * p,
                truth + share * right,
            )
        if truth > 0:
            losses.append(classes[k].item() * (1 - 2 * both / (predicted + truth)))
            counts.append(classes[k].item())
    return sum(losses) / sum(counts)


@pytest.mark.parametrize("weighted", [False, True])
def test_dice_is_numpy_s(labelled, weighted):
    logits, labels = labelled
    pixels, classes = torch.rand(3, 7, 6, dtype=f64), torch.rand(5, dtype=f64)
    given = dict(weights=pixels, class_weights=classes) if weighted else {}
    if not weighted:
        pixels, classes = torch.ones_like(pixels), torch.ones_like(classes)
    found = label_loss(logits, labels, "dice", **given)
    assert found.item() == pytest.approx(numpy_dice(logits, labels, pixels, classes))
    both = label_loss(logits, labels, "ce+dice", **given)
    torch.testing.assert_close(both, found + label_loss(logits, labels, "ce", **given))


def test_a_perfect_prediction_costs_nothing(labelled):
    _, labels = labelled
    known = torch.where(labels == IGNORE, 0, labels)
    logits = 100 * F.one_hot(known, 5).permute(0, 3, 1, 2).double()
    for kind in ("ce", "dice", "ce+dice"):
        assert label_loss(logits, labels, kind).item() == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("kind", ["silog", "l1", "log_l1"])
@pytest.mark.parametrize("weighted", [False, True])
def test_distances_are_numpy_s(measured, kind, weighted):
    predicted, distance = measured
    weights = torch.rand(3, 7, 6, dtype=f64) if weighted else None
    found = distance_loss(predicted, distance, kind, weights=weights).item()
    known = distance.numpy() > 0
    p, d = predicted[:, 0].numpy()[known], distance.numpy()[known]
    w = np.ones_like(p) if weights is None else weights.numpy()[known]
    g = np.log(p) - np.log(d)
    expected = {
        "silog": 10 * math.sqrt(
            np.average(g**2, weights=w) - 0.85 * np.average(g, weights=w) ** 2 + 1e-6) - 1e-2,
        "l1": np.average(abs(p - d), weights=w),
        "log_l1": np.average(abs(g), weights=w),
    }  # fmt: skip
    assert found == pytest.approx(expected[kind])


@pytest.mark.parametrize("kind", ["ce", "dice", "ce+dice"])
def test_pixels_without_a_label_change_nothing(labelled, kind):
    logits, labels = labelled
    logits.requires_grad_()
    label_loss(logits, labels, kind).backward()
    unknown = (labels == IGNORE)[:, None].expand_as(logits)
    assert not logits.grad[unknown].any() and logits.grad[~unknown].any()
    other = torch.where(unknown, 1e3, logits.detach())
    assert label_loss(other, labels, kind).item() == label_loss(logits, labels, kind).item()


@pytest.mark.parametrize("kind", ["silog", "l1", "log_l1"])
def test_pixels_without_a_distance_change_nothing(measured, kind):
    predicted, distance = measured
    predicted.requires_grad_()
    distance_loss(predicted, distance, kind).backward()
    unknown = (distance == 0)[:, None]
    assert not predicted.grad[unknown].any() and predicted.grad[~unknown].any()
    other = torch.where(unknown, 1e3, predicted.detach())
    assert distance_loss(other, distance, kind) == distance_loss(predicted, distance, kind)


def test_nothing_known_costs_nothing():
    logits = torch.randn(2, 4, 3, 3, requires_grad=True)
    nothing = torch.full((2, 3, 3), IGNORE)
    losses = [
        label_loss(logits, nothing, kind, class_weights=torch.rand(4), weights=torch.rand(2, 3, 3))
        for kind in ("ce", "dice", "ce+dice")
    ]
    predicted = logits[:, :1].exp()
    losses += [
        distance_loss(predicted, torch.zeros(2, 3, 3), kind) for kind in ("silog", "l1", "log_l1")
    ]
    assert [loss.item() for loss in losses] == [0.0] * 6
    sum(losses).backward()
    assert logits.grad.isfinite().all() and not logits.grad.any()


def test_gradients():
    logits = torch.randn(2, 3, 2, 3, dtype=f64, requires_grad=True)
    labels = torch.tensor([[[0, 1, 2], [IGNORE, 1, 1]], [[2, 2, 0], [0, 1, IGNORE]]])
    weights = torch.rand(2, 2, 3, dtype=f64)
    assert torch.autograd.gradcheck(
        lambda x: label_loss(x, labels, "ce+dice", weights=weights), logits
    )
    predicted = (0.5 + torch.rand(2, 1, 2, 3, dtype=f64)).requires_grad_()
    distance = labels.double() % 255
    for kind in ("silog", "l1", "log_l1"):
        assert torch.autograd.gradcheck(
            lambda x, k=kind: distance_loss(x, distance, k, weights=weights), predicted
        )


def test_silog_of_a_right_prediction_has_a_gradient():
    predicted = torch.full((1, 1, 2, 2), 3.0, requires_grad=True)
    loss = distance_loss(predicted, torch.full((1, 2, 2), 3.0))
    loss.backward()
    assert predicted.grad.isfinite().all() and loss.item() == pytest.approx(0, abs=1e-5)
