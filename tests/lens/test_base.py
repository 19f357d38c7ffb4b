import copy
import json
import math
import pickle

import numpy as np
import pytest
import torch
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader, Dataset

from darswin.lens import Equidistant, Perspective, Polynomial, Spherical, cat, from_dict, to_dict

f64 = torch.float64

# Four lenses of each model, in float64; the last ones reach far.
LENSES = {
    "perspective": Perspective(torch.tensor([1.5, 20.0, 300.0, 40.0], dtype=f64),
                               torch.tensor([1.52, 1.0, 0.3, 1.57], dtype=f64)),
    "spherical": Spherical(torch.tensor([0.0, 0.35, 1.0, 2.2134], dtype=f64), 30.0,
                           torch.tensor([1.55, 1.9, 3.1, 2.0], dtype=f64)),
    "polynomial": Polynomial(
        torch.tensor([[339.749, -31.988, 48.275, -7.201], [342.457, -22.4772, 28.5462, 1.78203],
                      [1.0, 0.0, 0.0, 0.0], [0.01, 0.0, 5.0, 0.0]], dtype=f64),
        torch.tensor([1.96, 1.9, 3.1, 1.2], dtype=f64)),
    "polynomial of degree 1": Polynomial(torch.tensor([[20.0]] * 4, dtype=f64), 2.0),
    "polynomial of degree 9": Polynomial(
        torch.tensor([[30.0, 0, -1.1, 0, 0.4, 0, -0.05, 0, 0.003]] * 4, dtype=f64), 2.5),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_unproject_is_the_inverse_to_1e_9(name):
    lens = LENSES[name]
    fractions = torch.cat((torch.tensor([1e-12, 1e-6, 1e-3], dtype=f64),
                           torch.linspace(0.01, 1, 500, dtype=f64)))  # fmt: skip
    theta = lens.theta_max[:, None] * fractions
    torch.testing.assert_close(lens.unproject(lens.project(theta)), theta, rtol=1e-9, atol=0)
    radius = lens.r_max[:, None] * fractions
    torch.testing.assert_close(lens.project(lens.unproject(radius)), radius, rtol=1e-9, atol=0)
    assert (lens.unproject(0.0) == 0).all() and (lens.project(0.0) == 0).all()


@pytest.mark.parametrize("name", LENSES)
def test_project_rises_beyond_90_degrees_where_the_model_does(name):
    lens = LENSES[name]
    steps = torch.linspace(0, 1, 2001, dtype=f64)
    assert (lens.project(lens.theta_max[:, None] * steps).diff(dim=1) > 0).all()
    if name != "perspective":
        assert (lens.theta_max > math.pi / 2).any()


def test_spherical_has_the_papers_focal_lengths():
    # The circle fills a 64 px image at a field of view of 174.63° (released data).
    xi = torch.tensor([0.0, 0.05, 0.2, 0.35, 0.5, 0.7, 0.93, 1.0], dtype=f64)
    lens = Spherical.from_fov(xi, 3.0479112779, 32.0)
    expected = [1.5, 3.102, 7.907, 12.712, 17.518, 23.925, 31.293, 33.535]
    torch.testing.assert_close(lens.focal, torch.tensor(expected, dtype=f64), rtol=0, atol=1e-3)
    torch.testing.assert_close(lens.r_max, torch.full((8,), 32.0, dtype=f64))


def test_spherical_is_perspective_at_0_and_stereographic_at_1():
    theta = torch.linspace(0, 1.4, 50, dtype=f64)
    flat, round_ = (Spherical(torch.tensor(x, dtype=f64), 10.0, 1.5) for x in (0.0, 1.0))
    torch.testing.assert_close(flat.project(theta), 10 * torch.tan(theta))
    torch.testing.assert_close(round_.project(theta), 10 * torch.tan(theta / 2))
    torch.testing.assert_close(
        Perspective.from_fov(2.8, 7.0).r_max, torch.tensor([7.0]), rtol=1e-5, atol=0
    )


def test_radii_where_nothing_lands_are_nan():
    assert Spherical(2.0, 10.0, 1.5).unproject(1e3).isnan().all()
    polynomial = Polynomial([20.0, 1.0], 1.5)
    outside = polynomial.unproject(torch.tensor([-1.0, 1e3, math.nan, math.inf]))
    assert outside.isnan().all()


@pytest.mark.parametrize("name", LENSES)
def test_gradients_of_both_directions(name):
    lens = LENSES[name]
    names = [n for n in lens._names() if getattr(lens, n) is not None]
    tensors = [getattr(lens, n).clone().requires_grad_() for n in names]
    part = torch.linspace(0.1, 0.9, 4, dtype=f64)

    def run(x, *values, direction="project"):
        made = lens.replace(**dict(zip(names, values, strict=True)))
        return getattr(made, direction)(x)

    theta = (lens.theta_max[:, None] * part).requires_grad_()
    assert torch.autograd.gradcheck(run, (theta, *tensors))
    radius = lens.project(theta).detach().requires_grad_()
    # gradcheck moves θ_max too, which no inverse depends on.
    assert torch.autograd.gradcheck(
        lambda x, *values: run(x, *values, direction="unproject"), (radius, *tensors)
    )


def test_a_parameter_can_be_learned():
    xi = torch.nn.Parameter(torch.tensor(0.3))
    lens = Spherical(xi, 10.0, 1.4)
    lens.project(torch.tensor([0.5, 1.0])).sum().backward()
    assert xi.grad is not None and xi.grad < 0
    coefficients = torch.nn.Parameter(torch.tensor([20.0, 1.0]))
    Polynomial(coefficients, 1.4).unproject(torch.tensor([5.0, 10.0])).sum().backward()
    assert (coefficients.grad < 0).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Perspective(0.0, 1.0), "focal must be"),
        (lambda: Perspective(-3.0, 1.0), r"focal must be .* got -3.0"),
        (lambda: Perspective(math.inf, 1.0), "focal must be"),
        (
            lambda: Perspective(1.0, math.pi / 2 + 1e-3),
            r"theta_max must be at most 1.570795 rad \(90.00°\).* got 1.57179",
        ),
        (lambda: Perspective(1.0, 0.0), "theta_max must be greater than 0"),
        (lambda: Perspective(1.0, math.nan), "theta_max must be"),
        (lambda: Spherical(-0.1, 1.0, 1.0), r"xi must be .* got -0.1"),
        (lambda: Spherical(math.nan, 1.0, 1.0), "xi must be"),
        (lambda: Spherical(0.5, 0.0, 1.0), "focal must be"),
        (
            lambda: Spherical(0.0, 1.0, 1.6),
            r"theta_max must be at most 1.57.*Spherical lens's r rises",
        ),
        (lambda: Spherical(0.5, 1.0, 2.2), r"theta_max must be at most 2.09"),
        (lambda: Spherical(2.0, 1.0, 2.2), r"theta_max must be at most 2.09"),
        (lambda: Spherical([0.1, 0.2], [1.0, 2.0, 3.0], 1.0), "agree in the number of lenses"),
        (lambda: Spherical([0.1, -0.2], 1.0, 1.0), r"xi must be .* got -0.2"),
        (lambda: Spherical([[0.1]], 1.0, 1.0), r"xi must be a number or \(N,\)"),
        (
            lambda: Polynomial([1.0, -5.0], 1.0),
            r"theta_max must be at most 0.09999.*as far as .* r rises",
        ),
        (lambda: Polynomial([0.0, 1.0], 1.0), "coefficients must be such that r rises"),
        (lambda: Polynomial([1.0, math.nan], 1.0), "coefficients must be finite"),
        (lambda: Polynomial(1.0, 1.0), r"coefficients must be \(K,\) or \(N, K\)"),
        (lambda: Polynomial([1.0], 3.2), "theta_max must be at most 3.14159"),
        (lambda: Perspective(1.0, 1.0, center=[1.0, 2.0, 3.0]), "center must be"),
        (lambda: Perspective(1.0, 1.0, center=3.0), r"center must be \(K,\) or \(N, K\)"),
        (lambda: Perspective.from_fov(3.2, 10.0), "focal must be"),  # tan(θ_max) < 0
        (lambda: Spherical.from_fov(0.5, 2.0, -1.0), "focal must be"),
    ],
)  # fmt: skip
def test_a_parameter_out_of_range_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_wrong_types():
    with pytest.raises(TypeError, match="focal must be a number or a tensor, got 'wide'"):
        Perspective("wide", 1.0)
    with pytest.raises(TypeError, match="xi must be a number"):
        Spherical(object(), 1.0, 1.0)
    with pytest.raises(TypeError, match=r"Spherical takes xi, focal, theta_max, .* got thetamax"):
        Spherical(0.5, 1.0, thetamax=1.0)


def test_dtype_and_precision():
    assert Spherical(0.3, 1.3, 1.0).focal.dtype == torch.float32
    lens = Spherical(torch.tensor(0.3, dtype=f64), 1.3, 1.0)
    assert lens.focal.dtype == f64 and lens.focal.item() == 1.3  # not rounded to float32 first
    assert lens.to(torch.float32).xi.dtype == torch.float32
    assert lens.to("meta").focal.device.type == "meta"


def test_shapes_of_project():
    one, many = Spherical(0.3, 10.0, 1.0), Spherical([0.3, 0.4, 0.5], 10.0, 1.0)
    assert one.project(0.5).shape == (1,) and many.project(0.5).shape == (3,)
    assert one.project(torch.zeros(7)).shape == (7,)
    assert one.project(torch.zeros(7, 2)).shape == (7, 2)
    assert many.project(torch.zeros(1, 5)).shape == (3, 5)
    assert many.unproject(torch.zeros(3, 5, 2)).shape == (3, 5, 2)
    for direction in (many.project, many.unproject):
        with pytest.raises(ValueError, match=r"number of lenses, 3 or 1, got shape \(5,\)"):
            direction(torch.zeros(5))


def test_indexing_and_stacking():
    lens = Spherical([0.0, 0.2, 0.4], [1.0, 2.0, 3.0], 1.2, center=[[1.0, 2.0]] * 3)
    assert len(lens) == 3 and len(lens[1]) == 1 and lens[1].focal.item() == 2.0
    assert lens[-1].xi.item() == pytest.approx(0.4)
    assert len(lens[np.int64(1)]) == 1
    assert lens[:2].xi.tolist() == pytest.approx([0.0, 0.2])
    assert lens[torch.tensor([2, 0])].focal.tolist() == [3.0, 1.0]
    assert lens[torch.tensor([True, False, True])].focal.tolist() == [1.0, 3.0]
    with pytest.raises(IndexError):
        lens[3]
    again = cat([lens[k] for k in range(3)])
    assert torch.equal(again.xi, lens.xi) and torch.equal(again.center, lens.center)
    assert [x.focal.item() for x in lens] == [1.0, 2.0, 3.0]
    assert len(lens[0].expand(5)) == 5
    with pytest.raises(ValueError, match="cannot expand"):
        lens.expand(4)
    with pytest.raises(ValueError, match="at least one"):
        cat([])
    with pytest.raises(ValueError, match="center for all"):
        cat([lens[0], Spherical(0.1, 1.0, 1.0)])


@pytest.mark.parametrize("name", LENSES)
def test_tensors_are_contiguous_however_a_lens_was_made(name):
    lens = LENSES[name].replace(image_size=torch.full((1, 2), 64.0, dtype=f64).expand(4, 2))
    made = {
        "built": lens,
        "reversed": lens[torch.arange(3, -1, -1)],
        "every second": lens[::2],
        "expanded": lens[0].expand(3),
        "narrowed": lens.with_theta_max(0.2),
        "resized": lens.resized((48, 64)),
        "halved": lens.resized(0.5),
        "cropped": lens.cropped(3, 5, 20, 40),
        "replaced": lens[:2].replace(theta_max=lens.theta_max[:1].expand(2)),
        "stacked": cat([lens, lens]),
        "float32": lens.to(torch.float32),
    }
    for how, other in made.items():
        for tensor in pytree.tree_leaves(other):
            assert tensor is None or tensor.is_contiguous(), how


def test_strided_parameters_make_contiguous_lenses():
    table = torch.tensor([[0.3, 300.0, 1.4], [0.9, 320.0, 1.5]], requires_grad=True)
    lens = Spherical(*table.unbind(1), center=table[:, :2].detach().t().flip(0).t())
    assert all(t is None or t.is_contiguous() for t in pytree.tree_leaves(lens))
    lens.r_max.sum().backward()
    assert (table.grad[:, 1] != 0).all()  # still the parameters that were given


def test_principal_point():
    lens = Spherical(0.1, 10.0, 1.0)
    assert lens.center_in((5, 8)).tolist() == [[3.5, 2.0]]  # (H, W) in, (x, y) out
    assert Spherical(0.1, 10.0, 1.0, center=[3.0, 4.0]).center_in((5, 8)).tolist() == [[3.0, 4.0]]


class Lenses(Dataset):
    def __len__(self):
        return 5

    def __getitem__(self, index):
        return {"image": torch.zeros(1), "lens": Spherical.from_fov(index / 5, 2.6, 16.0)}


@pytest.mark.parametrize("workers", [0, 2])
def test_a_dataloader_batches_lenses(workers):
    batches = list(DataLoader(Lenses(), batch_size=3, num_workers=workers))
    assert [len(b["lens"]) for b in batches] == [3, 2]
    assert batches[1]["lens"].xi.tolist() == pytest.approx([0.6, 0.8])


@pytest.mark.parametrize("name", LENSES)
def test_pickle_copy_and_pytree(name):
    lens = LENSES[name]
    for other in (pickle.loads(pickle.dumps(lens)), copy.deepcopy(lens)):
        assert torch.equal(other.r_max, lens.r_max)
    leaves, spec = pytree.tree_flatten(lens)
    assert torch.equal(pytree.tree_unflatten(leaves, spec).r_max, lens.r_max)
    assert type(lens).__name__ in repr(lens)


@pytest.mark.parametrize("center", [None, [20.0, 11.0]])
def test_a_resized_lens_projects_to_the_resized_image(center):
    lens = Spherical(0.4, 30.0, 1.3, center=center)
    half = lens.resized(0.5)
    assert half.project(1.0).item() == pytest.approx(lens.project(1.0).item() / 2)
    # Pixel centres are integers: the corner at -1/2 stays where it is.
    middle, before = half.center_in((15, 20))[0], lens.center_in((30, 40))[0]
    assert torch.allclose(middle + 0.5, (before + 0.5) / 2)
    assert Polynomial([5.0, 1.0], 1.0).resized(2).coefficients.tolist() == [[10.0, 2.0]]


@pytest.mark.parametrize("size", [(966, 1280), (483, 640), (75, 100), (1, 1), (1932, 2561)])
def test_in_a_picture_of_the_same_view(size):
    lens = Equidistant(300.0, 1.5, image_size=(966, 1280))
    found = lens.in_picture(size)
    assert found.image_size.tolist() == [list(size)]
    assert found.focal.item() == pytest.approx(300 * size[1] / 1280)
    assert (found is lens) == (size == (966, 1280))


def test_in_a_picture_of_another_view():
    lens = Equidistant(300.0, 1.5, image_size=(966, 1280))
    for size in [(966, 1278), (480, 643), (1280, 966)]:
        with pytest.raises(ValueError, match="pictures of 966×1280 px, and"):
            lens.in_picture(size)
    unknown = Equidistant(300.0, 1.5)
    assert unknown.in_picture((4, 9)) is unknown


def test_resizing_to_a_size_keeps_where_rays_land():
    lens = Polynomial([339.749, -31.988, 48.275, -7.201], 1.6, [643.4, 479.4],
                      affine=[[1.0, 0.0], [0.0, 1.2]], image_size=(966, 1280))  # fmt: skip
    theta, azimuth = torch.tensor([0.0, 0.5, 1.5]), torch.tensor([0.3, 2.0, -1.0])
    before = lens.project_rays(theta, azimuth)
    half = lens.resized((483, 320))
    assert half.image_size.tolist() == [[483, 320]]
    after = (before + 0.5) * torch.tensor([0.25, 0.5]) - 0.5
    torch.testing.assert_close(half.project_rays(theta, azimuth), after, rtol=1e-5, atol=1e-4)
    assert lens.resized(0.5).image_size.tolist() == [[483, 640]]
    assert lens.resized((483, 640)).affine.tolist() == lens.affine.tolist()
    with pytest.raises(ValueError, match="needs a lens that has an image_size"):
        Spherical(0.5, 10.0, 1.0).resized((3, 4))


def test_cropping_moves_the_principal_point():
    lens = Spherical(0.5, 100.0, 1.0, image_size=(300, 400))
    part = lens.cropped(50, 100, 200, 150)
    assert part.center.tolist() == [[199.5 - 100, 149.5 - 50]]
    assert part.image_size.tolist() == [[200, 150]]
    with pytest.raises(ValueError, match="needs the image_size"):
        Spherical(0.5, 100.0, 1.0).cropped(0, 0, 10, 10)


def test_angles_at_the_sides_of_the_image():
    lens = Polynomial([339.749, -31.988, 48.275, -7.201], None, [639.5, 482.5],
                      image_size=(966, 1280))  # fmt: skip
    left, top, right, bottom = torch.rad2deg(lens.side_angles()[0]).tolist()
    assert left == pytest.approx(94.88, abs=5e-3) and right == pytest.approx(left, abs=1e-4)
    assert top == pytest.approx(75.77, abs=5e-3) and bottom == pytest.approx(top, abs=1e-4)
    # An image that ends beyond the circle sees as far as the lens.
    small = Spherical(2.0, 10.0, image_size=(100, 8))
    assert small.side_angles()[0].tolist()[1] == small.theta_limit.item()


def test_another_theta_max():
    lens = Spherical([0.5, 2.0], 10.0, 1.0)
    assert torch.equal(lens.with_theta_max(None).theta_max, lens.theta_limit)
    assert lens.with_theta_max(1.5).theta_max.tolist() == [1.5, 1.5]
    assert lens.theta_max.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match=r"theta_max must be at most 2\.09"):
        lens.with_theta_max(2.5)


def test_stacking_needs_the_same_frame():
    with_size = Spherical(0.5, 10.0, 1.0, image_size=(4, 4))
    with pytest.raises(ValueError, match="image_size for all"):
        cat([with_size, Spherical(0.5, 10.0, 1.0)])
    tilted = Spherical(0.5, 10.0, 1.0, affine=[[1.0, 0.0], [0.0, 2.0]])
    both = cat([tilted, Spherical(0.5, 10.0, 1.0)])
    assert isinstance(both, Spherical) and both.affine[1].tolist() == [[1.0, 0.0], [0.0, 1.0]]


def test_as_json_and_back():
    lens = Spherical(torch.tensor(0.1, dtype=f64), 300.0, 1.3, [3.0, 4.0], image_size=(480, 640))
    described = to_dict(lens)
    assert described == {
        "model": "Spherical", "xi": 0.1, "focal": 300.0, "theta_max": 1.3, "center": [3.0, 4.0],
        "image_size": [480, 640],
    }  # fmt: skip
    assert to_dict(from_dict(json.loads(json.dumps(to_dict(lens))))) == to_dict(
        lens.to(torch.float32)
    )
    with pytest.raises(ValueError, match="one lens, got 2"):
        to_dict(lens.expand(2))


def test_resized_takes_any_number_and_nothing_that_is_no_image():
    lens = Perspective(100.0, 1.0, (319.5, 241.5), image_size=(483, 640))
    whole = lens.resized(0.5)
    for half in (np.float32(0.5), np.float64(0.5), torch.tensor(0.5), np.array(0.5)):
        resized = lens.resized(half)
        assert resized.focal.item() == 50 and resized.affine is None
        assert resized.image_size.tolist() == whole.image_size.tolist() == [[242, 320]]
    assert lens.resized(torch.tensor([240, 320])).image_size.tolist() == [[240, 320]]
    assert lens.resized((240.0, np.int64(320))).image_size.tolist() == [[240, 320]]
    assert lens.resized(1e-6).image_size.tolist() == [[1, 1]]
    for scale in (0, -1, math.nan, math.inf, np.float32(-2), torch.tensor(0.0)):
        with pytest.raises(ValueError, match="resized must be given a finite scale above 0, got"):
            lens.resized(scale)
    for size in ((0, 5), (-5, 5), torch.tensor([3, 0])):
        with pytest.raises(ValueError, match=r"image's \(H, W\) must be at least \(1, 1\), got"):
            lens.resized(size)
    for size in ((483,), (1, 2, 3), "12", None, (2.5, 3), (math.nan, 3), (None, 3)):
        with pytest.raises(TypeError, match=r"size must be \(H, W\)|whole pixels"):
            lens.resized(size)


def test_cropped_takes_only_parts_with_pixels():
    lens = Perspective(100.0, 1.0, (319.5, 241.5), image_size=(483, 640))
    padded = lens.cropped(-8, -4, 499, 648)
    assert padded.center.tolist() == [[323.5, 249.5]]
    assert padded.image_size.tolist() == [[499, 648]]
    for part in ((0, 0, -5, 10), (0, 0, 5, 0)):
        with pytest.raises(ValueError, match=r"must be at least \(1, 1\)"):
            lens.cropped(*part)
    for part in ((0.5, 0, 5, 10), (0, 0, math.nan, 10), (None, 0, 5, 5)):
        with pytest.raises(TypeError, match="an image has whole pixels, got"):
            lens.cropped(*part)
