import json

import pytest
import torch
from safetensors.torch import save_file

from darswin import create_model
from darswin.lens import Equidistant
from darswin.models.saving import ModelCard, load_model, read_card, save_model
from darswin.views import MercatorView, make_view

CARD = ModelCard(
    "darswin_a_nano", {"num_classes": 3, "in_chans": 1, "spacing": "tan"}, ["a", "b", "c"], 32, 2.9
)


@pytest.fixture(scope="module")
def weights():
    return CARD.create().state_dict()


def write(path, weights, **changes):
    entry = json.dumps(dict(vars(CARD)) | changes)
    save_file(weights, path, metadata={"darswin": entry})


def refusal(path):
    """The message of the error that `load_model` raises for a file; it must be one line."""
    with pytest.raises(ValueError, match="is no model that this darswin can build: ") as error:
        load_model(path)
    assert type(error.value) is ValueError and "\n" not in str(error.value)
    return str(error.value)


def test_files_that_are_no_model_of_ours(weights, tmp_path):
    path = tmp_path / "m.safetensors"
    with pytest.raises(FileNotFoundError):
        load_model(path)
    path.write_bytes(b"no model")
    with pytest.raises(ValueError, match=r"m\.safetensors cannot be read as safetensors: it is no"):
        load_model(path)
    save_file(weights, path)
    with pytest.raises(ValueError, match="not the name of their model"):
        load_model(path)
    for entry in ('{"model": 1}', "[]", "{", json.dumps(dict(vars(CARD), model="os.system"))):
        save_file(weights, path, metadata={"darswin": entry})
        refusal(path)


def test_other_weights_are_named_in_a_sentence(weights, tmp_path):
    path = tmp_path / "m.safetensors"
    write(path, {name: tensor for name, tensor in weights.items() if name != "head.bias"})
    assert 'Missing key(s) in state_dict: "head.bias"' in refusal(path)
    write(path, weights | {"more": torch.zeros(1)})
    assert 'Unexpected key(s) in state_dict: "more"' in refusal(path)
    write(path, weights | {"head.bias": torch.zeros(4)})
    assert "size mismatch for head.bias" in refusal(path)


WRONG = (None, True, -1, 0.5, "x", [], [1], {}, {"a": None}, [[None]], float("nan"), 1e400)


@pytest.mark.parametrize("field", vars(CARD))
def test_a_card_with_a_wrong_value_is_refused_in_a_sentence(field, weights, tmp_path):
    path, refused = tmp_path / "m.safetensors", []
    for value in WRONG:
        write(path, weights, **{field: value})
        try:
            assert isinstance(load_model(path)[1], ModelCard)
        except ValueError:
            assert f"{field} must be" in refusal(path) or field in ("model", "options", "quantized")
            refused.append(value)
    assert None in refused and len(refused) >= 8
    write(path, weights, **{field: None})
    with pytest.raises(ValueError, match=f"its {field} must be .*, got None"):
        read_card(path)


@pytest.mark.parametrize("option", ["num_classes", "in_chans", "spacing", "embed_dim", "depths",
                                    "num_heads", "mean", "x"])  # fmt: skip
def test_options_of_a_wrong_kind_are_refused_in_a_sentence(option, weights, tmp_path):
    path = tmp_path / "m.safetensors"
    for value in (*WRONG, "a", [None, 1]):
        write(path, weights, options=dict(CARD.options) | {option: value})
        try:
            load_model(path)
        except ValueError:
            refusal(path)


def test_a_card_without_a_field_is_refused(weights, tmp_path):
    path, shorter = tmp_path / "m.safetensors", dict(vars(CARD))
    del shorter["fit"]
    save_file(weights, path, metadata={"darswin": json.dumps(shorter)})
    assert refusal(path).endswith("its model card lacks fit")


def test_a_card_shows_the_normalization():
    assert (CARD.mean, CARD.std) == (0.0, 1.0)
    assert repr(CARD).endswith("channels=1, mean=0.0, std=1.0)") and "spacing" in repr(CARD)
    card = ModelCard("swin_nano", dict(mean=[0.4, 0.5, 0.6], std=0.2))
    assert (card.mean, card.std, card.channels) == ([0.4, 0.5, 0.6], 0.2, 3)
    assert str(card).endswith("mean=[0.4, 0.5, 0.6], std=0.2)")
    model = card.create()
    assert list(model.mean) == card.mean and set(model.std) == {card.std}


def test_a_card_keeps_the_whole_view(tmp_path):
    path, frame = tmp_path / "m.safetensors", torch.randint(256, (1, 3, 32, 32), dtype=torch.uint8)
    view = make_view(
        "mercator", (24, 32), fov=2.0, up=torch.tensor([0.2, -1, 0]), mean=0.4, std=0.2
    )
    for options in (dict(view=view, window=(3, 4)), dict(view="mercator", mean=0.4)):
        model = create_model("swin_nano", num_classes=3, **options).eval()
        card = ModelCard("swin_nano", dict(options, num_classes=3))
        save_model(path, model.state_dict(), card)
        loaded, read = load_model(path)
        made = model.view.made
        assert read.options["view"].items() <= json.loads(json.dumps(made)).items()
        assert loaded.view.made == made and (read.mean, read.std) == (0.4, card.std)
        assert torch.equal(*(net(frame, Equidistant(12.0, 1.3)) for net in (model, loaded)))
    with pytest.raises(ValueError, match="keeps views of make_view, but only its class made Merc"):
        ModelCard("swin_nano", dict(view=MercatorView((32, 32))))
    with pytest.raises(ValueError, match="mean is an option of the model and of its view"):
        ModelCard("swin_nano", dict(view=view, mean=0.5))
