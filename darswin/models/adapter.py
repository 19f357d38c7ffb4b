"""Any network that takes square images, or other pixels, behind any lens."""

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.lens import Lens
from darswin.models.base import Model, check_given_once
from darswin.models.detections import (
    decode_detections,
    detections_to_images,
    find_detections,
)
from darswin.models.prepared import Prepared
from darswin.utils.parameters import check
from darswin.views import PixelView, View, make_view
from darswin.views.base import Pair, PerChannel, size_of
from darswin.views.remap import Remaps


class LensAdapter(Model[Any]):
    """Wraps any network of images so that it works with any lens.

    The network runs on a view of the image, and its results come back to the pixels of the images:

    - maps, results with 4 dimensions (B, K, H', W') for any size, are resampled to (B, K, H, W).
      Maps of integers, such as ids, take the nearest value. Pixels that the view does not show get
      0; `adapter.prepare(lens, size).view.shown` is their mask;
    - detections, a dict of "boxes", "scores" and "labels" or a list of such dicts for each picture,
      as torchvision returns them, become a list with a dict for each image: boxes in pixels of the
      images, "rays" (K, 3), the directions of their middles, "visible" (K,), the share of each box
      that the image shows, and "cut" (K,), whether the border of the view cuts it. Their masks and
      keypoints come back too. The detections of several tiles are merged;
    - raw results of a detector, in a form of the how-to about detectors, become detections too.
      Those of Ultralytics are (B, 4 + n, cells) or (B, 300, 6), alone or before other results.
      Boxes that overlap are merged. No gradients come back from them;
    - other results, such as logits of classes, are returned as they are. A view of n tiles has n
      for each image. Lists, tuples and dicts of results may be nested.

    The network may come from timm, from segmentation_models_pytorch or from you, trained or not.
    Pretrained weights need a view in which objects stand upright and keep their shape: "mercator",
    the default, for one run per image, "tiles" for several. A network that is trained from scratch
    may take the "square": the image disc by the concentric map, in which equal steps of θ are at
    equal distances from the centre, whatever the lens is. The adapter is called `adapter(images,
    lens)`. It gives images in floating point to the network as they are.

    Args:
        network: a module that takes images (B, C, H', W').
        size: (H', W') of a view by name in pixels, or the side of a square.
        view: a `View`, which has its own size, mean and std: `make_view` takes its options. Or the
            name of a view, one of `list_views()`, with its own defaults.
        mean, std: the normalization of uint8 images that the network expects, `(pixel/255 - mean) /
            std`, one number or one for each channel. None refuses uint8 images.
        output: "pixels" resamples results with 4 dimensions as described; "view" returns all
            results as the network made them, in the view.
        boxes: a function that makes detections of the network's results, if they have another form.
        form: that of raw results of a detector, if neither they nor attributes of the network tell
            it, a word of the how-to about detectors; "numbers" if they are none.
        threshold: the lowest score of detections in raw results.

    Raises:
        ValueError: the size is below 1, an argument is given beside a `View`, the output is
            unknown, mean and std do not fit together, or the form or the threshold is none; in
            forward, the number of detections does not fit, or results look like those of a
            detector, but their form cannot be told.
        TypeError: the size is no int and no pair of ints; in forward, images of uint8 without mean
            and std, or results of `boxes` that are no detections.

    Source: the concentric map of Shirley and Chiu, JGT 1997.
    """

    stages = ()
    in_chans: int | None = None

    def __init__(
        self,
        network: nn.Module,
        size: int | Pair | None = None,
        *,
        view: str | View = "mercator",
        mean: PerChannel | None = None,
        std: PerChannel | None = None,
        output: Literal["pixels", "view"] = "pixels",
        boxes: Callable[[Any], Any] | None = None,
        form: str | None = None,
        threshold: float = 0.3,
    ):
        super().__init__()
        if output not in ("pixels", "view"):
            raise ValueError(f"output must be 'pixels' or 'view', got {output!r}")
        if form is not None:
            from darswin.frames.recognise import FORMS  # needs the compiled part of frames

            check("form", form, form in FORMS, f"one of {', '.join(FORMS)}")
            check("form", form, boxes is None, "left out beside boxes")
        check("threshold", threshold, 0 <= threshold <= 1, "from 0 to 1")
        if isinstance(view, View):
            check_given_once(size=size, mean=mean, std=std)
        else:
            view = make_view(view, size, mean=mean, std=std)
        size_of(view)  # or an error, if it is not of pixels
        self.view = view
        self.network, self.output, self.boxes = network, output, boxes
        self.form, self.threshold = form, threshold
        self.goes_back = output == "pixels"
        if isinstance(network, Model):
            self.in_chans, self.num_classes = network.in_chans, network.num_classes
        if self.mean is None:
            self._looks = 0  # the network may expect any values

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        prepared = super().prepare(lens, size)
        if isinstance(self.view, PixelView) and not torch.compiler.is_compiling():
            prepared = prepared._replace(remaps=Remaps(self.view, lens, size))
        return prepared

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Any:
        results = self.network(x)
        if self.boxes is not None:
            results = self.boxes(results)
        if self.output == "view":
            return results
        detections = find_detections(results)
        if detections is None and self.boxes is None:
            detections = decode_detections(results, x, self.network, self.form, self.threshold)
        if detections is not None:
            if len(detections) != len(x):
                raise ValueError(
                    f"the network must give detections for each of its {len(x)} pictures, got "
                    f"{len(detections)} results"
                )
            return detections_to_images(detections, self.view, prepared)
        if self.boxes is not None and len(x):
            raise TypeError(
                "boxes must return a dict of tensors boxes, scores and labels, or a list of them, "
                f"got {type(results).__name__}"
            )

        def to_images(out: Any) -> Any:
            has_pixels = isinstance(out, Tensor) and out.dim() == 4
            return self.view.back(out, prepared.view) if has_pixels else out

        return pytree.tree_map(to_images, results)

    def _check_dtype(self, name: str, images: Tensor) -> None:
        # The network may take other types of floating point than those of its weights.
        taken = (torch.uint8,) if self.mean is not None else ()
        if not (images.is_floating_point() or images.dtype in taken):
            hint = "" if taken else "; with mean and std, an adapter takes uint8 too"
            raise TypeError(f"{name} must be in floating point, got {images.dtype}{hint}")

    def _check_device(self, name: str, images: Tensor) -> None:
        """No check: the network may move its images itself."""

    def extra_repr(self) -> str:
        return f"output={self.output!r}"


def adapted(model: Any) -> Any:
    """The network of an adapter; another model itself."""
    return model.network if isinstance(model, LensAdapter) else model
