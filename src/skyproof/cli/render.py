"""`skyproof render`: scenes, sampled or read from a file, rendered to images with labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from skyproof.console import progress_bar, say
from skyproof.cycles.settings import Rendering
from skyproof.errors import ConfigurationError
from skyproof.files import new_file
from skyproof.ranges import Count, Seed
from skyproof.scenes.scene import Scene, read_scenes, write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split

if TYPE_CHECKING:
    from skyproof.scenes.backgrounds import BackgroundSet
    from skyproof.vehicles.fleet import Fleet

_USUAL_SCENES = SceneSettings(size_px=192)


@dataclass(frozen=True, kw_only=True)
class Render(Rendering):
    """Renders scenes to images with COCO labels, with or without a camouflage.

    Without `--scenes` it samples scenes on a split's ground and keeps them as scenes.jsonl. With
    `--renderer cycles` Blender path-traces the same scenes, with the same labels.

    Attributes:
        scenes: scene file, such as scenes.jsonl of a dataset.
        backgrounds: background set folder.
        fleet: fleet folder.
        out: dataset folder to write.
        split: split whose ground sampled scenes use.
        count: number of sampled scenes.
        settings: distribution of sampled scenes.
        seed: seed of sampled scenes.
        camouflage: camouflage folder, if any.
        labels: coco (annotations.json), or yolo for YOLO text as well.
        device: auto, cpu or cuda.
    """

    scenes: Path | None = None
    backgrounds: Path
    fleet: Path
    out: Path
    split: Split = "test"
    count: Count = 120
    settings: SceneSettings = _USUAL_SCENES
    seed: Seed = 0
    camouflage: Path | None = None
    labels: Literal["coco", "yolo"] = "coco"
    device: str = "auto"

    def run(self) -> None:
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.camouflage.random_controls import RandomPatterns
        from skyproof.cycles.renderer import open_renderer
        from skyproof.device import choose_device
        from skyproof.render.dataset import render_dataset
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.vehicles.fleet import Fleet

        self._refuse_sampling_beside_a_file()
        device = choose_device(self.device)
        backgrounds = BackgroundSet.open(self.backgrounds)
        with open_renderer(self, backgrounds, self.out) as renderer:
            fleet = Fleet.load(self.fleet)
            scenes = self._scenes(backgrounds, fleet)
            given = self.camouflage
            camouflage = load_camouflage(given).to(device) if given else RandomPatterns(fleet)
            with progress_bar(f"render {self.out.name}") as update:
                render_dataset(
                    self.out,
                    scenes,
                    fleet,
                    renderer,
                    camouflage=camouflage,
                    yolo=self.labels == "yolo",
                    device=device,
                    progress=update,
                )
        say(f"Dataset: {self.out.resolve()}")

    def _refuse_sampling_beside_a_file(self) -> None:
        names = ("split", "count", "settings", "seed")
        given = [name for name in names if getattr(self, name) != getattr(Render, name)]
        if self.scenes is not None and given:
            raise ConfigurationError(
                f"--{given[0]} is for sampled scenes, and --scenes reads {self.scenes}; leave one "
                "of the two out."
            )

    def _scenes(self, backgrounds: BackgroundSet, fleet: Fleet) -> Sequence[Scene]:
        if self.scenes is not None:
            return read_scenes(self.scenes)
        return sampled_scenes(self.settings, backgrounds, fleet, self.split, self.count, self.seed)


def sampled_scenes(
    settings: SceneSettings,
    backgrounds: BackgroundSet,
    fleet: Fleet,
    split: Split,
    count: int,
    seed: int,
    *,
    name: str | None = None,
) -> list[Scene]:
    """Samples scenes on a split's ground; their ids begin with `name`, or else with the split."""
    from skyproof.randomness import generator_of
    from skyproof.scenes.sampling import sample_scenes

    name = name or split
    generator = generator_of(seed, "scenes", name)
    return sample_scenes(
        settings, backgrounds, split, fleet.sizes_m, count, generator=generator, prefix=name
    )


def draw_scenes(
    backgrounds: Path,
    fleet: Path,
    out: Path,
    split: Split,
    count: int,
    settings: SceneSettings,
    seed: int,
) -> None:
    """Samples scenes on a split's ground, and writes them as JSON lines."""
    from skyproof.scenes.backgrounds import BackgroundSet
    from skyproof.vehicles.fleet import Fleet

    with new_file(out):
        ground, vehicles = BackgroundSet.open(backgrounds), Fleet.load(fleet)
        write_scenes(out, sampled_scenes(settings, ground, vehicles, split, count, seed))
    say(f"Scenes: {out.resolve()}")
