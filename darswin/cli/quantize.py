"""`darswin quantize`: the model of a run with weights and activations of 8 bits."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from darswin.cli.arguments import check_out
from darswin.cli.options import FIRST_TASK, check_folder
from darswin.deploy.quantize import Change, quantize_model
from darswin.layers.quantized import quantized_layers
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.saving import load_model, model_of_run, save_model
from darswin.train.data import RunData
from darswin.train.tasks import TASKS
from darswin.utils.parameters import check, with_flags
from darswin.utils.progress import Progress
from darswin.utils.text import read_text
from darswin.utils.words import counted

BATCH = 16


def quantize(
    *, run: str, pictures: int = 256, tolerance: float = 0.01, keep: list[str] | None = None,
    out: str | None = None,
) -> str:  # fmt: skip
    """Converts the best model of a run to 8 bits, which makes it faster on CPUs.

    The large matrix products run two to three times as fast as in float32 on CPUs with VNNI, and
    about 1.5 times as fast on others. The ranges of the activations are measured on training
    pictures, through the lenses of training. The parts that change the result most stay in float32.
    The command prints how much the results
    change on validation pictures. `darswin predict --model FILE` and
    `darswin.optimize(model, torch.int8)` run the file.

    Args:
        run: the folder of a run of `darswin fit`.
        pictures: the number of training pictures for the calibration, and of validation pictures
            for the comparison.
        tolerance: the largest allowed change of the results, as mean square over their variance.
            Parts return to float32 until the change is small enough.
        keep: the names of modules that stay in float32, e.g. ["stages.0",
            "stages.1.blocks.0.attn"].
        out: the safetensors file to write. The default is checkpoints/best.int8.safetensors in the
            folder of the run.
    """
    check("pictures", pictures, pictures >= 1, "at least 1")
    check_folder(Path(run), {})
    weights = model_of_run(run)
    check_out(out, [str(weights)])
    model, card = load_model(weights)
    with _with_names_of(Path(run)):
        config = yaml.safe_load(read_text(Path(run) / "config.yaml"))
        options = config["data"] | dict(batch_size=BATCH, workers=0)
        data = TASKS[config.get("task", FIRST_TASK)].data(**options)
        with Progress("reading training pictures"):
            seen = list(_batches(data, "train", pictures))
        if (config.get("trainer") or {}).get("limit_val_batches") == 0:
            held = []  # trained without validation
        else:
            held = list(_batches(data, "val", pictures))
    quantized = quantize_model(model, seen, keep=keep or (), tolerance=tolerance)
    layers = quantized_layers(quantized)
    path = Path(out) if out else weights.with_name(f"{weights.stem}.int8.safetensors")
    card = replace(card, quantized={name: tuple(given) for name, given in layers.items()})
    save_model(path, quantized.state_dict(), card)
    whole = sum(isinstance(module, torch.nn.Linear) for module in model.modules())
    sizes = [file.stat().st_size / 2**20 for file in (weights, path)]
    print(f"{path}: 8 bits in {len(layers)} of {counted(whole, 'linear layer')}")
    print(f"{sizes[0]:.1f} MiB → {sizes[1]:.1f} MiB")
    if not held:
        print("the run has no validation pictures to compare both models on")
        return str(path)
    with Progress("comparing both models on validation pictures"):
        lines = list(_comparison(model, quantized, card.task, held))
    print(*lines, sep="\n")
    return str(path)


@contextmanager
def _with_names_of(run: Path) -> Iterator[None]:
    """Errors of the data name the entries of the run's configuration: this command has no options
    for them."""
    try:
        yield
    except (OSError, ValueError) as error:
        said = with_flags(error, "data.{}".format)
        raise ValueError(f"the data of {run / 'config.yaml'}: {said}") from None


def _batches(data: RunData, split: Any, count: int) -> Iterator[tuple[Tensor, Lens, Tensor]]:
    """Batches of `count` evenly spread pictures of a split, prepared for evaluation."""
    dataset = data.dataset(split)
    count = min(count, len(dataset))
    chosen = [k * len(dataset) // count for k in range(count)]
    yield from DataLoader(Subset(dataset, chosen), BATCH)


def _comparison(
    model: Model, quantized: Model, task: str, batches: Iterable[tuple[Tensor, Lens, Tensor]]
) -> Iterator[str]:
    """Lines that compare the results of both models."""
    pictures = known = right = kept = same = pixels = 0
    results = Change()
    with torch.inference_mode():
        for images, lens, target in batches:
            prepared = model.prepare(lens, (images.shape[2], images.shape[3]))
            a, b = model.run(images, prepared).float(), quantized(images, lens).float()
            results.add(a, b)
            before, after = a.argmax(1), b.argmax(1)
            valid = (target >= 0) & (target < a.shape[1])
            if prepared.view.shown is not None:
                valid &= prepared.view.shown
            pictures, pixels = pictures + len(a), pixels + before.numel()
            known += int(valid.sum())
            right += int((before == target)[valid].sum())
            kept += int((after == target)[valid].sum())
            same += int((before == after).sum())
    share = f"mean square change / variance: {results.share():.1e}"
    yield f"{counted(pictures, 'validation picture')}: {share}"
    if task in ("classification", "segmentation"):
        yield (
            f"correct: {_percent(right, known)} before, {_percent(kept, known)} after; same "
            f"prediction: {_percent(same, pixels)}"
        )


def _percent(count: int, whole: int) -> str:
    return f"{100 * count / whole:.2f} %" if whole else "no labels"
