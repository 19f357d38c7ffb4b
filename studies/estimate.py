"""The estimate study: lenses found from lines, and what their error costs DarSwin on digits.

Eight lenses see ten views each of Freedoom's worlds: `apt-get install freedoom`. The real pictures
are those of Debian's `opencv-doc`. The digits are seen by the model "digits" that comes with
darswin, through the true lens, each estimate of it, and wrong lenses. `make study-estimate`.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch
from estimate_tables import MODELS, publish
from jobs import run_all
from sklearn.datasets import load_digits
from sklearn.model_selection import train_test_split
from worlds.poses import poses_of
from worlds.render import rays_of, render
from worlds.scene import Scene
from worlds.textures import Textures
from worlds.wad import load_map, map_names

from darswin import lens as kinds
from darswin import load_model
from darswin.calibrate import CalibrationError, lines
from darswin.calibrate.circle import image_circle
from darswin.calibrate.edges import curves
from darswin.lens import Lens, Perspective
from darswin.views import CameraView

SIZE = (480, 640)
MIDDLE = ((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)
CIRCLE = 234.0  # px: the radius of image circles, and of the circle that a digit fills
SHIFT = 3.0  # px: centres are up to this far from the middle, along each axis
NOISE = 2.0  # of 255: the standard deviation of pixels
SAMPLES = 2  # of a pixel, along each axis
LONG = 0.3  # of the radius: the length of a long curve
DIGIT, WIDEST = 32, math.radians(82.5)  # px; rad: the largest θ of the digits' training
DATA = Path("/usr/share/doc/opencv-doc/examples/data")

# Of each lens: the class, its parameters, its field of view in degrees, and whether an image
# circle shows it. Otherwise the field of view fills the width.
LENSES: dict[str, tuple[type[Lens], dict, float, bool]] = {
    "Spherical, ξ = 0.3": (kinds.Spherical, dict(xi=[0.3]), 125, False),
    "Spherical, ξ = 0.8": (kinds.Spherical, dict(xi=[0.8]), 170, True),
    "KannalaBrandt, 150°": (kinds.KannalaBrandt, dict(radial=[[-0.03, 0.004]]), 150, False),
    "KannalaBrandt, 200°": (kinds.KannalaBrandt, dict(radial=[[0.02, -0.008]]), 200, True),
    "Equidistant": (kinds.Equidistant, {}, 140, False),
    "Equisolid": (kinds.Equisolid, {}, 185, True),
    "Stereographic": (kinds.Stereographic, {}, 150, False),
    "FieldOfView": (kinds.FieldOfView, dict(omega=[0.9]), 130, False),
}


def lens_of(name: str) -> Lens:
    """A true lens, with a centre near the middle."""
    kind, numbers, fov, circle = LENSES[name]
    rng = np.random.default_rng([*name.encode()])
    center = torch.from_numpy(MIDDLE + rng.uniform(-SHIFT, SHIFT, 2))
    given = {key: torch.tensor(value, dtype=torch.float64) for key, value in numbers.items()}
    half = math.radians(fov / 2)
    unit = kind(focal=torch.ones(1, dtype=torch.float64), **given).with_theta_max(None)
    focal = (CIRCLE if circle else SIZE[1] / 2) / unit.project(half)
    lens = kind(focal=focal, center=center[None], image_size=SIZE, **given)
    return lens.with_theta_max(half if circle else None)


def pictures_of(name: str, count: int) -> list[np.ndarray]:
    """Views of the test maps, (H, W, 3) uint8, two of a map; each lens sees others."""
    number = list(LENSES).index(name)
    rng, rays = np.random.default_rng(number), rays_of(lens_of(name), SAMPLES)
    maps, found = map_names("test"), []
    for k in range(0, count, 2):
        wad, world = load_map(maps[(5 * number + k // 2) % len(maps)])
        scene = Scene(world, Textures(wad))
        for pose in poses_of(scene, world.name, min(2, count - k), seed=100 + number):
            image = render(scene, pose, rays).image + rng.normal(0, NOISE, (*SIZE, 3))
            found.append(image.round().clip(0, 255).astype(np.uint8))
    return found


@contextmanager
def searching_once() -> Iterator[None]:
    """The search and what lines allow do not depend on the model: each runs once for curves."""
    search, allowed, known = lines._search, lines._allowed, {}

    def once(work: Callable, given: object, of: lines.Lines) -> object:
        key = work, of.points.tobytes()
        if key not in known:
            known[key] = work(given)
        return known[key]

    with (
        mock.patch.object(lines, "_search", lambda of: once(search, of, of)),
        mock.patch.object(lines, "_allowed", lambda best: once(allowed, best, best.lines)),
    ):
        yield


def angle(lens: Lens, radius: float) -> float:
    """θ at a radius in px, rad, or the largest that the lens has."""
    lens = lens.with_theta_max(None)
    return lens.unproject(min(radius, lens.r_max.item())).item()


def estimates(
    found: Sequence[list[np.ndarray]], circle: tuple[float, float, float] | None, true: Lens
) -> tuple[dict[str, dict], dict[str, Lens]]:
    """What each model finds from the curves of pictures, in degrees and percent; and the lenses."""
    results, lenses = {}, {}
    for model in MODELS:
        try:
            got = lines.from_curves(found, SIZE, model, circle=circle)
        except CalibrationError as reason:
            results[model] = dict(refused=str(reason))
            continue
        rim, (low, high) = angle(true, got.radius), got.interval
        results[model] = dict(
            true=math.degrees(rim), rim=math.degrees(got.rim), error=100 * (got.rim / rim - 1),
            low=math.degrees(low), high=math.degrees(high), holds=low <= rim <= high,
            curves=got.curves, covered=got.covered, doubts=list(got.doubts),
        )  # fmt: skip
        lenses[model] = got.lens
    return results, lenses


class Digits:
    """The 500 scans that the demo's model has not seen, through a lens."""

    def __init__(self, true: Lens):
        digits = load_digits()
        _, unseen = train_test_split(
            np.arange(len(digits.target)), test_size=500, random_state=0, stratify=digits.target
        )
        self.labels = torch.from_numpy(digits.target[unseen])
        scans = (digits.images[unseen] / 16).astype(np.float32)
        camera = Perspective.from_fov(2 * min(angle(true, CIRCLE), WIDEST), scans.shape[2] / 2)
        remap = CameraView(self.square(true), supersampling=1).at(camera, scans.shape[1:])
        points = remap.points.astype(np.float32)
        images = [cv2.remap(scan, points, None, cv2.INTER_CUBIC) for scan in scans]
        self.images, self.model = (
            torch.from_numpy(np.stack(images))[:, None],
            load_model("digits")[0],
        )

    @staticmethod
    def square(lens: Lens) -> Lens:
        """A lens for the digits' pictures, which are the square in the middle."""
        height, width = SIZE
        lens = lens.with_theta_max(min(angle(lens, CIRCLE), WIDEST))
        return lens.cropped(0, (width - height) // 2, height, height).resized((DIGIT, DIGIT))

    @torch.inference_mode()
    def accuracy(self, lens: Lens) -> float:
        """The top-1 accuracy in percent if this lens is taken for the true one."""
        given = self.square(lens).to(torch.float32)
        guesses = [self.model(part, given).argmax(1) for part in self.images.split(100)]
        return 100 * (torch.cat(guesses) == self.labels).double().mean().item()


def wrong_lenses(true: Lens) -> dict[str, Lens]:
    """Lenses that one may guess: the field of view is that of the circle that the digit fills."""
    where = dict(radius=CIRCLE, center=torch.tensor([MIDDLE]), image_size=SIZE)
    return {
        "perspective": Perspective.from_fov(math.radians(100), **where),
        "equidistant, 180°": kinds.Equidistant.from_fov(math.pi, **where),
        "equidistant, true fov": kinds.Equidistant.from_fov(2 * angle(true, CIRCLE), **where),
    }


def study(name: str, count: int) -> dict:
    """All of one lens."""
    true, start = lens_of(name), time.process_time()
    pictures = pictures_of(name, count)
    rendered, found = time.process_time(), [curves(picture) for picture in pictures]
    with searching_once():
        results, lenses = estimates(found, image_circle(pictures), true)
        from_all, single = time.process_time(), {model: [] for model in MODELS}
        digits, of_single = Digits(true), []
        for picture, of in zip(pictures, found, strict=True):
            alone, lens = estimates([of], image_circle([picture]), true)
            for model in MODELS:
                single[model].append(alone[model])
            of_single.append(digits.accuracy(lens[MODELS[0]]) if MODELS[0] in lens else None)
    scores = dict(
        true=digits.accuracy(true),
        estimated={model: digits.accuracy(lens) for model, lens in lenses.items()},
        single=of_single,
        wrong={guess: digits.accuracy(lens) for guess, lens in wrong_lenses(true).items()},
    )
    seconds = dict(render=rendered - start, all=from_all - rendered, rest=time.process_time())
    seconds["rest"] -= from_all
    long = [sum(len(curve) > LONG * CIRCLE for curve in of) for of in found]
    return dict(
        name=name, circle=LENSES[name][3], fov=2 * math.degrees(angle(true, CIRCLE)),
        lens=kinds.to_dict(true), all=results, single=single, long=long, digits=scores,
        seconds=seconds,
    )  # fmt: skip


def published(camera: str) -> Lens:
    """The calibration that OpenCV ships for its pictures."""
    if camera == "left":
        return kinds.load(DATA / "left_intrinsics.yml").to(torch.float64)
    file = cv2.FileStorage(str(DATA / "intrinsics.yml"), cv2.FILE_STORAGE_READ)
    matrix, (k1, k2, p1, p2, k3) = file.getNode("M2").mat(), file.getNode("D2").mat().ravel()[:5]

    def t(*numbers: float) -> torch.Tensor:
        return torch.tensor([numbers], dtype=torch.float64)

    return kinds.BrownConrady(
        focal=t(matrix[0, 0])[0], radial=t(k1, k2, k3), tangential=t(p1, p2),
        center=t(*matrix[:2, 2]), image_size=SIZE,
    )  # fmt: skip


def real(camera: str) -> dict:
    """The estimate from 13 pictures of a chessboard, and the published calibration."""
    files = sorted(DATA.glob(f"{camera}[0-9][0-9].jpg"))
    if not files:
        raise SystemExit(f"{DATA} has no pictures: apt-get install opencv-doc")
    found = [curves(cv2.imread(str(file))) for file in files]
    with searching_once():
        results, _ = estimates(found, None, published(camera))
    return dict(camera=camera, pictures=len(files), all=results)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=int, default=10, help="of each lens")
    parser.add_argument("--lens", help="studies only lenses whose name contains this text")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args(arguments)
    jobs = [(name, args.pictures) for name in LENSES if (args.lens or "") in name]
    found = run_all(study, jobs, args.processes, "lens")
    found.sort(key=lambda of: list(LENSES).index(of["name"]))
    cameras = [] if args.lens else [real(camera) for camera in ("left", "right")]
    settings = dict(pictures=args.pictures, size=SIZE, shift=SHIFT, noise=NOISE, samples=SAMPLES)
    publish(dict(settings=settings, lenses=found, real=cameras), args.results)


if __name__ == "__main__":
    main()
