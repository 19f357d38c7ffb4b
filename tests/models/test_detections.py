"""Detections of networks behind views, in the pixels of the images."""

import math

import numpy as np
import pytest
import torch
from helpers import in_turn
from torch import nn

from darswin import boxes as of_boxes
from darswin.lens import Equidistant, KannalaBrandt, Spherical
from darswin.models import LensAdapter
from darswin.views import list_views, make_view

SIZE = (240, 320)
LENSES = {
    "radial": Spherical.from_fov(0.5, 2.8, 120.0, image_size=SIZE),
    "beyond 90°": Equidistant(72.0, math.radians(95), center=[163.0, 118.0], image_size=SIZE),
    "general": KannalaBrandt(
        80.0, [0.01], 1.4, center=[158.0, 121.0], affine=[[1.0, 0.02], [0.0, 1.05]],
        tangential=[0.01, 0.005], image_size=SIZE,
    ),
}  # fmt: skip
VIEWS = sorted(set(list_views()) - {"polar"})


class Disks(nn.Module):
    """A detector of disks, each in a channel of its own: the box, the mask and the middle of its
    bright pixels."""

    def forward(self, x):
        return [self.of_picture(picture) for picture in x]

    def of_picture(self, picture):
        boxes, labels = torch.zeros(0, 4), []
        for label, channel in enumerate(picture):
            down, across = (channel > 0.5).nonzero(as_tuple=True)
            if len(down) >= 8:
                box = torch.stack((across.min(), down.min(), across.max() + 1, down.max() + 1))
                boxes, labels = torch.cat((boxes, box[None])), [*labels, label]
        masks = picture[labels, None].clamp(0, 1)
        keypoints = torch.cat((boxes.unflatten(1, (2, 2)).mean(1), torch.ones(len(boxes), 1)), 1)
        return dict(
            boxes=boxes,
            scores=(masks > 0.5).sum((1, 2, 3)) / 1e5,  # whole disks are larger than cut ones
            labels=torch.tensor(labels, dtype=torch.long),
            masks=masks,
            keypoints=keypoints[:, None],
        )


# θ and azimuth of the middles of cones of 6°, rad.
CONES = ((0.05, 1.0), (0.5, 0.2), (0.8, 2.5), (0.95, -1.9))


def disks(lens):
    """A picture with a channel for each cone, and the exact boxes of the cones."""
    grid = torch.stack(torch.meshgrid(torch.arange(320.0), torch.arange(240.0), indexing="xy"), -1)
    rays = lens.unproject_points(grid[None], SIZE)[0].nan_to_num()
    image, boxes = torch.zeros(1, len(CONES), *SIZE), []
    for k, (theta, phi) in enumerate(CONES):
        middle = torch.tensor([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi),
                               math.cos(theta)])  # fmt: skip
        inside = rays @ middle > math.cos(math.radians(6))
        image[0, k, inside] = 1.0
        y, x = inside.nonzero(as_tuple=True)
        boxes.append([x.min(), y.min(), x.max() + 1, y.max() + 1])
    return image, torch.tensor(boxes).float()


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind"), in_turn([[name] for name in VIEWS], LENSES))
def test_detections_of_every_view_come_back_to_the_things_in_the_picture(name, kind):
    lens = LENSES[kind]
    images, exact = disks(lens)
    size = {"none": SIZE, "tiles": (256, 256)}.get(name, (400, 400))
    (found,) = LensAdapter(Disks(), view=make_view(name, size))(images, lens)
    shows = range(3 if name == "perspective" else 4)  # it ends at 50°
    assert set(found["labels"].tolist()) >= {*shows}
    overlap = of_boxes.iou(found["boxes"], exact)
    best = {k: overlap[found["labels"] == k, k].max().item() for k in shows}
    # The square shears things along its diagonals.
    least, mean = (0.6, 0.75) if name == "square" else (0.75, 0.85)
    assert min(best.values()) > least and np.mean([*best.values()]) > mean, best
    assert found["masks"].shape == (len(found["labels"]), 1, *SIZE)
    for label, mask, keypoint in zip(*(found[k] for k in ("labels", "masks", "keypoints")),
                                     strict=True):  # fmt: skip
        if name == "perspective" and label > 1:
            continue
        there, true = mask[0] > 0.5, images[0, label] > 0.5
        assert (there & true).sum() / (there | true).sum() > 0.87
        assert keypoint[0, 2] == 1
        low, high = exact[label].view(2, 2)
        assert (keypoint[0, :2] - (low + high) / 2).norm() < 0.15 * (high - low).max()
    if name == "none":
        assert torch.equal(found["boxes"], exact[found["labels"]]) and "rays" not in found
        return
    whole = found["visible"] == 1
    places = lens.project_points(found["rays"][None], SIZE)[0]
    middles = found["boxes"].unflatten(1, (2, 2)).mean(1) - 0.5
    assert (places - middles)[whole].norm(dim=1).max() < 2.5
    assert found["scores"].tolist() == sorted(found["scores"].tolist(), reverse=True)
    if name == "tiles":  # each disk is found once, though several tiles see it
        assert sorted(found["labels"].tolist()) == [0, 1, 2, 3]


@torch.no_grad()
def test_every_form_of_detections_gives_the_same():
    lens, (images, _) = LENSES["radial"], disks(LENSES["radial"])
    images = torch.cat((images, images.flip(3)))
    view = make_view("tiles", (256, 256))
    as_list = LensAdapter(Disks(), view=view)(images, lens)
    assert [len(found["boxes"]) for found in as_list] == [4, 4]
    by_function = LensAdapter(nn.Identity(), view=view, boxes=Disks())
    for one, other in zip(as_list, by_function(images, lens), strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one)

    class Batched(nn.Module):  # all pictures have as many boxes, with more values of each
        def forward(self, x):
            boxes = torch.tensor([[20.0, 30.0, 60.0, 90.0], [100.0, 90.0, 160.0, 150.0]])
            rows = torch.arange(len(x) * 3.0).view(-1, 3)  # the last one is none
            boxes = torch.cat((boxes, boxes[:1])).expand(len(x), -1, -1)
            counts = dict(num_dets=torch.full((len(x), 1), 2))
            return counts | dict(boxes=boxes, scores=rows, labels=rows.long(), own=rows)

    view = make_view("mercator", (200, 200))
    batched = LensAdapter(Batched(), view=view)(images, lens)
    assert [found["own"].tolist() for found in batched] == [[1, 0], [4, 3]]  # the best first
    boxes = torch.tensor([[20.0, 30.0, 60.0, 90.0], [100.0, 90.0, 160.0, 150.0]])
    exact, _ = of_boxes.carry(boxes, view.at(lens, SIZE).to_image)
    for found in batched:
        torch.testing.assert_close(found["boxes"].flip(0), exact, rtol=0, atol=0.02)
    single = LensAdapter(_Constant(boxes), view=view)(images[:1], lens)
    assert torch.equal(single[0]["boxes"], batched[0]["boxes"].flip(0))
    as_seen = LensAdapter(_Constant(boxes), view=view, output="view")(images[:1], lens)
    assert torch.equal(as_seen["boxes"], boxes)


class _Constant(nn.Module):
    """A network that finds the same boxes in every picture, for batches of one picture."""

    def __init__(self, boxes):
        super().__init__()
        self.found = boxes

    def forward(self, x):
        count = len(self.found)
        return dict(boxes=self.found, scores=torch.linspace(1, 0.5, count),
                    labels=torch.zeros(count, dtype=torch.long))  # fmt: skip


@torch.no_grad()
def test_turned_boxes_come_back_as_turned_ones():
    lens, images = LENSES["radial"], torch.zeros(1, 3, *SIZE)
    boxes = torch.tensor([[30.0, 34, 12, 20, 0.4]])
    detector = LensAdapter(_Constant(boxes), 64, view="tiles", boxes=lambda out: [out] * 5)
    (found,) = detector(images, lens)
    assert found["boxes"].shape == (5, 5)
    remap = make_view("tiles", (64, 64)).at(lens, SIZE)
    known = torch.cat([tile.boxes_to_image(boxes)[0] for tile in remap.tiles])
    assert (found["boxes"][:, None] - known).abs().amax(-1).amin(1).max() < 1e-3


@torch.no_grad()
@pytest.mark.parametrize("name", VIEWS)
def test_no_boxes_and_boxes_that_the_lens_does_not_see(name):
    lens, images = LENSES["beyond 90°"], torch.zeros(1, 3, *SIZE)
    size = SIZE if name == "none" else (64, 64)
    corner = torch.tensor([[-50.0, -50.0, -40.0, -40.0], [math.nan] * 4])
    for boxes in (torch.zeros(0, 4), corner[:0] if name == "none" else corner):
        tiles = 5 if name == "tiles" else 1
        detector = LensAdapter(
            _Constant(boxes), view=make_view(name, size), boxes=lambda out, n=tiles: [out] * n
        )
        found = detector(images, lens)
        assert len(found) == 1 and found[0]["boxes"].shape == (0, 4)
        assert found[0]["scores"].shape == (0,)


def test_detections_that_do_not_fit_are_refused():
    lens, images = LENSES["radial"], torch.zeros(1, 3, *SIZE)
    network = _Constant(torch.zeros(1, 4))
    with pytest.raises(ValueError, match="for each of its 5 pictures, got 1 results"):
        LensAdapter(network, 64, view="tiles")(images, lens)
    for view in ("mercator", "none"):
        with pytest.raises(ValueError, match="for each of its 2 pictures, got 1 results"):
            LensAdapter(network, 64, view=view)(images.expand(2, -1, -1, -1), lens)
    for wrong in (network.found, {"boxes": np.zeros((1, 4))}, [1, 2]):
        with pytest.raises(TypeError, match="boxes must return a dict of tensors boxes, scores"):
            LensAdapter(network, 64, view="tiles", boxes=lambda _, w=wrong: w)(images, lens)
    with pytest.raises(ValueError, match="a polar image"):
        LensAdapter(network, 64, view="polar")(images, lens)


@torch.no_grad()
@pytest.mark.parametrize("name", sorted(set(VIEWS) - {"panorama"}))  # whose ends no lens sees
def test_odd_boxes_of_networks(name):
    """Boxes larger than the view, of whole numbers, and values that are not of the boxes."""
    lens, images = LENSES["radial"], torch.zeros(1, 3, *SIZE)
    view = make_view(name, SIZE if name == "none" else (64, 64))
    tiles = view.count
    height, width = SIZE if name == "none" else (64, 64)
    large = torch.tensor([[-50, -50, 2 * width, 2 * height]])
    out = dict(boxes=large, scores=torch.ones(1), labels=torch.zeros(1), loss=torch.tensor(2.0))
    (found,) = LensAdapter(nn.Identity(), view=view, boxes=lambda _: [out] * tiles)(images, lens)
    assert len(found["boxes"]) >= 1 and "loss" not in found
    box = found["boxes"][0]
    assert (box[2:] - box[:2]).min() > (20 if name == "tiles" else 60)
    batched = {k: v[None].expand(tiles, *v.shape) if v.dim() else v for k, v in out.items()}
    (same,) = LensAdapter(nn.Identity(), view=view, boxes=lambda _: batched)(images, lens)
    assert torch.equal(same["boxes"], found["boxes"])
    empty = {name: value[:0] if value.dim() else value for name, value in out.items()}
    some = [dict(out, number=torch.tensor([3])), *[dict(empty, number=torch.tensor([3]))] * 4]
    (one,) = LensAdapter(nn.Identity(), view=view, boxes=lambda _: some[:tiles])(images, lens)
    assert len(one["boxes"]) == 1
    none = dict(out, boxes=torch.full((1, 4), math.nan))
    (empty,) = LensAdapter(nn.Identity(), view=view, boxes=lambda _: [none] * tiles)(images, lens)
    assert empty["boxes"].shape == (0, 4)
    for wrong, kind, message in (
        (dict(scores=torch.ones(2)), ValueError, r"got boxes \(1, 4\), scores \(2,\)"),
        (dict(boxes=torch.zeros(1, 6)), ValueError, r"got boxes \(1, 6\)"),
        (dict(boxes=large.numpy()), TypeError, "boxes of detections must be a tensor"),
    ):
        bad = [out | wrong] * tiles
        with pytest.raises(kind, match=message):
            LensAdapter(nn.Identity(), view=view, boxes=lambda _, bad=bad: bad)(images, lens)


@torch.no_grad()
def test_prepared_lenses_and_one_for_each_image():
    both = Spherical.from_fov([0.3, 0.9], 2.8, 120.0)
    images = torch.cat([disks(both[k])[0] for k in range(2)])
    detector = LensAdapter(Disks(), 384, view="mercator")
    together = detector.run(images, detector.prepare(both, SIZE))
    for k, found in enumerate(together):
        (alone,) = detector(images[k : k + 1], both[k])
        torch.testing.assert_close(found, alone)


@torch.no_grad()
def test_masks_of_each_box_alone_come_to_their_boxes():
    """As the heads of Mask R-CNN make them, whatever their box is."""
    box, upper = torch.tensor([[40.0, 30, 140, 190]]), torch.zeros(1, 1, 28, 28)
    upper[:, :, :14] = 1
    out = _Constant(box)(None) | dict(masks=upper)
    adapter = LensAdapter(nn.Identity(), view="none", boxes=lambda _: [out])
    (found,) = adapter(torch.zeros(1, 3, *SIZE), LENSES["radial"])
    known = torch.zeros(SIZE, dtype=torch.bool)
    known[30:110, 40:140] = True
    assert ((found["masks"][0, 0] > 0.5) != known).sum() < 0.01 * known.sum()
