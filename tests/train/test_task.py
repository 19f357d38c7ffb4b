import pytest
import torch
import torch.nn.functional as F
from torchmetrics.classification import MulticlassAccuracy

from darswin.train.classification import Classification, ClassMetrics


def test_targets_smooth_as_torch_does():
    logits, labels = torch.randn(6, 4), torch.tensor([0, 1, 2, 3, 1, 1])
    targets = Classification("darswin_a_nano", label_smoothing=0.1)._targets(labels, 4)
    expected = F.cross_entropy(logits, labels, label_smoothing=0.1)
    torch.testing.assert_close(F.cross_entropy(logits, targets), expected)


def test_a_broken_picture_weighs_nothing():
    task = Classification("darswin_a_nano", label_smoothing=0.1)
    logits = torch.randn(2, 4, requires_grad=True)
    F.cross_entropy(logits, task._targets(torch.tensor([2, -1]), 4)).backward()
    assert (logits.grad[1] == 0).all() and (logits.grad[0] != 0).all()


def test_metrics_count_images():
    measured = ClassMetrics(10).all()
    logits = torch.zeros(4, 10)
    logits[torch.arange(4), torch.tensor([1, 2, 3, 4])] = 1
    logits[2, 3] = -1  # last of all
    measured["top1"].update(logits, torch.tensor([1, 2, 3, 5]))
    assert measured["top1"].compute() == 0.5
    assert ClassMetrics(3).top5.top_k == 3


def test_metrics_are_those_of_torchmetrics_and_leave_broken_pictures_out():
    measured, logits = ClassMetrics(8), torch.randn(60, 8)
    labels = torch.randint(-1, 8, (60,))
    for part in (slice(0, 40), slice(40, 60)):
        measured.update(logits[part], labels[part])
    logits, labels = logits[labels >= 0], labels[labels >= 0]
    for name, k in (("top1", 1), ("top5", 5)):
        expected = MulticlassAccuracy(8, average="micro", top_k=k)(logits, labels)
        torch.testing.assert_close(measured.all()[name].compute(), expected)
    torch.testing.assert_close(measured.loss.compute(), F.cross_entropy(logits, labels))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(name="resnet"), "unknown model 'resnet'"),
        (dict(label_smoothing=1.0), "label_smoothing"),
        (dict(mixup=-1.0), "mixing needs"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        Classification(**options)
