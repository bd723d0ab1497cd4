"""The work of the steps that only a reproduction has: scenes, looks, features, report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from skyproof.console import progress_bar, say
from skyproof.files import new_file
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split

if TYPE_CHECKING:
    from skyproof.vehicles.fleet import Fleet


def draw_scenes(
    *,
    backgrounds: Path,
    fleet: Path,
    out: Path,
    split: Split,
    count: int,
    settings: SceneSettings,
    seed: int,
) -> None:
    """Samples scenes on a split's ground, and writes them as JSON lines."""
    from skyproof.randomness import generator_of
    from skyproof.scenes.backgrounds import BackgroundSet
    from skyproof.scenes.sampling import sample_scenes
    from skyproof.scenes.scene import write_scenes
    from skyproof.vehicles.fleet import Fleet

    with new_file(out):
        scenes = sample_scenes(
            settings,
            BackgroundSet.open(backgrounds),
            split,
            Fleet.load(fleet).sizes_m,
            count,
            generator=generator_of(seed, "scenes", split),
            prefix=split,
        )
        write_scenes(out, scenes)
    say(f"Scenes: {out.resolve()}")


def write_looks(
    *, out: Path, original: Path, camouflages: Sequence[Path], backgrounds: Path, fleet: Path
) -> None:
    """Measures what camouflages look like on a fleet: `looks.json` and sheets of samples.

    Args:
        out: folder to write.
        original: dataset without camouflage, whose first scenes are drawn.
        camouflages: camouflage folders.
        backgrounds: background set of the scenes.
        fleet: fleet of the scenes.
    """
    from skyproof.files import finished_folder, write_json
    from skyproof.reproduction.measure_looks import measure_looks
    from skyproof.vehicles.fleet import Fleet

    vehicles_of = Fleet.load(fleet)
    vehicles = vehicles_of.batch(vehicles_of.ids)
    with finished_folder(out) as partial, progress_bar("looks") as update:
        looks = measure_looks(camouflages, vehicles, progress=update)
        looks |= _draw_samples(partial, original, camouflages, backgrounds, vehicles_of)
        write_json(partial / "looks.json", {"vehicles": len(vehicles), **looks})
    say(f"Looks of {len(camouflages)} camouflages: {out.resolve()}")


def _draw_samples(
    folder: Path, original: Path, camouflages: Sequence[Path], backgrounds: Path, fleet: Fleet
) -> dict[str, list[dict[str, str]]]:
    """Draws some scenes on sheets; returns what they show, as `Looks` has it."""
    from PIL import Image

    from skyproof.camouflage.folder import load_camouflage
    from skyproof.camouflage.name import CamouflageName
    from skyproof.datasets.dataset import Dataset
    from skyproof.files import write_beside
    from skyproof.reproduction.samples import SAMPLES, sample_strips, sensor_strips
    from skyproof.results.score_folder import is_pictured
    from skyproof.scenes.backgrounds import BackgroundSet

    every = Dataset.open(original).scenes
    scenes = [scene for scene in every if scene.placements][:SAMPLES]
    if not scenes:
        return {}
    # Of textures, shapes and both the first and the last: from free to most constrained.
    kinds: dict[str, list[Path]] = {}
    for place in camouflages:
        name = CamouflageName.read(place.name)
        if is_pictured(name):
            kinds.setdefault(name.kind, []).append(place)
    shown = dict.fromkeys(
        place for places in kinds.values() for place in places[:: len(places) - 1 or 1]
    )
    loaded = {place.name: load_camouflage(place) for place in shown}
    ground = BackgroundSet.open(backgrounds)
    sheets = {
        "samples": sample_strips(scenes, fleet, ground, loaded),
        "sensor": sensor_strips(scenes, fleet, ground),
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


def store_features(
    *,
    detectors: Sequence[Path],
    out: Path,
    original: Path,
    camouflages: Sequence[Path],
    backgrounds: Path,
    fleet: Path,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """Stores detectors' features at vehicles, with and without camouflages, and at ground.

    Args:
        detectors: detector folders.
        out: Parquet file to write.
        original: dataset without camouflage, whose first scenes are rendered.
        camouflages: camouflage folders.
        backgrounds: background set of the scenes.
        fleet: fleet of the scenes.
        seed: seed of the places of the ground.
        device: auto, cpu or cuda.
    """
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

    refuse_existing(out)
    place = choose_device(device)
    dataset = Dataset.open(original)
    loaded = load_ensemble(detectors, place, dataset.gsd_m)
    vehicles = Fleet.load(fleet)
    renderer = TorchRenderer(BackgroundSet.open(backgrounds))
    with TemporaryDirectory() as images:
        camouflaged = {}
        for folder in camouflages:
            rendered = Path(images) / folder.name
            with progress_bar(f"render {folder.name}") as update:
                render_dataset(
                    rendered,
                    dataset.scenes[:MOST_SCENES],
                    vehicles,
                    renderer,
                    camouflage=load_camouflage(folder).to(place),
                    device=place,
                    progress=update,
                )
            camouflaged[folder.name] = Dataset.open(rendered)
        found = gather_features(loaded, dataset, camouflaged, seed=seed)
    write_features(out, found)
    say(f"Features of {len(detectors)} detectors: {out.resolve()}")


def write_report(*, out: Path) -> None:
    """Writes the report of the run folder `out`, with the paper's tables in it and beside it."""
    from skyproof.reproduction.report import write_reproduction_report

    say(f"Report: {write_reproduction_report(out).resolve()}")
