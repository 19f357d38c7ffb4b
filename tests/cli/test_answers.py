import numpy as np
import pytest
import torch

from darswin import create_model
from darswin.cli import answers as module
from darswin.cli.answers import ClassAnswers
from darswin.layers.position_bias import RelativeBias
from darswin.lens import Spherical
from darswin.models.saving import ModelCard

CARD = ModelCard("darswin_a_nano", dict(num_classes=6), "abcdef", 32)
SIZE = torch.tensor([[48, 64]])


@pytest.mark.parametrize("name", ["darswin_a_nano", "swin_nano"])
@torch.no_grad()
def test_answers_are_the_models_in_order_whatever_the_lenses(name, monkeypatch):
    model = create_model(name, num_classes=6).eval()
    card = ModelCard(name, dict(num_classes=6), "abcdef", 32, fit="crop")
    lenses = [Spherical.from_fov(xi, 2.6, 24.0).replace(image_size=SIZE) for xi in (0.1, 0.8)]
    order = [0] * 10 + [1, 0, 1, 1] + [0] * 3
    rng = np.random.default_rng(0)
    images = [rng.integers(256, size=(48, 64, 3), dtype=np.uint8) for _ in order]
    answers = ClassAnswers(model, card, 6)
    sizes = []
    run = answers.model.run
    monkeypatch.setattr(answers.model, "run", lambda x, p: sizes.append(len(x)) or run(x, p))
    for k, (image, which) in enumerate(zip(images, order, strict=True)):
        answers.add({"image": k}, image, lenses[which])
    answers.flush()
    answers.flush()
    assert sizes == [module.BATCH, 2, 1, 1, 2, 3] and answers.seconds > 0
    assert [entry["image"] for entry in answers.found] == list(range(len(order)))
    for entry, image, which in zip(answers.found, images, order, strict=True):
        pixels, lens = module.resized(model, card, image, lenses[which])
        assert pixels.shape == (1, 3, 32, 32)
        expected = model(pixels, lens).softmax(-1)[0]
        for found in entry["top"]:
            k = "abcdef".index(found["class"])
            assert found["probability"] == pytest.approx(expected[k].item(), abs=1e-5)


def test_a_lens_is_prepared_once(monkeypatch):
    answers = ClassAnswers(create_model("darswin_a_nano", num_classes=6), CARD, 2)
    lens = Spherical.from_fov(0.3, 2.6, 24.0).replace(image_size=SIZE)
    image = np.zeros((48, 64, 3), np.uint8)
    answers.add({}, image, lens)
    monkeypatch.setattr(RelativeBias, "forward", None)
    for _ in range(2 * module.BATCH):
        answers.add({}, image, lens)
    answers.flush()
    assert len(answers.found) == 2 * module.BATCH + 1
    assert all(len(entry["top"]) == 2 for entry in answers.found)


def test_lenses_that_take_turns_are_prepared_once(monkeypatch):
    answers = ClassAnswers(create_model("darswin_a_nano", num_classes=6), CARD, 1)
    prepared = []
    prepare = answers.model.prepare
    monkeypatch.setattr(answers.model, "prepare", lambda *a: prepared.append(a) or prepare(*a))
    image = np.zeros((48, 64, 3), np.uint8)
    lenses = [
        Spherical.from_fov(xi / 20, 2.6, 24.0).replace(image_size=SIZE) for xi in range(20)
    ]  # fmt: skip
    for lens in lenses[:4] * 3:
        answers.add({}, image, lens)
    assert len(prepared) == 4
    for lens in lenses + lenses[-module.LENSES :]:  # no more than so many are kept
        answers.add({}, image, lens)
    answers.flush()
    assert len(prepared) == 20 and len(answers.found) == 12 + 20 + module.LENSES
