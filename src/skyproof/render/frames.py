"""What a renderer hands over: images and where each vehicle is in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import VehicleBatch


@dataclass(frozen=True)
class Frames:
    """Rendered images; the N placements of all scenes follow each other, scene by scene.

    Attributes:
        image: `[B, 3, H, W]` sRGB in [0, 1].
        scene_index: `[N]` the image each placement is in.
        boxes: `[N, 4]` pixel xyxy around the vehicle without its shadow, cut at the image border.
        centres: `[N, 2]` pixel (x, y) of the middle of the vehicle, half its height above the
            ground.
        visible_px: `[N]` pixels' worth of samples that show the vehicle inside the image.
        visible_fraction: `[N]` of its samples, those that show it inside the image and are not
            hidden by the photograph's crowns and roofs.
        masks: `[N, H, W]` pixels at least half covered by the vehicle, before blur; None unless
            asked for.
    """

    image: Float[Tensor, "B 3 H W"]
    scene_index: Int[Tensor, " N"]
    boxes: Float[Tensor, "N 4"]
    centres: Float[Tensor, "N 2"]
    visible_px: Float[Tensor, " N"]
    visible_fraction: Float[Tensor, " N"]
    masks: Bool[Tensor, "N H W"] | None = None


@runtime_checkable
class Renderer(Protocol):
    """Draws scenes; `vehicles` holds one row per placement, scene by scene.

    Attributes:
        name: as tables show it.
        differentiable: whether gradients reach textures and vertices.
        concurrent: whether several threads may call it at once.
    """

    name: str
    differentiable: bool
    concurrent: bool

    def record(self, scenes: Sequence[Scene]) -> dict[str, Any]:
        """The settings that its images of these scenes depend on, as plain JSON values."""
        ...

    def __call__(
        self, scenes: Sequence[Scene], vehicles: VehicleBatch, *, masks: bool = False
    ) -> Frames:
        """Draws one image per scene."""
        ...
