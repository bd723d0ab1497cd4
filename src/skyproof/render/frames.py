"""A renderer's output: images, and where each vehicle is in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import VehicleBatch

Images = Float[Tensor, "B 3 H W"]


@dataclass(frozen=True)
class Frames:
    """Rendered images; the N placements of all scenes follow each other, scene by scene.

    Attributes:
        image: `[B, 3, H, W]` sRGB in [0, 1].
        scene_index: `[N]` the image each placement is in.
        boxes: `[N, 4]` pixel xyxy around the vehicle without its shadow, cut at the image border.
        centres: `[N, 2]` pixel (x, y) of the vehicle's middle at half its height.
        visible_px: `[N]` samples that show the vehicle inside the image, in pixels.
        visible_fraction: `[N]` share of its samples that are inside the image and not under cover.
        masks: `[N, H, W]` pixels at least half covered by the vehicle, before blur; or None.
    """

    image: Images
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
        differentiable: whether gradients reach textures and vertices.
        concurrent: whether several threads may call it at once.
    """

    name: str
    differentiable: bool
    concurrent: bool

    def record(self, scenes: Sequence[Scene]) -> dict[str, Any]:
        """Returns the settings that its images of these scenes depend on, as plain JSON values."""

    def __call__(
        self, scenes: Sequence[Scene], vehicles: VehicleBatch, *, masks: bool = False
    ) -> Frames:
        """Draws one image per scene."""
