"""Properties of lenses of any model with any parameters, and of their grids."""

import json
import math

import hypothesis
import hypothesis.strategies as st
import torch
from lens_examples import RANGES, f64, first_coefficients

from darswin.lens import MODELS, cat, from_dict, to_dict
from darswin.lens.spacing import SPACINGS
from darswin.views.polar import PLACEMENTS, PolarView


def rows(draw, low, high, count, width):
    row = st.lists(st.floats(low, high), min_size=width, max_size=width)
    return draw(st.lists(row, min_size=count, max_size=count))


@st.composite
def lenses(draw, radial=False):
    """One to three lenses of a model, with or without optional parameters."""
    name, count = draw(st.sampled_from(sorted(MODELS))), draw(st.integers(1, 3))
    model, values = MODELS[name], {}
    for key in (*model.parameters, *model.optional):
        aside = key in ("tangential", "prism")
        if key in model.optional and (key == "slopes" or (aside and radial) or draw(st.booleans())):
            continue
        if key == "coefficients":
            first, scale = first_coefficients(name, draw(st.floats(10, 2000)))
            more = rows(draw, -0.1 * scale, 0.1 * scale, count, draw(st.integers(1, 3)))
            values[key] = [first + row for row in more]
        elif key in ("angles", "radii"):
            steps = rows(draw, 0.01, 0.4, count, 6)
            most = 1 if key == "angles" else draw(st.floats(1, 2000))
            values[key] = [[0.0] + [most * sum(row[: k + 1]) for k in range(6)] for row in steps]
        elif len(model.declared[key].shape):
            width = model.declared[key].shape[0] or draw(st.integers(1, 4))
            values[key] = rows(draw, *RANGES[key], count, width)
        else:
            values[key] = [row[0] for row in rows(draw, *RANGES[key], count, 1)]
    frame = {}
    if draw(st.booleans()):
        frame["center"] = rows(draw, -50, 900, count, 2)
        frame["image_size"] = [[480, 640]] * count
    if draw(st.booleans()):
        skew, aspect = draw(st.floats(-0.1, 0.1)), draw(st.floats(0.5, 2))
        frame["affine"] = [[[1.0, skew], [0.0, aspect]]] * count
    tensors = {key: torch.tensor(value, dtype=f64) for key, value in (values | frame).items()}
    try:
        lens = model(**tensors)
    except ValueError as error:  # r does not rise
        hypothesis.assume("such that r " not in str(error))
        raise
    share = draw(st.floats(0.3 if name == "OCamInverse" else 0.05, 1))
    try:
        return lens.with_theta_max(share * lens.theta_limit)
    except ValueError:
        hypothesis.assume(name != "OCamInverse")  # r(0) need not be 0 there
        raise


@hypothesis.given(lens=lenses(radial=True), data=st.data())
def test_radii_and_angles_undo_each_other_and_nothing_else_lands(lens, data):
    fractions = torch.tensor(data.draw(st.lists(st.floats(0, 1), min_size=1, max_size=9))).double()
    theta = lens.theta_max[:, None] * fractions.sort().values
    radius = lens.project(theta)
    # Rounding θ changes r by the slope; rounding r changes θ by its inverse.
    slope = lens._slope(theta).clamp(min=1e-12)
    rounding = 64 * torch.finfo(f64).eps
    off = (lens.unproject(radius.clamp(min=0)) - theta).abs()
    r0 = lens.project(torch.zeros(1, 1, dtype=f64)).abs()  # of OCamInverse
    assert (off <= rounding * (4 + lens.r_max[:, None] / slope) + 1e-9 + 2 * r0 / slope).all()
    assert (radius.diff(dim=1) >= -rounding * lens.r_max[:, None]).all()
    beyond = torch.cat((lens.r_max[:, None] * 1.001 + 1e-9, -lens.r_max[:, None]), 1)
    edge = lens.project(lens.theta_max * (1 + rounding)).isfinite() & (lens.r_max < 1e9)
    assert lens.unproject(beyond)[edge].isnan().all()


@hypothesis.given(lens=lenses(), scale=st.floats(0.01, 20), data=st.data())
def test_a_resized_or_cropped_lens_sees_the_same(lens, scale, data):
    share = data.draw(st.floats(0, 0.98))
    theta, azimuth = share * lens.theta_max[:, None], torch.tensor([[-2.5, 0.0, 1.0]], dtype=f64)
    pixels = lens.project_rays(theta, azimuth, None if lens.image_size is not None else (480, 640))
    tolerance = 1e-9 * (1 + pixels.abs().max().item())
    if lens.center is None:
        return
    larger = lens.resized(scale).project_rays(theta, azimuth)
    torch.testing.assert_close(larger, (pixels + 0.5) * scale - 0.5, rtol=0, atol=20 * tolerance)
    height, width = data.draw(st.tuples(st.integers(1, 3000), st.integers(1, 3000)))
    other = lens.resized((height, width)).project_rays(theta, azimuth)
    factors = torch.tensor([width / 640, height / 480], dtype=f64)
    torch.testing.assert_close(other, (pixels + 0.5) * factors - 0.5, rtol=0, atol=20 * tolerance)
    top, left = data.draw(st.tuples(st.integers(-99, 400), st.integers(-99, 400)))
    part = lens.cropped(top, left, height, width).project_rays(theta, azimuth)
    moved = pixels - torch.tensor([left, top], dtype=f64)
    torch.testing.assert_close(part, moved, rtol=0, atol=tolerance)


@hypothesis.given(lens=lenses())
def test_a_batch_is_its_lenses_and_json_is_the_lens(lens):
    theta = 0.9 * lens.theta_max[:, None]
    together = lens.project_rays(theta, torch.full_like(theta, 0.7), (480, 640))
    joined = cat([lens[k] for k in range(len(lens))])
    for name in lens.names:
        value, other = getattr(lens, name), getattr(joined, name)
        assert (value is None) == (other is None) and (value is None or torch.equal(value, other))
    for k in range(len(lens)):
        described = json.loads(json.dumps(to_dict(lens[k])))
        torch.set_default_dtype(f64)  # JSON has no dtype
        try:
            read = from_dict(described)
        finally:
            torch.set_default_dtype(torch.float32)
        assert read.names == lens.names
        alone = lens[k].project_rays(theta[k : k + 1], 0.7, (480, 640))
        torch.testing.assert_close(alone, together[k : k + 1])


@hypothesis.given(
    lens=lenses(), rings=st.integers(1, 20), sectors=st.integers(1, 40), data=st.data()
)
def test_samples_of_any_grid_stand_in_their_patches(lens, rings, sectors, data):
    placement = data.draw(st.sampled_from(PLACEMENTS))
    least = 2 if placement == "edges" else 1
    samples = data.draw(st.tuples(st.integers(least, 6), st.integers(least, 6)))
    narrow = bool((lens.theta_max < math.pi / 2 - 1e-3).all())
    spacings = st.sampled_from([s for s in SPACINGS if narrow or s != "tan"])
    spacing, inner = data.draw(spacings), data.draw(spacings)
    hypothesis.assume(type(lens).__name__ != "OCamInverse" or "radius" not in (spacing, inner))
    view = PolarView(
        rings, sectors, samples, spacing=spacing, sample_spacing=inner, placement=placement
    )
    grid = view.grid(lens, (480, 640))
    slack = 1e-6 * (1 + lens.r_max[:, None, None])
    assert grid.radii.shape == (len(lens), rings * samples[0])
    assert grid.borders.shape == (len(lens), rings + 1)
    points = grid.radii.unflatten(1, (rings, samples[0]))
    low, high = grid.borders[:, :-1, None], grid.borders[:, 1:, None]
    assert (points >= low - slack).all() and (points <= high + slack).all()
    assert (points.diff(dim=2) >= -slack).all() and (high - low > -slack).all()
    torch.testing.assert_close(grid.borders[:, -1], lens.r_max, rtol=1e-6, atol=1e-6)
    azimuths = grid.azimuths.unflatten(0, (sectors, samples[1])) * (sectors / (2 * math.pi))
    places = (torch.arange(samples[1], dtype=f64) + 0.5) / samples[1]  # in a sector
    if placement == "edges":
        assert ((points[..., [0, -1]] - torch.cat((low, high), 2)).abs() <= slack).all()
        places = torch.linspace(0, 1, samples[1], dtype=f64)
    expected = torch.arange(sectors, dtype=f64)[:, None] + places
    torch.testing.assert_close(azimuths, expected, rtol=0, atol=1e-9)
    if spacing == "theta":
        steps = lens.project(lens.theta_max[:, None] * torch.linspace(0, 1, rings + 1, dtype=f64))
        torch.testing.assert_close(grid.borders, steps, rtol=1e-9, atol=1e-9)


special = st.sampled_from([0.0, -1.0, 1e-300, 1e300, math.nan, math.inf, 1.0, 100.0])
numbers = st.one_of(st.floats(), special)
rows_of_numbers = st.lists(numbers, max_size=5)


@hypothesis.given(name=st.sampled_from(sorted(MODELS)), data=st.data())
def test_any_numbers_make_a_lens_that_rises_or_an_error_in_a_sentence(name, data):
    model, values = MODELS[name], {}
    for key in (*model.parameters, *model.optional):
        if key in model.optional and data.draw(st.booleans()):
            continue
        values[key] = data.draw(rows_of_numbers if len(model.declared[key].shape) else numbers)
    if data.draw(st.booleans()):
        values["theta_max"] = data.draw(numbers)
    tensors = {key: torch.tensor(value, dtype=f64) for key, value in values.items()}
    try:
        lens = model(**tensors)
    except (ValueError, TypeError) as error:
        assert len(str(error)) < 1000 and "\n" not in str(error)
        return
    assert ((lens.theta_max > 0) & (lens.theta_max <= lens.theta_limit)).all()
    middle = lens.project(0.5 * lens.theta_max)
    assert (middle <= lens.r_max * (1 + 1e-9)).all() and not lens.r_max.isnan().any()
