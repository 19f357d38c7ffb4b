import json

import pytest
import torch
from safetensors.torch import save_file

from darswin.lens import Spherical
from darswin.models.saving import ModelCard, load_model, save_model

CARD = ModelCard(
    "darswin_a_nano", {"num_classes": 3, "in_chans": 1, "spacing": "tan"}, ["a", "b", "c"], 32, 2.9
)


def test_a_saved_model_computes_the_same(tmp_path):
    model = CARD.create().eval()
    save_model(tmp_path / "m.safetensors", model.state_dict(), CARD)
    loaded, card = load_model(tmp_path / "m.safetensors")
    assert card == CARD and not loaded.training
    images, lens = torch.rand(2, 1, 32, 32), Spherical.from_fov(0.3, 2.9, 16)
    assert torch.equal(loaded(images, lens), model(images, lens))


def test_what_is_no_model_of_ours(tmp_path):
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"no model")
    with pytest.raises(ValueError, match=r"m\.safetensors is no safetensors file"):
        load_model(path)
    weights = CARD.create().state_dict()
    save_file(weights, path)
    with pytest.raises(ValueError, match="not the name of their model"):
        load_model(path)
    for entry in ('{"model": 1}', "[]", "{", json.dumps(dict(vars(CARD), model="os.system"))):
        save_file(weights, path, metadata={"darswin": entry})
        with pytest.raises(ValueError, match="no model that this darswin can build"):
            load_model(path)
    save_model(path, {"head.weight": torch.zeros(2, 2)}, CARD)
    with pytest.raises(ValueError, match="no model that this darswin can build"):
        load_model(path)
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "nothing.safetensors")


def test_an_older_file_lacks_what_came_later(tmp_path):
    path, older = tmp_path / "m.safetensors", dict(vars(CARD))
    del older["fit"]
    save_file(CARD.create().state_dict(), path, metadata={"darswin": json.dumps(older)})
    assert load_model(path)[1] == CARD and CARD.fit == "whole"
