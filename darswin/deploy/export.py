"""Models as graphs of tensors, lens included: for AOTInductor, ONNX, and processes without us."""

import contextlib
import logging
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from inspect import Parameter, Signature
from types import BuiltinFunctionType
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch._ops import OpOverload
from torch.export import ExportedProgram
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils import _pytree as pytree

from darswin.layers.quantized import quantized_layers, with_unsigned_weights
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.ops import use_reference
from darswin.utils.extras import lack
from darswin.utils.progress import Progress
from darswin.views.base import Pair

__all__ = ["export_onnx", "export_package", "export_program"]

Input = Literal["images", "tokens"]


_LOGGERS = ("torch.onnx", "onnxscript", "onnx_ir")


@contextlib.contextmanager
def quiet_export() -> Iterator[None]:
    """A context, or a decorator, without the exporters' log lines below errors, without warnings of
    what will change in the packages themselves, and without a stack trace of each node: these help
    to find errors in an exporter, and take a tenth of its time. Before torch 2.12 it always keeps
    them."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    levels = [logger.level for logger in loggers]
    before = getattr(torch.fx.config, "do_not_emit_stack_traces", False)
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    torch.fx.config.do_not_emit_stack_traces = True
    try:
        with warnings.catch_warnings():
            for category in (FutureWarning, DeprecationWarning):
                warnings.simplefilter("ignore", category)
            yield
    finally:
        torch.fx.config.do_not_emit_stack_traces = before
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class _OfTensors(nn.Module):
    """A model that takes pixels and the tensors of its lens, by name.

    Without `tensors`, all that depends on the lens is computed here, before the graph begins. With
    `sampled`, the first pixels are the result of `Model.sample`. With `any_strides` the model reads
    its inputs by the strides they come with.
    """

    def __init__(
        self,
        model: nn.Module,
        lens: Lens | None,
        size: Pair | None,
        pixels: Iterable[str],
        tensors: Iterable[str],
        *,
        sampled: bool,
        any_strides: bool,
    ):
        super().__init__()
        self.model, self.lens, self.size = model, lens, size
        self.sampled, self.any_strides = sampled, any_strides
        # Copies: torch.export warns of constants that are views of weights.
        prepared = self._prepare({}) if not tensors else None
        self.prepared = pytree.tree_map_only(Tensor, torch.clone, prepared)
        # torch.export finds the names of the inputs in the signature of `forward`.
        inputs = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in pixels]
        inputs += [Parameter(name, Parameter.KEYWORD_ONLY) for name in tensors]
        forward: Any = partial(self._run)
        forward.__signature__ = Signature(inputs)
        self.forward = forward

    def _prepare(self, tensors: Mapping[str, Tensor]) -> Any:
        """The lens for `forward`, or for the methods of a model the result of its `prepare`."""
        lens = None if self.lens is None else self.lens.replace(**tensors)
        if not isinstance(self.model, Model):
            return lens
        assert self.size is not None
        return self.model.prepare(lens, self.size)

    def _run(self, *pixels: Tensor, **tensors: Tensor) -> Any:
        if self.any_strides:
            pixels = tuple(map(_in_order, pixels))
            tensors = {name: _in_order(tensor) for name, tensor in tensors.items()}
        prepared: Any = self._prepare(tensors) if tensors else self.prepared
        first, *others = pixels
        if not isinstance(self.model, Model):
            return self.model(first, prepared)
        run = self.model.run_sampled if self.sampled else self.model.run
        return run(first, prepared, *others)


def _in_order(tensor: Tensor) -> Tensor:
    # A contiguous copy. The kernels that AOTInductor writes take the example's strides for granted,
    # and it drops a `clone` of what is contiguous in the example. It leaves `masked_scatter` to
    # torch, on the CPU.
    copy = torch.empty_like(tensor, memory_format=torch.contiguous_format)
    return copy.masked_scatter(torch.ones((), dtype=torch.bool, device=tensor.device), tensor)


def export_program(
    model: nn.Module,
    images: Tensor,
    lens: Lens | None = None,
    *,
    fixed_lens: bool = False,
    input: Input = "images",
) -> ExportedProgram:
    """The graph of `model(images, lens)` for any batch size, with plain tensors as its inputs.

    The inputs are `images` and, by name, the tensors of the lens, with one row for each image. For
    a `Spherical` lens, call `program.module()(images, xi=xi, focal=focal, theta_max=theta_max)`,
    and add `center` if the lens has one.

    Args:
        model: in eval mode.
        images, lens: an example. The graph keeps its types and sizes, all but the batch size.
        fixed_lens: the graph keeps the lens too, which must be a single one; `images` is its input.
            What depends on the lens alone is computed before the graph begins.
        input: "images", or "tokens" for a graph that starts later: its input `tokens` is the result
            of `model.sample`, which `darswin.frames` also computes. `images` is a second input
            only for a model that `refines_with_images`.

    Raises:
        ValueError: a model in training mode, not one lens where it is to be fixed, or an unknown
            `input`.
        TypeError: "tokens" with a model that is no `darswin.models.base.Model`.
    """
    return _program(model, images, lens, fixed_lens, input, any_strides=True)


@quiet_export()
def _program(
    model: nn.Module,
    images: Tensor,
    lens: Lens | None,
    fixed_lens: bool,
    input: Input,
    any_strides: bool,
) -> ExportedProgram:
    if input not in get_args(Input):
        raise ValueError(f"input must be one of {get_args(Input)}, got {input!r}")
    if model.training:
        raise ValueError("model must be in eval mode, got one in training mode: call model.eval()")
    if fixed_lens and (lens is None or len(lens) != 1):
        raise ValueError(f"fixed_lens needs a single lens, got {lens}")
    images, tensors = images[[0, 0]], {}  # two: torch.export takes a size of 1 for a constant
    if lens is not None and not fixed_lens:
        leaves, _ = pytree.tree_flatten_with_path(lens[[0, 0]])
        tensors = {
            key.name: leaf
            for (key,), leaf in leaves
            if isinstance(key, pytree.GetAttrKey) and leaf is not None
        }
    sampled, size = input == "tokens", None
    if sampled and not isinstance(model, Model):
        raise TypeError(f'input="tokens" needs a model of darswin, got {type(model).__name__}')
    pixels, batch = {"images": images}, torch.export.Dim("batch")
    with torch.no_grad(), Progress("tracing the model"):
        if isinstance(model, Model):
            height, width = model._with_shape(images).shape[2:]
            size = height, width
            if sampled:
                pixels = _sampled(model, images, lens, size)
        rows = {key: {0: batch} for key in (*pixels, *tensors)}
        if sampled and isinstance(model, Model) and model.view.count > 1:
            rows["tokens"] = {0: model.view.count * batch}  # all pictures of an image, in turn
        module = _OfTensors(
            model, lens, size, pixels, tensors, sampled=sampled, any_strides=any_strides
        )
        program = torch.export.export(
            module,
            tuple(pixels.values()),
            tensors,
            dynamic_shapes=rows,
            strict=False,  # it takes half of the time of a strict export
        )
        for graph in program.graph_module.modules():  # its own, and those of its loops
            if isinstance(graph, torch.fx.GraphModule):
                _join_equal_nodes(graph.graph)
                graph.recompile()
    return program


def _join_equal_nodes(graph: torch.fx.Graph) -> None:
    """Computes once what a graph computes several times, such as the powers of an angle in each of
    Newton's steps. All that follows takes time for every node: decompositions, rules, compilers."""
    nodes, apart = list(graph.nodes), set[torch.fx.Node]()
    for node in reversed(nodes):
        # What is changed in place must not be the result of another node too, nor what is random.
        changes = isinstance(node.target, OpOverload) and (
            node.target._schema.is_mutable or torch.Tag.nondeterministic_seeded in node.target.tags
        )
        if changes or (node in apart and _may_share_memory(node.target)):
            apart.update((node, *node.all_input_nodes))
    apart.update(graph.output_node().all_input_nodes)  # their names are those of the outputs
    known: dict[tuple, torch.fx.Node] = {}
    for node in nodes:
        if node in apart or not isinstance(node.target, OpOverload | BuiltinFunctionType):
            continue
        # A node within the arguments is shown by its name.
        key = node.target, repr(node.args), repr(node.kwargs)
        if (first := known.setdefault(key, node)) is not node:
            node.replace_all_uses_with(first)
            graph.erase_node(node)


def _may_share_memory(target: object) -> bool:
    """True if the result of a node may be a view of an input."""
    if not isinstance(target, OpOverload):
        return True
    is_view = any(result.alias_info is not None for result in target._schema.returns)
    # An operator that is made of others may end with a view.
    key = "CompositeImplicitAutograd"
    return is_view or torch._C._dispatch_has_kernel_for_dispatch_key(target.name(), key)


def _sampled(model: Model, images: Tensor, lens: Lens | None, size: Pair) -> dict[str, Tensor]:
    """The inputs of `model.run_sampled` for images of (H, W), by name."""
    lens = None if lens is None else lens[[0] * len(images)]
    tokens = model.sample(images, model.prepare(lens, size))
    return {"tokens": tokens} | ({"images": images} if model.refines_with_images else {})


def export_package(
    model: nn.Module,
    path: str | os.PathLike,
    images: Tensor,
    lens: Lens | None = None,
    *,
    fixed_lens: bool = False,
    input: Input = "images",
) -> None:
    """Compiles the graph of `export_program` with AOTInductor, and writes it as a package.

    A package for CPUs takes expanded, cropped or transposed tensors too. It does not check its
    inputs. Its metadata contains the dtype and the size of one row of each input, by name: for
    example "uint8 [480, 640, 3]" for "images".

    Args:
        path: of the file, which must end in ".pt2".

    The other arguments and the errors are those of `export_program`.
    """
    program = export_program(model, images, lens, fixed_lens=fixed_lens, input=input)
    positional, named = program.example_inputs or ((), {})
    tensors = dict(
        zip(program.graph_signature.user_inputs, (*positional, *named.values()), strict=True)
    )
    rows = {
        name: f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape[1:])}"
        for name, tensor in tensors.items()
    }
    with Progress("compiling the graph"):
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=os.fspath(path),
            # By default, a kernel uses as many threads as the process that compiles it.
            inductor_configs={"aot_inductor.metadata": rows, "cpp.dynamic_threads": True},
        )


@quiet_export()
def export_onnx(
    model: nn.Module,
    path: str | os.PathLike,
    images: Tensor,
    lens: Lens | None = None,
    *,
    fixed_lens: bool = False,
    input: Input = "images",
    vnni_only: bool = False,
) -> None:
    """Writes the graph of `export_program` as one ONNX file, by the operators' reference.

    Inputs are named as there, the output is `logits`.

    Args:
        path: of the file; it holds the weights too.
        vnni_only: of a quantized model, the file is faster on x86 CPUs with VNNI and wrong on x86
            CPUs without it. By default it is right on every CPU. Other models stay the same.

    The other arguments and the errors are those of `export_program`.

    Raises:
        ModuleNotFoundError: onnx or onnxscript is not installed.
    """
    if (without := lack("onnx", ("onnx", "onnxscript"))) is not None:
        raise ModuleNotFoundError(without)
    if quantized_layers(model) and not vnni_only:
        model = with_unsigned_weights(model)
    # MATH, as other attention kernels of torch lay out their result unlike their decomposition.
    with use_reference(), sdpa_kernel(SDPBackend.MATH):
        program = _program(model, images, lens, fixed_lens, input, any_strides=False)
        inputs = program.graph_signature.user_inputs
        with Progress("translating the graph to ONNX"):
            torch.onnx.export(
                program,
                f=path,
                output_names=["logits"],
                # Of the first input alone: the others have as many rows.
                dynamic_shapes=dict.fromkeys(inputs[1:]) | {inputs[0]: {0: "batch"}},
                external_data=False,
                verbose=False,
            )
