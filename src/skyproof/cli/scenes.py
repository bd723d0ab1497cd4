"""`skyproof scenes`: scenes on a split's ground, as a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from skyproof.cli.console import say
from skyproof.files import new_file
from skyproof.ranges import Count, Seed
from skyproof.scenes.settings import SceneSettings


def _usual_settings() -> SceneSettings:
    return SceneSettings(size_px=192)


@dataclass(frozen=True)
class Scenes:
    """Samples scenes on a split's ground: which window, camera, sun, weather, and vehicles where.

    Attributes:
        backgrounds: background set folder; it also says how many metres a pixel has.
        fleet: fleet folder.
        out: scene file (JSON lines) to write.
        split: which ground of the background set the scenes lie on.
        count: how many scenes.
        settings: how they are drawn.
        seed: decides every draw.
    """

    backgrounds: Path
    fleet: Path
    out: Path
    split: Literal["train", "validation", "attack", "test"] = "test"
    count: Count = 120
    settings: SceneSettings = field(default_factory=_usual_settings)
    seed: Seed = 0

    def run(self) -> None:
        """Samples the scenes and writes them."""
        from skyproof.randomness import generator_of
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.scenes.sampling import sample_scenes
        from skyproof.scenes.scene import write_scenes
        from skyproof.vehicles.fleet import Fleet

        with new_file(self.out):
            scenes = sample_scenes(
                self.settings,
                BackgroundSet.open(self.backgrounds),
                self.split,
                Fleet.load(self.fleet).sizes_m,
                self.count,
                generator=generator_of(self.seed, "scenes", self.split),
                prefix=self.split,
            )
            write_scenes(self.out, scenes)
        say(f"Scenes: {self.out.resolve()}")
