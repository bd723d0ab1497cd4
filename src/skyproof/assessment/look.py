"""The first look at imagery, labels and detectors before any work, and the plan of a test."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import numpy as np
from shapely import Polygon, box, union_all

from skyproof.assessment.judging import refuse_few_tiles
from skyproof.assessment.preparing import tiling_of
from skyproof.assessment.run import Step
from skyproof.assessment.subject import REFERENCE_GSD_M, Subject
from skyproof.console import duration
from skyproof.cycles.blender import find_blender
from skyproof.detectors.card import detector_folder
from skyproof.detectors.import_checkpoint import Checkpoint, kind_of, read_network
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ImageryError, SkyproofError
from skyproof.files import refuse_unwritable
from skyproof.imagery.exif import exif_words
from skyproof.imagery.labels.label import GroundLabels, Labels
from skyproof.imagery.settings import LabelSettings
from skyproof.imagery.tiles.georeference import system_of, to_reference_system
from skyproof.imagery.tiles.grid import Cell, Grid, cells_of, lay_grids
from skyproof.imagery.tiles.placed_labels import PlacedLabels, vehicle_classes
from skyproof.imagery.tiles.sources import Source, notes_on
from skyproof.imagery.tiles.tiling import refuse_too_few
from skyproof.imagery.tiles.whole_cells import outline_of
from skyproof.imagery.words import merged_notes
from skyproof.results.statistics.acceptance import fewest_tiles
from skyproof.results.statistics.planning import (
    Assumptions,
    expected_half_width,
    tiles_needed,
    tiles_to_decide,
    tiles_to_show,
)
from skyproof.words import counted, percent, span

_LENGTHS_M = (3.0, 7.0)
"""Plausible median lengths of labelled vehicles at the right resolution; cars are 4.5 m long."""

_FEW = 5
"""Fewest labels whose median is taken seriously."""

_FEW_ON_TILES = 40
"""With so many labelled vehicles, validation and test tiles almost certainly both hold some."""

_VEHICLES = 3
"""Mean number in a test scene."""
_EASR = 0.8
_CORRELATION = 0.1
"""Assumed correlation of vehicles on one tile."""
_HALF_WIDTH = 0.05
_CLEAR_S = 0.6
"""Estimated seconds on one core to clear a tile."""


def first_look(its: Subject, steps: Sequence[Step]) -> list[str]:
    """Describes imagery and labels, the limits of the results, and the size and time of the test.

    Raises:
        SkyproofError: names every mistake that shows in options and files.
    """
    request = its.request
    mistakes: list[SkyproofError] = []
    test_tiles, sentences = its.suite.tiles[3], list[str]()
    with _noted(mistakes):
        refuse_unwritable(request.out)
    with _noted(mistakes):
        if request.cycles:
            find_blender(request.blender)
    for place in () if its.black_box is not None else request.detectors:
        with _noted(mistakes):
            _look_at_detector(its, place)
    with _noted(mistakes):
        if request.imagery:
            test_tiles, sentences = _look_at_imagery(its, mistakes)
    if len(mistakes) == 1:
        raise mistakes[0]
    if mistakes:
        raise type(mistakes[0])(" ".join(map(str, mistakes)))
    return [*sentences, *limits(its), *_plan(its, test_tiles, steps)]


def limits(its: Subject) -> Iterator[str]:
    """Yields the limits of this run's results, in sentences."""
    request = its.request
    if not request.imagery:
        yield "without --imagery, ground is drawn, so the result says nothing about your sites"
    elif not its.labelled:
        yield (
            "without --labels, the threshold is not chosen on photographs, only detected vehicles "
            "are cleared, and the AP on real vehicles is unknown"
        )
    if request.imagery and request.requirement is None:
        yield "without --accept and --reject, there is no verdict"
    if not its.fits_reference:
        yield (
            f"the detector sees {its.gsd_m:g} m per pixel, and the reference detectors, which "
            f"start query attacks, see {REFERENCE_GSD_M}: query attacks are left out, so gradient "
            "masking is not tested"
        )
    elif len(its.names) > 1 and its.suite.compared:
        yield "gradient masking is tested only if a detector is assessed alone"


def _look_at_detector(its: Subject, place: Path) -> None:
    """Loads a detector folder or a checkpoint now, because steps load it only after hours."""
    request = its.request
    path = detector_folder(place)
    if path.is_dir():
        load_detector(place)
        return
    kind = kind_of(path, request.architecture)
    checkpoint = Checkpoint(path, kind, request.vehicle_classes, request.architecture)
    read_network(checkpoint, 1.0, its.names[0])


@contextmanager
def _noted(mistakes: list[SkyproofError]) -> Iterator[None]:
    """Collects a mistake and goes on, so that a user learns of all mistakes at once."""
    try:
        yield
    except SkyproofError as error:
        mistakes.append(error)


def _look_at_imagery(its: Subject, mistakes: list[SkyproofError]) -> tuple[int, list[str]]:
    request = its.request
    tiling = tiling_of(its)
    notes: list[str] = []
    sources = its.inspected
    grids: list[Grid] = []
    cells: list[Cell] = []
    with _noted(mistakes):
        grids = lay_grids(sources, tiling, notes)
        cells = [cell for grid in grids for cell in cells_of(grid)]
        refuse_too_few(len(cells), tiling)
    test_tiles = max(1, round(len(cells) * tiling.shares[3]))
    sentences: list[str] = []
    if cells:
        its.told.extend([*notes_on(sources), *notes])
        exif = exif_words([source.exif for source in sources])
        sentences += [_imagery(sources, cells), *exif, *merged_notes(its.told)]
    with _noted(mistakes):
        if its.labels is not None:
            settings = LabelSettings(request.labels, request.label_classes)
            placed = PlacedLabels(its.labels, settings, sources, cells) if cells else None
            # A wrong resolution may be why no tile fits.
            sentences.append(_labels(its.labels, settings, grids, its))
            if placed is not None:
                its.told.extend(placed.notes)
                sentences += [*_on_tiles(placed, cells), *merged_notes(placed.notes)]
    with _noted(mistakes):
        if request.requirement is not None and cells:
            said = f"The imagery holds at most {counted(test_tiles, 'test tile')}"
            refuse_few_tiles(said, test_tiles, request.requirement, its.suite.test_images)
    return test_tiles, sentences


def _imagery(sources: Sequence[Source], cells: Sequence[Cell]) -> str:
    places = [source.georeference for source in sources]
    gsds_cm = [100 * (math.hypot(*place.gsd_m) / math.sqrt(2)) for place in places]
    placed = sum(place.crs is not None for place in places)
    widths = [source.width_px * source.georeference.gsd_m[0] for source in sources]
    heights = [source.height_px * source.georeference.gsd_m[1] for source in sources]
    tiles_m = [cell.side_m for cell in cells]
    used = sum(side_m**2 for side_m in tiles_m) / _ground_m2(sources)
    return (
        f"{counted(len(sources), 'image')} of {span(min(widths), max(widths))} x "
        f"{span(min(heights), max(heights))} m at {span(min(gsds_cm), max(gsds_cm), 1)} cm per "
        f"pixel, {placed} of them on a map: about {counted(len(cells), 'tile')} of "
        f"{span(min(tiles_m), max(tiles_m))} m, which cover {percent(min(used, 1.0))} of the ground"
    )


def _ground_m2(sources: Sequence[Source]) -> float:
    """Adds up the ground in images; ground that several photographs show counts once."""
    shown = defaultdict[str, list[Polygon]](list)
    for source in sources:
        across_m, down_m = source.georeference.gsd_m
        outline = outline_of(source)
        if source.georeference.plane is None:
            outline = box(0, 0, source.width_px * across_m, source.height_px * down_m)
        shown[source.georeference.plane or str(source.path)].append(outline)
    return sum(union_all(outlines).area for outlines in shown.values())


def _labels(labels: Labels, settings: LabelSettings, grids: Sequence[Grid], its: Subject) -> str:
    """States the number and length of labelled vehicles, and refuses impossible lengths."""
    lengths_m, count = _lengths_m(labels, vehicle_classes(labels, settings), its.inspected, grids)
    number = counted(count, "labelled vehicle")
    if len(lengths_m) < _FEW:
        return number
    middle_m = median(lengths_m)
    if not _LENGTHS_M[0] <= middle_m <= _LENGTHS_M[1] and not its.request.go_on:
        raise ImageryError(
            f"The median labelled vehicle is {middle_m:.1f} m long, and cars are {_LENGTHS_M[0]:g} "
            f"to {_LENGTHS_M[1]:g} m: correct --gsd or --label-classes, or insist with --go-on."
        )
    return f"{number}, the median is {middle_m:.1f} m long (a car is about 4.5 m)"


def _on_tiles(placed: PlacedLabels, cells: Sequence[Cell]) -> Iterator[str]:
    """States how many labelled vehicles lie on tiles, and raises an error if none does."""
    count = 0
    for cell in cells:
        owner = np.full((cell.size_px, cell.size_px), cell.sources[0])
        count += sum(not row.ignore for row in placed.on(cell, owner))
    if not count:
        raise ImageryError(
            "No labelled vehicle lies on a tile, so no threshold can be frozen on the labels; "
            "label more of the imagery, or leave out --labels."
        )
    few = ", which may be too few for each split" if count < _FEW_ON_TILES else ""
    yield f"about {counted(count, 'labelled vehicle')} on tiles{few}"


def _lengths_m(
    labels: Labels, classes: Sequence[str], sources: Sequence[Source], grids: Sequence[Grid]
) -> tuple[list[float], int]:
    """Returns the lengths of labelled vehicles that are not mere points, and the number of all."""
    if isinstance(labels, GroundLabels):
        wanted = [
            label for label in labels.labels if label.class_name in classes and not label.ignore
        ]
        grid = next((grid for grid in grids if grid.crs is not None), None)
        if grid is None:
            return [], len(wanted)
        system = system_of(labels.crs, "the labels")
        corners = [corner for label in wanted for corner in label.corners]
        moved = iter(to_reference_system(system, grid.crs, corners))
        placed = [(label.moved([next(moved) for _ in label.corners]), 1.0) for label in wanted]
    else:
        placed = [
            (label, math.sqrt(math.prod(source.georeference.gsd_m)))
            for source in sources
            for label in labels.images.get(source.path.stem, ())
            if label.class_name in classes and not label.ignore
        ]
    lengths_m = [label.length * scale_m for label, scale_m in placed if len(label.corners) > 1]
    return [length_m for length_m in lengths_m if math.isfinite(length_m)], len(placed)


def _plan(its: Subject, tiles: int, steps: Sequence[Step]) -> Iterator[str]:
    """States the size of a test on at most so many tiles, the size that it needs, and its time."""
    scenes = its.suite.test_images
    # Scenes fall on tiles at random, so some tiles are seen twice and others never.
    shown = max(1, round(tiles * (1 - (1 - 1 / max(tiles, 1)) ** scenes)))
    per_tile = max(_VEHICLES * scenes / shown, 1.0)
    effect = 1 + max(per_tile - 1, 0) * _CORRELATION
    fleet = its.suite.vehicles[3]
    assumptions = Assumptions(_EASR, vehicles_per_tile=per_tile, design_effect=effect, fleet=fleet)
    width = expected_half_width(shown, assumptions)
    at_most = "at most " if its.request.imagery else ""
    wide = f"be about ±{100 * width:.0f} percentage points" if width < 0.5 else "say nothing"
    yield (
        f"{scenes} test scenes with about {_VEHICLES * scenes} vehicles will stand on {shown} of "
        f"{at_most}{counted(tiles, 'test tile')}: if an attack hides {percent(_EASR)} of the "
        f"vehicles found, the 95 % interval would {wide}"
    )
    needed = tiles_needed(_HALF_WIDTH, assumptions)
    if needed is not None:
        yield f"for ±{100 * _HALF_WIDTH:.0f} points it would take about {needed:,} such tiles"
    requirement = its.request.requirement
    if requirement is not None:
        fewest = fewest_tiles(requirement.reject, requirement.consumer_risk)
        decides = tiles_to_decide(requirement, assumptions)
        verdict = "enough" if shown >= fewest else "too few"
        yield (
            f"no verdict is possible on fewer than {fewest} tiles that scenes stand "
            f"on ({shown} are {verdict}), which takes about {tiles_to_show(fewest, scenes):,} "
            f"test tiles; on about {decides:,}, nine of ten tests decide it"
        )
    effort_s = math.fsum(step.effort_s for step in steps)
    if its.request.imagery:
        effort_s += _CLEAR_S * tiles / tiling_of(its).shares[3]
    yield (
        f"{len(steps)} steps will take about {duration(effort_s)} on one CPU core with a small "
        "detector, less on several or on a GPU"
    )
