"""Pictures of labels and distances: colours, overlays, and predictions beside the truth.

Labels are integer ids (H, W). Ids without a colour are grey, such as that of unlabelled pixels.
Distances are (H, W) in metres. They are unknown, and grey, if they are 0 or not finite.
"""

from collections.abc import Callable, Sequence
from functools import partial

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, PercentFormatter, StrMethodFormatter

from darswin.boxes import Instances, corners, decode_rle
from darswin.utils.image import with_channels
from darswin.viz.plot import TEXT, add_legend, page_figure

__all__ = [
    "distance_image", "distance_range", "draw_boxes", "draw_instances", "label_image", "overlay",
    "palette",
]  # fmt: skip

UNKNOWN = (128, 128, 128)  # the colour of pixels without a label or distance
MOST_CLASSES = 255  # 8 bits of a label picture, of which 255 means none

# Near is bright. Equal steps look equal, also to colour-blind people.
_DISTANCES = "viridis_r"
_ERRORS, _WORST = "magma", Normalize(0, 0.5, clip=True)
_WRONG, _RIGHT = (213, 0, 50), (222, 222, 222)
# Okabe and Ito's colours without black.
_FIRST = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233),
          (213, 94, 0), (240, 228, 66))  # fmt: skip
# Those after them, a digit for each of r, g and b. Of all such colours, each differs most from
# those before it, also for people who do not see red or green.
_MORE = (
    "00fbfa004430109eff76f5356b61385da763644ff869fbdf00243d34b321ffd068dc66dc3bc225d74ff2006b18740"
    "17d423c1ad34e0629d8d84b99c300bde65c8c025fbff6be882238b709f860269cf72f95510321230d5cc9068ec25d"
    "cef224d83d5c42bf488afc2f21081326da36d81169437fb4c52308099da5efe34aef9d77fe3507747d75a9b5344bd"
    "602c65005957343de7001fba2329830239ced99851ffb8439edbab48e700d2acbb45b113bf542abd58747d710a745"
    "114ff70a8fc0da8654134279ade21127afc9b5649c71638603508c14982c01537e638ffc852fa0e538645c6a8b341"
    "7bf36b7076eb11610724612c73748d84c83ffaaf5ab29275735eb7dbd7fc9fddeee47c3359e81981a419bb4dda79a"
    "7b7c94608947d88caa85c0dd65ef9350e0446ae811dd79be13c00c54c72bd6fb50713b86c28db9b5b48315432dee9"
    "fc4f2ce39af8d68d95f69e8d99564ec9ce62b55442474176fe5e5d2a2363562f96a79ffa510e3e8e9ae1ceb3e6672"
)  # fmt: skip
_COLORS = (*_FIRST, *(
    tuple(17 * int(level, 16) for level in _MORE[k : k + 3]) for k in range(0, len(_MORE), 3)
))  # fmt: skip

Row = tuple[np.ndarray, np.ndarray, np.ndarray]  # image (H, W, 1 or 3) uint8, truth, prediction
# Pictures of truth, prediction and error, and the error in words.
Painted = tuple[np.ndarray, np.ndarray, np.ndarray, str]


def palette(count: int) -> list[list[int]]:
    """Colours (r, g, b) in 0 … 255 that differ from each other and from the grey of unknown pixels.

    The first seven are by Okabe and Ito. Each following colour differs as much as possible from
    those before it, also for people who cannot see red or green. A longer palette begins with the
    colours of a shorter one.

    Raises:
        ValueError: `count` is below 0 or above 255.
    """
    if not 0 <= count <= MOST_CLASSES:
        raise ValueError(f"a palette has 0 to {MOST_CLASSES} colours, got {count}")
    return [*map(list, _COLORS[:count])]


def label_image(labels: np.ndarray, colors: Sequence[Sequence[int]]) -> np.ndarray:
    """Labels (H, W) in the colours (r, g, b) of their ids: (H, W, 3) uint8.

    Raises:
        TypeError: the labels are not integers. ValueError: the labels have another shape.
    """
    if not np.issubdtype(labels.dtype, np.integer):
        raise TypeError(f"labels must be integers, got {labels.dtype}")
    _check_map("labels", labels)
    table = np.array([*colors, UNKNOWN], np.uint8).reshape(-1, 3)
    known = (labels >= 0) & (labels < len(colors))
    return np.take(table, np.where(known, labels, len(colors)), 0)


def distance_image(distance: np.ndarray, near: float, far: float) -> np.ndarray:
    """Distances (H, W) in metres as colours of their logarithm: (H, W, 3) uint8.

    Args:
        near, far: the distances (m) of the brightest and the darkest colour, which nearer or
            farther distances have too. `distance_range` computes suitable values.

    Raises:
        ValueError: the distances have another shape, or 0 < near < far does not hold.
    """
    _check_map("distance", distance)
    if not 0 < near < far < np.inf:
        raise ValueError(f"0 < near < far must hold, got {near:g} and {far:g} m")
    known = is_known(distance)
    part = np.log(np.where(known, distance, near).clip(near, far) / near) / np.log(far / near)
    table = [*matplotlib.colormaps[_DISTANCES](np.arange(256), bytes=True)[:, :3], UNKNOWN]
    steps = np.where(known, np.rint(255 * part), 256).astype(np.int16)
    return np.take(np.array(table, np.uint8), steps, 0)


def distance_range(distance: np.ndarray) -> tuple[float, float]:
    """Computes (near, far) in metres for `distance_image`, without the nearest and farthest 2 %."""
    known = distance[is_known(distance)]
    if not known.size:
        return 1.0, 10.0
    near, far = np.percentile(known, (2, 98)).tolist()
    return near, max(far, 1.1 * near)


def is_known(distance: np.ndarray) -> np.ndarray:
    """True for distances (H, W) that are finite and above 0."""
    return np.isfinite(distance) & (distance > 0)


def overlay(
    image: np.ndarray, picture: np.ndarray, alpha: float = 0.5, where: np.ndarray | None = None
) -> np.ndarray:
    """Blends a picture (H, W, 3) over an image (H, W, 1 or 3), both uint8: (H, W, 3) uint8.

    Args:
        alpha: the opacity of the picture, 0 to 1.
        where: (H, W), True for pixels to blend; None means all.

    Raises:
        ValueError: the pictures have other shapes, or `alpha` is out of its range.
    """
    image = image[..., None] if image.ndim == 2 else image
    if picture.shape != (*image.shape[:2], 3) or image.shape[2] not in (1, 3):
        raise ValueError(
            "image and picture must be (H, W, 1 or 3) and (H, W, 3) of one size, got "
            f"{image.shape} and {picture.shape}"
        )
    if not 0 <= alpha <= 1:
        raise ValueError(f"alpha must be in 0 … 1, got {alpha}")
    below = with_channels(image, 3)
    laid = cv2.addWeighted(below, 1 - alpha, picture, alpha, 0)
    return laid if where is None else cv2.copyTo(laid, where.astype(np.uint8), below.copy())


def draw_boxes(
    image: np.ndarray,
    boxes: np.ndarray,
    texts: Sequence[str],
    colors: Sequence[Sequence[int]],
    outlines: np.ndarray | None = None,
) -> np.ndarray:
    """Draws boxes and their texts on an image (H, W, 1 or 3) uint8: (H, W, 3) uint8.

    Args:
        boxes: (K, 4), x0, y0, x1 and y1 in px, where the image covers (0, 0) to (W, H); of any
            order, the first on top.
        texts: of each box; ASCII, as OpenCV draws them. colors: (r, g, b) of each box.
        outlines: (K, 4, 2), the corners of turned boxes, which are drawn in place of the boxes.
    """
    drawn = with_channels(image, 3).copy()
    scale = max(image.shape[:2]) / 1500
    thick, letters = max(1, round(2 * scale)), max(0.4, 0.8 * scale)
    every = list(zip(range(len(boxes)), boxes, texts, colors, strict=True))
    for k, box, text, color in reversed(every):
        # A box ends at the edge of its last pixel.
        left, top, right, bottom = np.rint(np.add(box, (0, 0, -1, -1))).astype(int).tolist()
        if outlines is None:
            cv2.rectangle(drawn, (left, top), (right, bottom), color, thick)
        else:
            cv2.polylines(drawn, [np.rint(outlines[k]).astype(np.int32)], True, color, thick)
        (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, letters, thick)
        foot = max(top, height + below)  # inside of the picture
        cv2.rectangle(drawn, (left, foot - height - below), (left + width, foot), color, cv2.FILLED)
        place = left, foot - below // 2
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, letters, (0, 0, 0), thick)
    return drawn


def draw_instances(image: np.ndarray, instances: Instances, texts: Sequence[str]) -> np.ndarray:
    """Draws boxes with their texts, masks and keypoints on an image (H, W, 1 or 3) uint8: (H, W, 3)
    uint8. Masks are run lengths, and the colours those of the labels."""
    of_label = palette(MOST_CLASSES)
    colors = [of_label[label % MOST_CLASSES] for label in instances.labels.tolist()]
    picture = with_channels(image, 3)
    if instances.masks is not None:
        laid, where = np.zeros_like(picture), np.zeros(picture.shape[:2], bool)
        for rle, color in reversed(list(zip(instances.masks, colors, strict=True))):
            mask = decode_rle(rle)
            laid[mask], where[mask] = color, True
        picture = overlay(picture, laid, where=where)
    outlines = corners(instances.boxes) if instances.boxes.shape[1] == 5 else None
    picture = draw_boxes(picture, instances.upright, texts, colors, outlines)
    keypoints = () if instances.keypoints is None else instances.keypoints
    for points, color in zip(keypoints, colors, strict=False):
        for x, y in points[np.isfinite(points[:, 0]), :2].astype(int).tolist():
            cv2.circle(picture, (x, y), max(2, max(picture.shape) // 500), color, cv2.FILLED)
    return picture


def draw_predictions(
    rows: Sequence[Row], classes: Sequence[str] = (), colors: Sequence[Sequence[int]] = ()
) -> Figure:
    """Draws image, truth, prediction and error, in one row for each sample.

    Truth and prediction are integer labels, with the names and colours of their classes, or
    distances as floats in metres. Where the truth is known, the error shows wrong labels in red, or
    the relative error of the distance.
    """
    if not rows:
        raise ValueError("there are no predictions to draw")
    are_labels = np.issubdtype(rows[0][1].dtype, np.integer)
    if are_labels and not classes:
        raise ValueError("labels need the names of their classes")
    height, width = rows[0][1].shape
    tall = len(rows) * (1.4 * height / width + 0.3) + (0.3 if are_labels else 1.5)
    figure = page_figure(tall)
    panels = figure.subplots(len(rows), 4, squeeze=False)
    paint: Callable[[np.ndarray, np.ndarray], Painted]
    if are_labels:
        colors = colors or palette(len(classes))
        paint = partial(_label_pictures, colors=colors)
        _draw_legend(figure, classes, colors)
    else:
        near, far = distance_range(np.concatenate([truth[is_known(truth)] for _, truth, _ in rows]))
        paint = partial(_distance_pictures, near=near, far=far)
        _draw_bars(figure, panels[-1], near, far)
    for axes, (image, truth, prediction) in zip(panels, rows, strict=True):
        *pictures, text = paint(truth, prediction)
        for panel, picture in zip(axes, (image, *pictures), strict=True):
            _show(panel, picture)
        axes[3].set_xlabel(text)
    for axes, title in zip(panels[0], ("image", "truth", "prediction", "error"), strict=True):
        axes.set_title(title, fontsize=TEXT)
    return figure


def _label_pictures(
    truth: np.ndarray, prediction: np.ndarray, colors: Sequence[Sequence[int]]
) -> Painted:
    known, right = (truth >= 0) & (truth < len(colors)), truth == prediction
    error = label_image(np.where(known, right, 2), (_WRONG, _RIGHT))
    share = right[known].mean() if known.any() else float("nan")
    pictures = label_image(truth, colors), label_image(prediction, colors)
    return *pictures, error, f"{share:.0%} right"


def _draw_legend(figure: Figure, classes: Sequence[str], colors: Sequence[Sequence[int]]) -> None:
    meanings = [*zip(classes, colors, strict=False), ("wrong", _WRONG), ("no label", UNKNOWN)]
    entries = [
        Patch(color=(red / 255, green / 255, blue / 255), label=name)
        for name, (red, green, blue) in meanings
    ]
    add_legend(figure, entries)


def _distance_pictures(
    truth: np.ndarray, prediction: np.ndarray, near: float, far: float
) -> Painted:
    both = is_known(truth) & is_known(prediction)
    relative = np.abs(prediction - truth) / np.where(both, truth, 1)
    error = matplotlib.colormaps[_ERRORS](_WORST(np.where(both, relative, 0)), bytes=True)
    error = np.where(both[..., None], error[..., :3], np.array(UNKNOWN, np.uint8))
    mean = relative[both].mean() if both.any() else float("nan")
    pictures = distance_image(truth, near, far), distance_image(prediction, near, far)
    return *pictures, error, f"mean {mean:.0%}"


def _draw_bars(figure: Figure, panels: np.ndarray, near: float, far: float) -> None:
    """Draws the scales of distances and of their errors below the panels."""
    distances = ScalarMappable(LogNorm(near, far), matplotlib.colormaps[_DISTANCES])
    bar = figure.colorbar(
        distances, ax=panels[:3], location="bottom", shrink=0.5, aspect=40, extend="both"
    )
    bar.set_label("distance (m), log scale; grey: not known")
    bar.ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    bar.ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bar.ax.minorticks_off()
    errors = ScalarMappable(_WORST, matplotlib.colormaps[_ERRORS])
    bar = figure.colorbar(errors, ax=panels[3], location="bottom", aspect=15, extend="max")
    bar.set_label("error of the\ntrue distance")
    bar.set_ticks([0, 0.25, 0.5])
    bar.ax.xaxis.set_major_formatter(PercentFormatter(1, 0))


def _show(axes: Axes, picture: np.ndarray) -> None:
    picture = with_channels(np.atleast_3d(picture), 3)
    axes.imshow(picture, interpolation="nearest" if max(picture.shape) <= 160 else "antialiased")
    axes.set(xticks=[], yticks=[])


def _check_map(name: str, values: np.ndarray) -> None:
    if values.ndim != 2:
        raise ValueError(f"{name} must be (H, W), got {values.shape}")
