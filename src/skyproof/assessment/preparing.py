"""The steps before any attack: ground without vehicles, detectors with a threshold, test scenes."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from skyproof.assessment.run import GROUND_S, RENDER_S, START_S, VEHICLE_S, Step
from skyproof.assessment.subject import ENOUGH_PLACES, Subject
from skyproof.cli.clear import FAILED, clear_tiles, failed_precheck
from skyproof.cli.ground import Ground
from skyproof.cli.import_detector import Import, say_card
from skyproof.cli.precheck import Precheck
from skyproof.cli.render import Render, draw_scenes
from skyproof.cli.vehicles import Vehicles, draw_fleets
from skyproof.console import say
from skyproof.cycles.settings import Rendering
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import detector_folder, write_card
from skyproof.detectors.import_checkpoint import kind_of
from skyproof.detectors.loaded import copy_detector, load_detector
from skyproof.files import finished_folder
from skyproof.imagery.clearing.footprints import worn_paints
from skyproof.imagery.clearing.vehicle_masks import VehicleFinder
from skyproof.imagery.settings import LabelSettings, TilingSettings, tiling_for_images
from skyproof.layout import Layout
from skyproof.results.precheck import PRECHECK_FILE
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.words import counted

Shown = Literal[Split, "empty"]
YOURS = "your imagery"
VEHICLE_CLASSES = ("vehicle",)

# Train, validation, attack and test: roughly the shares of a suite's drawn tiles.
_SHARES = (0.0, 0.25, 0.25, 0.5)

_FEWEST_LABELS = 20
"""Fewest labelled vehicles to take a fleet's paints from, and to freeze a detector's threshold on.
A share of a fifth, such as that of a colour, is then known to 9 points (standard deviation)."""

_FEW = (
    "labels give fewer sunlit places with a heading than "
    f"{ENOUGH_PLACES['test']} on test and {ENOUGH_PLACES['attack']} on attack tiles"
)
_STAND = {
    "removed": "vehicles stand where labelled ones stood",
    "drivable": "vehicles stand on drivable ground, because {why}",
    "uniform": "vehicles stand anywhere, even on roofs, because {why}, and drivable ground was not "
    "found",
}

_LONG_S = 60.0
"""Estimated seconds, on one core, of steps without an estimate of their own."""


def prepare(its: Subject) -> Iterator[Step]:
    """Yields the steps that prepare detectors, and ground without vehicles."""
    imagery = bool(its.request.imagery)
    yield tiles(its) if imagery else drawn_ground(its, its.layout, its.suite.tiles)
    for name, place in zip(its.names, its.request.detectors, strict=True):
        yield from detector(its, name, place)
    if imagery:
        yield cleared(its)


def tiling_of(its: Subject) -> TilingSettings:
    """Returns the tiling of imagery; nothing is trained, so the train split gets no tiles."""
    return replace(tiling_for_images(its.image_px, gsd_m=its.gsd_m, imagery=True), shares=_SHARES)


def tiles(its: Subject) -> Step:
    """Cuts the imagery into tiles of four splits, with their labels."""
    request, out = its.request, its.layout.tiles
    source = its.source_settings
    labels = LabelSettings(path=request.labels, classes=request.label_classes)
    tiling = tiling_of(its)
    cut = Ground(out, request.imagery, seed=its.seed, tiling=tiling, source=source, labels=labels)
    read = its.sources.get(str(request.labels))
    settings = (request.imagery, its.seed, tiling, source, labels, read)

    def work() -> None:
        cut.run(its.inspected, its.told)

    return Step("ground", "tiles", (out,), work, settings, effort_s=_LONG_S)


def drawn_ground(
    its: Subject, layout: Layout, counts: tuple[int, int, int, int], title: str = "ground"
) -> Step:
    """Draws ground, with a number of tiles per split."""
    out = layout.backgrounds
    tiling = tiling_for_images(its.image_px, gsd_m=its.gsd_m, imagery=False)
    draw = Ground(out, tiles=counts, seed=its.seed, tiling=tiling)
    effort_s = START_S + GROUND_S * sum(counts) * tiling.size_px**2 / 1e6
    return Step("ground", title, (out,), draw.run, (counts, tiling, its.seed), effort_s=effort_s)


def detector(its: Subject, name: str, place: Path) -> Iterator[Step]:
    """Yields the steps that add a detector to the run; labels, if any, freeze its threshold."""
    if its.black_box is None and detector_folder(place).is_dir():
        yield frozen_on_labels(its, name, place) if its.labelled else copied(its, name, place)
    elif its.labelled:
        yield brought(its, name, place, its.layout.tiles / "validation")
    else:
        # Without labels, rendered vehicles freeze a missing threshold.
        world = Layout(its.layout.folder / "threshold")
        yield drawn_ground(its, world, (1, its.suite.tiles[1], 1, 1), "threshold-ground")
        yield fleets(its, world, "threshold-fleets")
        yield scenes(its, world, "validation", "threshold-validation")
        yield rendered(its, world, "validation", "threshold-validation")
        yield brought(its, name, place, world.dataset("validation"))


def copied(its: Subject, name: str, place: Path) -> Step:
    """Copies a detector folder, with its precheck if the suite has none."""
    folder, out = detector_folder(place), its.layout.detector(name)
    also = ["steps.jsonl", *([] if its.suite.check_scenes else [PRECHECK_FILE])]

    def work() -> None:
        load_detector(folder)
        with finished_folder(out) as partial:
            copy_detector(folder, partial, also)

    settings = (its.sources.get(str(place)), also)
    return Step("detector", name, (out / "detector.json",), work, settings)


def frozen_on_labels(its: Subject, name: str, place: Path) -> Step:
    """Copies a detector with its threshold frozen on the labels, or its own if these are few."""
    out, kept = its.layout.detector(name), copied(its, name, place)
    freeze = Precheck(
        (detector_folder(place),),
        frames=(f"{YOURS}={its.layout.tiles / 'validation'}@{its.gsd_m}",),
        frame_classes=VEHICLE_CLASSES,
        freeze=out,
        device=its.request.device,
    )

    def work() -> None:
        count = sum(map(len, Dataset.open(its.layout.tiles / "validation").boxes))
        if count >= _FEWEST_LABELS:
            freeze.run()
            return
        say(
            f"  note: {counted(count, 'labelled vehicle')} on validation tiles cannot choose a "
            f"threshold, which takes {_FEWEST_LABELS}, so {name} keeps its own"
        )
        kept.work()

    settings = (its.sources.get(str(place)), its.gsd_m)
    return Step("threshold", name, (out / "detector.json",), work, settings, effort_s=_LONG_S)


def brought(its: Subject, name: str, place: Path, validation: Path) -> Step:
    """Imports a checkpoint or adds a black-box detector, with a threshold frozen on images."""
    request, out = its.request, its.layout.detector(name)

    def work() -> None:
        if its.black_box is not None:
            its.black_box.freeze(Dataset.open(validation))
            write_card(out / "detector.json", its.black_box.card)
            say_card(its.black_box.card, out)
            return
        path = detector_folder(place)
        Import(
            path,
            kind_of(path, request.architecture),
            request.vehicle_classes,
            validation,
            out,
            architecture=request.architecture,
            name=name,
            device=request.device,
        ).run()

    read = its.sources.get(str(place))
    # An ONNX file resizes images itself.
    form = request.architecture if its.black_box is None else request.detector_gsd
    settings = (read, request.vehicle_classes, form, validation)
    kind = "import" if its.black_box is None else "threshold"
    return Step(kind, name, (out / "detector.json",), work, settings, effort_s=_LONG_S)


def cleared(its: Subject) -> Step:
    """Removes the vehicles from the tiles; the second of several detectors checks the first."""
    folders = [its.layout.detector(name) for name in its.names[:2]]

    def work() -> None:
        detectors = [(its.load(folder), folder) for folder in folders]
        finders = [VehicleFinder.of_folder(*each, its.device) for each in detectors]
        checker: VehicleFinder | None = finders[-1]
        if failed_precheck(folders[-1]):
            say(f"{its.names[-1]} {FAILED}.")
            checker = None
        clear_tiles(its.layout.tiles, its.layout.backgrounds, finders[0], checker)

    return Step("clear", "clear", (its.layout.backgrounds,), work, its.names, effort_s=_LONG_S)


def fleets(its: Subject, layout: Layout, title: str = "fleets") -> Step:
    """Draws the vehicles of the four splits, in labelled vehicles' paints if enough show theirs."""
    counts = its.suite.vehicles
    draw = Vehicles(layout.fleets, counts=counts, seed=its.seed)
    effort_s = START_S + VEHICLE_S * sum(counts)
    drawn = FleetSettings(paints=draw.paints, shapes=draw.shapes)
    of_place = its.labelled and layout == its.layout

    def work() -> None:
        worn = None
        if of_place:
            worn = worn_paints(*map(BackgroundSet.open, (layout.tiles, layout.backgrounds)))
            if len(worn) < _FEWEST_LABELS:
                say(
                    f"  note: {counted(len(worn), 'labelled vehicle')} show their paint, and "
                    f"{_FEWEST_LABELS} are enough, so vehicles have the usual paints"
                )
                worn = None
        draw_fleets(layout.fleets, counts, drawn, its.seed, partial(sample_fleet, worn=worn))

    settings = (counts, drawn, its.seed, of_place)
    return Step("vehicles", title, (layout.fleets,), work, settings, effort_s=effort_s)


def _ground(split: Shown) -> Split:
    """Returns the split that provides the ground and vehicles of scenes."""
    return "test" if split == "empty" else split


def _images(its: Subject, split: Shown) -> int:
    return its.suite.empty_images if split == "empty" else its.suite.test_images


def scenes(its: Subject, layout: Layout, split: Shown, title: str = "") -> Step:
    """Draws the scenes of a split; "empty" are test scenes without vehicles."""
    count, out, ground = _images(its, split), layout.scenes(split), _ground(split)

    def work() -> None:
        images = count
        if split == "empty":
            # More images than tiles have room for would show the same false alarms again.
            tiles = BackgroundSet.open(layout.backgrounds).tiles(ground)
            area_px = sum(tile.width_px * tile.height_px for tile in tiles)
            images = min(count, math.ceil(area_px / its.image_px**2))
        # Only the run's own ground was cut from imagery.
        places: Places = "uniform"
        if layout == its.layout and its.request.imagery:
            places = its.places
            why = _FEW if its.labelled else "there are no labels"
            if split != "empty":
                say(f"  note: {_STAND[places].format(why=why)}")
        settings = SceneSettings(
            size_px=its.image_px, places=places, empty_share=float(split == "empty")
        )
        fleet = layout.fleets / ground
        draw_scenes(
            layout.backgrounds, fleet, out, ground, count=images, settings=settings, seed=its.seed
        )

    return Step("scenes", title or split, (out,), work, (its.image_px, count, its.seed))


def rendered(
    its: Subject, layout: Layout, split: Shown, title: str = "", rendering: Rendering | None = None
) -> Step:
    """Renders the scenes of a split without camouflage, by either renderer."""
    chosen = rendering or Rendering()
    title = title or (split if rendering is None else f"{split}-{chosen.renderer}")
    out = layout.dataset(split if rendering is None else title)
    render = Render(
        **vars(chosen),
        scenes=layout.scenes(split),
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / _ground(split),
        out=out,
        device=its.request.device,
    )
    effort_s = START_S + RENDER_S[chosen.renderer] * its.megapixels(_images(its, split))
    extra = rendering is not None
    return Step("render", title, (out,), render.run, chosen, extra=extra, effort_s=effort_s)
