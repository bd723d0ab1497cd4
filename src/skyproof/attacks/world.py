"""The world of an attack: ground, vehicles, light and camera, drawn anew at every step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.random_controls import RandomPatterns
from skyproof.detectors.batches import Batch
from skyproof.detectors.inference import device_of
from skyproof.errors import ConfigurationError
from skyproof.files import value_digest
from skyproof.render.dataset import placed_vehicles
from skyproof.render.frames import Frames, Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from skyproof.vehicles.fleet import Fleet


@dataclass(frozen=True)
class World:
    """The scenes of an attack, drawn anew at every step.

    Attributes:
        renderer: differentiable, on `backgrounds`.
        backgrounds: attacks use their split "attack".
        fleet: vehicles to camouflage.
        scenes: distribution of the scenes; attacks expect exactly one vehicle per image (section
            3.2).
        split: split of the ground.
    """

    renderer: Renderer
    backgrounds: BackgroundSet
    fleet: Fleet
    scenes: SceneSettings
    split: Split = "attack"

    def __post_init__(self) -> None:
        if not self.renderer.differentiable:
            raise ConfigurationError(
                "An attack expects a differentiable renderer; give TorchRenderer."
            )

    @classmethod
    def open(
        cls,
        backgrounds: str | Path,
        fleet: str | Path,
        *,
        size_px: int = 384,
        conditions: Sequence[str] = ("clear",),
        places: Places = "uniform",
        split: Split = "attack",
    ) -> "World":
        """Opens a background set and a fleet folder under the differentiable renderer.

        The background set gives the resolution. `size_px` is the image side, `conditions` and
        `places` are those of `SceneSettings`.

        Raises:
            ConfigurationError: the settings of the scenes contradict each other.
            StoredFileError: a folder is missing or damaged.
        """
        scenes = SceneSettings(
            size_px=size_px, vehicles_maximum=1, places=places, conditions=tuple(conditions)
        )
        photographs = BackgroundSet.open(Path(backgrounds))
        return cls(TorchRenderer(photographs), photographs, Fleet.load(Path(fleet)), scenes, split)

    @cached_property
    def digest(self) -> str:
        """The SHA-256 of the index of the ground's tiles and of the vehicles' sizes."""
        ground = self.backgrounds
        return value_digest([ground.gsd_m, ground.tiles(self.split), self.fleet.sizes_m])

    @property
    def gsd_m(self) -> float:
        """Metres per pixel of its images."""
        return self.backgrounds.gsd_m

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of its images."""
        return self.scenes.size_px, self.scenes.size_px

    def draw(self, count: int, *, generator: torch.Generator) -> list[Scene]:
        """Draws random scenes on the ground of the split."""
        return sample_scenes(
            self.scenes,
            self.backgrounds,
            self.split,
            self.fleet.sizes_m,
            count,
            generator=generator,
        )

    def step_scenes(self, count: int, seed: int, step: int) -> list[Scene]:
        """Draws the scenes of one step of an attack; steps 0, -1, -2 ... serve to measure."""
        if (self.scenes.vehicles_minimum, self.scenes.vehicles_maximum) != (1, 1):
            raise ConfigurationError(
                "An attack expects exactly one vehicle per image; give scenes with one."
            )
        return self.draw(
            count, generator=torch.Generator().manual_seed((seed * 1_000_003 + step) % 2**63)
        )

    def frames(
        self,
        camouflage: Camouflage | None,
        scenes: Sequence[Scene],
        device: torch.device | None = None,
    ) -> Frames:
        """Renders the scenes, on the camouflage's device, or without camouflage on `device`."""
        vehicles = placed_vehicles(self.fleet, scenes)
        if camouflage is None:
            return self.renderer(scenes, vehicles.to(device or "cpu"))
        return self.renderer(scenes, camouflage(vehicles.to(device_of(camouflage))))

    def for_training(self, empty_share: float = 0.0) -> "World":
        """Returns the same world with the scenes of `SceneSettings.for_training`."""
        scenes = self.scenes.for_training(self.backgrounds.gsd_m, empty_share)
        return replace(self, scenes=scenes)

    @torch.no_grad()
    def images(self, count: int, *, generator: torch.Generator, device: torch.device) -> Batch:
        """Renders new scenes on `device`, with random patterns on some vehicles."""
        scenes = self.draw(count, generator=generator)
        vehicles = RandomPatterns(self.fleet)(placed_vehicles(self.fleet, scenes).to(device))
        frames = self.renderer(scenes, vehicles)
        return frames.image, boxes_in_sight(frames)


def boxes_in_sight(frames: Frames) -> list[Float[Tensor, "_n 4"]]:
    """The boxes of each image; one of a vehicle out of sight would make the loss infinite."""
    boxes = frames.boxes.detach()
    seen = (boxes[:, 2:] > boxes[:, :2]).all(dim=1)
    return [boxes[seen & (frames.scene_index == row)] for row in range(len(frames.image))]
