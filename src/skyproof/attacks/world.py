"""What an attack sees: ground, vehicles, light and camera, drawn anew at every step."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec
import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.inference import device_of
from skyproof.errors import ConfigurationError
from skyproof.render.dataset import placed_vehicles
from skyproof.render.frames import Frames, Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch


@dataclass(frozen=True)
class World:
    """What the attack sees, drawn anew at every step.

    Attributes:
        renderer: differentiable, on `backgrounds`.
        backgrounds: their split "attack" is used.
        fleet: vehicles to camouflage.
        scenes: how scenes are drawn; exactly one vehicle an image (section 3.2).
    """

    renderer: Renderer
    backgrounds: BackgroundSet
    fleet: Fleet
    scenes: SceneSettings

    def __post_init__(self) -> None:
        if not self.renderer.differentiable:
            raise ConfigurationError(
                "An attack expects a differentiable renderer; give TorchRenderer."
            )
        if (self.scenes.vehicles_minimum, self.scenes.vehicles_maximum) != (1, 1):
            raise ConfigurationError(
                "An attack expects exactly one vehicle per image; give scenes with one."
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
    ) -> World:
        """Opens a background set and a fleet folder under the differentiable renderer.

        Args:
            backgrounds: background set folder; its resolution is the scenes'.
            fleet: fleet folder.
            size_px: image side.
            conditions: weather and light that scenes are drawn from, each equally likely.
            places: where vehicles stand, as of `SceneSettings`.

        Raises:
            ConfigurationError: scenes cannot be drawn so.
            StoredFileError: a folder is missing or damaged.
        """
        scenes = SceneSettings(
            size_px=size_px, vehicles_maximum=1, places=places, conditions=tuple(conditions)
        )
        photographs = BackgroundSet.open(Path(backgrounds))
        return cls(TorchRenderer(photographs), photographs, Fleet.load(Path(fleet)), scenes)

    @cached_property
    def digest(self) -> str:
        """The SHA-256 of the ground's tiles, as their index has them, and of the vehicles' sizes.

        It tells this world from another of the same settings.
        """
        told = [self.backgrounds.gsd_m, self.backgrounds.tiles("attack"), self.fleet.sizes_m]
        return hashlib.sha256(msgspec.json.encode(told)).hexdigest()

    def draw(self, count: int, *, generator: torch.Generator) -> list[Scene]:
        """Draws random scenes on the attack backgrounds."""
        return sample_scenes(
            self.scenes, self.backgrounds, "attack", self.fleet.sizes_m, count, generator=generator
        )

    def step_scenes(self, count: int, seed: int, step: int) -> list[Scene]:
        """Draws the scenes of one step.

        Those of steps 0, -1, -2 ... are seen by no step of an attack, and serve to measure.
        """
        return self.draw(
            count, generator=torch.Generator().manual_seed((seed * 1_000_003 + step) % 2**63)
        )

    def camouflaged(self, camouflage: Camouflage, scenes: list[Scene]) -> VehicleBatch:
        """Puts the scenes' vehicles into the camouflage, on its device."""
        return camouflage(placed_vehicles(self.fleet, scenes).to(device_of(camouflage)))

    def bare(self, scenes: list[Scene], device: torch.device) -> Frames:
        """Renders the scenes, their vehicles as they are, on a device."""
        return self.renderer(scenes, placed_vehicles(self.fleet, scenes).to(device))

    def frames(self, camouflage: Camouflage, scenes: list[Scene]) -> Frames:
        """Renders the scenes, their vehicles in the camouflage, on its device."""
        return self.renderer(scenes, self.camouflaged(camouflage, scenes))
