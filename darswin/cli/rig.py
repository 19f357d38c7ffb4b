"""`darswin rig`: draws a rig of cameras, stitches their pictures, and checks whether they agree."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from darswin.cli.arguments import check_out
from darswin.cli.rig_fisheye import fisheye
from darswin.cli.views import Look, Up
from darswin.lens.files.reader import Coefficients
from darswin.lens.rig import Camera, Rig
from darswin.utils.parameters import check, naming
from darswin.utils.words import counted, in_px
from darswin.views import GroundView, PixelView, RayView
from darswin.views.registry import flat_views, view_class
from darswin.views.rig_reads import Seam, read_at, see

if TYPE_CHECKING:
    from darswin.views.rig import RigRemap

Direction = Literal["camera_to_rig", "rig_to_camera"]
VIEWS = ("ground", *(name for name in flat_views() if issubclass(view_class(name), RayView)))
MOST_PIXELS = 2**24  # of a view
SIDE, DRAWN, COMPARED = 800, 400, 160  # px, the longer side of a view: by default, in drawings …
SPAN = 12.0  # m of the ground
RECORD, AHEAD = "rig.json", Look("", None, 0.0, 0.0, None)
LOWEST = 0.1  # m above the ground: a rig whose cameras are all higher is shown there
# What `compare` tries of one camera at a time.
TURNS, MOVES, POINTS = (0.5, 1.0, 2.0), (2, 5), 4000  # degrees, cm, and places at most
CLEAR, LEAST = 0.2, 0.5  # the part of the difference, and units of 255, by which it must shrink


def show(
    rig: str, pictures: Sequence[str] = (), *, out: str = "rig.png", span: float | None = None,
    up: Up | None = None, height: float = 0.0, direction: Direction | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Draws the cameras of a rig from above and from the side, and how many see each place.

    Prints where each camera is, in metres from the rig's origin, and where it looks: yaw to the
    right, pitch up, and roll clockwise.

    Args:
        pictures: a picture of each camera to draw too: see `darswin rig stitch`. Of frames, the
            first counts.
        out: the file to write; its ending names the format: png, jpg, webp, tif, pdf or svg.
    """
    from darswin.viz.plot import figure_format, save_figure
    from darswin.viz.rig import draw_rig

    figure_format(out)
    check_out(out, ())
    cameras = open_rig(rig, up, height, direction, coefficients)
    remap = _view(cameras, side=DRAWN, span=span).at(cameras, seam="narrow")
    picture = remap(_first(cameras, pictures, out)) if pictures else None
    counts, what = remap.seen_by.sum(0), "sphere"
    weights = np.ones(counts.shape)
    if isinstance(remap.view, GroundView):
        what = f"ground, {remap.view.span:g} m wide"
    else:  # rows are latitudes
        weights *= np.sin(math.pi * (np.arange(len(counts)) + 0.5) / len(counts))[:, None]
    shares = [np.average(seen, weights=weights) for seen in (counts == 1, counts > 1, counts == 0)]
    save_figure(draw_rig(remap, picture), out)
    for name, camera in cameras.cameras.items():
        print(f"{name}: {_described(camera, cameras)}")
    parts = "{:.1%} are seen by one camera, {:.1%} by more and {:.1%} by none".format(*shares)
    print(f"of the {what}, {parts}\n{out}")


def stitch(
    rig: str, pictures: Sequence[str] = (), *, out: str, view: str | None = None,
    size: tuple[int, int] | None = None, span: float | None = None,
    center: tuple[float, float] | None = None, rise: float | None = None,
    fov_deg: float | None = None, yaw_deg: float = 0.0, pitch_deg: float = 0.0,
    seam: Seam = "narrow", gain: bool = False, distance: float | None = None, up: Up | None = None,
    height: float = 0.0, direction: Direction | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Writes one picture of what all cameras of a rig see: the ground from above, or a panorama.

    Args:
        pictures: a folder with a picture of each camera, named after it, such as front.png, or with
            a folder of frames for each, such as front/0001.png; or words NAME=PATH.
        out: the picture to write; of frames, a folder.
        view: ground, or a map of directions such as equirectangular or perspective. The default is
            the ground if all cameras are above it, and else equirectangular.
        size: height and width of the picture, px. The default is 800,800 for the ground, and else
            400,800.
        center: the middle of the ground that is shown, in metres ahead and to the left of the rig's
            origin. The default is below the middle of the cameras.
        rise: turns the ground into a bowl, e.g. 0.15: the height is this · (r - 5)² at r > 5 m.
        fov_deg: the horizontal field of view of a view of directions, in degrees. The default is
            360, but 340 for a stereographic view and 100 for a perspective one.
        yaw_deg: the angle that a view of directions looks to the right of ahead, in degrees.
        pitch_deg: the angle that it looks up, in degrees.
        seam: hard: each place from one camera; narrow: mixed in the middle of an overlap; wide:
            mixed of all that see it.
        gain: whether each camera gets a factor that makes all equally bright. Of frames, the first
            tells it.
    """
    from darswin.cli.pictures import claim_folder, is_below
    from darswin.cli.rig_files import files_of, read_frames
    from darswin.utils.image import WRITTEN, write_image
    from darswin.utils.progress import Progress

    cameras = open_rig(rig, up, height, direction, coefficients)
    look = Look("", fov_deg, yaw_deg, pitch_deg, None)
    shown = _view(cameras, view, size, look, span=span, center=center, rise=rise)
    remap = shown.at(cameras, seam=seam, distance=distance)
    frames = files_of(pictures, cameras.names)
    folder = Path(out).parent
    names = {"": Path(out).name}
    if "" not in frames:
        for word in pictures:
            is_apart = not is_below(word.partition("=")[2] or word, out)
            check("out", out, is_apart, "a folder without the originals")
        folder, names = claim_folder(out, RECORD), {frame: f"{frame}.png" for frame in frames}
    else:
        ending = Path(out).suffix.lower() in WRITTEN
        check("out", out, ending, f"a file that ends in one of {', '.join(sorted(WRITTEN))}")
        check_out(out, map(str, frames[""].values()))
    sampler = None
    with Progress("stitch", len(frames)) as progress:
        for frame, files in frames.items():
            pictures_of = read_frames(cameras, files)
            # The factors of the first frame hold for all: else films would flicker.
            if sampler is None:
                sampler = remap.sampler(gains=remap.gains(pictures_of) if gain else None)
            write_image(folder / names[frame], sampler(pictures_of))
            progress.done += 1
    print(f"{out}: {counted(len(frames), 'picture')}, {in_px(remap.view_size)}")


def compare(
    rig: str, pictures: Sequence[str] = (), *, out: str | None = None, span: float | None = None,
    distance: float | None = None, up: Up | None = None, height: float = 0.0,
    direction: Direction | None = None, coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Measures how much the cameras of a rig disagree where they see the same places.

    Wrong poses, heights and lenses show, and also things that stand on the ground. It also tries
    small turns and moves of each camera alone, and of the rig's height, and names the best one if
    the pictures then agree clearly better.

    Args:
        pictures: a picture of each camera: see `darswin rig stitch`. Of frames, the first counts.
        out: the file for a drawing of the differences; its ending names the format, as for show.
    """
    from darswin.viz.plot import figure_format, save_figure
    from darswin.viz.rig import draw_differences

    if out is not None:
        figure_format(out)
    cameras = open_rig(rig, up, height, direction, coefficients)
    remap = _view(cameras, side=COMPARED, span=span).at(cameras, distance=distance)
    frames = _first(cameras, pictures, out)
    gains = dict(zip(cameras.names, remap.gains(frames), strict=True))
    levelled = {name: frame.astype(np.float32) * gains[name] for name, frame in frames.items()}
    means, apart = remap.disagreement(levelled)
    if not means:
        raise ValueError("no two cameras see the same places, so there is nothing to compare")
    for (first, second), mean in means.items():
        print(f"{first} and {second} differ by {mean:.1f} of 255")
    print(f"in all overlaps, cameras differ by {np.nanmean(apart):.1f} of 255")
    for name, gain in gains.items():
        if abs(gain - 1) >= 0.01:
            print(f"{name} is {'darker' if gain > 1 else 'brighter'}: its factor is {gain:.2f}")
    print(_better(remap, levelled))
    if out is not None:
        save_figure(draw_differences(remap, apart), out)
        print(out)


def open_rig(
    rig: str, up: Up | None, height: float, direction: Direction | None,
    coefficients: Coefficients | None,
) -> Rig:  # fmt: skip
    """The rig of a file or a folder, or of `cube:SIDE`."""
    given = dict[str, Any](up=up, height=height, direction=direction, coefficients=coefficients)
    name, colon, side = rig.partition(":")
    if name != "cube" or not colon:
        return Rig.load(rig, **given)
    for option, value in given.items():
        check(option, value, not value, "left out for a cube")
    if not side.isdecimal():
        raise ValueError(f"a cube is cube:SIDE, with the side of its pictures in px, got {rig}")
    return Rig.cube(int(side))


def _view(
    rig: Rig, name: str | None = None, size: tuple[int, int] | None = None,
    look: Look = AHEAD, side: int = SIDE, **ground: Any,
) -> PixelView:  # fmt: skip
    """A view of (H, W), or else of its usual shape with a longest side; ground: the arguments of
    `GroundView`, None for their defaults."""
    lowest = min(camera.pose[:3, 3] @ rig.up for camera in rig.cameras.values())
    if name is None:
        name = "ground" if lowest > LOWEST else "equirectangular"
    check("view", name, name in VIEWS, f"one of {', '.join(VIEWS)}")
    size = size or ((side, side) if name == "ground" else (side // 2, side))
    fits = min(size) >= 2 and math.prod(size) <= MOST_PIXELS
    check("size", size, fits, f"at least 2,2 and at most {MOST_PIXELS} px in all")
    if name != "ground":
        for option, value in ground.items():
            check(option, value, value is None, "left out unless the view is the ground")
        look = look._replace(view=name)
        look.check()
        return look.make(size, look.fov_deg)
    for option in ("fov_deg", "yaw_deg", "pitch_deg"):
        value = getattr(look, option)
        check(option, value, not value, "left out for the ground")
    if lowest <= 0:
        text = "the ground is at the rig's origin, below all cameras: give `height`, in metres"
        raise naming(ValueError(text), "height")
    right, _, ahead = rig.middle @ rig.level
    given: dict[str, Any] = dict(span=SPAN, center=(ahead, -right))
    return GroundView(size, **given | {k: v for k, v in ground.items() if v is not None})


def _first(rig: Rig, pictures: Sequence[str], out: str | None) -> dict[str, np.ndarray]:
    """The pictures of the first frame; ValueError if `out` would replace one."""
    from darswin.cli.rig_files import files_of, read_frames

    files = min(files_of(pictures, rig.names).items())[1]
    check_out(out, map(str, files.values()))
    return read_frames(rig, files)


def _described(camera: Camera, rig: Rig) -> str:
    """The lens, place and direction of a camera in words."""
    right, _, ahead = (rig.level.T @ camera.pose[:3, :3]).T
    x, y, z = np.round(camera.pose[:3, 3] @ rig.level, 2)
    yaw, pitch = math.atan2(ahead[0], ahead[2]), math.asin(max(-1.0, min(1.0, -ahead[1])))
    if abs(ahead[1]) > 1 - 1e-9:  # straight up or down, yaw is that of the picture's top
        yaw = math.atan2(-right[2], right[0])
    level = np.array((math.cos(yaw), 0, -math.sin(yaw)))
    roll = math.atan2(right @ np.cross(ahead, level), right @ level)
    angles = (f"{name} {math.degrees(angle) + 0:.1f}°" for name, angle in
              (("yaw", yaw), ("pitch", pitch), ("roll", roll)))  # fmt: skip
    place = f"{z + 0:.2f} m ahead, {-x + 0:.2f} m to the left, {-y + 0:.2f} m up"
    return f"{type(camera.lens).__name__}, {in_px(camera.size)}; {place}; {', '.join(angles)}"


def _better(remap: "RigRemap", frames: dict[str, np.ndarray]) -> str:
    """The small change by which frames (H, W, C) float32 agree best, if that is clear."""
    rig, seen_now = remap.rig, remap.seen_by
    images = [torch.from_numpy(frame).movedim(2, 0)[None].contiguous() for frame in frames.values()]

    def apart(cameras: dict[str, Camera], numbers: list[int], points: np.ndarray) -> float:
        """The mean difference of some cameras from others at points; ∞ if most are lost."""
        seen, parts = see(remap.view, rig.with_cameras(cameras), remap.distance, points), []
        reads = zip(images, np.nan_to_num(seen.pixels), strict=True)
        values = np.stack([read_at(image, pixels)[0].numpy() for image, pixels in reads])
        shown = seen.room >= 0
        for number in numbers:
            both = shown & shown[number]
            both[number] = False
            parts.append(np.abs(values - values[number]).mean(1)[both])
        lost = (shown[numbers].any(0) & (shown.sum(0) > 1)).mean() < 0.5
        return math.inf if lost else float(np.concatenate(parts).mean())

    best, text = 1 - CLEAR, "no small turn or move agrees clearly better"
    for names in (*((name,) for name in rig.names), rig.names):
        numbers = [rig.names.index(name) for name in names]
        points = np.argwhere(seen_now[numbers].any(0) & (seen_now.sum(0) > 1))[:, ::-1]
        if not len(points):
            continue
        points = points[:: -(-len(points) // POINTS)].astype(np.float64)
        now = apart({}, numbers, points)
        for how, change in _changes(remap, names):
            moved = {name: rig[name]._replace(pose=change @ rig[name].pose) for name in names}
            then = apart(moved, numbers, points)
            if then <= min(best * now, now - LEAST):
                who, best = names[0] if len(names) == 1 else "all cameras", then / now
                text = f"{who}: {how}, pictures agree better ({now:.1f} → {then:.1f})"
    return text


def _changes(remap: "RigRemap", names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Small turns of a camera, and moves along the vertical if they matter, in words and as (4, 4)
    for points of the rig's frame; for several cameras only moves."""
    import cv2

    pose, up = remap.rig[names[0]].pose, np.array(remap.rig.up)
    axes = ((-up, "to the right", "to the left"), (pose[:3, 0], "up", "down"),
            (pose[:3, 2], "clockwise", "counterclockwise"))  # fmt: skip
    for axis, forth, back in axes if len(names) == 1 else ():
        for degrees in (sign * turn for turn in TURNS for sign in (1, -1)):
            turn = np.eye(4)
            turn[:3, :3] = cv2.Rodrigues(math.radians(degrees) * axis)[0]
            turn[:3, 3] = pose[:3, 3] - turn[:3, :3] @ pose[:3, 3]
            yield f"turned by {abs(degrees):g}° {forth if degrees > 0 else back}", turn
    if remap.view.is_surface or remap.distance is not None:
        for centimetres in (sign * move for move in MOVES for sign in (1, -1)):
            move = np.eye(4)
            move[:3, 3] = centimetres / 100 * up
            yield f"{abs(centimetres)} cm {'higher' if centimetres > 0 else 'lower'}", move


COMMANDS = {"show": show, "stitch": stitch, "check": compare, "fisheye": fisheye}
