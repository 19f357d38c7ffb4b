"""`darswin warp`: a data set, pictures and labels, as another lens or a view sees it."""

import json
import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from darswin.boxes import Instances
from darswin.cli.pictures import ByLens, claim_folder, is_below
from darswin.cli.views import camera_view, named_view, to_corners
from darswin.data.cameras import Calibrations, is_json
from darswin.data.labels import Labels, open_labels, write_coco, write_yolo
from darswin.data.labels.labels import LEAST_VISIBLE, LabelledPictures, move_instances
from darswin.data.labels.yolo import is_yolo, moved_splits
from darswin.lens import Lens, save, to_dict
from darswin.lens.files.fields import listed
from darswin.lens.files.reader import Coefficients
from darswin.utils.files import replace_file
from darswin.utils.image import (
    BrokenImageError,
    read_header,
    read_oriented,
    write_image,
    written_as,
)
from darswin.utils.parameters import check, naming, with_flags
from darswin.utils.processes import die_with_parent
from darswin.utils.progress import Progress
from darswin.utils.words import counted
from darswin.views import CameraView, PixelView, list_views
from darswin.views.camera import picture_size

RECORD, LENS, VIEW, LEFT = "warp.json", "lens.json", "view.json", "left.json"
COCO, PICTURES = "annotations.json", "images"
_SIZE = (512, 512)  # of a view
_NAMED = 10  # pictures that cannot be read


def warp(
    source: str, *, to: str, out: str, lens: str | None = None, size: tuple[int, int] | None = None,
    fov_deg: float | None = None, up: Sequence[float] | None = None, pictures: str | None = None,
    camera: str | None = None, coefficients: Coefficients | None = None, processes: int = 1,
) -> None:  # fmt: skip
    """Writes a data set, its pictures and labels, as another lens or a view sees it.

    Polygons, masks and keypoints move exactly, and boxes without them as the ellipse inside. An
    instance of which less than a fifth is visible is left out and listed in left.json. The same
    command goes on where an earlier run was stopped. Pictures and labels that cannot be read are
    named at the end; all others are written.

    Args:
        source: a COCO file of instances or keypoints, or its folder; a folder in the form of YOLO
            or its data.yaml; or a folder of WoodScape with its boxes. Oriented boxes of YOLO are
            outlines with four corners, and become outlines with many.
        to: the calibration file of the new camera, or its lens as JSON, see --lens; or a view, such
            as mercator or tiles:5, with the number of tiles.
        out: the folder to write to: new, empty, or from an earlier run of the same command. It gets
            the pictures, annotations.json in COCO's form or the text files of YOLO if the source
            has them, and lens.json, the new camera, or view.json, the view.
        lens: the calibration file of the camera that took the pictures, in any format that
            `darswin.lens.load` reads; or a lens as JSON, such as {"model": "Perspective",
            "fov_deg": 60}; or a lenses.json for several cameras. The default is a lens.json beside
            the labels, and the calibrations of WoodScape.
        size: height and width of the new pictures in px, e.g. 480,640. The default is the size of
            the new camera, and 512,512 for views.
        pictures: the folder of the pictures, if a COCO file does not lie where COCO has it.
        processes: the number of processes that work at the same time.
    """
    check("processes", processes, processes >= 1, "at least 1")
    check("size", size, size is None or min(size) >= 1, "at least 1,1")
    view = _view(to, size, fov_deg, up)
    data = open_labels(source, pictures)
    if lens is not None:
        root = "." if is_json(lens) else data.folder
        data.lenses = Calibrations(lens, root, camera, coefficients)
    if data.lenses is None:
        text = f"missing `lens`: {source} has no calibration, so give that of its camera"
        raise naming(ValueError(text), "lens")
    if is_below(out, source):
        raise ValueError(f"--out must be a folder outside of {source}, got {out}")
    if outside := [file for file in data.files if os.path.isabs(file) or ".." in Path(file).parts]:
        raise ValueError(
            f"{source} names pictures outside of the folder {data.folder}, such as {outside[0]}: "
            "name them relative to their folder"
        )
    in_yolo = is_yolo(Path(source))
    _check_names(data, view.count, in_yolo)
    settings = dict(
        source=os.path.abspath(source), to=to, size=size, fov_deg=fov_deg, up=up, lens=lens,
        camera=camera, coefficients=coefficients, pictures=os.path.abspath(data.folder),
        cameras=data.lenses.digest(),
        target=to_dict(view.lens) if isinstance(view, CameraView) else None,
    )  # fmt: skip
    folder = claim_folder(out, RECORD, settings)
    work = _Work(replace(data, files=(), raw=(), entries=()), view,
                 folder if in_yolo else folder / PICTURES)  # fmt: skip
    warped: list[_Warped] = []
    with Progress("warp", len(data)) as progress, _pool(work, processes) as each:
        for new in each(data.files, data.raw):
            warped.append(new)
            progress.done += 1
    _write(folder, data, view, warped, settings | {"yolo": source if in_yolo else None})


class _Warped(NamedTuple):
    """What became of a picture: its new files and their labels, the instances that left, and the
    lens that took it, as JSON; or an error. Those that left have "shares" in `more`: how much of
    them is visible in each new picture."""

    pictures: Sequence[tuple[str, Labels]] = ()
    left: Instances = Instances.joined(())
    lens: str = ""
    error: str = ""
    wrong: Sequence[str] = ()  # instances that cannot be read


class _Maps:
    """What pictures of one lens become: pictures of another camera, or of a view."""

    def __init__(self, lens: Lens, view: PixelView):
        camera = to_corners(lens)
        self.remap = view.at(camera, picture_size(lens))
        self.said = json.dumps(to_dict(camera))

    def pictures(self, image: np.ndarray) -> np.ndarray:
        return self.remap(image).reshape(len(self.remap.tiles), *self.remap.view_size, -1)


@dataclass
class _Work:
    """Writes the new pictures of a picture, unless they are there, and moves its labels."""

    data: LabelledPictures
    view: PixelView
    folder: Path
    by_lens: ByLens = field(default_factory=ByLens)

    def __call__(self, file: str, raw: Any) -> _Warped:
        try:
            return self._warped(file, raw)
        except (BrokenImageError, ValueError) as error:
            said = with_flags(error)
            return _Warped(error=said if file in said else f"{file}: {said}")

    def _warped(self, file: str, raw: Any) -> _Warped:
        assert self.data.lenses is not None
        name = self.data.folder / file
        header = read_header(name)
        labels, wrong = self.data.read(raw, header.upright)
        lens = self.data.lenses.lens_of(name, header.upright, header.orientation)
        maps = self.by_lens(lens, lambda: _Maps(lens, self.view))
        files = _new_names(file, self.view.count)
        if not all((self.folder / file).is_file() for file in files):
            image, orientation = read_oriented(name, header.channels)
            if (image.shape[:2], orientation) != (header.upright, header.orientation):
                raise BrokenImageError(
                    f"cannot read {name}: its orientation stands behind its pixels"
                )
            for file, picture in zip(files, maps.pictures(image), strict=True):
                write_image(self.folder / file, picture)
        moved = [move_instances(labels.instances, tile) for tile in maps.remap.tiles]
        shares = np.stack([instances.more["visible"] for instances in moved], 1)
        left = labels.instances.with_columns(shares=shares)[(shares < LEAST_VISIBLE).all(1)]
        shown = [
            Labels(instances[instances.more["visible"] >= LEAST_VISIBLE], tile.view_size)
            for instances, tile in zip(moved, maps.remap.tiles, strict=True)
        ]
        return _Warped([*zip(files, shown, strict=True)], left, maps.said, wrong=wrong)


def _new_names(file: str, count: int) -> list[str]:
    """The names of the new pictures of a picture."""
    new = written_as(Path(file))
    tiles = [f"_{k}" for k in range(count)] if count > 1 else [""]
    return [str(new.with_stem(new.stem + tile)) for tile in tiles]


def _check_names(data: LabelledPictures, count: int, in_yolo: bool) -> None:
    """ValueError if two pictures or their labels would be one file."""
    taken: dict[str, str] = {}
    for file in data.files:
        for name in _new_names(file, count):
            key = os.path.normpath(name)
            key = os.path.splitext(key)[0] if in_yolo else key
            if (other := taken.setdefault(key, file)) != file:
                raise ValueError(f"{other} and {file} would both become {name}: rename one of them")


@contextmanager
def _pool(work: _Work, processes: int) -> Iterator[Callable[..., Iterable[_Warped]]]:
    """A `map` of the work, in this process or in several."""
    if processes == 1:
        yield partial(map, work)
        return
    # Forks of a process whose threads have computed may hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _start, (work, os.getpid())) as pool:
        try:
            yield partial(pool.map, _one, chunksize=4)
        except BrokenProcessPool as error:
            text = "a process was ended, perhaps because the memory is full: use fewer `processes`"
            raise naming(ChildProcessError(text), "processes") from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


_work: list[_Work] = []  # of this process of a pool


def _start(work: _Work, parent: int) -> None:
    die_with_parent(parent)
    warnings.simplefilter("ignore")  # the first process opens the same calibrations
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _work.append(work)


def _one(file: str, raw: Any) -> _Warped:
    return _work[0](file, raw)


def _view(
    to: str, size: tuple[int, int] | None, fov_deg: float | None, up: Sequence[float] | None
) -> PixelView:
    """The view, or the new camera as one."""
    if to.partition(":")[0] in list_views():
        view = named_view("to", to, size or _SIZE, fov_deg=fov_deg, up=up)
        if not view.uses_lens:
            raise naming(ValueError(f"`to` {to} shows the picture as it is"), "to")
        return view
    for name, value in (("fov_deg", fov_deg), ("up", up)):
        check(name, value, value is None, "left out unless --to is a view")
    if not is_json(to) and not os.path.exists(to):
        text = f"`to` {to} is neither a file nor a view: {', '.join(list_views())}"
        raise naming(FileNotFoundError(text), "to")
    return camera_view(to, size)


def _write(
    folder: Path, data: LabelledPictures, view: PixelView, warped: Sequence[_Warped],
    settings: Mapping[str, Any],
) -> None:  # fmt: skip
    """Writes the labels, the new camera or view, and the report, and prints it."""
    entries = data.entries or [{}] * len(data)
    pictures = [
        ({**entry, "file_name": file} | ({"source": name} if len(new.pictures) > 1 else {}), labels)
        for name, entry, new in zip(data.files, entries, warped, strict=True)
        for file, labels in new.pictures
    ]
    if settings["yolo"] is not None:
        new_names = {
            os.path.normpath(name): [file for file, _ in new.pictures]
            for name, new in zip(data.files, warped, strict=True)
        }
        said, missing, lost = moved_splits(Path(settings["yolo"]), folder, new_names)
        write_yolo(folder, pictures, data.categories, said)
        for split in missing:
            print(f"left out of data.yaml, because it is not in {data.folder}: {split}")
    else:
        lost = []
        write_coco(folder / COCO, pictures, data.categories)
    if isinstance(view, CameraView):
        save(view.lens, folder / LENS)
    else:
        lenses = [json.loads(said) for said in dict.fromkeys(new.lens for new in warped) if said]
        options = {name: settings[name] for name in ("fov_deg", "up")}
        record = {"view": settings["to"], "size": view.size} | options | {"lenses": lenses}
        replace_file(folder / VIEW, json.dumps(record, indent=1))
    names = {category["id"]: category["name"] for category in data.categories}
    left = [
        {
            "file": name, "id": entry.get("id"), "category": names[label],
            "visible": round(float(shares.max()), 3),
            "fits_no_tile": bool(shares.sum() >= LEAST_VISIBLE),
        }
        for name, new in zip(data.files, warped, strict=True) if len(new.left)
        for entry, label, shares in zip(
            new.left.more["entry"], new.left.labels.tolist(), new.left.more["shares"], strict=True
        )
    ]  # fmt: skip
    replace_file(folder / LEFT, json.dumps(left, indent=1, ensure_ascii=False))
    bad = [new.error for new in warped if new.error]
    wrong = [*data.wrong, *lost, *(text for new in warped for text in new.wrong)]
    count = sum(len(labels.instances) for _, labels in pictures)
    assert data.lenses is not None
    cameras = listed(
        one.calibration if is_json(one.calibration) else one.name for one in data.lenses.cameras
    )
    print(f"pictures by {cameras}, as {settings['to']} sees them")
    made, instances = counted(len(pictures), "picture"), counted(count, "instance")
    print(f"{folder}: {made} of {len(data)}, with {instances}")
    large = sum(lost["fits_no_tile"] for lost in left)
    share = f"{LEAST_VISIBLE:.0%} of them"
    for number, what in (
        (len(left) - large, f"left the picture, because less than {share} is visible"),
        (large, f"too large for the tiles: none shows {share}, only several together"),
    ):
        if number:
            print(f"{counted(number, 'instance')} {what}; see {folder / LEFT}")
    report: list[str] = []
    for texts, what in (
        (bad, f"left out: {len(bad)} of {counted(len(data), 'picture')}"),
        (wrong, f"left out: {len(wrong)} of the pictures and annotations in the labels"),
    ):
        if texts:
            more = [f"and {len(texts) - _NAMED} more"] * (len(texts) > _NAMED)
            report += [f"{what}:", *texts[:_NAMED], *more]
    if report:
        raise BrokenImageError("\n".join(report))
