"""Detectors judged: from datasets to a score folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from skyproof.camouflage.name import CamouflageName
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.inference import detect_by_each
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, write_beside, write_jsonl
from skyproof.measure.baseline import BaselineSet, measure_baseline
from skyproof.results.baseline import Baseline, write_baselines
from skyproof.results.pairs.compare import Comparison, compare
from skyproof.results.pairs.outcomes import MATCHES, Outcome, write_outcomes
from skyproof.results.pairs.sets import ORIGINAL, SetScore, write_sets
from skyproof.results.pairs.tiles import count_tiles, write_tiles
from skyproof.results.pictures import choose_scenes, draw_scene
from skyproof.results.rows import MAIN_MATCH
from skyproof.results.score_folder import (
    Pair,
    ScoreRecord,
    is_pictured,
    write_pairs,
    write_record,
)
from skyproof.results.statistics.rates import false_alarms_per_km2
from skyproof.seeds import numpy_generator

Judge = LoadedDetector[Detector]


def score_detectors(
    judges: Sequence[Judge],
    folder: str | Path,
    *,
    original: str | Path | None = None,
    camouflaged: Mapping[str, str | Path] | None = None,
    clean: Sequence[BaselineSet] = (),
    seed: int = 0,
    sources: Sequence[str] = (),
    add: Callable[[Path], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Judges every vehicle with and without each camouflage, and detectors on clean images.

    Args:
        judges: detectors with their cards.
        folder: the score folder; written whole or not at all, and must not exist yet.
        original: dataset without camouflage; it says the scenes and the renderer.
        camouflaged: datasets of the same scenes by camouflage name.
        clean: further images to check the detectors on.
        seed: of the bootstrap.
        sources: what the ground was cut from, or ["procedural"]; empty where it is not known.
        add: writes more into the folder before it is finished.
        progress: called with (detector runs done, runs in all).

    Raises:
        ConfigurationError: the datasets do not show the same scenes by the same renderer, or a
            detector finds no vehicle in `original`.
        StoredFileError: a dataset is missing or damaged.
        RunFolderError: the folder exists, or the disk cannot take it.
    """
    folder = Path(folder)
    pairs = _Pairs.open(Path(original), camouflaged or {}) if original is not None else None
    if pairs is not None:
        _refuse_twice("datasets", [place.name for place in pairs.places])
    _refuse_twice("detectors", [judge.name for judge in judges])
    _refuse_twice("sets of frames", [each.name for each in clean])
    runs = len(judges) * (len(clean) + (0 if pairs is None else len(pairs.places)))
    scored = _Scored(judges, seed, runs, progress)
    with finished_folder(folder) as partial:
        if pairs is not None:
            scored.compare(pairs, partial)
            write_outcomes(partial / "outcomes.parquet", scored.outcomes)
            write_tiles(partial / "tiles.parquet", count_tiles(scored.outcomes))
            write_sets(partial / "sets.json", scored.sets)
            write_pairs(partial, scored.pairs)
        scored.check(clean)
        write_baselines(partial / "baselines.json", scored.checks)
        if add is not None:
            add(partial)
        thresholds = {judge.name: judge.threshold for judge in judges}
        renderer = None if pairs is None else pairs.original.renderer
        write_record(partial, ScoreRecord(thresholds, seed, renderer, list(sources)))


@dataclass(frozen=True)
class _Pairs:
    """Datasets of the same scenes, without camouflage and with each."""

    original: Dataset
    camouflaged: Mapping[str, Dataset]
    places: Sequence[Path]

    @classmethod
    def open(cls, original: Path, camouflaged: Mapping[str, str | Path]) -> _Pairs:
        before = Dataset.open(original)
        after = {name: Dataset.open(place) for name, place in camouflaged.items()}
        for name, dataset in {ORIGINAL: before, **after}.items():
            place = camouflaged.get(name, original)
            # Ids alone do not tell: two runs number their scenes alike.
            if dataset.scenes != before.scenes:
                raise ConfigurationError(
                    f"{place} does not show the scenes of {original}; render it from the same "
                    "scenes."
                )
            _refuse_other_rendering(original, before, Path(place), dataset)
            vehicles = [len(scene.placements) for scene in dataset.scenes]
            if list(dataset.ids) != [scene.id for scene in dataset.scenes] or vehicles != list(
                map(len, dataset.boxes)
            ):
                raise StoredFileError(
                    f"{place} has other images or vehicles than its scenes.jsonl says; copy the "
                    "whole folder again, or make the dataset again."
                )
        return cls(before, after, [original, *map(Path, camouflaged.values())])


def _refuse_other_rendering(original: Path, before: Dataset, place: Path, dataset: Dataset) -> None:
    """Pairs may differ in camouflage and in nothing else."""
    known = (before.renderer, before.rendering)
    if (dataset.renderer, dataset.rendering) == known:
        return
    changed = sorted(
        key
        for key in {*before.rendering, *dataset.rendering}
        if before.rendering.get(key) != dataset.rendering.get(key)
    )
    settings = (
        f" with other settings ({', '.join(changed)})"
        if dataset.renderer == before.renderer
        else ""
    )
    raise ConfigurationError(
        f"{original} was rendered by {before.renderer} and {place} by {dataset.renderer}"
        f"{settings}, so that they differ in more than camouflage; render both with the same "
        "--renderer and settings."
    )


@dataclass(frozen=True)
class _Seen:
    """What one detector found in one dataset, and each rule's matches of it."""

    found: Sequence[Detections]
    matches: Mapping[str, MatchTable]


@dataclass
class _Scored:
    """Everything that judging brings together, for all detectors."""

    judges: Sequence[Judge]
    seed: int
    runs: int
    progress: Callable[[int, int], None] | None
    done: int = 0
    outcomes: list[Outcome] = field(default_factory=list)
    sets: list[SetScore] = field(default_factory=list)
    checks: list[Baseline] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)

    def compare(self, pairs: _Pairs, folder: Path) -> None:
        """Judges every vehicle without and with each camouflage."""
        before = pairs.original
        # All detectors see the clean set first: one that finds nothing there ends the scoring
        # before the long part.
        unharmed: dict[str, _Seen] = {}
        for judge, seen in zip(self.judges, self._see(before), strict=True):
            _write_detections(folder, pairs.places[0], judge, before, seen)
            # Each check draws alike, so that adding a set does not change another's interval.
            check = self._check_rendered(judge, before, seen)
            if not check.recall.estimate > 0:
                raise _undefined(judge, pairs.places[0], check.vehicles)
            self.checks.append(check)
            self.sets.extend(_set_scores(ORIGINAL, judge, before, seen))
            unharmed[judge.name] = seen
        # Camouflage by camouflage, detector by detector; told detector by detector.
        hidden: dict[tuple[str, str], tuple[list[Outcome], list[SetScore]]] = {}
        for (camouflage, dataset), place in zip(
            pairs.camouflaged.items(), pairs.places[1:], strict=True
        ):
            for number, (judge, seen) in enumerate(
                zip(self.judges, self._see(dataset), strict=True)
            ):
                _write_detections(folder, place, judge, dataset, seen)
                outcomes = _outcomes(camouflage, judge, before, unharmed[judge.name], seen)
                scores = _set_scores(camouflage, judge, dataset, seen)
                hidden[judge.name, camouflage] = (outcomes, scores)
                if number == 0 and is_pictured(CamouflageName.read(camouflage)):
                    sides = ((before, unharmed[judge.name]), (dataset, seen))
                    self.pairs.extend(_draw(folder, camouflage, judge, outcomes, sides))
        for judge in self.judges:
            for camouflage in pairs.camouflaged:
                outcomes, scores = hidden[judge.name, camouflage]
                self.outcomes.extend(outcomes)
                self.sets.extend(scores)

    def check(self, clean: Sequence[BaselineSet]) -> None:
        """Checks every detector on every set, and orders all checks by detector."""
        for images in clean:
            for judge, seen in zip(self.judges, self._see(images.images), strict=True):
                self.checks.append(self._check(judge, images, seen))
        order = [judge.name for judge in self.judges]
        self.checks.sort(key=lambda check: order.index(check.detector))

    def _see(self, dataset: Dataset) -> list[_Seen]:
        """What each detector finds in a dataset."""
        seen = []
        for found in detect_by_each([judge.detector for judge in self.judges], dataset):
            matches: dict[str, MatchTable] = {
                match: match_images(found, dataset, criterion=match) for match in MATCHES
            }
            seen.append(_Seen(found, matches))
        self.done += len(seen)
        if self.progress:
            self.progress(self.done, self.runs)
        return seen

    def _check(self, judge: Judge, clean: BaselineSet, seen: _Seen) -> Baseline:
        generator = numpy_generator(self.seed)
        centre, overlap = seen.matches[MAIN_MATCH], seen.matches["iou_50"]
        return measure_baseline(judge, clean, centre, overlap, generator=generator)

    def _check_rendered(self, judge: Judge, images: Dataset, seen: _Seen) -> Baseline:
        places = [scene.background.tile for scene in images.scenes]
        name = "Blender Cycles test" if images.renderer == "cycles" else "rendered test"
        return self._check(judge, BaselineSet(name, images, real=False, places=places), seen)


def _undefined(judge: Judge, original: Path, vehicles: int) -> ConfigurationError:
    """Without a vehicle found before, there is no share of them that a camouflage hides."""
    if not vehicles:
        return ConfigurationError(
            f"{original} shows no vehicles to hide; render scenes with vehicles."
        )
    return ConfigurationError(
        f"{judge.name} finds none of the {vehicles} vehicles of {original} at its threshold of "
        f"{judge.threshold:.4g}, so no success rate (EASR) is defined for it; train it longer or "
        "on more images, or leave it out."
    )


def _refuse_twice(kind: str, names: Sequence[str]) -> None:
    """Tables and files go by name: two of one name would be mixed up."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigurationError(
            f"Two {kind} are called {twice!r}; give each once, or score them separately."
        )


def _outcomes(
    camouflage: str, judge: Judge, before: Dataset, unharmed: _Seen, seen: _Seen
) -> list[Outcome]:
    comparison = Comparison(camouflage, before.renderer, judge.name, judge.threshold)
    visible = [values.numpy() for values in before.visible_fractions]
    return [
        outcome
        for match in MATCHES
        for outcome in compare(
            before.scenes,
            unharmed.matches[match],
            seen.matches[match],
            comparison,
            visible_fractions=visible,
        )
    ]


def _set_scores(camouflage: str, judge: Judge, images: Dataset, seen: _Seen) -> list[SetScore]:
    scores = []
    for match, matches in seen.matches.items():
        _, false_alarms = matches.counts_at(judge.threshold)
        density = false_alarms_per_km2(false_alarms, images.area_m2)
        precision = average_precision(matches)
        scores.append(SetScore(camouflage, images.renderer, judge.name, match, precision, density))
    return scores


def _draw(
    folder: Path,
    camouflage: str,
    judge: Judge,
    outcomes: Sequence[Outcome],
    sides: tuple[tuple[Dataset, _Seen], tuple[Dataset, _Seen]],
) -> list[Pair]:
    """Draws the chosen scenes of one camouflage; those without it are shared by all."""
    scenes: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        if outcome.match == MAIN_MATCH:
            scenes.setdefault(outcome.scene, []).append(outcome)
    index_of = {name: index for index, name in enumerate(sides[0][0].ids)}
    pairs = []
    for scene, why in choose_scenes(scenes).items():
        rows = scenes[scene]
        index = index_of[scene]
        before = [(row.placement, row.detected_original, row.score_original) for row in rows]
        after = [(row.placement, row.detected_adversarial, row.score_adversarial) for row in rows]
        files = (f"{ORIGINAL}/{scene}.jpg", f"{camouflage}/{scene}.jpg")
        for file, (images, seen), vehicles in zip(files, sides, (before, after), strict=True):
            path = folder / "pairs" / file
            if path.exists():
                continue
            found = seen.found[index]
            picture = draw_scene(
                images.image(index).permute(1, 2, 0).numpy(),
                [
                    (images.boxes[index][place].numpy(), hit, score)
                    for place, hit, score in vehicles
                ],
                found.boxes.cpu().numpy(),
                found.scores.cpu().numpy(),
                judge.threshold,
            )
            with write_beside(path) as temporary:
                picture.save(temporary, "JPEG", quality=85, subsampling=0)
        pairs.append(
            Pair(
                camouflage=camouflage,
                detector=judge.name,
                scene=scene,
                why=why,
                vehicles=len(rows),
                found_before=sum(row.detected_original for row in rows),
                found_after=sum(row.detected_adversarial for row in rows),
                original=files[0],
                adversarial=files[1],
            )
        )
    return pairs


def _write_detections(
    folder: Path, dataset: Path, judge: Judge, images: Dataset, seen: _Seen
) -> None:
    rows = [
        {
            "image": name,
            "boxes": [[round(value, 2) for value in box] for box in found.boxes.tolist()],
            "scores": [round(score, 5) for score in found.scores.tolist()],
        }
        for name, found in zip(images.ids, seen.found, strict=True)
    ]
    write_jsonl(folder / "detections" / dataset.name / f"{judge.name}.jsonl", rows)
