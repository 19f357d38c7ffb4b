"""Checks a darswin whose compiled modules cannot be loaded, and prints what it says about them."""

import warnings


def error_of(call, kind) -> str:
    try:
        call()
    except kind as error:
        return str(error)
    raise AssertionError(f"expected an error of {kind}")


def main() -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        import torch

        import darswin
        from darswin import ops

        torch.manual_seed(0)
        lens = darswin.lens.Spherical.from_fov(0.4, 2.6, 15.5)
        model = darswin.create_model("darswin_unet_a_nano", num_classes=3)
        images = torch.rand(1, 3, 32, 32)
        model(images, lens).sum().backward()
    (warning,) = (str(w.message) for w in told if w.category is RuntimeWarning)
    assert "The operators now run their PyTorch reference" in warning
    print(darswin.__file__, warning, sep="\n")
    assert all(p.grad is not None for p in model.parameters())

    assert ops.cpu_capability() == "reference"
    with ops.use_reference(False):
        assert ops._library.reference_in_use()
    # A gradient that only the reference has.
    azimuths = torch.linspace(0, 6, 8, requires_grad=True)
    radii, center = torch.linspace(1, 9, 8)[None], torch.full((1, 2), 15.5)
    ops.polar_sample(images, radii, azimuths, center, samples=(2, 2)).sum().backward()
    assert azimuths.grad.abs().sum() > 0

    print("optimize:", error_of(lambda: darswin.optimize(model), ImportError))
    print("darswin.frames:", error_of(lambda: darswin.frames, ImportError))

    expected = model.eval()(images, lens)
    program = torch.export.export(model, (images, lens)).module()
    # A graph rounds differently, by up to 3e-5 here.
    torch.testing.assert_close(program(images, lens), expected, rtol=1e-4, atol=1e-4)

    from darswin.cli.info import facts

    found = facts()
    assert found["tier"].startswith("the PyTorch reference: ") and "int8" not in found
    assert "without its compiled module" in found["darswin"]


if __name__ == "__main__":
    main()
