"""Exported models compute what the model does, at other batch sizes, and without `darswin`."""

import importlib.util
import logging
import subprocess
import sys
import zipfile

import pytest
import torch
from helpers import create
from lens_examples import example

from darswin import create_model
from darswin.compat import OfficialDarSwin
from darswin.deploy.export import (
    _join_equal_nodes,
    export_onnx,
    export_package,
    export_program,
)
from darswin.layers.transformer import Block
from darswin.lens import Mei, Polynomial, Spherical, solve
from darswin.models.unet import Unet
from darswin.ops import _module

SPHERICAL = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
# θ_max = 115°.
POLYNOMIAL = Polynomial([[7.0, 0.4, -0.1, 0.05], [7.5, 0.3, -0.1, 0.05]], 2.0, [15.0, 17.0])
MEI = Mei(2.0, 25.0, [0.03, 0.5], 1.4, tangential=[6e-4, -3e-3], affine=[[1.0, 0.01], [0.0, 0.99]])

ONE_BLOCK = dict(depths=(1,), num_heads=(1,))  # tracing takes as long as there are nodes


def short(name, **options):
    if name != "conv_unet_nano":  # it has no blocks
        options = dict(depths=(1, 1), num_heads=(1, 2)) | options
    options = dict(num_classes=5) | options
    if name == "official":
        return OfficialDarSwin(embed_dim=24, samples=(4, 4), **options).eval()
    return create(name, **options).eval()


def batch_of(lens, count):
    """Images and lenses, and the lenses' tensors by name."""
    lens = lens[[k % len(lens) for k in range(count)]]
    return torch.randn(count, 3, 32, 32), lens, tensors_of(lens)


def tensors_of(lens):
    names = (*lens.parameters, "theta_max", "center")
    return {name: getattr(lens, name) for name in names if getattr(lens, name) is not None}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "lens"),
    [
        # A radius that only Newton's method takes back to an angle.
        ("darswin_ra_nano", dict(spacing="radius", sample_spacing="theta"), POLYNOMIAL),
        ("official", {}, SPHERICAL),
        ("swin_nano", {}, SPHERICAL),
        ("darswin_unet_a_nano", dict(skip_width=4), SPHERICAL),
        ("darswin_unet_ra_nano", dict(ONE_BLOCK, task="distance"), POLYNOMIAL),
        ("swin_unet_nano perspective", dict(ONE_BLOCK, image_size=32), SPHERICAL),
        (
            "swin_unet_nano",
            dict(ONE_BLOCK, image_size=32, view=dict(name="square", fov=3.0)),
            SPHERICAL,
        ),
        ("conv_unet_nano", {}, SPHERICAL),
        ("swin_unet_nano square", dict(ONE_BLOCK, image_size=32), SPHERICAL),
    ],
)
def test_program(name, options, lens):
    model = short(name, **options)
    program = export_program(model, *batch_of(lens, 1)[:2]).module()
    for count in (1, 2, 5):
        images, lenses, tensors = batch_of(lens, count)
        torch.testing.assert_close(program(images, **tensors), model(images, lenses))


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(3, 20, 30, 3), (3, 20, 30, 1), (3, 4, 20, 30)])
def test_program_of_camera_frames_through_one_lens(shape):
    channels = min(shape[1], shape[3])
    model = short("darswin_a_nano", mean=0.5, std=0.2, in_chans=channels)
    frames = torch.randint(256, shape, dtype=torch.uint8)
    program = export_program(model, frames[:1], SPHERICAL[1], fixed_lens=True)
    torch.testing.assert_close(program.module()(frames), model(frames, SPHERICAL[1]))


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
    command = [sys.executable, "-c", ELSEWHERE, _module.FILE]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


ONNX_MODELS = {
    "darswin_a_nano": ({}, POLYNOMIAL),
    "darswin_ra_nano": (ONE_BLOCK, POLYNOMIAL[0]),
    "swin_nano perspective": (ONE_BLOCK, SPHERICAL),
    "dat_nano": (dict(ONE_BLOCK, blocks=("D",), groups=(1,)), SPHERICAL),
    "darswin_unet_a_nano": (ONE_BLOCK, SPHERICAL),
    "swin_unet_nano square": (dict(ONE_BLOCK, image_size=32, task="distance"), SPHERICAL[0]),
}


@pytest.fixture(scope="module", params=ONNX_MODELS)
def onnx_file(request, tmp_path_factory):
    """A model, its ONNX file, and its lens."""
    pytest.importorskip("onnxscript")
    options, lens = ONNX_MODELS[request.param]
    model, folder = short(request.param, **options), tmp_path_factory.mktemp("onnx")
    export_onnx(model, folder / "model.onnx", *batch_of(lens, 1)[:2], fixed_lens=len(lens) == 1)
    assert [file.name for file in folder.iterdir()] == ["model.onnx"]
    return model, folder / "model.onnx", lens


def check_runtime(run, model, lens, tolerance):
    """Compares `run`, which takes arrays by name, with the model, for two batch sizes."""
    for count in (1, 5):
        images, lenses, tensors = batch_of(lens, count)
        inputs = dict(images=images) | ({} if len(lens) == 1 else tensors)
        logits = torch.from_numpy(run({name: t.numpy() for name, t in inputs.items()}))
        with torch.no_grad():
            expected = model(images, lenses)
        assert (logits - expected).abs().max() <= tolerance * expected.abs().max()
    wrong = {name: t[..., 1:].numpy() if t.dim() == 4 else t.numpy() for name, t in inputs.items()}
    with pytest.raises(Exception, match=r"images|shape"):  # each runtime has its own error
        run(wrong)


@pytest.mark.slow
def test_onnx_runtime(onnx_file):
    onnxruntime = pytest.importorskip("onnxruntime")
    model, path, lens = onnx_file
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    named = [] if len(lens) == 1 else [*tensors_of(lens)]
    assert [i.name for i in session.get_inputs()] == ["images", *named]
    assert {i.shape[0] for i in session.get_inputs()} == {"batch"}
    check_runtime(lambda arrays: session.run(["logits"], arrays)[0], model, lens, 1e-4)


@pytest.mark.slow
def test_openvino(onnx_file):
    openvino = pytest.importorskip("openvino")
    model, path, lens = onnx_file
    settings = {"INFERENCE_PRECISION_HINT": "f32"}
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    tolerance = 1e-4 if isinstance(model, Unet) else 1e-5
    check_runtime(lambda arrays: compiled(arrays)["logits"], model, lens, tolerance)


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


def sampled(model, images, lens):
    """The inputs of a graph that starts at the tokens, but for the lens, as tensors by name."""
    prepared = model.prepare(lens, model._checked(images).shape[2:])
    inputs = dict(tokens=model.sample(images, prepared))
    return inputs | (dict(images=images) if model.refines_with_images else {})


@pytest.mark.slow
def test_a_graph_of_tokens_gives_the_classes_of_the_graph_of_frames(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    model, lens = short("darswin_a_nano", mean=0.5, std=0.2), SPHERICAL[1]
    frames = torch.randint(256, (20, 40, 48, 3), dtype=torch.uint8)
    with torch.no_grad():
        inputs = dict(images=frames, **sampled(model, frames, lens))
    logits = []
    for name, tensor in inputs.items():
        path = tmp_path / f"{name}.onnx"
        export_onnx(model, path, frames[:1], lens, fixed_lens=True, input=name)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        (out,) = session.run(["logits"], {name: tensor.numpy()})
        logits.append(torch.from_numpy(out))
    whole, rest = logits
    assert torch.equal(whole.argmax(1), rest.argmax(1)) and len(whole.argmax(1).unique()) > 1
    assert (whole - rest).abs().max() <= 1e-5 * whole.abs().max()


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
    with pytest.raises(ValueError, match="model must be in eval mode"):
        export_program(model.train(), images, lens)


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
