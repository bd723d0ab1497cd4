"""Fills masked ground: OpenCV, and ground from nearby on top of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from msgspec import Meta
from torch import Tensor

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.imagery.clearing.exemplar import ExemplarSettings, fill_by_exemplar
from skyproof.ranges import check_ranges


@runtime_checkable
class Inpainting(Protocol):
    """Any function of this form fills masks; what it returns outside the mask is not used."""

    def __call__(
        self, image: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
    ) -> Float[Tensor, "3 H W"]:
        """Fills an sRGB image in [0, 1] where the mask is True."""
        ...


def apply_inpainting(
    inpainting: Inpainting, image: UInt8[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
) -> UInt8[Tensor, "3 H W"]:
    """Fills the mask; every byte outside it stays as it was.

    Raises:
        ImageryError: the inpainting failed, or returned another shape, type or values that are not
            finite.
    """
    name = inpainting_record(inpainting)["name"]
    try:
        filled = inpainting(image.float() / 255, mask.clone())
    except RuntimeError as error:
        reason = " ".join(str(error).split())[-300:]
        raise ImageryError(
            f"The inpainting {name} failed on a tile of {tuple(image.shape)} ({reason}); "
            "give another one with --inpainting, or leave it out."
        ) from error
    if (
        not isinstance(filled, Tensor)
        or filled.shape != image.shape
        or not filled.is_floating_point()
    ):
        came = (
            f"{filled.dtype} {tuple(filled.shape)}"
            if isinstance(filled, Tensor)
            else type(filled).__name__
        )
        raise ImageryError(
            f"The inpainting {name} is to return a float image of shape {tuple(image.shape)} but "
            f"returned {came}; use one that keeps the size."
        )
    if not torch.isfinite(filled[:, mask]).all():
        raise ImageryError(
            f"The inpainting {name} returned values that are not finite; use another one."
        )
    values = (filled.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)
    return torch.where(mask, values, image)


def inpainting_record(inpainting: Inpainting) -> dict[str, Any]:
    """Returns what a clearing's record says of it: its own `record`, or its name alone."""
    record = getattr(inpainting, "record", None)
    if callable(record):
        return dict(record())
    return {"name": str(getattr(inpainting, "__name__", type(inpainting).__name__))}


@dataclass(frozen=True)
class Diffusion:
    """OpenCV's inpainting: colours are carried on from the mask's edge; smooth, without texture.

    Attributes:
        method: "telea" (fast marching) or "navier-stokes".
        radius_px: neighbourhood OpenCV looks at.
    """

    method: Literal["telea", "navier-stokes"] = "telea"
    radius_px: Annotated[float, Meta(ge=1, le=100)] = 5.0

    def __post_init__(self) -> None:
        check_ranges(self)

    def __call__(
        self, image: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
    ) -> Float[Tensor, "3 H W"]:
        """Fills the mask."""
        cv2 = _opencv()
        flag = cv2.INPAINT_TELEA if self.method == "telea" else cv2.INPAINT_NS
        pixels = np.ascontiguousarray(
            (image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        )
        filled = cv2.inpaint(pixels, mask.numpy().astype(np.uint8) * 255, self.radius_px, flag)
        return torch.from_numpy(filled).permute(2, 0, 1).float() / 255

    def record(self) -> dict[str, Any]:
        """Returns method and OpenCV's version."""
        return {
            "name": f"opencv {self.method}",
            "radius_px": self.radius_px,
            "opencv": _opencv().__version__,
        }


@dataclass(frozen=True)
class Exemplar:
    """Ground copied from nearby, see `fill_by_exemplar`.

    Where no place fits, `otherwise` fills in.

    Attributes:
        settings: of the search.
        otherwise: used where no place nearby is large enough and free of vehicles.
    """

    settings: ExemplarSettings = field(default_factory=ExemplarSettings)
    otherwise: Diffusion = field(default_factory=Diffusion)

    def __call__(
        self, image: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
    ) -> Float[Tensor, "3 H W"]:
        """Fills the mask."""
        pixels, start = (
            i.permute(1, 2, 0).double().numpy() for i in (image, self.otherwise(image, mask))
        )
        filled = fill_by_exemplar(pixels, mask.numpy(), self.settings, start=start)
        return torch.from_numpy(filled).permute(2, 0, 1).float()

    def record(self) -> dict[str, Any]:
        """Returns the settings, and those of the fallback."""
        return {"name": "exemplar", **asdict(self.settings), "otherwise": self.otherwise.record()}


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ConfigurationError(
            "Inpainting needs OpenCV, which is not installed; install skyproof with the extra "
            "'imagery' (pip install 'skyproof[imagery]'), or give --inpainting a file."
        ) from error
    return cv2
