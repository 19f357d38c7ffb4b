"""`_network` and `_run`: whole networks as one operator.

tests/deploy/test_contract.py compares results with models.
"""

import math
import multiprocessing
import sys
from multiprocessing.pool import ThreadPool

import pytest
import torch
from helpers import network, refused

from darswin import optimize
from darswin.deploy.networks import frame_program
from darswin.deploy.optimize import fast_copy
from darswin.deploy.program import Checked
from darswin.lens import Spherical

CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)


def given(name="darswin_a_nano", **options):
    """The inputs, the weights and the words of a network's program for one lens."""
    model = network(name, **options)
    size = model.image_size or (32, 32)
    lens = Spherical.from_fov(0.5, math.radians(160), size[0] / 2)
    fast = optimize(model, lens=lens)
    prepared = fast.prepare(None, size)
    found = frame_program(fast_copy(model), lens, size, model)
    images = torch.randn(1, 3, *size)
    inputs = [fast.sample(images, prepared)]
    inputs += [images.permute(0, 2, 3, 1)] * found.reads_frame
    return [*inputs, *(x[None] for x in found.constants)], found.weights, found.words


@pytest.mark.parametrize(
    "name", ["darswin_a_nano", "darswin_unet_a_nano", "swin_unet_nano perspective"]
)
def test_wrong_programs_are_refused_or_run(name):
    inputs, weights, words = given(name)
    chance = torch.Generator().manual_seed(0)

    def drawn(most):
        return int(torch.randint(most, (), generator=chance))

    refused = 0
    for _ in range(400):
        changed = list(words)
        for _ in range(1 + drawn(2)):
            known = words[drawn(len(words))]
            values = (0, -1, 1, drawn(20), drawn(5000), known, 2**40, 2**62, -(2**63))
            changed[drawn(len(words))] = values[drawn(len(values))]
        if drawn(5) == 0:
            changed = changed[: drawn(len(changed))]
        try:
            Checked(weights, changed)(inputs)
        except (ValueError, RuntimeError, MemoryError):
            refused += 1
    assert refused > 200  # most words matter


BLOCK = (1, 2**10, 2**10, 1, 1, 4096, *[0] * 10, 1, 1, 0, 0, 0, 0, 0)  # 2**20 tokens, MLP of 4096


@pytest.mark.parametrize(
    "words",
    [
        (1, 48, 1, 2**30, 0), (1, 48, 2, 2**23, 2**24, 0), (1, 1, 1, 2**20, 0, 2, 23, *BLOCK),
    ],
)  # fmt: skip
def test_a_small_program_cannot_ask_for_all_memory(words):
    weights = torch.zeros(2**17, dtype=torch.int32)
    with pytest.raises((RuntimeError, ValueError), match="more memory than its inputs"):
        Checked(weights, words)


def test_wrong_inputs_are_refused():
    inputs, weights, words = given()
    x, *tables = inputs
    run = Checked(weights, words)
    for changed in (
        [x], [x[0], *tables], [x.double(), *tables], [x.to("meta"), *tables],
        [torch.zeros(2, *x.shape[1:]), *(torch.cat([t] * 3) for t in tables)], [],
    ):  # fmt: skip
        refused("_run", run, changed, error=(RuntimeError, NotImplementedError))
    for changed in (weights.float(), weights[::2], weights[:-1]):
        refused("weights", Checked, changed, words, error=(RuntimeError, ValueError))
    assert run([x[:0], *tables])[0].shape == (0, 5)


def test_a_network_is_kept_until_its_program_ends():
    inputs, weights, words = given()
    number = torch.ops.darswin._network(weights, words)
    other, run = Checked(weights.clone(), words), torch.ops.darswin._run
    expected = run(inputs, number)
    del weights  # the network keeps them
    assert torch.equal(other(inputs)[0], expected[0])
    torch.ops.darswin._forget_network.default.redispatch(CPU, number)
    for wrong in (number, -1, 2**16, 2**62):
        refused("there is no such network", run, inputs, wrong, error=RuntimeError)
        torch.ops.darswin._forget_network.default.redispatch(CPU, wrong)  # which does nothing
    taken = other._run.keywords["network"]
    del other
    refused("there is no such network", run, inputs, taken, error=RuntimeError)


def test_networks_survive_threads_and_forks():
    inputs, weights, words = given()
    program, many = Checked(weights, words), ThreadPool(4)
    expected = program(inputs)[0]

    def made_and_run(_):
        return torch.equal(Checked(weights, words)(inputs)[0], expected)

    assert all(many.map(made_and_run, range(40)))

    def in_child():
        again = Checked(weights, words)(inputs)[0]
        sys.exit(not (torch.equal(program(inputs)[0], expected) and torch.equal(again, expected)))

    child = multiprocessing.get_context("fork").Process(target=in_child)
    child.start()
    child.join(60)
    assert child.exitcode == 0
