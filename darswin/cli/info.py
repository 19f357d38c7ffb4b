"""`darswin info`: what a report of an issue needs to say about this installation and machine."""

import argparse
import platform

import torch

from darswin.bench.machine import machine
from darswin.layers import onednn
from darswin.ops import _module
from darswin.utils.extras import lack

EXTRAS = ("demo", "onnx", "train")


def run(argv: list[str]) -> None:
    """Runs `darswin info` with the arguments that follow it, of which there are none."""
    argparse.ArgumentParser(prog="darswin info", description=__doc__).parse_args(argv)
    for name, value in info().items():
        print(f"{name:<10}{value}")


def info() -> dict[str, str]:
    """Versions, CPU, instruction-set tiers, threads, oneDNN, and which extras are installed."""
    here = machine()
    commit = f", commit {here['commit']}" if here["commit"] else ""
    lines = {
        "darswin": f"{here['darswin']}{commit}, compiled by {here['compiler']}",
        "torch": str(here["torch"]),
        "python": f"{here['python']}, {platform.platform()}",
        "CPU": f"{here['cpu']}, {torch.get_num_threads()} threads",
        "tier": f"{here['tier']}, of {', '.join(_module.tiers())}",
    }
    for dtype in (torch.float32, torch.bfloat16):
        reason = onednn.missing(dtype)
        name = str(dtype).removeprefix("torch.")
        lines[name] = "oneDNN's products" if reason is None else f"torch's products: {reason}"
    for extra in EXTRAS:
        lines[f"[{extra}]"] = lack(extra) or "installed"
    return lines
