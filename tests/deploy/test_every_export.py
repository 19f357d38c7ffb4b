"""Every kind of model × every kind of lens × every export, at any batch size, also 0 and 1."""

import pytest
import torch
from helpers import create, slow_but
from lens_examples import ASIDE, example

from darswin.compat import OfficialDarSwin
from darswin.deploy.export import export_onnx, export_package, export_program
from darswin.lens import MODELS as LENS_MODELS
from darswin.models import LensAdapter

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
}
# One of each view and of each network, which are traced in a second.
FAST = ("fixed angle", "conv whole lens", "unet", "unet without skip", "official", "adapter")


def model_of(kind):
    torch.manual_seed(0)
    name, options = KINDS[kind]
    if kind == "official":
        sizes = dict(rings=4, sectors=16, samples=(2, 2))
        return OfficialDarSwin(num_classes=5, **ONE, **sizes).eval()
    if kind == "adapter":
        return LensAdapter(torch.nn.Conv2d(3, 4, 3, padding=1), SIDE, view="square").eval()
    return create(name, **(dict(num_classes=5) | options)).eval()


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


def check(kind, lens_name, written, input, fixed, path):
    """Exports, and compares the results at batches of 0, 1 and 3 with those of the model."""
    model, lens, images = model_of(kind), lenses_of(lens_name), torch.rand(1, 3, SIDE, SIDE)
    settings = dict(fixed_lens=fixed, input=input)
    if written == "program":
        program = export_program(model, images, lens[:1], **settings).module()
    else:
        runtime = pytest.importorskip("onnxruntime")
        export_onnx(model, path, images, lens[:1], **settings)
        session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
        taken = [given.name for given in session.get_inputs()]
    for count in (0, 1, 3):
        images = torch.rand(count, 3, SIDE, SIDE)
        lenses = lens[:1] if fixed else lens[[k % 2 for k in range(count)]]
        named = {} if fixed else lenses._tensors()
        with torch.no_grad():
            expected, inputs = model(images, lenses), dict(images=images)
            if input == "tokens":
                tokens = model.sample(images, model.prepare(lenses, (SIDE, SIDE)))
                inputs = dict(tokens=tokens) | (inputs if model.refines_with_images else {})
            if written == "program":
                found = program(*inputs.values(), **named)
            else:
                arrays = {key: t.numpy() for key, t in (inputs | named).items() if key in taken}
                assert [*arrays] == taken
                found = [torch.from_numpy(array) for array in session.run(None, arrays)]
        expected, found = (
            [x] if isinstance(x, torch.Tensor) else list(x) for x in (expected, found)
        )
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", slow_but(KINDS, *FAST))
def test_the_program_of_every_model(kind, tmp_path):
    lens = "KannalaBrandt" if kind == "official" else "KannalaBrandt, general"
    check(kind, lens, "program", "images", True, tmp_path / "model.onnx")


@pytest.mark.parametrize(
    "lens",
    slow_but(
        ["Tabulated", "KannalaBrandt, general", "affine alone, general"], "affine alone, general"
    ),
)
def test_the_program_of_a_dense_model_with_rays(lens, tmp_path):
    check("conv", lens, "program", "images", False, tmp_path / "model.onnx")


def pairs():
    """Each model in each form, through lenses that take turns; the slow ones rarely in ONNX."""
    for row, kind in enumerate(KINDS):
        radial = THREE[row % 2]
        general = radial if kind == "official" else THREE[2]  # it knows radial lenses alone
        yield kind, general if row % 3 == 0 else radial, "program", "tokens", False
        yield kind, THREE[(row + 1) % 2], "onnx", "images", False
        fixed = row % 4 > 0
        yield kind, general if fixed else radial, "onnx", "tokens", fixed


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "lens", "written", "input", "fixed"), [*pairs()])
def test_every_model(kind, lens, written, input, fixed, tmp_path):
    check(kind, lens, written, input, fixed, tmp_path / "model.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("lens", [*LENS_MODELS, *GENERAL])
@pytest.mark.parametrize("kind", ["classifier A", "conv"])
def test_every_lens(kind, lens, tmp_path):
    # The search in the plane is long: one of its lenses is enough in ONNX.
    dense = kind == "conv"
    written = "onnx" if dense and ("general" not in lens or "Mei" in lens) else "program"
    check(kind, lens, written, "images" if dense else "tokens", False, tmp_path / "model.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["unet A", "conv"])
def test_a_package_with_rays_through_a_general_lens(kind, tmp_path):
    model, lens = model_of(kind), lenses_of("Mei, general")[:1]
    path = tmp_path / "model.pt2"
    export_package(model, path, torch.rand(1, 3, SIDE, SIDE), lens, fixed_lens=True)
    package = torch._inductor.aoti_load_package(str(path))
    images = torch.rand(3, 3, SIDE, SIDE)
    with torch.no_grad():
        torch.testing.assert_close(package(images), model(images, lens), rtol=1e-3, atol=1e-4)
