"""`darswin info` and `darswin models`."""

import platform

import torch

from darswin.bench.machine import machine
from darswin.deploy.packed import fastest_dtype, has_own_int8
from darswin.layers.linear import onednn_lack
from darswin.models import list_models, list_pretrained, read_card
from darswin.ops import _module
from darswin.utils import extras

EXTRAS = ("demo", "onnx", "train")


def models() -> None:
    """Lists the names of all models, and of the trained ones for `darswin predict --model`."""
    print("\n".join(list_models()))
    print("\ntrained models, for `darswin predict --model NAME`:")
    for name in list_pretrained():
        card = read_card(name)
        print(
            f"{name}: {card.model} for {card.task}, {len(card.classes)} classes, "
            f"images of {card.size}×{card.size} with {card.channels} channels, mean {card.mean}, "
            f"std {card.std}"
        )


def info() -> None:
    """Prints the details of this installation and machine to include in a bug report."""
    for name, value in facts().items():
        print(f"{name:<10}{value}")


def facts() -> dict[str, str]:
    """Versions, CPU, instruction-set tiers, threads, oneDNN, and which extras are installed."""
    here = machine()
    commit = f", commit {here['commit']}" if here["commit"] else ""
    lack = _module.LACK
    made = f"compiled by {here['compiler']}" if lack is None else "without its compiled module"
    lines = {
        "darswin": f"{here['darswin']}{commit}, {made}",
        "torch": str(here["torch"]),
        "python": f"{here['python']}, {platform.platform()}",
        "CPU": f"{here['cpu']}, {torch.get_num_threads()} threads",
        "tier": f"{here['tier']}, of {', '.join(_module.tiers())}",
    }
    if lack is not None:
        lines["tier"] = f"the PyTorch reference: {lack}"
    for dtype in (torch.float32, torch.bfloat16):
        reason = onednn_lack(dtype)
        lines[_name(dtype)] = "oneDNN" if reason is None else f"torch: {reason}"
    if lack is None:
        lines["int8"] = "darswin" if has_own_int8() else "oneDNN"
        lines["fastest"] = f"int8 for quantized models, else {_name(fastest_dtype())}"
    for extra in EXTRAS:
        lines[f"[{extra}]"] = extras.lack(extra) or "installed"
    return lines


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
