"""Which options of a run may change when it is resumed."""

from collections.abc import Mapping
from typing import Any

# A change takes effect from the checkpoint on. Options of the trainer may change as well, except
# for accumulate_grad_batches, which is part of a step's size.
CHANGEABLE = {
    *("checkpoint_steps", "weights_only"),
    *(f"model.{rate}_rate" for rate in ("learning", "warmup", "final")),
    *("model.warmup_epochs", "model.reference_batch", "model.weight_decay"),
    *("model.label_smoothing", "model.mixup", "model.cutmix", "model.mix_p"),
    *("model.loss", "model.class_weights", "model.solid_angle_weights", "model.zones"),
    *("model.matmul_backend", "model.grad_checkpointing"),
    *("data.path", "data.classes", "data.splits", "data.skip_broken"),
    *("data.lens", "data.camera", "data.coefficients"),
    *("data.batch_size", "data.workers"),
    *("data.train_lenses", "data.test_lenses", "data.pair_lenses"),
    *("data.render", "data.fit", "data.picture_size", "data.randaugment", "data.erasing"),
    *("data.flip", "data.rotate_deg", "data.crop", "data.lens_augmentation"),
    *("data.test_paths", "data.max_distance"),
}


def check_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What differs between a run's configuration and the one to resume with, a line an option.

    Raises:
        ValueError: an option that cannot change, named as people type it.
    """
    before, now = _options(before), _options(now)
    changes = {
        name: f"--{name} {now[name]!r} in place of {before.get(name)!r}"
        for name in now
        # An option that is off is none that an older run lacks.
        if now[name] != before.get(name) and (name in before or now[name])
    }
    refused = [
        text
        for name, text in changes.items()
        if name not in CHANGEABLE
        and (not name.startswith("trainer.") or name == "trainer.accumulate_grad_batches")
    ]
    if refused:
        raise ValueError(f"a run goes on with what it began with, not with {'; '.join(refused)}")
    return list(changes.values())


def _options(config: Mapping[str, Any]) -> dict[str, Any]:
    """The options by their names on the command line."""
    found: dict[str, Any] = {"task": "classification"}  # before there were others
    for group, value in config.items():
        if group in ("model", "data", "trainer"):
            found |= {f"{group}.{name}": own for name, own in value.items()}
        elif group != "run":  # it may have moved
            found[group] = value
    return found
