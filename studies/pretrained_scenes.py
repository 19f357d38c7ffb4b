"""The scenes of the pretrained study: photographs of things in panoramas, through known lenses.

Each thing stands upright in the world, faces the camera, and is in front of a real panorama. Its
box in the camera's picture is exact: it contains the pixels of its mask. The classes and the
photographs were listed by name before any detector ran.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from pretrained_files import PANORAMAS, Files

from darswin.lens import DoubleSphere, KannalaBrandt, Lens, Perspective, Spherical

SIZE = 1024  # px, of the camera's square picture
SUBPIXELS = 2  # samples along each side of a pixel
VISIBLE = 0.7  # the least share of a thing that the camera sees
FLAT = 512  # px, of the flat pictures around each thing, of 90°

# The classes of COCO that have photographs among the stamps, and those photographs.
CLASSES = {
    "person": "people/fireman200b people/fireman240a",
    "car": "vehicles/auto/beetle vehicles/auto/sedan vehicles/auto/sportscar2 "
    "vehicles/race/indycar",
    "airplane": "vehicles/flight/planes/747 military/vehicles/f22_raptor",
    "bus": "vehicles/masstransit/green_korean_bus",
    "truck": "vehicles/auto/truck vehicles/emergency/firetruck vehicles/garbagetruck",
    "traffic light": "town/roadsigns/stoplight_01_red town/roadsigns/stoplight_02_yellow "
    "town/roadsigns/stoplight_03_green",
    "stop sign": "town/roadsigns/stop",
    "bird": "animals/birds/blackbird animals/birds/chicken_profile animals/birds/crow "
    "animals/birds/drake animals/birds/duck animals/birds/gander animals/birds/guineafowl "
    "animals/birds/hen animals/birds/heron_greatblue animals/birds/lark animals/birds/magpie "
    "animals/birds/ostrich animals/birds/owl animals/birds/pelican animals/birds/pigeon "
    "animals/birds/pink_flamingo animals/birds/rainbow-lorikeet animals/birds/rooster "
    "animals/birds/seagull animals/birds/silver-gull animals/birds/turkey animals/birds/vulture",
    "dog": "animals/mammals/dogs/dingo animals/mammals/dogs/dog",
    "horse": "animals/mammals/equines/horse",
    "sheep": "animals/mammals/bovines/ram animals/mammals/bovines/sheep "
    "animals/mammals/bovines/sheep_lamb",
    "cow": "animals/mammals/bovines/bull animals/mammals/bovines/cow "
    "animals/mammals/bovines/cow_white animals/mammals/bovines/zebu",
    "elephant": "animals/mammals/elephant",
    "bear": "animals/mammals/bears/bear animals/mammals/bears/european-bear",
    "zebra": "animals/mammals/equines/zebra",
    "giraffe": "animals/mammals/giraffe",
    "sports ball": "sports/basketball sports/cricketball sports/soccer sports/tennis_ball",
    "tennis racket": "sports/tennis_racket",
    "cup": "household/dishes/mug",
    "banana": "food/fruit/banana",
    "apple": "food/fruit/apple_fuji food/fruit/apple_granny_smith food/fruit/apple_green "
    "food/fruit/apple_red food/fruit/apple_sierra_beauty",
    "orange": "food/fruit/mandarine food/fruit/orange food/fruit/orange_seville "
    "food/fruit/sliced_orange",
    "broccoli": "food/vegetables/broccoli",
    "carrot": "food/vegetables/carrot",
    "toilet": "household/toilet",
    "scissors": "household/arttools/scissors_small_closed household/arttools/scissors_small_open",
    "teddy bear": "animals/mammals/bears/toys/edward_bear",
}
# The 80 classes of COCO in the order of the detectors' outputs.
_NAMES = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,"
    "stop sign,parking meter,bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,"
    "backpack,umbrella,handbag,tie,suitcase,frisbee,skis,snowboard,sports ball,kite,baseball bat,"
    "baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,knife,spoon,bowl,"
    "banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,"
    "oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush"
)
COCO = _NAMES.split(",")


def filling(lens: Lens, fov_deg: float) -> Lens:
    """The lens, resized so that a field of view fills the circle in the picture."""
    lens = lens.to(torch.float64).with_theta_max(math.radians(fov_deg) / 2)
    return lens.resized(SIZE / 2 / lens.r_max.item())


def spherical(xi: float, fov_deg: float) -> Lens:
    return Spherical.from_fov(xi, math.radians(fov_deg), SIZE / 2).to(torch.float64)


def perspective() -> Lens:
    """A perspective lens of 90° from side to side; it sees up to the corners."""
    lens = Perspective.from_fov(math.pi / 2, SIZE / 2).to(torch.float64)
    return lens.with_theta_max(math.atan(math.sqrt(2)))


LENSES: dict[str, Callable[[], Lens]] = {
    "ξ = 0.3, 165°": lambda: spherical(0.3, 165),
    "ξ = 0.9, 175°": lambda: spherical(0.9, 175),
    "Kannala-Brandt, 190°": lambda: filling(KannalaBrandt(300.0, [0.05, -0.01, 0.001]), 190),
    "double sphere, 180°": lambda: filling(DoubleSphere(-0.2, 0.55, 300.0), 180),
    "perspective, 90°": perspective,
}
WIDE = tuple(LENSES)[:4]
# The same field of view and circle, and another curve.
WRONG = {WIDE[0]: (0.95, 165), WIDE[1]: (0.2, 175), WIDE[2]: (0.2, 190), WIDE[3]: (0.2, 180)}


class Split(NamedTuple):
    """A kind of scene."""

    lenses: tuple[str, ...] = WIDE
    sizes: tuple[float, float] = (15, 50)  # of the larger side of a thing, degrees
    thetas: tuple[float, float] = (0, 85)  # of its middle, degrees
    things: int = 6
    looks_down: bool = False


SPLITS = {
    "level": Split(),
    "small": Split(sizes=(5, 15), things=8),
    "down": Split(thetas=(20, 85), looks_down=True),
    "perspective": Split(lenses=("perspective, 90°",), thetas=(0, 45), sizes=(15, 40), things=3),
}
# From the camera's frame to the world's, whose y points down.
LEVEL = np.eye(3)
DOWN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass(eq=False)
class Thing:
    """A photograph in the world."""

    label: str
    stamp: str
    direction: np.ndarray  # of its middle, in the camera's frame
    size: float  # rad, of the larger side
    box: np.ndarray | None = None  # in the camera's picture

    @property
    def theta_deg(self) -> float:
        return math.degrees(math.acos(np.clip(self.direction[2], -1, 1)))


class Billboard:
    """A photograph (H, W, 4) that stands upright and faces the camera; only its rays are needed."""

    def __init__(self, image: np.ndarray, direction: np.ndarray, up: np.ndarray, size: float):
        height, width = image.shape[:2]
        opacity = image[..., 3:].astype(np.float32) / 255
        image = np.dstack((opacity * image[..., :3], 255 * opacity))  # so that mixtures are right
        shrink = math.degrees(size) * 14 / max(height, width)  # about the samples of a picture
        if shrink < 1:
            sides = max(1, round(width * shrink)), max(1, round(height * shrink))
            image = cv2.resize(image, sides, interpolation=cv2.INTER_AREA)
        self.image, self.direction = image, direction
        right = np.cross(direction, up)
        self.right = right / np.linalg.norm(right)
        self.down = np.cross(direction, self.right)
        half = math.tan(size / 2)
        self.half = half * np.array([width, height]) / max(height, width)
        self.radius = math.atan(math.hypot(*self.half))

    def paint(self, picture: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Paints over a picture (P, 3) of rays (P, 3); returns the pixels of its mask."""
        near = np.flatnonzero(
            rays @ self.direction.astype(rays.dtype) > math.cos(self.radius + 0.02)
        )
        seen = rays[near]
        plane = seen @ np.stack((self.right, self.down), 1) / (seen @ self.direction)[:, None]
        sides = np.array(self.image.shape[1::-1])
        places = ((plane / self.half + 1) / 2 * sides - 0.5).astype(np.float32)
        colours = sampled(self.image, places)
        opacity = colours[:, 3:] / 255
        picture[near] = colours[:, :3] + (1 - opacity) * picture[near]
        return near[opacity[:, 0] > 0.5]

    def mask_rays(self) -> np.ndarray:
        """The rays (P, 3) of the middles of its opaque pixels."""
        rows, columns = np.nonzero(self.image[..., 3] > 127)
        sides = np.array(self.image.shape[1::-1])
        plane = ((np.stack((columns, rows), 1) + 0.5) / sides * 2 - 1) * self.half
        rays = self.direction + plane @ np.stack((self.right, self.down))
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def sampled(image: np.ndarray, places: np.ndarray, border: int = cv2.BORDER_CONSTANT) -> np.ndarray:
    """An image (H, W, C) at places (P, 2), bilinear: (P, C)."""
    if not len(places):
        return np.zeros((0, image.shape[2]), image.dtype)
    rows = 4096  # OpenCV takes at most 32,767 in a row
    padded = np.full((math.ceil(len(places) / rows) * rows, 2), -10, np.float32)
    padded[: len(places)] = places
    found = cv2.remap(image, padded.reshape(-1, rows, 2), None, cv2.INTER_LINEAR, borderMode=border)
    return found.reshape(len(padded), -1)[: len(places)]


class Shot:
    """A panorama through a lens, and the things before it."""

    def __init__(
        self, files: Files, lens_name: str, panorama: str, yaw: float, to_world: np.ndarray = LEVEL
    ) -> None:
        self.files, self.lens_name, self.lens = files, lens_name, LENSES[lens_name]()
        self.panorama, self.yaw, self.to_world = panorama, yaw, to_world
        self.up = to_world.T @ np.array([0.0, -1.0, 0.0])
        self.things: list[Thing] = []

    def board(self, thing: Thing) -> Billboard:
        return Billboard(self.files.stamp(thing.stamp), thing.direction, self.up, thing.size)

    def picture_of(self, rays: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """The colours (P, 3) of rays (P, 3) in the camera's frame, and the rays of each mask."""
        picture = self.background(rays)
        return picture, [self.board(thing).paint(picture, rays) for thing in self.things]

    def background(self, rays: np.ndarray) -> np.ndarray:
        """The colours (P, 3) of the panorama along rays (P, 3) in the camera's frame."""
        world = rays @ self.to_world.T.astype(rays.dtype)
        azimuth = (np.arctan2(world[:, 0], world[:, 2]) + self.yaw) / (2 * math.pi) + 0.5
        elevation = np.arcsin(world[:, 1].clip(-1, 1)) / math.pi + 0.5
        image = self.files.panorama(self.panorama)
        height, width = image.shape[:2]
        places = np.stack((azimuth % 1 * width - 0.5, elevation * height - 0.5), 1)
        return sampled(image, places.astype(np.float32), cv2.BORDER_WRAP).astype(np.float32)

    def render(self) -> np.ndarray:
        """The camera's picture (SIZE, SIZE, 3) uint8 RGB; the things learn their boxes."""
        side = SIZE * SUBPIXELS
        rays, seen = camera_rays(self.lens_name)
        colours, masks = self.picture_of(rays)
        fine = np.zeros((side * side, 3), np.float32)
        fine[seen] = colours
        for thing, mask in zip(self.things, masks, strict=False):  # others know their boxes
            rows, columns = np.divmod(seen[mask], side)
            ends = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            thing.box = np.array(ends) / SUBPIXELS
        return reduced(fine.reshape(side, side, 3))


class Scene(Shot):
    """Things before a panorama, through a lens."""

    def __init__(self, files: Files, split: str, index: int) -> None:
        kind = SPLITS[split]
        rng = np.random.default_rng([index, *split.encode()])
        super().__init__(
            files,
            kind.lenses[index % len(kind.lenses)],
            PANORAMAS[rng.integers(len(PANORAMAS))],
            rng.uniform(0, 2 * math.pi),
            DOWN if kind.looks_down else LEVEL,
        )
        self.split, self.index = split, index
        while len(self.things) < kind.things:
            self.things = self._placed(rng, kind)

    def _placed(self, rng: np.random.Generator, kind: Split) -> list[Thing]:
        """Things that do not overlap and that the camera sees; fewer if there was no place."""
        things: list[Thing] = []
        boards: list[Billboard] = []
        for _ in range(200):
            label = str(rng.choice(list(CLASSES)))
            stamp = str(rng.choice(CLASSES[label].split()))
            theta, phi = math.radians(rng.uniform(*kind.thetas)), rng.uniform(0, 2 * math.pi)
            size = math.radians(rng.uniform(*kind.sizes))
            x, y = math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi)
            thing = Thing(label, stamp, np.array([x, y, math.cos(theta)]), size)
            if abs(thing.direction @ self.up) > math.sin(math.radians(85)):
                continue  # it would lie
            board = self.board(thing)
            apart = [
                math.acos(np.clip(thing.direction @ other.direction, -1, 1))
                > board.radius + other.radius
                for other in boards
            ]
            if all(apart) and self._seen(board.mask_rays()) >= VISIBLE:
                things.append(thing)
                boards.append(board)
            if len(things) == kind.things:
                break
        return things

    def _seen(self, rays: np.ndarray) -> float:
        """The share of rays that land in the picture."""
        points = self.lens.project_points(torch.from_numpy(rays)[None], (SIZE, SIZE))[0]
        inside = (points > -0.5) & (points < SIZE - 0.5)
        return inside.all(-1).double().mean().item()

    def flat(self, thing: Thing) -> tuple[np.ndarray, np.ndarray]:
        """A flat picture of 90°, (FLAT, FLAT, 3), whose middle is a thing, and its box there."""
        side = FLAT * SUBPIXELS
        board = self.board(thing)
        steps = (np.arange(side) + 0.5) / side * 2 - 1
        plane = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
        rays = board.direction + plane @ np.stack((board.right, board.down))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        colours, masks = self.picture_of(rays.astype(np.float32))
        rows, columns = np.divmod(masks[self.things.index(thing)], side)
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) / SUBPIXELS
        return reduced(colours.reshape(side, side, 3)), box


def reduced(fine: np.ndarray) -> np.ndarray:
    """A picture of samples as uint8: the mean of each pixel's samples."""
    blocks = fine.reshape(-1, SUBPIXELS, fine.shape[1] // SUBPIXELS, SUBPIXELS, 3)
    return (blocks.mean((1, 3)) + 0.5).clip(0, 255).astype(np.uint8)


_rays: dict[str, tuple[np.ndarray, np.ndarray]] = {}


def camera_rays(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The rays (P, 3) float32 of the samples that a lens sees, and their places in the picture."""
    if name not in _rays:
        _rays.clear()  # they take 50 MB
        lens = LENSES[name]()
        side = SIZE * SUBPIXELS
        steps = (np.arange(side, dtype=np.float32) + 0.5) / SUBPIXELS - SIZE / 2
        x, y = (of.ravel() for of in np.meshgrid(steps, steps))
        radius = np.hypot(x, y)
        seen = np.flatnonzero(radius <= lens.r_max.item())
        radius, x, y = radius[seen], x[seen], y[seen]
        # The lenses are radial: a fine table of θ serves all samples.
        table = torch.linspace(0, lens.r_max.item(), 20_001, dtype=torch.float64)
        angles = lens.unproject(table[None])[0].nan_to_num(lens.theta_max.item())
        theta = np.interp(radius, table.numpy(), angles.numpy()).astype(np.float32)
        aside = np.sin(theta) / np.maximum(radius, 1e-6)
        _rays[name] = np.stack((x * aside, y * aside, np.cos(theta)), 1), seen
    return _rays[name]
