"""The graphs of exports, packages without `darswin`, and errors; test_every_export.py compares the
results."""

import importlib.util
import logging
import sys
import zipfile

import pytest
import torch
from helpers import create, output, refused
from lens_examples import example

from darswin import create_model
from darswin.deploy.export import (
    _join_equal_nodes,
    export_onnx,
    export_package,
    export_program,
)
from darswin.layers.transformer import Block
from darswin.lens import Mei, Polynomial, Spherical, solve
from darswin.ops import _module

SPHERICAL = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
# θ_max = 115°.
POLYNOMIAL = Polynomial([[7.0, 0.4, -0.1, 0.05], [7.5, 0.3, -0.1, 0.05]], 2.0, [15.0, 17.0])
MEI = Mei(2.0, 25.0, [0.03, 0.5], 1.4, tangential=[6e-4, -3e-3], affine=[[1.0, 0.01], [0.0, 0.99]])

ONE_BLOCK = dict(depths=(1,), num_heads=(1,))  # tracing takes as long as there are nodes


def short(name, **options):
    if name != "conv_unet_nano":  # it has no blocks
        options = dict(depths=(1, 1), num_heads=(1, 2)) | options
    return create(name, **(dict(num_classes=5) | options)).eval()


def batch_of(lens, count):
    """Images and lenses, and the lenses' tensors by name."""
    lens = lens[[k % len(lens) for k in range(count)]]
    return torch.randn(count, 3, 32, 32), lens, tensors_of(lens)


def tensors_of(lens):
    names = (*lens.parameters, "theta_max", "center")
    return {name: getattr(lens, name) for name in names if getattr(lens, name) is not None}


ELSEWHERE = """
import sys, torch
torch.ops.load_library(sys.argv[1])
model = torch._inductor.aoti_load_package("model.pt2")
for name, (images, tensors, logits) in torch.load("calls.pt").items():
    tensors = dict(reversed(tensors.items()))  # by name, in any order
    torch.testing.assert_close(
        model(images, **tensors), logits, rtol=1e-4, atol=1e-5, msg=lambda m: name + m
    )
assert "darswin" not in sys.modules
"""


@pytest.mark.slow
def test_package_in_a_process_without_the_package(tmp_path):
    # docs/howto/export.md, whose code the tests run, compiles two stages.
    model = short("darswin_a_nano", mean=0.5, std=0.2, **ONE_BLOCK)
    lens = Spherical.from_fov([0.3, 0.6, 0.9], 2.6, 16.0)
    frames = torch.randint(256, (3, 32, 40, 3), dtype=torch.uint8)
    export_package(model, tmp_path / "model.pt2", frames, lens)
    with zipfile.ZipFile(tmp_path / "model.pt2") as package:
        sources = [package.read(name) for name in package.namelist() if name.endswith(".cpp")]
    assert any(b"#pragma omp parallel\n" in source for source in sources)
    assert not any(b"num_threads(" in source for source in sources)
    shared = {name: t[:1].expand(3) for name, t in tensors_of(lens).items()}
    columns = dict(
        zip(tensors_of(lens), torch.stack((*tensors_of(lens).values(),), 1).unbind(1), strict=True)
    )
    large = torch.randint(256, (4, 3, 70, 52), dtype=torch.uint8)
    crop = large.permute(0, 2, 3, 1)[1:, 3:67:2, 5:45]
    assert not crop.is_contiguous() and not columns["xi"].is_contiguous()
    calls = {
        "as it was made": (frames, tensors_of(lens)),
        "one image": (frames[1:2], tensors_of(lens[1])),
        "one lens, expanded": (frames, shared),
        "one image, expanded": (frames[:1].expand(3, -1, -1, -1), tensors_of(lens)),
        "columns of a table, crops of a picture": (crop, columns),
    }
    for name, (images, tensors) in calls.items():
        with torch.no_grad():
            calls[name] = (images, tensors, model(images, Spherical(**tensors)))
    torch.save(calls, tmp_path / "calls.pt")
    output(sys.executable, "-c", ELSEWHERE, _module.FILE, cwd=tmp_path)


@pytest.fixture
def translated(monkeypatch):
    """The sizes of the graphs that `export_onnx` gives to torch.onnx, which does no work then."""
    sizes = []
    monkeypatch.setattr(
        torch.onnx, "export", lambda program, **_: sizes.append(len(program.graph.nodes))
    )
    return sizes


@pytest.mark.slow
def test_each_block_is_traced_once(translated, monkeypatch):
    pytest.importorskip("onnxscript")
    model, images, blocks = create_model("darswin_a_nano").eval(), torch.zeros(1, 3, 64, 64), []
    forward = Block.forward

    def counted(self, *arguments):
        blocks.append(self)
        return forward(self, *arguments)

    monkeypatch.setattr(Block, "forward", counted)
    for fixed, nodes in ((False, 680), (True, 600)):
        export_onnx(model, "unused.onnx", images, SPHERICAL[0], fixed_lens=fixed)
        assert blocks == [module for module in model.modules() if isinstance(module, Block)]
        assert translated.pop() <= nodes
        blocks.clear()


@pytest.mark.slow
def test_a_fixed_lens_is_solved_before_the_graph_begins(translated):
    pytest.importorskip("onnxscript")
    model, images = short("conv_unet_nano", task="distance"), torch.zeros(1, 3, 32, 32)
    for lens in (SPHERICAL[0], POLYNOMIAL[0], MEI):
        export_onnx(model, "unused.onnx", images, lens, fixed_lens=True)
    assert len({*translated}) == 1 and translated[0] <= 160


@pytest.mark.slow
@pytest.mark.parametrize("loops", [True, False])
def test_the_nodes_that_solve_for_the_rays_of_pixels(loops, monkeypatch):
    model, (images, lens, tensors) = (
        short("conv_unet_nano", widths=(4,)), batch_of(POLYNOMIAL, 1)
    )  # fmt: skip
    monkeypatch.setattr(solve, "_HAS_LOOPS", loops)
    monkeypatch.setattr(solve, "_STEPS", 40 if loops else 8)  # each of Newton's steps is 40 nodes
    program = export_program(model, images, lens)
    assert loops == any("while_loop" in node.name for node in program.graph.nodes)
    assert len(program.graph.nodes) <= (320 if loops else 600)
    torch.testing.assert_close(program.module()(images, **tensors), model(images, lens))


@pytest.mark.slow
def test_a_graph_searches_once_for_the_end_of_a_lens_and_keeps_no_stack_traces():
    lens = example("OCam", torch.Generator().manual_seed(0))[:1]
    model, images = short("conv_unet_nano", widths=(4,)), torch.rand(1, 3, 32, 32)
    nodes = export_program(model, images, lens).graph.nodes
    assert [node.op for node in nodes if str(node.target) == "while_loop"] == ["call_function"]
    assert sum(bool(node.stack_trace) for node in nodes) <= 1  # the batch size has its own
    assert not torch.fx.config.do_not_emit_stack_traces


@pytest.mark.slow
def test_onnx_exports_say_nothing_about_themselves(tmp_path, caplog, recwarn):
    pytest.importorskip("onnxscript")
    model = short("darswin_a_nano", **ONE_BLOCK)
    export_onnx(model, tmp_path / "model.onnx", torch.zeros(1, 3, 32, 40), POLYNOMIAL)
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert not said and not [str(warning.message) for warning in recwarn]


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(48, 64, 3), (3, 48, 64)], ids=["frames", "planes"])
def test_onnx_gathers_from_a_frame_before_all_else(shape, tmp_path):
    onnx, onnxruntime = (pytest.importorskip(name) for name in ("onnx", "onnxruntime"))
    model, path = short("darswin_a_nano", mean=0.5, std=0.2, **ONE_BLOCK), tmp_path / "model.onnx"
    frames, lens = torch.randint(256, (2, *shape), dtype=torch.uint8), SPHERICAL[1]
    export_onnx(model, path, frames, lens, fixed_lens=True)
    whole, takers = {"images"}, []
    nodes = onnx.load(path).graph.node
    assert not {node.op_type for node in nodes} & {"Sin", "Cos"}  # the grid is finished
    for node in nodes:
        if whole & {*node.input}:
            takers.append(node.op_type)
            if node.op_type == "Reshape":
                whole |= {*node.output}
    # A view of the frame, its batch size, and one gather for each of the four pixels of a sample.
    assert set(takers) <= {"Reshape", "Shape", "GatherElements"}
    assert takers.count("GatherElements") == 4
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (logits,) = session.run(None, {"images": frames.numpy()})
    with torch.no_grad():
        torch.testing.assert_close(
            torch.from_numpy(logits), model(frames, lens), rtol=1e-4, atol=1e-4
        )


@pytest.mark.slow
@pytest.mark.parametrize(("side", "samplers"), [(64, 2), (320, 1)])
def test_onnx_samples_small_images_and_maps_with_an_operator_of_the_runtime(
    side, samplers, tmp_path
):
    onnx, path = pytest.importorskip("onnx"), tmp_path / "model.onnx"
    model = short("darswin_unet_a_nano", **ONE_BLOCK)
    export_onnx(model, path, torch.rand(1, 3, side, side), SPHERICAL[0], fixed_lens=True)
    nodes = [node.op_type for node in onnx.load(path).graph.node]
    assert nodes.count("GridSample") == samplers


def test_what_is_missing_is_named_with_packages_that_exist(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "onnxscript" else found(name)
    )
    expected = "^onnxscript missing; .*: pip install 'onnxscript>=0.6'$"
    with pytest.raises(ModuleNotFoundError, match=expected):
        export_onnx(short("swin_nano"), "model.onnx", torch.zeros(1, 3, 32, 32))


def test_errors():
    model, (images, lens, _) = short("darswin_a_nano"), batch_of(SPHERICAL, 2)
    with pytest.raises(ValueError, match="fixed_lens needs a single lens, got Spherical"):
        export_program(model, images, lens, fixed_lens=True)
    with pytest.raises(ValueError, match="fixed_lens needs a single lens, got None"):
        export_program(model, images, fixed_lens=True)
    with pytest.raises(ValueError, match=r"input must be one of .*, got 'logits'"):
        export_program(model, images, lens, input="logits")
    with pytest.raises(TypeError, match="needs a model of darswin, got Identity"):
        export_program(torch.nn.Identity().eval(), images, input="tokens")
    refused("model must be in eval mode", export_program, model.train(), images, lens)


def test_equal_nodes_are_joined_unless_one_is_changed_in_place():
    class Twice(torch.nn.Module):
        def forward(self, images):
            same = torch.sin(images) + torch.sin(images)
            one, other = torch.zeros(3), torch.zeros(3)
            one += 1
            first, second = torch.cos(images).view(-1), torch.cos(images).view(-1)
            first.mul_(2)
            return same, one - other, first - second

    images = torch.rand(2, 3)
    program = torch.export.export(Twice(), (images,), strict=False)
    _join_equal_nodes(program.graph)
    program.graph_module.recompile()
    names = [str(node.target) for node in program.graph.nodes]
    assert [names.count(f"aten.{name}.default") for name in ("sin", "zeros", "cos")] == [1, 2, 2]
    for found, expected in zip(program.module()(images), Twice()(images), strict=True):
        torch.testing.assert_close(found, expected)
