"""A batch of lenses as tensors, and the image that they belong to."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from helpers import refused
from lens_examples import example, f64
from torch.utils import _pytree as pytree

from darswin.lens import MODELS, Equidistant, KannalaBrandt, Perspective, Spherical, cat


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
        refused(r"number of lenses, 3 or 1, got shape \(5,\)", direction, torch.zeros(5))


def test_indexing_and_joining():
    lens = Spherical([0.0, 0.2, 0.4], [1.0, 2.0, 3.0], 1.2, center=[[1.0, 2.0]] * 3)
    assert len(lens) == 3 and len(lens[1]) == 1 and lens[1].focal.item() == 2.0
    assert lens[-1].xi.item() == pytest.approx(0.4)
    assert len(lens[np.int64(1)]) == 1
    assert lens[:2].xi.tolist() == pytest.approx([0.0, 0.2])
    assert lens[torch.tensor([2, 0])].focal.tolist() == [3.0, 1.0]
    assert lens[torch.tensor([True, False, True])].focal.tolist() == [1.0, 3.0]
    with pytest.raises(IndexError):
        lens[3]
    assert [x.focal.item() for x in lens] == [1.0, 2.0, 3.0]
    assert len(lens[0].expand(5)) == 5
    refused("cannot expand", lens.expand, 4)
    refused("at least one", cat, [])
    plain = Spherical(0.1, 1.0, 1.0)
    refused("center for all", cat, [lens[0], plain])
    refused("image_size for all", cat, [plain.replace(image_size=torch.ones(1, 2)), plain])
    both = cat([Spherical(0.5, 10.0, 1.0, affine=[[1.0, 0.0], [0.0, 2.0]]), plain])
    assert isinstance(both, Spherical) and both.affine[1].tolist() == [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize("name", MODELS)
def test_a_lens_is_copied_whole_and_has_contiguous_tensors_however_it_was_made(name):
    lens = example(name, torch.Generator().manual_seed(1))
    lens = lens.replace(image_size=torch.full((1, 2), 64.0, dtype=f64).expand(4, 2))
    for other in (
        lens, lens[torch.arange(3, -1, -1)], lens[::2], lens[0].expand(3), cat([lens, lens]),
        lens.with_theta_max(0.9 * lens.theta_limit), lens.resized((48, 64)), lens.resized(0.5),
        lens.cropped(3, 5, 20, 40), lens[:2].replace(theta_max=lens.theta_max[:1].expand(2)),
        lens.to(torch.float32),
    ):  # fmt: skip
        assert all(tensor.is_contiguous() for tensor in other._tensors().values())
    leaves, spec = pytree.tree_flatten(lens)
    copies = pickle.loads(pickle.dumps(lens)), copy.deepcopy(lens)
    assert all(torch.equal(other.r_max, lens.r_max) for other in copies)
    assert torch.equal(pytree.tree_unflatten(leaves, spec).r_max, lens.r_max)
    assert name in repr(lens)


def test_a_column_of_coefficients_is_not_many_lenses():
    column = [[0.01], [0.002], [-0.001], [0.0003]]  # the shape of OpenCV's D
    for make in (lambda: KannalaBrandt(300.0, column), lambda: KannalaBrandt([300.0], column)):
        refused(r"radial of shape \(4, 1\) means 4 lenses with one coef", make)
    assert len(KannalaBrandt([300.0] * 4, column)) == 4
    assert len(KannalaBrandt(300.0, [[0.01]])) == 1


def test_the_same_numbers_are_the_same_lens_and_merge():
    lens = KannalaBrandt([8.0, 9.0], radial=[0.1, 0.0, 0.0, 0.0])
    assert lens.same_as(lens[:])
    for other in (
        lens[0], lens[[1, 0]], lens.to(torch.float64), lens.with_theta_max(1.0),
        KannalaBrandt([8.0, 9.0]), Equidistant([8.0, 9.0], 1.0), None,
    ):  # fmt: skip
        assert not lens.same_as(other)
    lens = KannalaBrandt([8.0, 9.0, 8.0], radial=[0.1, 0.0, 0.0, 0.0])
    assert lens.merged() is lens and lens[[0, 2]].merged().same_as(lens[0])
    assert len(lens[:0].merged()) == 0 and lens[1].merged().same_as(lens[1])


def test_resized_and_cropped_take_any_number_and_nothing_that_is_no_image():
    bare = Spherical(0.1, 10.0, 1.0)
    assert bare.center_in((5, 8)).tolist() == [[3.5, 2.0]]  # (H, W) in, (x, y) out
    refused("needs the image_size", bare.cropped, 0, 0, 10, 10)
    refused("needs a lens that has an image_size", bare.resized, (3, 4))
    lens = Perspective(100.0, 1.0, (319.5, 241.5), image_size=(483, 640))
    assert lens.center_in((5, 8)).tolist() == [[319.5, 241.5]]
    whole = lens.resized(0.5)
    for half in (np.float32(0.5), np.float64(0.5), torch.tensor(0.5), np.array(0.5)):
        resized = lens.resized(half)
        assert resized.focal.item() == 50 and resized.affine is None
        assert resized.image_size.tolist() == whole.image_size.tolist() == [[242, 320]]
    assert lens.resized(torch.tensor([240, 320])).image_size.tolist() == [[240, 320]]
    assert lens.resized((240.0, np.int64(320))).image_size.tolist() == [[240, 320]]
    assert lens.resized(1e-6).image_size.tolist() == [[1, 1]]
    for scale in (0, -1, math.nan, math.inf, np.float32(-2), torch.tensor(0.0)):
        refused("resized must be given a finite scale above 0, got", lens.resized, scale)
    for size in ((0, 5), (-5, 5), torch.tensor([3, 0])):
        refused(r"image's \(H, W\) must be at least \(1, 1\), got", lens.resized, size)
    for size in ((483,), (1, 2, 3), "12", None, (2.5, 3), (math.nan, 3), (None, 3)):
        refused(r"size must be \(H, W\)|whole pixels", lens.resized, size, error=TypeError)
    padded = lens.cropped(-8, -4, 499, 648)
    assert padded.center.tolist() == [[323.5, 249.5]]
    assert padded.image_size.tolist() == [[499, 648]]
    for part in ((0, 0, -5, 10), (0, 0, 5, 0)):
        refused(r"must be at least \(1, 1\)", lens.cropped, *part)
    for part in ((0.5, 0, 5, 10), (0, 0, math.nan, 10), (None, 0, 5, 5)):
        refused("an image has whole pixels, got", lens.cropped, *part, error=TypeError)


def test_in_a_picture_of_the_same_view():
    lens = Equidistant(300.0, 1.5, image_size=(966, 1280))
    for size in [(966, 1280), (483, 640), (75, 100), (1, 1), (1932, 2561)]:
        found = lens.in_picture(size)
        assert found.image_size.tolist() == [list(size)]
        assert found.focal.item() == pytest.approx(300 * size[1] / 1280)
        assert (found is lens) == (size == (966, 1280))
    for size, advice in [((966, 1278), "crop"), ((480, 643), "crop"), ((1280, 966), "turned")]:
        said = rf"is for 966 × 1280 px \(H × W\), .* has {size[0]} × {size[1]} .*{advice}"
        refused(said, lens.in_picture, size)
    with pytest.warns(UserWarning, match="of 966 × 1280 px .*, which 480 × 640 px .* keeps"):
        lens.resized((640, 480))
    lens.resized((64, 64))  # as a network squeezes pictures: no mistake
    unknown = Equidistant(300.0, 1.5)
    assert unknown.in_picture((4, 9)) is unknown
