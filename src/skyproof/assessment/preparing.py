"""The steps before any attack: ground without vehicles, detectors with a threshold, test scenes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from skyproof.assessment.run import START_S, Step
from skyproof.assessment.subject import Subject
from skyproof.camouflage.fleets import draw_fleets
from skyproof.console import progress_bar, say, stage_bars
from skyproof.cycles.opening import open_renderer
from skyproof.cycles.settings import Rendering
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import write_card
from skyproof.detectors.import_checkpoint import Checkpoint, import_detector
from skyproof.detectors.loaded import copy_detector, copy_with_threshold, load_detector
from skyproof.detectors.reference_detectors import detector_folder
from skyproof.files import finished_folder, new_file
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.clear import clear_backgrounds
from skyproof.imagery.clearing.vehicle_masks import VehicleFinder
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.settings import (
    ClearSettings,
    LabelSettings,
    SourceSettings,
    TilingSettings,
    tiling_for_images,
)
from skyproof.imagery.tiles.tiling import tile_imagery
from skyproof.imagery.words import cleared_words, tiling_words
from skyproof.layout import Layout
from skyproof.measure.frames import read_frames
from skyproof.randomness import generator_of
from skyproof.render.dataset import render_dataset
from skyproof.results.findings import findings, verdict
from skyproof.results.precheck import PRECHECK_FILE, read_precheck
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import read_scenes, write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import SPLITS, Split
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from skyproof.vehicles.settings import PaintVariety

YOURS = "your imagery"
VEHICLE_CLASSES = ("vehicle",)

# Of train, validation, attack and test: as many tiles as a suite draws, roughly.
_SHARES = (0.0, 0.25, 0.25, 0.5)

_PUSHED_OUT = 0.25
"""Share of the vehicles of train and validation whose surface is pushed out at random."""

# Seconds on one core: in all, for a million pixels, and for a vehicle; for the time left alone.
_LONG_S = 60.0
_GROUND_S = 2.6
_VEHICLE_S = 0.08
RENDER_S = {"torch": 3.2, "cycles": 30.0}


def prepare(its: Subject) -> Iterator[Step]:
    """Gives the steps to ground without vehicles and to detectors, whichever can come first."""
    request = its.request
    thresholds = [step for number in range(len(its.names)) for step in detector(its, number)]
    if not request.imagery:
        yield drawn_ground(its, its.layout, its.suite.tiles)
        yield from thresholds
        return
    yield tiles(its)
    yield from thresholds
    yield cleared(its)


def tiling_of(its: Subject) -> TilingSettings:
    """Says how imagery is cut: nothing is trained, so that train has no share of it."""
    tiling = tiling_for_images(its.image_px, gsd_m=its.gsd_m, imagery=True)
    return replace(tiling, shares=_SHARES)


def tiles(its: Subject) -> Step:
    """Cuts the imagery into tiles of four splits, with their labels."""
    request, out = its.request, its.layout.tiles
    tiling = tiling_of(its)
    source = SourceSettings(gsd_m=request.gsd)
    wanted = LabelSettings(path=request.labels, classes=request.label_classes)

    def work() -> None:
        labels = None if request.labels is None else (read_labels(request.labels), wanted)
        with finished_folder(out) as folder, progress_bar("ground tiles") as update:
            record = tile_imagery(
                request.imagery,
                folder,
                settings=tiling,
                generator=generator_of(its.seed, "imagery"),
                source_settings=source,
                labels=labels,
                progress=update,
            )
        for line in tiling_words(record, labelled=labels is not None):
            say(line)

    read = its.sources.get(str(request.labels))
    settings = (request.imagery, its.seed, tiling, source, wanted, read)
    return Step("ground", "tiles", (out,), work, settings, effort_s=_LONG_S)


def drawn_ground(
    its: Subject, layout: Layout, counts: tuple[int, int, int, int], title: str = "ground"
) -> Step:
    """Draws ground, so many tiles of each split."""
    tiling = tiling_for_images(its.image_px, gsd_m=its.gsd_m, imagery=False)

    def work() -> None:
        with finished_folder(layout.backgrounds) as folder, progress_bar("ground tiles") as update:
            write_procedural_backgrounds(
                folder,
                dict(zip(SPLITS, counts, strict=True)),
                tiling.size_px,
                seed=its.seed,
                gsd_m=tiling.gsd_m,
                progress=update,
            )

    effort_s = START_S + _GROUND_S * sum(counts) * tiling.size_px**2 / 1e6
    settings = (counts, tiling, its.seed)
    return Step("ground", title, (layout.backgrounds,), work, settings, effort_s=effort_s)


def detector(its: Subject, number: int) -> Iterator[Step]:
    """Brings a detector into the run folder; its threshold is frozen on labels, where possible."""
    name = its.names[number]
    place = None if its.black_box is not None else its.request.detectors[number]
    stored = place is not None and detector_folder(place).is_dir()
    if place is not None and stored:
        yield frozen_on_labels(its, name, place) if its.labelled else copied(its, name, place)
    elif its.labelled:
        yield brought(its, name, place, its.layout.tiles / "validation")
    else:
        # Without labels, a threshold that is not there is frozen on rendered vehicles.
        world = Layout(its.layout.folder / "threshold")
        counts = (1, its.suite.tiles[1], 1, 1)
        yield drawn_ground(its, world, counts, "threshold-ground")
        yield fleets(its, world, "threshold-fleets")
        yield scenes(its, world, "validation", "threshold-validation")
        yield rendered(its, world, "validation", "threshold-validation")
        yield brought(its, name, place, world.dataset("validation"))


def copied(its: Subject, name: str, place: Path) -> Step:
    """Copies a detector folder, with its precheck where the suite has none of its own."""
    folder, out = detector_folder(place), its.layout.detector(name)
    also = ["steps.jsonl", *([] if its.suite.check_scenes else [PRECHECK_FILE])]

    def work() -> None:
        load_detector(folder)
        with finished_folder(out) as partial:
            copy_detector(folder, partial, also)

    settings = (its.sources.get(str(place)), also)
    return Step("detector", name, (out / "detector.json",), work, settings)


def frozen_on_labels(its: Subject, name: str, place: Path) -> Step:
    """Copies a detector with the lowest threshold within a point of the best F1 on the labels."""
    folder, out = detector_folder(place), its.layout.detector(name)
    shown = f"{YOURS}={its.layout.tiles / 'validation'}@{its.gsd_m}"

    def work() -> None:
        frames = read_frames((shown,), VEHICLE_CLASSES, its.gsd_m)
        labelled = {each.name: each.images for each in frames}
        say(copy_with_threshold(folder, labelled, out, its.device))

    settings = (its.sources.get(str(place)), its.gsd_m)
    return Step("threshold", name, (out / "detector.json",), work, settings, effort_s=_LONG_S)


def brought(its: Subject, name: str, place: Path | None, validation: Path) -> Step:
    """Imports a checkpoint or takes a black box, with a threshold frozen on these images."""
    request, out = its.request, its.layout.detector(name)

    def work() -> None:
        images = Dataset.open(validation)
        if place is None:
            assert its.black_box is not None
            its.black_box.freeze(images)
            card = its.black_box.card
            out.mkdir(parents=True, exist_ok=True)
            write_card(out / "detector.json", card)
        else:
            kind = "torchvision" if request.architecture else "ultralytics"
            checkpoint = Checkpoint(place, kind, request.vehicle_classes, request.architecture)
            card = import_detector(checkpoint, images, out, name=name, device=its.device)
        say(
            f"Validation AP (centre within 1 m) {card.validation['ap_centre_1m']:.3f}, threshold "
            f"{card.threshold:.3f}."
        )
        for doubt in card.doubts:
            say(f"Warning: {doubt}")

    read = its.sources.get(str(place))
    settings = (read, request.vehicle_classes, request.architecture, validation)
    kind = "threshold" if place is None else "import"
    return Step(kind, name, (out / "detector.json",), work, settings, effort_s=_LONG_S)


def cleared(its: Subject) -> Step:
    """Removes the vehicles from the tiles; of several detectors, the second checks the first."""
    folders = [its.layout.detector(name) for name in its.names[:2]]

    def work() -> None:
        finder, *others = [
            VehicleFinder.of_folder(its.load(folder), folder, its.device) for folder in folders
        ]
        checker: VehicleFinder | None = others[0] if others else finder
        if _failed_precheck(folders[-1]):
            say(f"{its.names[-1]} failed its precheck: it cannot tell that no vehicle is left.")
            checker = None
        with finished_folder(its.layout.backgrounds) as partial, stage_bars("vehicles") as update:
            record = clear_backgrounds(
                its.layout.tiles,
                partial,
                ClearSettings(),
                finder=finder,
                checker=checker,
                progress=update,
            )
        for line in cleared_words(record, its.layout.backgrounds, checked=checker is not None):
            say(line)

    return Step("clear", "clear", (its.layout.backgrounds,), work, its.names, effort_s=_LONG_S)


def _failed_precheck(folder: Path) -> bool:
    place = folder / PRECHECK_FILE
    return place.is_file() and verdict(findings(read_precheck(folder))) == "failed"


def fleets(its: Subject, layout: Layout, title: str = "fleets") -> Step:
    """Draws the vehicles of the four splits."""
    counts = its.suite.vehicles
    drawn = FleetSettings(paints=PaintVariety(), shapes=_PUSHED_OUT)

    def work() -> None:
        draw_fleets(layout.fleets, counts, drawn, its.seed, sample_fleet)

    effort_s = START_S + _VEHICLE_S * sum(counts)
    settings = (counts, drawn, its.seed)
    return Step("vehicles", title, (layout.fleets,), work, settings, effort_s=effort_s)


def scenes(its: Subject, layout: Layout, split: Split, title: str = "") -> Step:
    """Draws the scenes of a split."""
    # Only the run's own ground was cut from imagery.
    places = its.places if layout == its.layout else "uniform"
    settings = SceneSettings(size_px=its.image_px, places=places)
    count, out = its.suite.test_images, layout.scenes(split)

    def work() -> None:
        with new_file(out):
            drawn = sample_scenes(
                settings,
                BackgroundSet.open(layout.backgrounds),
                split,
                Fleet.load(layout.fleets / split).sizes_m,
                count,
                generator=generator_of(its.seed, "scenes", split),
                prefix=split,
            )
            write_scenes(out, drawn)

    return Step("scenes", title or split, (out,), work, (settings, count, its.seed))


def rendered(
    its: Subject, layout: Layout, split: Split, title: str = "", rendering: Rendering | None = None
) -> Step:
    """Renders the scenes of a split without camouflage, by either renderer."""
    chosen = rendering or Rendering()
    title = title or (split if rendering is None else f"{split}-{chosen.renderer}")
    out = layout.dataset(split if rendering is None else title)

    def work() -> None:
        backgrounds = BackgroundSet.open(layout.backgrounds)
        with (
            open_renderer(chosen, backgrounds, out) as renderer,
            progress_bar(f"render {out.name}") as update,
        ):
            render_dataset(
                out,
                read_scenes(layout.scenes(split)),
                Fleet.load(layout.fleets / split),
                renderer,
                device=its.device,
                progress=update,
            )

    effort_s = START_S + RENDER_S[chosen.renderer] * its.test_megapixels
    extra = rendering is not None
    return Step("render", title, (out,), work, chosen, extra=extra, effort_s=effort_s)
