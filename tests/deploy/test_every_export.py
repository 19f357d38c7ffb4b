"""The contract of exports: every kind of model × every kind of lens × every form of a graph × every
kind of input, at batches of other sizes, also 0 and 1.
"""

import pytest
import torch
from helpers import create, product, products, slow, slow_but
from lens_examples import ASIDE, example

from darswin.compat import OfficialDarSwin
from darswin.deploy.export import export_onnx, export_package, export_program
from darswin.lens import MODELS as LENS_MODELS
from darswin.models import LensAdapter
from darswin.views import make_view

SIDE = 16
ONE = dict(embed_dim=8, depths=(1,), num_heads=(1,))
POLAR = dict(ONE, rings=2, sectors=8, samples=(2, 2), window=(1, 8))
SQUARES = dict(POLAR, window=(2, 4))
PLAIN = dict(ONE, image_size=SIDE)
TWO_STAGES = dict(depths=(1, 1), num_heads=(1, 1))
RAYS = dict(task="distance", skip_width=2)
# The name for `create_model`, and its options.
KINDS = {
    "classifier A": ("darswin_a_nano", POLAR),
    "gray": ("darswin_a_nano", dict(POLAR, in_chans=1)),
    "classifier RA": ("darswin_ra_nano", dict(SQUARES, spacing="radius", sample_spacing="theta")),
    "spacing g": ("darswin_a_nano", dict(POLAR, spacing="g")),
    "spacing tan": ("darswin_a_nano", dict(POLAR, spacing="tan", placement="edges")),
    "fixed angle": ("darswin_a_nano", dict(POLAR, theta_max=1.0)),
    "polar bias": ("darswin_a_nano", dict(POLAR, position_bias="polar", harmonics=2)),
    "maps": ("darswin_a_nano", dict(POLAR, **TWO_STAGES, merges=((1, 1),), features_only=True)),
    "swin": ("swin_nano", PLAIN),
    "perspective": ("swin_nano perspective", dict(PLAIN, **TWO_STAGES)),
    "dat": ("dat_nano", dict(PLAIN, blocks=("D",), groups=(1,))),
    "conv": ("conv_unet_nano", dict(widths=(4, 4), task="distance")),
    "conv mercator": (
        "conv_unet_nano",
        dict(widths=(4, 4), view=dict(name="mercator", size=(20, 12), fov=2.0)),
    ),
    "unet A": ("darswin_unet_a_nano", dict(POLAR, **TWO_STAGES, merges=((1, 2),), **RAYS)),
    "unet RA": ("darswin_unet_ra_nano", dict(SQUARES, skip_width=2, rays=True)),
    "unet without skip": ("darswin_unet_a_nano", dict(POLAR, skip_width=0, places=False)),
    "unet": ("swin_unet_nano", PLAIN),
    "unet perspective": ("swin_unet_nano perspective", dict(PLAIN, **RAYS)),
    "conv whole lens": ("conv_unet_nano", dict(widths=(4,), view="mercator", size=(8, 16))),
    "unet equirectangular": (
        "swin_unet_nano",
        dict(PLAIN, **RAYS, view=dict(name="equirectangular", size=(8, 16), fov=2.0)),
    ),
    "unet square": ("swin_unet_nano square", dict(PLAIN, **RAYS)),
    "unet fixed square": ("swin_unet_nano", dict(PLAIN, **RAYS, view=dict(name="square", fov=2.0))),
    "official": (None, {}),
    "adapter": (None, {}),
    "adapter tiles": ("swin_nano", PLAIN),
    "adapter polar": (None, {}),
    "adapter of a Unet": ("conv_unet_nano", dict(widths=(4,), rays=False)),
}
ADAPTER_VIEWS = {"adapter tiles": "tiles", "adapter polar": "polar"}
NORMALIZED = dict(mean=0.4, std=0.2)
# One of each view and of each network, which are traced in a second.
FAST = ("fixed angle", "conv whole lens", "unet", "unet without skip", "official", "adapter")


def model_of(kind):
    torch.manual_seed(0)
    name, options = KINDS[kind]
    if kind == "official":
        sizes = dict(rings=4, sectors=16, samples=(2, 2))
        return OfficialDarSwin(num_classes=5, **ONE, **sizes, **NORMALIZED).eval()
    if kind.startswith("adapter"):
        options = options if name is None else dict(num_classes=5) | options
        network = create(name, **options) if name else torch.nn.Conv2d(3, 4, 3, padding=1)
        view = make_view(ADAPTER_VIEWS.get(kind, "square"), SIDE, **NORMALIZED)
        return LensAdapter(network, view=view).eval()
    return create(name, **(dict(num_classes=5, **NORMALIZED) | options)).eval()


def lenses_of(name):
    """Two lenses whose image circle touches the sides of the images."""
    if name.endswith(", general"):
        lens = ASIDE[name.removesuffix(", general")].replace(center=None)[[0, 0]]
    else:
        lens = example(name, torch.Generator().manual_seed(0))[:2]
    lens = lens.with_theta_max((lens.theta_limit * 0.8).clamp(max=1.3))
    return lens._scaled(SIDE / 2 / lens.r_max).to(torch.float32)


GENERAL = [f"{name}, general" for name in ASIDE]
# A closed inverse, one by Newton's method along the radius, and one in the plane.
THREE = ("Spherical", "Polynomial", "KannalaBrandt, general")
PIXELS = {  # kinds of images, as they are made
    "floats": lambda *shape: torch.rand(shape),
    "planes": lambda *shape: torch.randint(256, shape, dtype=torch.uint8),
    "frames": lambda *shape: torch.randint(256, shape, dtype=torch.uint8).permute(0, 2, 3, 1),
}


def graph_of(model, images, lens, written, path, **settings):
    """A model in a graph, as a function of tensors by name, and the names that a file takes."""
    if written == "program":
        program = export_program(model, images, lens, **settings).module()
        return lambda inputs, of_lens: program(*inputs.values(), **of_lens), None
    export_onnx(model, path, images, lens, **settings)
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert {each.shape[0] for each in session.get_inputs()} == {"batch"}
    names = [each.name for each in session.get_inputs()]
    if written == "openvino":
        settings = {"INFERENCE_PRECISION_HINT": "f32"}
        compiled = pytest.importorskip("openvino").Core().compile_model(path, "CPU", settings)

    def run(inputs, of_lens):
        given = inputs | of_lens
        arrays = {name: tensor.numpy() for name, tensor in given.items() if name in names}
        assert [*arrays] == names
        found = session.run(None, arrays) if written == "onnx" else compiled(arrays).values()
        return [torch.from_numpy(array) for array in found]

    return run, names


def check(kind, lens_name, written, input, fixed, path, pixels="floats"):
    """Exports, and compares the results at batches of several sizes with those of the model."""
    if kind == "official" and "general" in lens_name:  # it knows radial lenses alone
        lens_name = "Polynomial"
    model, lens = model_of(kind), lenses_of(lens_name)
    shape, make = (1 if kind == "gray" else 3, SIDE, SIDE), PIXELS[pixels]
    settings = dict(fixed_lens=fixed, input=input)
    run, names = graph_of(model, make(1, *shape), lens[:1], written, path, **settings)
    if names is not None and input == "images" and model.uses_lens:
        assert names == ["images", *([] if fixed else lens._tensors())]
    for count in (1, 3) if written == "openvino" else (0, 1, 3):
        images = make(count, *shape)
        lenses = lens[:1] if fixed else lens[[k % 2 for k in range(count)]]
        with torch.no_grad():
            expected, inputs = model(images, lenses), dict(images=images)
            if input == "tokens":
                tokens = model.sample(images, model.prepare(lenses, (SIDE, SIDE)))
                inputs = dict(tokens=tokens) | (inputs if model.refines_with_images else {})
            of_lens = {} if fixed else lenses._tensors()
            found = run(inputs, of_lens)
        expected, found = (
            [x] if isinstance(x, torch.Tensor) else list(x) for x in (expected, found)
        )
        # Newton's method in the plane ends at another rounding.
        rtol, atol = (1e-3, 1e-4) if "general" in lens_name else (1e-4, 1e-5)
        torch.testing.assert_close(found, expected, rtol=rtol, atol=atol)
    if names is not None and input == "images":
        with pytest.raises(Exception, match=r"images|shape"):  # each runtime has its own error
            run(dict(images=torch.cat((images, images), 2)), of_lens)


@pytest.mark.parametrize("kind", slow_but(KINDS, *FAST))
def test_the_program_of_every_model(kind, tmp_path):
    check(kind, "KannalaBrandt, general", "program", "images", True, tmp_path / "model.onnx")


@pytest.mark.parametrize(
    "lens",
    slow_but(
        ["Tabulated", "KannalaBrandt, general", "affine alone, general"], "affine alone, general"
    ),
)
def test_the_program_of_a_dense_model_with_rays(lens, tmp_path):
    check("conv", lens, "program", "images", False, tmp_path / "model.onnx")


@pytest.mark.parametrize(
    ("kind", "lens", "written", "input", "fixed", "pixels"),
    [
        # Each value once, and the pairs in `make test-products`. The whole would take hours.
        pytest.param(*row.values, marks=[slow, products] if row.marks else slow)
        for row in product(
            KINDS, THREE, ["program", "onnx"], ["images", "tokens"], [False, True], PIXELS
        )
        if products not in row.marks
    ],
)
def test_every_model(kind, lens, written, input, fixed, pixels, tmp_path):
    check(kind, lens, written, input, fixed, tmp_path / "model.onnx", pixels)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "lens", "fixed"),
    [
        ("classifier A", "Polynomial", False),
        ("classifier RA", "Polynomial", True),
        ("dat", "Spherical", False),
        pytest.param("perspective", "Spherical", False, marks=products),
        pytest.param("unet A", "Spherical", False, marks=products),
        ("unet square", "Spherical", True),
    ],
)
def test_openvino(kind, lens, fixed, tmp_path):
    check(kind, lens, "openvino", "images", fixed, tmp_path / "model.onnx")


# A search for the angle in a table and along the radius; that in the plane is in a package below.
SEARCHES = ("Tabulated", "Polynomial")


@pytest.mark.parametrize(
    ("kind", "lens"),
    [
        *(pytest.param("classifier A", lens, marks=slow) for lens in (*LENS_MODELS, *GENERAL)),
        *(
            pytest.param("conv", lens, marks=slow if lens in SEARCHES else [slow, products])
            for lens in (*LENS_MODELS, *GENERAL)
        ),
    ],
)
def test_every_lens(kind, lens, tmp_path):
    # The search in the plane is long: one of its lenses is enough in ONNX.
    dense = kind == "conv"
    written = "onnx" if dense and ("general" not in lens or "Mei" in lens) else "program"
    check(kind, lens, written, "images" if dense else "tokens", False, tmp_path / "model.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("unet A", marks=products), "conv"])
def test_a_package_with_rays_through_a_general_lens(kind, tmp_path):
    model, lens = model_of(kind), lenses_of("Mei, general")[:1]
    path = tmp_path / "model.pt2"
    export_package(model, path, torch.rand(1, 3, SIDE, SIDE), lens, fixed_lens=True)
    package = torch._inductor.aoti_load_package(str(path))
    images = torch.rand(3, 3, SIDE, SIDE)
    with torch.no_grad():
        torch.testing.assert_close(package(images), model(images, lens), rtol=1e-3, atol=1e-4)
