"""`darswin info` and `darswin models`."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from darswin.deploy.optimize import optimize
from darswin.layers.quantized import quantized_layers
from darswin.models import create_model, list_models
from darswin.models.registry import list_pretrained
from darswin.models.saving import load_model, read_card
from darswin.ops import _module, cpu_capability, linear
from darswin.utils import extras
from darswin.utils.words import counted

BYTE_PRODUCTS = {
    "pairs": "as numbers of 16 bits", "fours": "by VNNI or dot products", "tiles": "by AMX",
}  # fmt: skip
EXTRAS = ("demo", "onnx", "train")


def models() -> None:
    """Lists the names of all models, and of the trained ones for `darswin predict --model`."""
    print("\n".join(list_models()))
    print("\ntrained models, for `darswin predict --model NAME`:")
    for name in list_pretrained():
        card = read_card(name)
        print(
            f"{name}: {card.model} for {card.task}, {counted(len(card.classes), 'class')}, "
            f"images of {card.size}×{card.size} with {card.channels} channels, mean {card.mean}, "
            f"std {card.std}"
        )


def info(*, model: str | None = None) -> None:
    """Prints the details of this installation and machine to include in a bug report.

    Args:
        model: a name that `darswin models` lists, or a file of weights, to print how
            `darswin.optimize` runs that model on this machine.
    """
    lines = facts()
    if model is not None:
        lines["model"] = f"{model}: {way_of(model)}"
    for name, value in lines.items():
        print(f"{name:<10}{value}")


def way_of(name: str) -> str:
    """How `optimize` runs a model: as one program, or layer by layer because of a part."""
    model = create_model(name) if name in list_models() else load_model(name)[0]
    dtype = torch.int8 if quantized_layers(model) else torch.float32
    fast: Any = optimize(model.eval(), dtype)
    return fast.lack or "one program"


def facts() -> dict[str, str]:
    """Versions, CPU, instruction-set tiers, threads, products, and which extras are installed."""
    lack, checkout = _module.LACK, commit()
    compiler = f"compiled by {_module.build_info()['compiler']}"
    made = compiler if lack is None else "without its compiled module"
    lines = {
        "darswin": f"{version('darswin')}{f', commit {checkout}' * bool(checkout)}, {made}",
        "torch": torch.__version__,
        "python": f"{platform.python_version()}, {platform.platform()}",
        "CPU": f"{cpu()}, {torch.get_num_threads()} threads",
        "tier": f"{cpu_capability()}, of {', '.join(_module.tiers())}",
    }
    if lack is not None:
        lines["tier"] = f"the PyTorch reference: {lack}"
    lines["training"] = f"linear layers by {'darswin' if linear.IS_FASTER else 'torch'}"
    if lack is None:
        lines["int8"] = f"darswin, {BYTE_PRODUCTS[_module.byte_products()]}"
    for extra in EXTRAS:
        lines[f"[{extra}]"] = extras.lack(extra) or "installed"
    return lines


def cpu() -> str:
    """The name of this CPU."""
    # Family and model are added on x86, because the name may stay the same for years.
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    read = {key.strip(): value.strip() for key, _, value in (s.partition(":") for s in lines)}
    name = read.get("model name", platform.processor())
    if "cpu family" not in read:
        return name
    return f"{name} (family {read['cpu family']}, model {read['model']})"


def commit() -> str:
    """The commit of a checkout, which is "-dirty" if a file has changed; "" elsewhere."""
    root = Path(__file__).parent.parent.parent
    if not (root / ".git").exists():
        return ""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True).stdout

    # The records of a run, which are written one by one, are no change of the code.
    changes = git("status", "--porcelain", "-uno", "--", ".", ":!benchmarks/results")
    return git("describe", "--always").strip() + "-dirty" * bool(changes)
