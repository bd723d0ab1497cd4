"""The steps of a reproduction that no other run has, as commands.

Snakemake runs them as `python -m skyproof.reproduction STEP`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

from skyproof.cli.render import usual_scenes
from skyproof.console import progress_bar, say
from skyproof.files import new_file
from skyproof.ranges import Count, Seed
from skyproof.scenes.settings import SceneSettings

if TYPE_CHECKING:
    from skyproof.vehicles.fleet import Fleet

STEPS = {
    "scenes": "skyproof.reproduction.step_commands:Scenes",
    "looks": "skyproof.reproduction.step_commands:Looks",
    "features": "skyproof.reproduction.step_commands:Features",
    "report": "skyproof.reproduction.step_commands:Report",
}


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
    settings: SceneSettings = field(default_factory=usual_scenes)
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


@dataclass(frozen=True, kw_only=True)
class Looks:
    """Measures what camouflages look like on a fleet, and draws samples of them.

    Attributes:
        out: folder to write.
        original: dataset without camouflage, whose first scenes are drawn.
        camouflages: camouflage folders.
        backgrounds: background set of the scenes.
        fleet: fleet of the scenes.
    """

    out: Path
    original: Path
    camouflages: tuple[Path, ...]
    backgrounds: Path
    fleet: Path

    def run(self) -> None:
        """Writes `looks.json` and the sheets of samples."""
        from skyproof.files import finished_folder, write_json
        from skyproof.reproduction.measure_looks import measure_looks
        from skyproof.vehicles.fleet import Fleet

        fleet = Fleet.load(self.fleet)
        vehicles = fleet.batch(fleet.ids)
        with finished_folder(self.out) as partial, progress_bar("looks") as update:
            looks = measure_looks(self.camouflages, vehicles, progress=update)
            looks |= self._draw_samples(partial, fleet)
            write_json(partial / "looks.json", {"vehicles": len(vehicles), **looks})
        say(f"Looks of {len(self.camouflages)} camouflages: {self.out.resolve()}")

    def _draw_samples(self, folder: Path, fleet: Fleet) -> dict[str, list[dict[str, str]]]:
        """Draws some scenes on sheets; returns what they show, as `Looks` has it."""
        from PIL import Image

        from skyproof.camouflage.folder import load_camouflage
        from skyproof.camouflage.name import CamouflageName
        from skyproof.datasets.dataset import Dataset
        from skyproof.files import write_beside
        from skyproof.reproduction.samples import SAMPLES, sample_strips, sensor_strips
        from skyproof.results.score_folder import is_pictured
        from skyproof.scenes.backgrounds import BackgroundSet

        every = Dataset.open(self.original).scenes
        scenes = [scene for scene in every if scene.placements][:SAMPLES]
        if not scenes:
            return {}
        # Of textures, shapes and both the first and the last: from free to most constrained.
        kinds: dict[str, list[Path]] = {}
        for place in self.camouflages:
            name = CamouflageName.read(place.name)
            if is_pictured(name):
                kinds.setdefault(name.kind, []).append(place)
        shown = dict.fromkeys(
            place for places in kinds.values() for place in places[:: len(places) - 1 or 1]
        )
        worn = {place.name: load_camouflage(place) for place in shown}
        backgrounds = BackgroundSet.open(self.backgrounds)
        sheets = {
            "samples": sample_strips(scenes, fleet, backgrounds, worn),
            "sensor": sensor_strips(scenes, fleet, backgrounds),
        }
        told: dict[str, list[dict[str, str]]] = {}
        for sheet, strips in sheets.items():
            told[sheet] = []
            for number, (label, pixels) in enumerate(strips):
                file = f"{sheet}/{number}.png"
                with write_beside(folder / file) as temporary:
                    Image.fromarray(pixels.permute(1, 2, 0).numpy()).save(temporary)
                told[sheet].append({"label": label, "file": file})
        return told


@dataclass(frozen=True, kw_only=True)
class Features:
    """Stores the detectors' features at vehicles, with and without camouflages, and at ground.

    Attributes:
        detectors: detector folders.
        out: Parquet file to write.
        original: dataset without camouflage, whose first scenes are looked at.
        camouflages: camouflage folders.
        backgrounds: background set of the scenes.
        fleet: fleet of the scenes.
        seed: of the places of the ground.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    out: Path
    original: Path
    camouflages: tuple[Path, ...]
    backgrounds: Path
    fleet: Path
    seed: Seed = 0
    device: str = "auto"

    def run(self) -> None:
        """Renders the scenes with each camouflage, and writes the features."""
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.loaded import load_ensemble
        from skyproof.device import choose_device
        from skyproof.files import refuse_existing
        from skyproof.render.dataset import render_dataset
        from skyproof.render.renderer import TorchRenderer
        from skyproof.reproduction.gather_features import MOST_SCENES, gather_features
        from skyproof.reproduction.stored_features import write_features
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.vehicles.fleet import Fleet

        refuse_existing(self.out)
        device = choose_device(self.device)
        original = Dataset.open(self.original)
        detectors = load_ensemble(self.detectors, device, original.gsd_m)
        fleet = Fleet.load(self.fleet)
        renderer = TorchRenderer(BackgroundSet.open(self.backgrounds))
        with TemporaryDirectory() as images:
            camouflaged = {}
            for folder in self.camouflages:
                place = Path(images) / folder.name
                with progress_bar(f"render {folder.name}") as update:
                    render_dataset(
                        place,
                        original.scenes[:MOST_SCENES],
                        fleet,
                        renderer,
                        camouflage=load_camouflage(folder).to(device),
                        device=device,
                        progress=update,
                    )
                camouflaged[folder.name] = Dataset.open(place)
            found = gather_features(detectors, original, camouflaged, seed=self.seed)
        write_features(self.out, found)
        say(f"Features of {len(self.detectors)} detectors: {self.out.resolve()}")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Writes the report of a reproduction, with the paper's tables in it and beside it.

    Attributes:
        out: the run folder.
    """

    out: Path

    def run(self) -> None:
        """Writes the page and the tables."""
        from skyproof.reproduction.report import write_reproduction_report

        say(f"Report: {write_reproduction_report(self.out).resolve()}")
