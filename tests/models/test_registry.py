import pytest

from darswin.models import registry
from darswin.models.encoder import Encoder


def test_a_model_is_registered_in_four_sizes(monkeypatch):
    monkeypatch.setattr(registry, "_MODELS", {})

    @registry.register_model("ours", presets=dict(nano=dict(embed_dim=8)), variant="A")
    class Ours(Encoder):
        def __init__(self, **options):
            super().__init__()
            self.options = options

    names = [f"ours_{size}" for size in ("micro", "nano", "small", "tiny")]
    assert registry.list_models() == names
    assert all(registry.model_class(name) is Ours for name in names)
    nano, small = (registry.create_model(f"ours_{size}").options for size in ("nano", "small"))
    assert nano["embed_dim"] == 8 and small["embed_dim"] == 96  # a preset goes before its size's
    assert nano.keys() == small.keys() and nano["variant"] == small["variant"] == "A"
    assert registry.create_model("ours_nano", variant="B").options["variant"] == "B"
    with pytest.raises(ValueError, match="unknown model 'swin_nano'; there are ours_micro, ours_n"):
        registry.model_class("swin_nano")
