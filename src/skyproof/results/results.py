"""All results of a run, read from its score folders."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.detectors.card import DetectorCard
from skyproof.files import inside, write_json
from skyproof.layout import Layout
from skyproof.results.likeness import Likeness
from skyproof.results.operating_points import OperatingPoint, equal_alarm_rows, points_of
from skyproof.results.outcomes import Outcome, OutcomeCounts, Series, read_outcomes
from skyproof.results.paints import beside_paints
from skyproof.results.precheck import PrecheckRecord, read_prechecks
from skyproof.results.result import FROZEN, LENIENT_MATCH, MAIN_MATCH, MEAN, Result, summarise
from skyproof.results.rows_file import flat_row
from skyproof.results.score_folder import Baseline, Pair, ScoreFolder, merge_scores
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample
from skyproof.results.stored import (
    AttackRecord,
    RunConfig,
    Timing,
    read_config,
    read_detectors,
    read_environment,
    read_records,
    read_sources,
    read_timings,
)
from skyproof.scenes.scene import Scene, read_scenes

RENDERER = "torch"
"""The differentiable renderer, which attacks use."""

CYCLES = "cycles"
"""The second renderer, Blender's path tracer, which checks the first."""


@dataclass(frozen=True)
class RendererChange:
    """Mean EASR under two renderers, and the paired difference of the second and the first."""

    first: float
    second: float
    difference: Interval


@dataclass(frozen=True)
class Results:
    """All results of one run. What a run folder lacks is empty.

    `rows` are the table at the frozen thresholds, for each renderer and match rule, computed from
    the `counts` of outcomes. Cards and prechecks are by detector, records of camouflages by folder.
    """

    folder: Path
    scores: Sequence[ScoreFolder]
    rows: Sequence[Result]
    counts: OutcomeCounts
    baselines: Sequence[Baseline]
    config: RunConfig
    environment: Mapping[str, Any]
    timings: Sequence[Timing]
    cards: Mapping[str, DetectorCard]
    records: Mapping[str, AttackRecord]
    prechecks: Mapping[str, PrecheckRecord] = field(default_factory=dict)
    seed: int = 0

    @classmethod
    def open(cls, run_folder: str | Path) -> Self:
        """Reads a run folder, or a single score folder.

        Raises:
            StoredFileError: nothing was scored or prechecked yet, or a file is damaged.
            ConfigurationError: the scores do not belong together.
        """
        folder = Path(run_folder)
        layout = Layout(folder)
        prechecks = read_prechecks(layout.detectors)
        scores = ScoreFolder.all_of(folder, needed=not prechecks)
        counts, sets = merge_scores(scores)
        config = read_config(layout.config)
        seed = scores[0].record.seed if config.seed is None and scores else config.seed or 0
        results = cls(
            folder=folder,
            scores=scores,
            rows=summarise(counts, sets, seed=seed),
            counts=counts,
            baselines=_merged_baselines(scores, prechecks),
            config=config,
            environment=read_environment(layout.environment),
            timings=read_timings(layout.timings),
            cards=read_detectors(layout.detectors),
            records=read_records(layout.camouflages),
            prechecks=prechecks,
            seed=seed,
        )
        own, names = results.own_prechecks, results.detectors
        return replace(results, rows=[beside_paints(row, own, names) for row in results.rows])

    def write(self, worst: Sequence[Mapping[str, Any]] = ()) -> Path:
        """Writes `results.json`; rates are fractions, undefined ones null."""
        path = Layout(self.folder).results
        document = {
            "rows": [row.json() for row in self.rows],
            "equal_alarms": [row.json() for row in self.equal_alarms],
            "operating_points": [flat_row(one) for own in self.points.values() for one in own],
            "baselines": [flat_row(baseline) for baseline in self.baselines],
            "worst_cases": list(worst),
        }
        write_json(path, document)
        return path

    @cached_property
    def points(self) -> dict[str, list[OperatingPoint]]:
        """The operating points of each detector; none where no empty ground was scored."""
        empty = [one for one in self.baselines if not one.vehicles and not one.real]
        first = {one.detector: points_of(one) for one in reversed(empty) if one.area_km2 > 0}
        return {name: first.get(name, []) for name in self.detectors}

    @cached_property
    def equal_alarms(self) -> list[Result]:
        """The table at equal false alarms (`EQUAL_ALARMS`); empty where none are known."""
        return equal_alarm_rows(self.scores, self.points, self.seed)

    @cached_property
    def detectors(self) -> list[str]:
        """The detectors that scored camouflages, or all where there are only baselines."""
        scored = dict.fromkeys(row.detector for row in self.rows if row.detector != MEAN)
        return list(scored) or self.all_detectors

    @cached_property
    def all_detectors(self) -> list[str]:
        """All detectors of the scores, also those with a baseline alone, or of the prechecks."""
        scored = [row.detector for row in self.rows if row.detector != MEAN]
        named = [name for score in self.scores for name in score.record.thresholds]
        return list(dict.fromkeys([*scored, *(named or self.prechecks)]))

    @cached_property
    def renderers(self) -> list[str]:
        """The renderers of compared images, that of the attacks first."""
        return list(dict.fromkeys(row.renderer for row in self.rows))

    @cached_property
    def names(self) -> list[CamouflageName]:
        """All camouflages, without repeats."""
        return list(dict.fromkeys(row.camouflage for row in self.rows))

    @cached_property
    def sources(self) -> list[str]:
        """Sources of the ground, or ["procedural"]; empty if not recorded."""
        imagery = self.config.imagery
        if imagery:
            return [imagery] if isinstance(imagery, str) else imagery
        index = Layout(self.folder).backgrounds / "index.json"
        tiles = read_sources(index) if index.exists() else []
        recorded = [source for score in self.scores for source in score.record.sources]
        return [source for source in dict.fromkeys([*tiles, *recorded]) if source]

    @cached_property
    def test_scenes(self) -> list[Scene]:
        """Scenes of the test; empty if their file is missing."""
        place = Layout(self.folder).scenes("test")
        return read_scenes(place) if place.exists() else []

    @cached_property
    def own_prechecks(self) -> dict[str, PrecheckRecord]:
        """The prechecks on scenes of the test, or all of them if its scenes are unknown."""
        every, scenes = self.prechecks.items(), self.test_scenes
        return {name: each for name, each in every if not scenes or each.was_made_on(scenes)}

    @cached_property
    def likeness(self) -> list[Likeness]:
        """Photographed and rendered vehicles compared, once per detector and rule.

        Scores come first, because they cover all test scenes; prechecks cover only some.
        """
        scored = [each for each in self.scores if each.record.renderer == RENDERER]
        every = [
            *(row for score in scored for row in score.likeness()),
            *(row for record in self.own_prechecks.values() for row in record.likeness),
        ]
        first = {(row.detector, row.match): row for row in reversed(every)}
        return [row for row in every if first[row.detector, row.match] is row]

    def likeness_of(self, detector: str) -> Likeness | None:
        """Returns the comparison by the main rule, which decides; None if it was not measured."""
        decides = (detector, MAIN_MATCH)
        return next((row for row in self.likeness if (row.detector, row.match) == decides), None)

    @cached_property
    def sample(self) -> Sample:
        """The tiles and vehicles of the test, for intervals that are not in the rows."""
        return Sample.draw(self.counts.cells, generator=np.random.default_rng(0))

    def row(
        self,
        name: CamouflageName,
        detector: str | None = None,
        *,
        renderer: str = RENDERER,
        match: str = MAIN_MATCH,
    ) -> Result | None:
        """Returns a camouflage's row for one detector or the mean of all; None if not scored."""
        wanted = detector or (MEAN if len(self.detectors) > 1 else self.detectors[0])
        return self._by_key.get((name, wanted, renderer, match))

    def at(self, row: Result, point: str) -> Result | None:
        """Returns the same result at another operating point; None where it is not known."""
        # Computed only on demand, because every operating point resamples all outcomes again.
        every = self.rows if point == FROZEN else self.equal_alarms
        same = (each for each in every if (each.key, each.operating_point) == (row.key, point))
        return next(same, None)

    @cached_property
    def quoted(self) -> list[Result]:
        """The mean (or only) result of each optimised camouflage and renderer, by the main rule."""
        # Where there are several detectors, their mean comes last.
        last = {
            (row.camouflage, row.renderer): row
            for row in self.rows
            if row.match == MAIN_MATCH and not row.camouflage.random
        }
        return list(last.values())

    def by_detector(self, row: Result) -> list[Result]:
        """Returns the rows of this camouflage, renderer and rule by detector, the mean last."""
        like = (row.camouflage, row.renderer, row.match)
        return [each for each in self.rows if (each.camouflage, each.renderer, each.match) == like]

    def control(self, row: Result) -> Result | None:
        """Returns the result of a camouflage's random control; None where it was not scored."""
        return self.row(row.camouflage.control, row.detector, renderer=row.renderer)

    def lenient(self, row: Result) -> Result | None:
        """Returns the same result by the lenient rule; None where it was not scored."""
        name, detector = row.camouflage, row.detector
        return self.row(name, detector, renderer=row.renderer, match=LENIENT_MATCH)

    def outcomes(self, name: CamouflageName | None, renderer: str) -> list[Outcome]:
        """Returns the outcomes of one camouflage's repeats, or of all, by the main rule."""
        every = {outcome.camouflage for outcome in self._outcomes[renderer]}
        wanted = {each for each in every if name in (None, CamouflageName.read(each).pooled)}
        return [outcome for outcome in self._outcomes[renderer] if outcome.camouflage in wanted]

    def pairs(self, name: CamouflageName, renderer: str) -> list[tuple[Path, Pair]]:
        """Lists the pictured scenes of a camouflage, each with the folder of its files."""
        return [
            (score.path / "pairs", pair)
            for score in self.scores
            if score.record.renderer == renderer
            for pair in score.pairs()
            if CamouflageName.read(pair.camouflage).pooled == name
        ]

    def pattern(self, name: CamouflageName, file: str) -> Path | None:
        """Returns a picture or log of the first repeat of a camouflage; None if there is none."""
        for score in self.scores:
            for folder in (name, name.with_repeat(0)):
                place = f"patterns/{folder}/{file}"
                if (score.path / place).exists():
                    return inside(score.path, place, score.path)
        return None

    def change(
        self,
        names: Iterable[CamouflageName],
        *,
        detector: str | None = None,
        net: bool = False,
        first: str = RENDERER,
        second: str = CYCLES,
    ) -> RendererChange | None:
        """Says how far the mean EASR of some camouflages moves from one renderer to another.

        Only repeats that were scored under both count, each paired with itself. The mean is over
        camouflages, each of which is the mean of its repeats. With `net`, the EASR of the random
        control is subtracted. None where nothing is shared, or with `net` no control.
        """
        own = self._shared(set(names), detector, first, second)
        controls = {name.control for name in names} if net else set()
        random = self._shared(controls, detector, first, second)
        if own is None or (net and random is None):
            return None
        if random is None:
            return RendererChange(own[0].rate, own[1].rate, difference_interval([own[1]], [own[0]]))
        before, after = (each.rate - drawn.rate for each, drawn in zip(own, random, strict=True))
        change = difference_interval([own[1], random[0]], [own[0], random[1]])
        return RendererChange(before, after, change)

    def single_interval(self, camouflage: str) -> Interval | None:
        """Returns the EASR of one repeat, averaged over detectors; None if unknown or undefined."""
        group = self._group(camouflage)
        return None if group is None or math.isnan(group.rate) else mean_interval(group)

    def difference(self, later: str, earlier: str) -> Interval | None:
        """Returns the EASR of one repeat minus another's, on the same tiles; None if unknown."""
        after = self._group(later)
        before = self._group(earlier)
        return None if after is None or before is None else difference_interval([after], [before])

    @cached_property
    def _by_key(self) -> dict[tuple[CamouflageName, str, str, str], Result]:
        return {row.key: row for row in self.rows}

    @cached_property
    def _outcomes(self) -> Mapping[str | None, list[Outcome]]:
        """The outcomes by the main rule, by renderer."""
        found: dict[str | None, list[Outcome]] = defaultdict(list)
        for score in self.scores:
            path = score.path / "outcomes.parquet"
            outcomes = read_outcomes(path) if path.exists() else []
            found[score.record.renderer] += [one for one in outcomes if one.match == MAIN_MATCH]
        return found

    def _shared(
        self, names: set[CamouflageName], detector: str | None, first: str, second: str
    ) -> tuple[Group, Group] | None:
        """Gathers the repeats and detectors that two renderers share."""
        shared = [
            key
            for key in self.counts.series
            if (key.renderer, key.match) == (first, MAIN_MATCH)
            and detector in (None, MEAN, key.detector)
            and CamouflageName.read(key.camouflage).pooled in names
            and key._replace(renderer=second) in self.counts.series
        ]
        if not shared:
            return None
        of = [str(CamouflageName.read(key.camouflage).pooled) for key in shared]
        after = [key._replace(renderer=second) for key in shared]
        return self.counts.group(shared, self.sample, of), self.counts.group(after, self.sample, of)

    def _group(self, camouflage: str) -> Group | None:
        keys = [Series(camouflage, RENDERER, detector, MAIN_MATCH) for detector in self.detectors]
        known = all(key in self.counts.series for key in keys)
        # The question is what this very repeat hides, not what another start would hide.
        return replace(self.counts.group(keys, self.sample), repeats=()) if known else None


def _merged_baselines(
    scores: Sequence[ScoreFolder], prechecks: Mapping[str, PrecheckRecord]
) -> list[Baseline]:
    """Returns each baseline once, because every score folder holds that on the unchanged images.

    Prechecks add the photographs that were not scored, and all their sets to a run without scores.
    """
    first: dict[tuple[str, str], Baseline] = {}
    for baseline in (one for score in scores for one in score.baselines()):
        first.setdefault((baseline.detector, baseline.dataset), baseline)
    detectors = {name for score in scores for name in score.record.thresholds}
    for baseline in (one for record in prechecks.values() for one in record.sets):
        if not scores or (baseline.real and baseline.detector in detectors):
            first.setdefault((baseline.detector, baseline.dataset), baseline)
    order = list(dict.fromkeys(detector for detector, _ in first))
    return sorted(first.values(), key=lambda baseline: order.index(baseline.detector))
