"""What `skyproof bench` draws: four procedural tiles, sixteen vehicles, and scenes of them."""

from __future__ import annotations

from pathlib import Path

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.randomness import generator_of
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

_TILE_PX = 560


class BenchGround:
    """Ground and vehicles that are the same in every run.

    Args:
        folder: gets the tiles.
        image_px: the side of an image in pixels.
    """

    def __init__(self, folder: Path, image_px: int) -> None:
        self.image_px = image_px
        self.backgrounds: BackgroundSet = write_procedural_backgrounds(
            folder / "tiles", {"attack": 4}, _TILE_PX, seed=0
        )
        self.fleet: Fleet = sample_fleet(
            FleetSettings(count=16), generator=generator_of(0, "fleet")
        )

    def scenes(self, count: int, *, most: int = 1) -> list[Scene]:
        """Draws scenes of one vehicle, or of up to `most`."""
        return sample_scenes(
            SceneSettings(size_px=self.image_px, vehicles_maximum=most),
            self.backgrounds,
            "attack",
            self.fleet.sizes_m,
            count,
            generator=generator_of(0, "scenes"),
        )
