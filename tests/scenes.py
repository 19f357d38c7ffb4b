"""Data sets of scenes on disk, small, in the form of each reader."""

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from darswin.lens import Lens, Stereographic, load, save
from darswin.lens.pixels import pixel_rays

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from rooms import Room

CALIBRATIONS = Path(__file__).parent / "lens" / "files"
WOODSCAPE = CALIBRATIONS / "woodscape.json"
CLASSES = {"names": ["sky", "ground", "wall"], "colors": [[0, 0, 255], [0, 128, 0], [200, 0, 0]]}
SIZE = (121, 160)


def drawn(polygons: Sequence[np.ndarray], size: tuple[int, int], fine: int = 4) -> np.ndarray:
    """How much of each pixel polygons cover, up to 255, by OpenCV in a finer picture."""
    points = [np.round((p * fine - 0.5) * 16).astype(np.int32) for p in polygons]
    mask = cv2.fillPoly(np.zeros(np.array(size) * fine, np.uint8), points, 255, shift=4)
    return cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA)


def labels_of(theta: np.ndarray, azimuth: np.ndarray, classes: int = 3) -> np.ndarray:
    """Labels as a function of the ray: sectors of azimuth that change with every 0.4 rad of θ."""
    sector = np.floor(np.nan_to_num(azimuth) / (2 * np.pi) * 6 + 6)
    return ((sector + np.floor(np.nan_to_num(theta) / 0.4)) % classes).astype(np.uint8)


def distance_of(theta: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Metres as a function of the ray: smooth, from 2 to 10."""
    theta, azimuth = np.nan_to_num(theta), np.nan_to_num(azimuth)
    return (6 + 2 * np.cos(3 * theta) + 2 * np.sin(theta) * np.cos(azimuth)).astype(np.float32)


def rays_of(lens: Lens, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """θ, NaN where nothing is seen, and azimuth of each pixel, (H, W)."""
    theta, direction = pixel_rays(lens.to(torch.float64), size)
    azimuth = torch.atan2(direction[..., 1], direction[..., 0])
    return theta[0].numpy(), azimuth[0].numpy()


def seen(
    rays: tuple[np.ndarray, np.ndarray], number: int, colors: Sequence = CLASSES["colors"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture (H, W, 3) uint8, BGR, the labels and the distances of a scene; each scene is
    turned further than the one before. The picture has the labels' colours, with noise, and is
    black where nothing is seen."""
    theta, azimuth = rays[0], rays[1] + 0.3 * number
    labels = labels_of(theta, azimuth, len(colors))
    noise = np.random.default_rng(number).integers(0, 40, size=(*theta.shape, 3))
    picture = np.where(np.isnan(theta)[..., None], 0, np.asarray(colors)[labels] * 0.8 + noise)
    return picture.astype(np.uint8)[..., ::-1], labels, distance_of(theta, azimuth)


def write(file: Path, array: np.ndarray) -> Path:
    """An array as PNG, BGR where it has colours, or distances × 256; makes its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if array.dtype == np.float32:
        array = np.round(array * 256).astype(np.uint16)
    assert cv2.imwrite(str(file), np.ascontiguousarray(array))
    return file


def write_plain(
    folder: Path,
    count: int = 4,
    *,
    lens: Lens | None = None,
    size: tuple[int, int] = SIZE,
    split: str | None = None,
    own_lenses: bool = False,
    classes: dict | list | None = CLASSES,
    name: Callable[[int], str] = "{:03d}".format,
) -> Path:
    """`count` scenes in the plain form, which a lens sees: labels and distances of the ray.

    Args:
        split: a folder of a split in `folder`, or None. own_lenses: a file a picture.
    """
    place = folder if split is None else folder / split
    lens = (load(WOODSCAPE) if lens is None else lens).in_picture(size)
    if lens.image_size is None:
        lens = lens.replace(image_size=torch.tensor([size], dtype=torch.float32))
    rays = rays_of(lens, size)
    for k in range(count):
        for part, array in zip(("images", "labels", "distance"), seen(rays, k), strict=True):
            write(place / part / f"{name(k)}.png", array)
        if own_lenses:
            (place / "lenses").mkdir(exist_ok=True)
            save(lens, place / "lenses" / f"{name(k)}.json")
    if not own_lenses:
        save(lens, place / "lens.json")
    if classes is not None:
        (folder / "classes.json").write_text(json.dumps(classes))
    return folder


# -- trees of data sets that cannot be downloaded: as their authors describe them ----------------

WOODSCAPE_INFO = {
    "class_names": ["void", "road", "lanemarks", "curb", "person", "rider", "vehicles", "bicycle",
                    "motorcycle", "traffic_sign"],
    "class_colors": [[k, 10 * k, 255 - k] for k in range(10)],
    "class_indexes": list(range(10)),
    "color_scheme": "BGR",
}  # fmt: skip
VIEWS = ("FV", "RV", "MVL", "MVR")


def _woodscape_rays(folder: Path, number: int, size: tuple[int, int] = SIZE):
    """Writes the calibration of a frame, whose offsets and numbers differ from the others', and
    gives the frame's stem and the rays of its pixels."""
    stem, content = f"{number:05d}_{VIEWS[number % 4]}", json.loads(WOODSCAPE.read_text())
    content["name"] = VIEWS[number % 4]
    content["intrinsic"]["cx_offset"] += number
    content["intrinsic"]["k1"] += number % 4
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{stem}.json"
    file.write_text(json.dumps(content))
    return stem, rays_of(load(file).in_picture(size), size)


def write_woodscape(
    folder: Path, count: int = 8, *, size: tuple[int, int] = SIZE, nested: bool = True,
    calibration: str = "calibration/calibration",
) -> Path:  # fmt: skip
    """WoodScape's tree, `count` frames of its four cameras in turn, with green rows.

    Args:
        nested: semantic_annotations/semantic_annotations/, as its archives unpack. calibration:
            where the calibrations are.
    """
    annotations = folder / "semantic_annotations" / ("semantic_annotations" if nested else "")
    colors = WOODSCAPE_INFO["class_colors"]
    for k in range(count):
        stem, rays = _woodscape_rays(folder / calibration, k, size)
        image, labels, _ = seen(rays, k, colors)
        green = -(-3 * size[0] // 966)
        image[:green] = image[-green:] = (0, 255, 0)
        write(folder / "rgb_images" / f"{stem}.png", image)
        write(folder / "previous_images" / f"{stem}_prev.png", image)
        write(annotations / "gtLabels" / f"{stem}.png", labels)
        write(annotations / "rgbLabels" / f"{stem}.png", np.asarray(colors, np.uint8)[labels])
        boxes = folder / "box_2d_annotations" / "box_2d_annotations" / f"{stem}.txt"
        boxes.parent.mkdir(parents=True, exist_ok=True)
        boxes.write_text("vehicles,0,10,10,40,40\n")
    write(folder / "rgb_images(test_set)" / "08234_FV.png", image)
    (folder / "semantic_annotations" / "seg_annotation_info.json").write_text(
        json.dumps(WOODSCAPE_INFO)
    )
    return folder


def write_synwoodscape(folder: Path) -> Path:
    """SynWoodScape's tree: labels of 25 classes, depth maps in metres in which 1000 is the sky."""
    labels_folder = folder / "semantic_annotations" / "semantic_annotations" / "gtLabels"
    raw = folder / "depth_maps" / "raw_data"
    raw.mkdir(parents=True)
    for k in range(4):
        stem, rays = _woodscape_rays(folder / "calibration" / "calibration", k)
        image, labels, metres = seen(rays, k, [[10 * k, 0, 255 - 10 * k] for k in range(25)])
        write(folder / "rgb_images" / "rgb_images" / f"{stem}.png", image)
        write(labels_folder / f"{stem}.png", labels)
        np.save(raw / f"{stem}.npy", np.where(rays[1] < -2, 1000, metres).astype(np.float32))
    return folder


def write_kitti360(folder: Path) -> Path:
    """KITTI-360's tree of both fisheye cameras; every frame but the last of a drive has distances,
    as sparse as those of a LiDAR."""
    size, count = (140, 140), 3
    (folder / "calibration").mkdir(parents=True, exist_ok=True)
    for camera in ("image_02", "image_03"):
        calibration = folder / "calibration" / f"{camera}.yaml"
        shutil.copy(CALIBRATIONS / f"kitti360_{camera[-2:]}.yaml", calibration)
        rays = rays_of(load(calibration).in_picture(size), size)
        for drive in range(3):
            name, raw = f"2013_05_28_drive_{drive:04d}_sync", folder / "data_2d_raw"
            for k in range(count):
                image, _, metres = seen(rays, k)
                write(raw / name / camera / "data_rgb" / f"{k:010d}.png", image)
                metres[::2] = 0
                if k < count - 1:
                    write(folder / "distance" / name / camera / f"{k:010d}.png", metres)
            write(raw / name / "image_00" / "data_rect" / "0000000000.png", image)
    return folder


def write_cityscapes(folder: Path) -> Path:
    """Cityscapes' tree, three pictures of "train" and one of "val", with ids from 6 to 8."""
    rays = rays_of(load(WOODSCAPE).in_picture(SIZE), SIZE)
    for split, city, count in (("train", "aachen", 3), ("val", "lindau", 1), ("test", "bonn", 1)):
        for k in range(count):
            name = f"{split}/{city}/{city}_{k:06d}_000019"
            image, labels, _ = seen(rays, k)
            write(folder / "leftImg8bit" / f"{name}_leftImg8bit.png", image)
            for kind in ("labelIds", "instanceIds"):
                write(folder / "gtFine" / f"{name}_gtFine_{kind}.png", labels + 6)
    return folder


def write_coco(folder: Path) -> Path:
    """COCO's panoptic tree, two pictures of each split, with segments of the categories 1, 17 and
    200; nothing is known at the left side."""
    rays = rays_of(load(WOODSCAPE).in_picture(SIZE), SIZE)
    categories = [
        {"id": id_, "name": name, "color": color, "isthing": 0}
        for id_, name, color in zip((1, 17, 200), *CLASSES.values(), strict=True)
    ]
    segments = (66051, 300, 7)
    infos = [
        {"id": segment, "category_id": category["id"]}
        for segment, category in zip(segments, categories, strict=True)
    ]
    for split in ("train2017", "val2017"):
        annotations = []
        for k in range(2):
            image, labels, _ = seen(rays, k)
            write(folder / split / f"{k:012d}.jpg", image)
            ids = np.array(segments)[labels]
            ids[:, :9] = 0
            colors, name = (
                np.stack([ids // 65536, ids // 256 % 256, ids % 256], -1),
                f"{k:012d}.png",
            )
            write(folder / "annotations" / f"panoptic_{split}" / name, colors.astype(np.uint8))
            annotations.append({"image_id": k, "file_name": name, "segments_info": infos})
        content = {"images": [], "annotations": annotations, "categories": categories}
        (folder / "annotations" / f"panoptic_{split}.json").write_text(json.dumps(content))
    return folder


def write_outlines(folder: Path) -> Path:
    """Pictures in the plain form whose labels are COCO's outlines of objects: a large box of the
    category 7, a small one of the category 3 in it, and a crowd in the first column."""
    write_plain(folder, 10, classes=None)
    shutil.rmtree(folder / "labels")
    small, large = [40, 50, 60, 50, 60, 80, 40, 80], [20, 30, 100, 30, 100, 90, 20, 90]
    crowd = {"counts": [0, 121, 159 * 121], "size": [121, 160]}
    objects = [
        {"category_id": 3, "segmentation": [small], "area": 600, "iscrowd": 0},
        {"category_id": 7, "segmentation": [large], "area": 4800, "iscrowd": 0},
        {"category_id": 3, "segmentation": crowd, "area": 121, "iscrowd": 1},
    ]
    annotations = [{"image_id": k} | object_ for k in range(10) for object_ in objects]
    size = {"height": 121, "width": 160}
    images = [{"id": k, "file_name": f"{k:03d}.png"} | size for k in range(10)]
    categories = [{"id": 3, "name": "cat"}, {"id": 7, "name": "sofa"}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "annotations").mkdir()
    (folder / "annotations" / "instances_train.json").write_text(json.dumps(content))
    return folder


# -- ordinary pictures -----------------------------------------------------------------------------


def write_rooms(folder: Path, count: int) -> Lens:
    """Pictures of rooms, with nine rays in each pixel, and the lens that sees them."""
    size = (400, 480)
    lens = Stereographic(torch.tensor([160.0], dtype=torch.float64), image_size=size)
    side = torch.tensor([-1 / 3, 0, 1 / 3], dtype=torch.float64)
    y, x = torch.meshgrid(*(torch.arange(n).double() for n in size), indexing="ij")
    rays = [lens.unproject_points(torch.stack((x + dx, y + dy), -1)[None])[0].numpy()
            for dx in side for dy in side]  # fmt: skip
    folder.mkdir(exist_ok=True)
    for k in range(count):
        room = Room(np.random.default_rng(k))
        colors = np.mean([room.colors(r.astype(np.float32)) for r in rays], 0)
        cv2.imwrite(f"{folder}/{k}.png", colors.astype(np.uint8)[..., ::-1])
    return lens


def write_classes(folder: Path) -> np.ndarray:
    """A folder of pictures for each of two classes; returns the last picture."""
    random = np.random.default_rng(0)
    for name in ("cat", "dog"):
        (folder / name).mkdir(parents=True)
        for k in range(12):
            picture = random.integers(256, size=(48, 64, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / name / f"{k}.jpg"), picture)
    return picture
