"""The base class of all models: how they are called, and how they describe themselves."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from darswin.layers.linear import MATMUL_BACKENDS, Linear, MatmulBackend
from darswin.layers.polar import check_images, check_lens
from darswin.layers.transformer import Block, Mlp, WindowAttention
from darswin.lens import Lens
from darswin.models.stages import Pair, StagePlan
from darswin.ops._library import transformed
from darswin.ops.checks import per_channel, readable
from darswin.ops.reference import normalized

# Images in floating point with larger values have not been normalized: with ImageNet's statistics,
# normalized images end at 2.7.
LARGEST_NORMALIZED = 20


class FeatureInfo(list[dict[str, Any]]):
    """A list with one dict per stage, and timm's accessors.

    Keys:
        num_chs: D, the width of the stage's map.
        reduction: the number of pixels that a token spans along its longer side. They are pixels of
            the image, or of the view if the model makes one. DarSwin counts samples of the polar
            grid instead, because the number of pixels depends on the lens and the ring.
        module: the stage's name in the model.
        map_size: (R, A) of a polar map, (H, W) of any other map.
    """

    def get(self, key: str, idx: int | Sequence[int] | None = None) -> Any:
        """The values of a key for one stage (an int), several stages, or all of them (None)."""
        if isinstance(idx, int):
            return self[idx][key]
        return [self[k][key] for k in (range(len(self)) if idx is None else idx)]

    def channels(self, idx: int | Sequence[int] | None = None) -> Any:
        """The widths D of the stages' maps."""
        return self.get("num_chs", idx)

    def reduction(self, idx: int | Sequence[int] | None = None) -> Any:
        """The number of pixels that a token of each stage spans; see `FeatureInfo`."""
        return self.get("reduction", idx)

    def module_name(self, idx: int | Sequence[int] | None = None) -> Any:
        """The stages' names in the model."""
        return self.get("module", idx)


class Model(nn.Module):
    """The base class of all models. They are called `model(images, lens)` and have timm's methods.

    A call checks the images, computes `prepare(lens, size)`, and runs the network on both. If your
    lens stays the same, call `prepare` once and then `run(images, prepared)` for each batch: the
    results are the same. `run_sampled` starts later, at the result of `sample`: pixels that were
    sampled elsewhere, such as on a camera. A subclass defines `_prepare`, `_run`, `_sample`,
    `_points` and `_run_sampled`.

    Attributes:
        in_chans: C, the number of channels of the images.
        num_classes: the number of classes of the result.
        mean, std: the normalization of `normalize`, for each channel.
        image_size: the size (H, W) that all images must have; None allows any size.
        square_images: True if the images must be square.
        uses_lens: False if the model ignores its lens, which may then be None.
        refines_with_images: True if `run_sampled` needs the images too.
        feature_info: the sizes of the encoder's stages.
        pretrained_cfg: timm's description of a model, a dict. Its keys are "architecture" (the
            name for `create_model`), "num_classes", "input_size" (C, H, W), "fixed_input_size",
            "mean" and "std" (for pixels in [0, 1]), "interpolation", "crop_pct", "first_conv" (the
            layer that reads the pixels) and "classifier". A loaded model also has "label_names"
            and "file", and its other values agree with its card.
    """

    image_size: Pair | None = None
    square_images = False
    uses_lens = True
    refines_with_images = False
    in_chans: int
    num_classes: int
    mean: float | Sequence[float] | None
    std: float | Sequence[float] | None
    matmul_backend: MatmulBackend = "torch"  # see `set_matmul_backend`
    _looks = 3  # the number of calls that still look at the values of their images

    def __init__(self) -> None:
        super().__init__()
        self.feature_info = FeatureInfo()
        self.pretrained_cfg: dict[str, Any] = {}

    def prepare(self, lens: Lens | None, size: Pair) -> Any:
        """Everything that depends on the lens but not on the pixels, for any number of `run` calls.

        Args:
            lens: N lenses, or None if the model ignores its lens.
            size: (H, W) of the images.

        Raises:
            TypeError: the lens is missing, and the model uses one.
            ValueError: the lens belongs to images of another size.
        """
        if self.uses_lens:
            check_lens(lens, size)
        return self._prepare(lens, size)

    def _prepare(self, lens: Any, size: Pair) -> Any:
        """The result of `prepare`, from a lens that was checked."""
        raise NotImplementedError

    def _run(self, images: Tensor, prepared: Any) -> Any:
        """The result of `run`, from images that were checked."""
        raise NotImplementedError

    def _sample(self, images: Tensor, prepared: Any) -> Tensor:
        """The result of `sample`, from images that were checked."""
        raise NotImplementedError

    def _points(self, prepared: Any) -> Any:
        """The points at which `_sample` reads the images; None if it takes them as they are."""
        return None

    def _run_sampled(self, sampled: Tensor, prepared: Any, images: Tensor | None) -> Any:
        """The result of `run_sampled`, from pixels and images that were checked."""
        raise NotImplementedError

    def forward(self, images: Tensor, lens: Lens | None = None) -> Any:
        """Images (B, C, H, W) and their lenses (B or 1) → the model's result."""
        return self._run(*self._checked_and_prepared(images, lens))

    def run(self, images: Tensor, prepared: Any) -> Any:
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
        return self._run(self._checked(images), prepared)

    def sample(self, images: Tensor, prepared: Any) -> Tensor:
        """The pixels that the network reads, in floating point; uint8 images are normalized.

        They are polar samples (B, R, A, S_r·S_φ·C) in the inner order (S_r, S_φ, C) for a DarSwin
        encoder. For other models they are the view (B, C, H', W'), or the images themselves.

        Args:
            images, prepared: as in `run`.

        Raises:
            TypeError, ValueError: as in `run`.
        """
        return self._sample(self._checked(images), prepared)

    def run_sampled(self, sampled: Tensor, prepared: Any, images: Tensor | None = None) -> Any:
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
        sampled = self._checked_sampled(sampled, prepared)
        self._check_device("sampled", sampled)
        if not self.refines_with_images:
            images = None
        elif images is None:
            raise TypeError("images are missing: this model refines its result with their pixels")
        else:
            images = self._checked(images)
        return self._run_sampled(sampled, prepared, images)

    def _checked_and_prepared(self, images: Tensor, lens: Lens | None) -> tuple[Tensor, Any]:
        images = self._checked(images)
        height, width = images.shape[2:]
        return images, self.prepare(lens, (height, width))

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
                their values, which are looked at on the CPU, are far beyond 1.
        """
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
        return self._normalized(images)

    def _checked(self, images: Tensor) -> Tensor:
        """The result of `_with_shape`. Warns once if the values cannot be normalized ones."""
        images = self._with_shape(images)
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
        """The images as (B, C, H, W), after a check of their channels, size and device."""
        images = check_images(images, channels=self.in_chans)
        if images.shape[1] != self.in_chans:
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

    def _checked_sampled(self, sampled: Tensor, prepared: Any) -> Tensor:
        """The pixels of `run_sampled`, after a check of their shape."""
        return self._checked(sampled)

    def _floating(self, images: Tensor) -> Tensor:
        """The images in floating point: uint8 images are normalized, others stay as they are."""
        return images if images.dtype != torch.uint8 else self._normalized(images)

    def _normalized(self, images: Tensor) -> Tensor:
        weight = next(self.parameters(), None)
        dtype = torch.float32 if weight is None else weight.dtype
        exact = torch.promote_types(dtype, torch.float32)
        assert self.mean is not None and self.std is not None
        mean = per_channel("mean", self.mean, images.shape[1])
        std = per_channel("std", self.std, images.shape[1])
        return normalized(images, mean, std, exact).to(dtype)

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters without weight decay, in addition to biases and norms."""
        return {name for name, _ in self.named_parameters() if ".position_bias." in name}

    def set_matmul_backend(self, matmul_backend: MatmulBackend) -> None:
        """Chooses the library that computes the matrix products of the linear layers.

        Args:
            matmul_backend: "torch", "onednn" or "autotune"; see `Linear`.

        Raises:
            ValueError: the backend is unknown.
        """
        if matmul_backend not in MATMUL_BACKENDS:
            raise ValueError(
                f"matmul_backend must be one of {MATMUL_BACKENDS}, got {matmul_backend!r}"
            )
        for module in self.modules():
            if isinstance(module, (Linear, Model)):
                module.matmul_backend = matmul_backend

    def set_grad_checkpointing(self, enable: bool = True) -> None:
        """Turns on training with less memory, or turns it off.

        The backward pass then recomputes the norms, the GELUs and the window attention, which are a
        few percent of the work. The gradients stay the same, bit for bit.
        """
        for module in self.modules():
            if isinstance(module, (Block, Mlp, WindowAttention)):
                module.grad_checkpointing = enable


def _largest(images: Tensor) -> float:
    """The largest value of plain images on the CPU. Others are not looked at, since that could
    wait for a device or end up in a graph: 0."""
    plain = type(images) in (Tensor, nn.Parameter) and readable(images) and not transformed()
    if not plain or torch.jit.is_tracing() or not images.numel():
        return 0.0
    return float(images.detach().float().numpy().max())  # NumPy's work is in no graph


def init_weights(module: nn.Module) -> None:
    """Initialises a linear layer as the Swin Transformer does, and leaves other layers alone."""
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def init_by_width(module: nn.Module) -> None:
    """Initialises a linear layer so that it keeps the scale of its inputs (LeCun's rule).

    The Swin Transformer's standard deviation of 0.02 suits 2,500 inputs. Layers with 24 to 768
    inputs then start with small results, and dense models learn much more slowly.
    """
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=module.in_features**-0.5)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def feature_info(plans: Sequence[StagePlan], embed_dim: int, patch: Pair) -> FeatureInfo:
    """The sizes of stages. A token of the first one spans `patch`; the width doubles per stage."""
    infos = FeatureInfo()
    for plan in plans:
        merged = zip(patch, plans[0].map_size, plan.map_size, strict=True)
        infos.append(
            dict(
                num_chs=embed_dim * 2**plan.index,
                reduction=max(span * before // after for span, before, after in merged),
                module=f"stages.{plan.index}",
                map_size=plan.map_size,
            )
        )
    return infos


def take_indices(count: int, indices: int | Sequence[int] | None) -> list[int]:
    """Numbers of the chosen ones of `count` stages: the last ones for an int, all for None."""
    if isinstance(indices, int):
        chosen: Sequence[int] = range(count)[-indices:] if 0 < indices <= count else ()
    else:
        chosen = range(count) if indices is None else indices
    if not chosen or not all(-count <= i < count for i in chosen):
        raise ValueError(f"indices must name some of {count} stages, got {indices}")
    return [i % count for i in chosen]
