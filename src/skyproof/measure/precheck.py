"""The precheck: is a detector worth attacking? Changes without optimisation answer that."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from textwrap import wrap
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.paint import LATTICE, TWO_TONES, Colour, plain_paint, two_tone_paint
from skyproof.camouflage.palette import ground_palette
from skyproof.camouflage.patterns import PATTERNS, draw_pattern
from skyproof.detectors.detector import Detector
from skyproof.errors import ConfigurationError
from skyproof.files import value_digest
from skyproof.measure.baseline import BaselineSet, measure_baselines
from skyproof.measure.likeness import compare_kinds
from skyproof.measure.measure import compare
from skyproof.measure.views import SceneChange, SceneRenderer, SceneView, counter, look, views
from skyproof.randomness import generator_of
from skyproof.render.renderer import TorchRenderer
from skyproof.results.likeness import Likeness
from skyproof.results.outcomes import count_cells
from skyproof.results.precheck import (
    LARGEST_EASR,
    PAINTED,
    Finding,
    Kind,
    MeasuredOn,
    PrecheckRecord,
    Rate,
    findings,
    misfit_thresholds,
    rate_words,
    worst,
)
from skyproof.results.result import MAIN_MATCH
from skyproof.results.score_folder import Baseline
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, scenes_digest
from skyproof.seeds import numpy_generator
from skyproof.vehicles.fleet import Fleet
from skyproof.words import detector_name, hides, interval, percent

BLURS_PX = (0.4, 0.7, 1.0, 1.4)
"""Sigmas of blur, from the sharpest to the softest aerial photographs that we know."""

CONTROLS = ("R-U", "R-Pix", "R-Fc", "R-PixFc", "R-Lc", "R-S-O@0.4", *PATTERNS)

SUN_ELEVATIONS_DEG = (10.0, 25.0, 45.0, 65.0)

_FEW = 6
"""Up to this number all changes are printed, above it only the worst."""

_WORST = 3
_WIDTH = 110
_INDENT = 48


@dataclass(frozen=True)
class PrecheckScenes:
    """Scenes and annotated frames of a precheck; every random control is drawn `draws` times."""

    backgrounds: BackgroundSet
    fleet: Fleet
    scenes: Sequence[Scene]
    draws: int
    frames: Sequence[BaselineSet]
    seed: int

    @cached_property
    def measured_on(self) -> MeasuredOn:
        """The identity of the data; two prechecks that agree in it measured the same."""
        names = dict.fromkeys(scene.background.tile for scene in self.scenes)
        tiles = [self.backgrounds.tile(name) for name in names]
        return MeasuredOn(
            scenes=len(self.scenes),
            scenes_sha256=scenes_digest(self.scenes),
            sources=tuple(dict.fromkeys(tile.source for tile in tiles)),
            draws=self.draws,
            seed=self.seed,
            frames=tuple(each.name for each in self.frames),
            frames_sha256=tuple(value_digest([its.images.digest, its.note]) for its in self.frames),
            ground_sha256=value_digest([self.backgrounds.gsd_m, tiles]),
            fleet_sha256=value_digest([self.fleet.sizes_m]),
        )


def precheck(
    detectors: Sequence[Detector],
    data: PrecheckScenes,
    *,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> list[PrecheckRecord]:
    """Measures what plain changes hide from every detector, and its baselines.

    The scenes are rendered as they are, then once under each change: 27 plain paints on body panels
    and 27 on the whole vehicle, eight two-tone paints, four blurs, ten random controls, four
    elevations of the sun. Rates are by centres within 1 m at the frozen threshold. Nothing is
    written. `progress` is called with (images done, images in all). `skyproof.results.precheck`
    judges the records.
    """
    scenes, seed = data.scenes, data.seed
    for each in data.frames:
        if not sum(map(len, each.images.boxes)):
            raise ConfigurationError(
                f"{each.name} has no labelled vehicles, so nothing says what a detector misses "
                "there; give frames with labels, or leave them out."
            )
    changes = precheck_changes(ground_palette(data.backgrounds), draws=data.draws, seed=seed)
    stage = SceneRenderer(data.fleet, TorchRenderer(data.backgrounds), device)
    count = counter(progress, len(scenes) * (1 + len(changes)))
    seen = views(detectors, scenes, changes, stage, other_classes=True, progress=count)
    before = next(seen)
    places = [scene.background.tile for scene in scenes]
    note = "drawn as they are, before any change"
    rendered = BaselineSet("rendered scenes", before.images, real=False, note=note, places=places)
    baselines = measure_baselines(detectors, rendered, before, seed=seed)
    likeness: list[Likeness] = []
    for each in data.frames:
        photographed = look(detectors, each.name, each.images, other_classes=True)
        baselines += measure_baselines(detectors, each, photographed, seed=seed)
        likeness += compare_kinds(detectors, each, photographed, scenes, before, seed=seed)
    rates = _rates(detectors, scenes, changes, before, seen, seed)
    return [
        PrecheckRecord(
            each.name,
            each.weights_sha256,
            each.threshold,
            data.measured_on,
            [baseline for baseline in baselines if baseline.detector == each.name],
            *rates[each.name],
            likeness=[row for row in likeness if row.detector == each.name],
        )
        for each in detectors
    ]


def precheck_changes(palette: Float[Tensor, "K 3"], *, draws: int, seed: int) -> list[SceneChange]:
    """Makes all changes of a precheck; `palette` gives the fixed colours as sRGB in [0, 1]."""
    kinds: tuple[tuple[Kind, bool], ...] = (("paint_body", True), ("paint_whole", False))
    changes = [
        SceneChange(_hex(colour), plain_paint(colour, masked=masked), kind=kind)
        for kind, masked in kinds
        for colour in LATTICE
    ]
    changes += [
        SceneChange(_hex(upper) + _hex(lower), two_tone_paint(upper, lower), kind="two_tone")
        for upper, lower in TWO_TONES
    ]
    changes += [
        SceneChange(f"{sigma:g} px", blur_sigma_px=sigma, kind="blur") for sigma in BLURS_PX
    ]
    changes += [
        SceneChange(name, _control(name, draw, palette, seed), kind="control")
        for name in CONTROLS
        for draw in range(draws)
    ]
    return changes + [
        SceneChange(f"{angle:g}°", sun_elevation_deg=angle, kind="sun")
        for angle in SUN_ELEVATIONS_DEG
    ]


def _hex(colour: Colour) -> str:
    return f"#{bytes(colour).hex()}"


def _control(text: str, draw: int, palette: Float[Tensor, "K 3"], seed: int) -> Camouflage:
    if text in PATTERNS:
        return draw_pattern(text, palette, seed=seed, draw=draw)
    name = CamouflageName.parse(text).with_repeat(draw)
    generator = generator_of(seed, "gate", str(name))
    return make_camouflage(name, generator=generator, palette=palette).requires_grad_(False)


def _rates(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    changes: Sequence[SceneChange],
    before: SceneView,
    changed: Iterable[SceneView],
    seed: int,
) -> dict[str, tuple[list[Rate], list[int]]]:
    """Returns by detector its rates, and the vehicles that it found before on each tile.

    The draws of one control are averaged and taken as given.
    """
    cells = sorted({(s.background.tile, each.vehicle) for s in scenes for each in s.placements})
    row_of = {cell: row for row, cell in enumerate(cells)}
    sample = Sample.draw(cells, generator=numpy_generator(seed))
    counts: dict[tuple[str, Any, str], list[np.ndarray]] = {}
    for change, after in zip(changes, changed, strict=True):
        for each in detectors:
            outcomes = compare(scenes, before, after, each, TorchRenderer.name, [MAIN_MATCH])
            drawn = counts.setdefault((each.name, change.kind, change.name), [])
            drawn.append(count_cells(outcomes, row_of))
    rates: dict[str, tuple[list[Rate], list[int]]] = {each.name: ([], []) for each in detectors}
    for (detector, kind, name), drawn in counts.items():
        group = Group(np.stack(drawn), sample)
        rate = Rate(kind, name, len(drawn), mean_interval(group))
        own, found = rates[detector]
        if kind in PAINTED:
            both, lost, _ = sample.by_tile(group.counts)[0].T
            found[:] = (both + lost).tolist()
            rate = replace(rate, lost_by_tile=tuple(lost.tolist()))
        own.append(rate)
    return rates


def precheck_lines(record: PrecheckRecord, doubts: Sequence[str] = ()) -> list[str]:
    """Returns a few lines on what was measured, the findings, and the doubts on the card."""
    found = findings(record)
    lines = [
        f"{detector_name(record.detector)}: {worst(found).outcome.upper()} "
        f"({record.measured_on.scenes} scenes, threshold {record.threshold:.3f})"
    ]
    for check, finding in zip(record.sets, found, strict=False):
        lines += _told(check.dataset, finding, _set(check))
    for finding in found[len(record.sets) :]:
        lines += _told(finding.criterion, finding, _changes(finding))
    alike = record.likeness_by_main_rule
    sentences = [*([alike.sentence] if alike else []), *doubts, *misfit_thresholds(record.sets)]
    for sentence in sentences:
        lines += wrap(f"  {sentence}", _WIDTH, subsequent_indent="  ")
    return lines


def _told(title: str, finding: Finding, words: str) -> list[str]:
    head = f"  {title:<34}{finding.outcome:<12}"
    return wrap(head + words, _WIDTH, subsequent_indent=" " * _INDENT)


def _set(check: Baseline) -> str:
    best = check.best
    other = f"; {check.leniently}" if check.leniently else ""
    other += "" if best is None else f"; largest F1 at {best.threshold:.3f}"
    return (
        f"AP {_sure(check.ap_centre_1m)}, precision {_sure(check.precision)}, recall "
        f"{_sure(check.recall)}; {check.vehicles} vehicles, {check.clusters} "
        f"{check.clustered_by}{other}"
    )


def _changes(finding: Finding) -> str:
    rates = finding.rates
    beyond = [rate for rate in rates if rate.easr.estimate > LARGEST_EASR]
    shown = rates if len(rates) <= _FEW else (beyond or rates[:1])[:_WORST]
    words = ", ".join(
        f"{rate_words(rate)} {hides(rate.easr.estimate)} "
        f"({interval(rate.easr.low, rate.easr.high)})"
        for rate in shown
    )
    return f"{len(beyond)} of {len(rates)} hide more than {percent(LARGEST_EASR)}: {words}"


def _sure(value: Interval) -> str:
    return f"{percent(value.estimate)} ({interval(value.low, value.high)})"
