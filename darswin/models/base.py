"""The base class of all models: how they are called, and how they describe themselves."""

import warnings
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from darswin.layers.transformer import Block, Stage
from darswin.lens import Lens
from darswin.models.features import FeatureInfo
from darswin.models.prepared import Prepared
from darswin.ops._library import transformed
from darswin.ops.checks import per_channel, readable
from darswin.views import View, make_view
from darswin.views.base import (
    Pair,
    PerChannel,
    check_images,
    check_one_picture,
)

Result = TypeVar("Result", covariant=True)

# Images in floating point with larger values have not been normalized: with ImageNet's statistics,
# normalized images end at 2.7.
LARGEST_NORMALIZED = 20


class Model(nn.Module, Generic[Result]):
    """The base class of all models: a view and a network.

    All models are called `model(images, lens)` and have timm's methods. A call checks the images,
    computes `prepare(lens, size)`, and runs the network on what the view sees. If your lens stays
    the same, call `prepare` once and then `run(images, prepared)` for each batch: the results are
    the same. `run_sampled` starts later, at the result of `sample`: pixels that were sampled
    elsewhere, such as on a camera. A subclass makes a `view`, and defines `forward_network`.

    Attributes:
        view: what the network sees of the images through their lenses.
        stages: the stages of the network; `prepare` computes the position biases of their blocks.
        in_chans: C, the number of channels of the images; None allows any number.
        num_classes: the number of classes of the result.
        image_size: the size (H, W) that all images must have; None allows any size.
        goes_back: the size of the maps that go back to the pixels of the images, or False.
        reads_rays: True if the network reads the viewing directions of pixels.
        token_maps: the sizes of the maps of whose tokens the network reads the positions.
        refines_with_images: True if `run_sampled` needs the images too.
        feature_info: the sizes of the encoder's stages.
        pretrained_cfg: timm's description of a model, a dict. Its keys are "architecture" (the
            name for `create_model`), "num_classes", "input_size" (C, H, W), "fixed_input_size",
            "mean" and "std" (for pixels in [0, 1]), "interpolation", "crop_pct", "first_conv" (the
            layer that reads the pixels) and "classifier". A loaded model also has "label_names"
            and "file", and its other values agree with its card.
    """

    view: View
    stages: Iterable[Stage]
    in_chans: int | None
    num_classes: int
    image_size: Pair | None = None
    goes_back: bool | Pair = False
    reads_rays = False
    token_maps: Sequence[Pair] = ()
    refines_with_images = False
    _looks = 3  # the number of calls that still look at the values of their images

    def __init__(self) -> None:
        super().__init__()
        self.feature_info = FeatureInfo()
        self.pretrained_cfg: dict[str, Any] = {}

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Result:
        """The network's part of `forward`.

        Args:
            x: what the view sees, in floating point.
            prepared: the result of `prepare`.
            images: the images, checked; None only unless the model `refines_with_images`.
        """
        raise NotImplementedError

    def forward(self, images: Tensor, lens: Lens | None = None) -> Result:
        """Images (B, C, H, W) and their lenses (B or 1) → the model's result."""
        return self.forward_network(*self._seen(images, lens))

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """Everything that depends on the lens but not on the pixels, for any number of `run` calls.

        It includes the position biases, so call it again after the weights have changed.

        Args:
            lens: N lenses, or None if the model ignores its lens.
            size: (H, W) of the images.

        Raises:
            TypeError: the lens is missing, and the model uses one.
            ValueError: the lens belongs to images of another size.
        """
        view = self.view
        if self.goes_back or self.reads_rays:
            view = view.for_lens(lens, size)
        prepared = view.prepare(lens, size, back=self.goes_back)
        return Prepared(
            prepared,
            rays=view.ray_channels(lens, size) if self.reads_rays else None,
            tokens=[view.token_positions(lens, of_map) for of_map in self.token_maps],
            tables=[stage.tables(prepared.grid) for stage in self.stages],
        )

    def run(self, images: Tensor, prepared: Prepared) -> Result:
        """The result of `forward`, with the lens given as the result of `prepare`.

        Args:
            images: (B, C, H, W), in floating point and normalized; or of uint8, also (B, H, W, C),
                which the model normalizes itself.
            prepared: the result of `prepare` for B lenses or one, and for the size of the images.

        Raises:
            TypeError: the images are no tensor, or have a dtype that the model cannot take.
            ValueError: the images have a wrong shape or are on another device than the model, or
                the number of lenses is neither B nor 1.
        """
        self._check_learning(prepared)
        images = self._checked(images)
        x = self.view.see(images, prepared.view, self.dtype)
        return self.forward_network(x, prepared, images)

    def sample(self, images: Tensor, prepared: Prepared) -> Tensor:
        """The pixels that the network reads, in floating point; uint8 images are normalized.

        They are polar samples (B, R, A, S_r·S_φ·C) in the inner order (S_r, S_φ, C) for a DarSwin
        encoder. For other models they are the view (B, C, H', W'), or the images themselves.

        Args:
            images, prepared: as in `run`.

        Raises:
            TypeError, ValueError: as in `run`.
        """
        return self.view.see(self._checked(images), prepared.view, self.dtype)

    def run_sampled(
        self, sampled: Tensor, prepared: Prepared, images: Tensor | None = None
    ) -> Result:
        """The result of `run`, up to rounding, from pixels that were sampled already.

        Args:
            sampled: the result of `sample`, in eval mode.
            prepared: as in `run`.
            images: as in `run`, if the model `refines_with_images`. This is a `Unet` with the view
                "polar" and a skip_width above 0.

        Raises:
            TypeError: an argument is no tensor, has an unsupported dtype, or is missing.
            ValueError: an argument has a wrong shape, or the number of lenses is neither B nor 1.
        """
        self._check_learning(prepared)
        sampled = self.view.check_seen(sampled, prepared.view, self.in_chans)
        self._check_device("sampled", sampled)
        if self.view.in_pixels:
            self._check_dtype("sampled", sampled)
            sampled = self.view.floating(sampled, self.dtype)
        if not self.refines_with_images:
            images = None
        elif images is None:
            raise TypeError("images are missing: this model refines its result with their pixels")
        else:
            images = self._checked(images)
        return self.forward_network(sampled, prepared, images)

    @property
    def uses_lens(self) -> bool:
        """False if the model ignores its lens, which may then be None."""
        return self.view.uses_lens or self.reads_rays

    @property
    def mean(self) -> PerChannel | None:
        """The mean of the normalization of `normalize`, for each channel."""
        return self.view.mean

    @property
    def std(self) -> PerChannel | None:
        """The standard deviation of the normalization of `normalize`, for each channel."""
        return self.view.std

    @property
    def square_images(self) -> bool:
        """True if the images must be square."""
        return self.image_size is not None and self.image_size[0] == self.image_size[1]

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the weights."""
        weight = next(self.parameters(), None)
        return torch.float32 if weight is None else weight.dtype

    def normalize(self, images: Tensor) -> Tensor:
        """`(image - mean) / std` for each channel: floating point as the model takes it.

        Images of uint8 need no call: the model normalizes them. It takes images in floating point
        as they are.

        Args:
            images: (B, C, H, W), in floating point in [0, 1]; or of uint8 in [0, 255], also
                (B, H, W, C).

        Returns:
            (B, C, H, W) in the dtype of the weights.

        Raises:
            TypeError: the images are no tensor, or neither in floating point nor of uint8.
            ValueError: the images have a wrong shape or are on another device than the model; or
                their values, which are looked at on the CPU, are far beyond 1; or the model has no
                mean and std.
        """
        if self.mean is None:
            raise ValueError("normalize needs a model with mean and std")
        images = self._with_shape(images)
        if images.dtype != torch.uint8:
            if not images.is_floating_point():
                raise TypeError(f"images must be in floating point or uint8, got {images.dtype}")
            largest = _largest(images)
            if largest > LARGEST_NORMALIZED:
                raise ValueError(
                    f"images in floating point must be in [0, 1], got values up to {largest:g}: "
                    "divide them by 255, or pass uint8"
                )
        return self.view.normalized(images, self.dtype)

    def _seen(self, images: Tensor, lens: Lens | None) -> tuple[Tensor, Prepared, Tensor]:
        """The arguments of `forward_network`."""
        images = self._checked(images)
        height, width = images.shape[2:]
        prepared = self.prepare(lens, (height, width))
        return self.view.see(images, prepared.view, self.dtype), prepared, images

    def _checked(self, images: Tensor) -> Tensor:
        """The images as (B, C, H, W), after a check of their channels, size, device and dtype.

        Warns once if their values cannot be normalized ones.
        """
        images = self._with_shape(images)
        self._check_dtype("images", images)
        if not torch.compiler.is_compiling() and self._looks and images.is_floating_point():
            self._looks -= 1
            largest = _largest(images)
            if largest > LARGEST_NORMALIZED:
                self._looks = 0
                warnings.warn(
                    "images in floating point are taken as they are, but these have values up to "
                    f"{largest:g}: pass uint8, or model.normalize(images / 255)",
                    stacklevel=2,
                )
        return images

    def _with_shape(self, images: Tensor) -> Tensor:
        images = check_images(images, channels=self.in_chans)
        if self.in_chans is not None and images.shape[1] != self.in_chans:
            last = images.shape[3] == self.in_chans
            advice = "; the channels come first: pass images.permute(0, 3, 1, 2)" if last else ""
            raise ValueError(
                f"images must have {self.in_chans} channels, got {images.shape[1]}{advice}"
            )
        if self.image_size is not None and images.shape[2:] != self.image_size:
            raise ValueError(
                f"images must have the model's image_size, (H, W) = {self.image_size}, "
                f"got {tuple(images.shape[2:])}"
            )
        self._check_device("images", images)
        return images

    def _check_device(self, name: str, images: Tensor) -> None:
        weight = next(self.parameters(), None)
        if weight is not None and weight.device != images.device:
            raise ValueError(
                f"{name} must be on the device of the model, {weight.device}, got {images.device}: "
                f'pass {name}.to("{weight.device}")'
            )

    def _check_dtype(self, name: str, images: Tensor) -> None:
        """TypeError unless pixels are uint8, have the model's dtype, or autocast converts them."""
        if images.dtype in (torch.uint8, self.dtype):
            return
        autocast = torch.is_autocast_enabled(images.device.type)
        if not autocast or torch.float64 in (images.dtype, self.dtype):
            raise TypeError(
                f"{name} must be uint8 or {self.dtype}, the dtype of the weights, "
                f"got {images.dtype}"
            )

    def _check_learning(self, prepared: Prepared) -> None:
        """ValueError if a step of training would not reach the position biases."""
        if torch.compiler.is_compiling() or not (self.training and torch.is_grad_enabled()):
            return
        learned = any(self.get_parameter(name).requires_grad for name in self.no_weight_decay())
        if learned and not any(table.grad_fn for of in prepared.tables for table in of):
            raise ValueError(
                "prepared was computed without gradients, so the position biases would not be "
                "trained: in training, call prepare in every step"
            )

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters without weight decay, in addition to biases and norms."""
        return {name for name, _ in self.named_parameters() if ".position_bias." in name}

    def set_grad_checkpointing(self, enable: bool = True) -> None:
        """Turns on training with less memory, or turns it off.

        The backward pass then recomputes the norms and the window attention, which are a few
        percent of the work. The gradients stay the same, bit for bit.
        """
        for module in self.modules():
            if isinstance(module, Block):
                module.grad_checkpointing = enable


def view_of_model(
    view: str | View, size: int | Pair | None, channels: int, mean: PerChannel | None,
    std: PerChannel | None,
) -> View:  # fmt: skip
    """The view of one picture that a model sees of images with C channels.

    Args:
        view: a `View`, which has its own size, mean and std; or the name of one.
        size: of a view by name.
        mean, std: of a view by name; None means 0 and 1.

    Raises:
        ValueError: mean or std are given twice or do not fit, or the view is not of one picture.
    """
    if isinstance(view, View):
        check_given_once(mean=mean, std=std)
        mean, std = view.mean, view.std
    else:
        mean, std = 0.0 if mean is None else mean, 1.0 if std is None else std
    if mean is not None and std is not None:
        mean, std = per_channel("mean", mean, channels), per_channel("std", std, channels)
    if not isinstance(view, View):
        view = make_view(view, size, mean=mean, std=std)
    check_one_picture(view)
    return view


def check_given_once(**given: Any) -> None:
    """ValueError for arguments that are given beside a `View`, which has its own."""
    if wrong := [name for name, value in given.items() if value is not None]:
        raise ValueError(f"a View has its own {' and '.join(wrong)}: leave them out")


def _largest(images: Tensor) -> float:
    """The largest value of plain images on the CPU. Others are not looked at, since that could
    wait for a device or end up in a graph: 0."""
    plain = type(images) in (Tensor, nn.Parameter) and readable(images) and not transformed()
    if not plain or torch.jit.is_tracing() or not images.numel():
        return 0.0
    return float(images.detach().float().numpy().max())  # NumPy's work is in no graph


def init_weights(module: nn.Module, std: float | None = 0.02) -> None:
    """Initialises a linear layer, and leaves other layers alone.

    Args:
        std: the standard deviation of the weights, by default that of the Swin Transformer. None
            keeps the scale of the inputs (LeCun's rule).
    """
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=module.in_features**-0.5 if std is None else std)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


# For dense models. The standard deviation of 0.02 suits 2,500 inputs. Layers with 24 to 768 inputs
# then start with small results, and dense models learn much more slowly.
init_by_width = partial(init_weights, std=None)
