"""Labels and points of every form go through every lens and view, against masks and OpenCV."""

import functools
import math

import cv2
import numpy as np
import pytest
import torch
from helpers import products, slow
from lens_examples import every_lens

from darswin import boxes as of_boxes
from darswin.lens import BrownConrady, KannalaBrandt
from darswin.views import list_views, make_view

OF_PIXELS = sorted(set(list_views()) - {"polar"})
SIZE = (180, 180)
HALF = 0.25  # rad, of the cone that is looked at


def cone(to_rays, size, middle):
    """The pixels of (H, W) whose rays are near a direction. Every picture shows them as a disc."""
    y, x = torch.from_numpy(np.indices(size, float))
    rays = to_rays(torch.stack((x, y), -1)[None])[0].nan_to_num().numpy()
    return (rays @ middle > math.cos(HALF)).astype(np.uint8)


def box_of(mask):
    y, x = mask.nonzero()
    return np.array([[x.min(), y.min(), x.max() + 1, y.max() + 1]], float)


def overlap(mask, other):
    return (mask & other).sum() / (mask | other).sum()


def outline(mask):
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return max(contours, key=len)[:, 0].astype(float) + 0.5


def filled(polygon, size):
    points = np.rint((polygon - 0.5) * 16).astype(np.int32)
    return cv2.fillPoly(np.zeros(size, np.uint8), [points], 1, shift=4)


@functools.cache
def picture_through(model):
    """A picture in which the cone is about 60 pixels wide: the lens, the direction of the cone's
    axis, and its exact mask."""
    given, number = every_lens()[model][0], [*every_lens()].index(model)
    scale = 24 / given.project(torch.full((1, 1), HALF).double()).item()
    lens = given.replace(image_size=torch.tensor([[999.0, 999.0]]).double()).resized(scale)
    lens = lens.replace(center=torch.tensor([[89.0, 91.0]]).double(),
                        image_size=torch.tensor([SIZE]).double())  # fmt: skip
    theta, phi = 0.35 * min(lens.theta_max.item(), 1.0), 0.7 + number
    aside = math.sin(theta)
    middle = np.array([aside * math.cos(phi), aside * math.sin(phi), math.cos(theta)])
    return lens, middle, cone(lens.unproject_points, SIZE, middle)


def is_whole(mask):
    return mask.sum() > 300 and mask[1:-1, 1:-1].sum() == mask.sum()


MODELS = [*every_lens()]


# Each view with a few models of lenses in turn; with all in `make test-products`.
IN_TURN = [(name, MODELS[k :: len(OF_PIXELS)]) for k, name in enumerate(OF_PIXELS)]
ALL = [pytest.param(name, MODELS, marks=[slow, products]) for name in OF_PIXELS]


@pytest.mark.parametrize(("name", "models"), IN_TURN + ALL)
def test_labels_of_every_form_go_through_every_lens(name, models):
    checked, overlaps = set(), []
    view_size = {"none": SIZE, "panorama": (150, 420)}.get(name, (180, 180))
    view = make_view(name, view_size, fov=2.0 if name == "perspective" else None)
    for model in models:
        lens, middle, in_picture = picture_through(model)
        assert is_whole(in_picture)
        for tile, remap in enumerate(view.at(lens, SIZE).tiles):
            in_view = cone(lambda p, r=remap: r.rays(p[0])[None], view_size, middle)
            if not is_whole(in_view):
                continue  # another tile sees it
            checked.add(model)
            for source, target, there, back in (
                (in_view, in_picture, remap.to_image, remap.to_view),
                (in_picture, in_view, remap.to_view, remap.to_image),
            ):
                where = (model, tile, target.shape)
                mask = of_boxes.carry_mask(source, back, target.shape)
                assert overlap(mask, target) > 0.93, where
                polygon = of_boxes.carry_polygon(outline(source), there)
                assert overlap(filled(polygon, target.shape), target) > 0.88, where
                carried, visible = of_boxes.carry(box_of(source), there)
                overlaps.append(of_boxes.iou(carried, box_of(target)).item())
                assert visible == 1 and overlaps[-1] > 0.6, where
    assert len(checked) >= 0.9 * len(models) - 0.5
    # The square shears things, and a box does not tell by how much.
    assert np.mean(overlaps) > (0.8 if name == "square" else 0.9)


@pytest.mark.parametrize("name", ["mercator", "cylindrical", "perspective"])
def test_points_of_views_are_those_of_opencv(name):
    """OpenCV projects the same directions, into the view and into the picture."""
    camera = np.array([[150.0, 0, 322], [0, 150, 238], [0, 0, 1]])
    radial, tangential = [-0.1, 0.02], [1e-3, -2e-3]
    terms, nothing = [0.02, -0.004, 0.001, 0.0], np.zeros(3)
    middle = dict(center=[322.0, 238.0])
    fisheye = KannalaBrandt(150.0, terms, 1.5, **middle)
    brown = BrownConrady(150.0, radial, 0.9, **middle, tangential=tangential)
    fov, side = 1.4, 201
    step = (2 * math.tan(fov / 2) if name == "perspective" else fov) / side
    warper = cv2.PyRotationWarper("plane" if name == "perspective" else name, 1.0)
    eye = np.eye(3, dtype=np.float32)
    view = make_view(name, (side, side), fov=fov)
    for lens, far, project, coefficients in (
        (fisheye, 2.0, cv2.fisheye.projectPoints, terms),
        (brown, 0.6, cv2.projectPoints, radial + tangential),
    ):
        # x/z and y/z of the directions.
        places = np.random.default_rng(0).uniform(-far, far, (40, 2))
        rays = np.concatenate((places, np.ones((40, 1))), -1)[:, None]
        pixels = project(rays, nothing, nothing, camera, np.array(coefficients))[0][:, 0]
        flat = np.array([warper.warpPoint(tuple(place), eye, eye) for place in places.tolist()])
        remap = view.at(lens.to(torch.float64), (480, 640))
        expected, inside = flat / step + side / 2, (np.abs(pixels - [319.5, 239.5]) < [320, 240])
        found = of_boxes.carry_points(pixels + 0.5, remap.to_view)
        np.testing.assert_allclose(found, expected, atol=2e-3)
        inside, found = inside.all(-1), remap.to_image(expected - 0.5)
        np.testing.assert_allclose(found[inside], pixels[inside], atol=2e-3)
