"""Detectors over matched datasets: from folders of images to outcomes, average precision and the table of results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import LoadedDetector
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, write_json, write_jsonl
from skyproof.results.clean import CleanSet, check_clean
from skyproof.results.pairs.compare import Comparison, compare, count_false_alarms
from skyproof.results.pairs.outcomes import MATCHES, Outcome, write_outcomes
from skyproof.results.pairs.sets import ORIGINAL, SetScore, write_sets
from skyproof.results.pairs.tiles import count_tiles, write_tiles
from skyproof.results.statistics.rates import false_alarms_per_km2
from skyproof.results.summary import summarise
from skyproof.scenes.scene import Scene, read_scenes

__all__ = ["evaluate_pairs"]


def evaluate_pairs(
    judges: Sequence[LoadedDetector[Detector]],
    original: Path,
    camouflaged: Mapping[str, Path],
    folder: Path,
    *,
    clean: Sequence[CleanSet] = (),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Judges every vehicle with and without each camouflage, and writes all that was found (PAPER 9, 38-41).

    Args:
        judges: detectors with their cards.
        original: dataset without camouflage; its `scenes.jsonl` says the conditions, and it names the renderer.
        camouflaged: datasets of the same scenes by camouflage name.
        folder: gets `outcomes.parquet`, `tiles.parquet`, `sets.json`, `results.json`, `clean.json`,
            `detections/<dataset>/<detector>.jsonl`; whole or not at all; must not exist yet.
        clean: further images to check the detectors on.
        seed: of the bootstrap.
        progress: called with (detector runs done, runs in all).

    Returns:
        The rows of `results.json`.

    Raises:
        ConfigurationError: the datasets do not show the same scenes by the same renderer, or a detector finds no
            vehicle in `original`.
        StoredFileError: a dataset is missing or damaged.
        RunFolderError: the folder exists, or the disk cannot take it.
    """
    scenes = read_scenes(Path(original) / "scenes.jsonl")
    before = Dataset.open(original)
    renderer, settings = before.renderer, before.rendering
    after = {name: Dataset.open(place) for name, place in camouflaged.items()}
    for name, place in camouflaged.items():
        # Ids alone do not tell: two runs number their scenes alike.
        if read_scenes(Path(place) / "scenes.jsonl") != scenes:
            raise ConfigurationError(
                f"{place} does not show the scenes of {original}; render it from the same scenes."
            )
        theirs = (after[name].renderer, after[name].rendering)
        if theirs != (renderer, settings):
            changed = sorted(
                key for key in {*settings, *theirs[1]} if settings.get(key) != theirs[1].get(key)
            )
            raise ConfigurationError(
                f"{original} was rendered by {renderer} and {place} by {theirs[0]}"
                f"{' with other settings (' + ', '.join(changed) + ')' if theirs[0] == renderer else ''}, so that they "
                "differ in more than camouflage; render both with the same --renderer and settings."
            )
    _check_names(judges, [Path(original), *map(Path, camouflaged.values())])
    for name, images in {ORIGINAL: before, **after}.items():
        if list(images.ids) != [scene.id for scene in scenes]:
            place = camouflaged.get(name, original)
            raise StoredFileError(
                f"{place} has other images than its scenes.jsonl says; write the dataset again."
            )
    # Each check draws alike, so that adding a set does not change the interval of another.
    rendered = CleanSet(
        "rendered test", before, places=[scene.background.tile for scene in scenes], real=False
    )
    total, done = len(judges) * (1 + len(after) + len(clean)), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    outcomes: list[Outcome] = []
    scores: list[SetScore] = []
    checks: list[dict[str, Any]] = []
    with finished_folder(Path(folder)) as partial:
        # All detectors see the clean set first: one that finds nothing there ends the evaluation before the long part.
        unharmed: list[list[Detections]] = []
        for judge in judges:
            name = judge.name
            found = detect_all(judge.detector, before)
            _write_detections(
                partial / "detections" / Path(original).name / f"{name}.jsonl", before.ids, found
            )
            check = check_clean(judge, rendered, found, generator=np.random.default_rng(seed))
            if not check["recall"]:
                raise _undefined(judge, original, check["vehicles"])
            scores.extend(_scores(ORIGINAL, renderer, judge, scenes, before, found))
            checks.append(check)
            unharmed.append(found)
            step()
        for judge, found in zip(judges, unharmed, strict=True):
            name = judge.name
            for camouflage, images in after.items():
                hidden = detect_all(judge.detector, images)
                place = (
                    partial / "detections" / Path(camouflaged[camouflage]).name / f"{name}.jsonl"
                )
                _write_detections(place, images.ids, hidden)
                scores.extend(_scores(camouflage, renderer, judge, scenes, images, hidden))
                for match in MATCHES:
                    comparison = Comparison(
                        camouflage, renderer, name, match, judge.threshold, before.gsd_m
                    )
                    pair = compare(
                        scenes,
                        before.boxes,
                        found,
                        hidden,
                        comparison,
                        adversarial_truth_boxes=images.boxes,
                        visible_fractions=before.visible_fractions,
                    )
                    outcomes.extend(pair)
                step()
            for each in clean:
                found = detect_all(judge.detector, each.images)
                checks.append(
                    check_clean(judge, each, found, generator=np.random.default_rng(seed))
                )
                step()
        tiles = count_tiles(outcomes)
        rows = summarise(tiles, scores, generator=np.random.default_rng(seed))
        write_outcomes(partial / "outcomes.parquet", outcomes)
        write_tiles(partial / "tiles.parquet", tiles)
        write_sets(partial / "sets.json", scores)
        order = [judge.name for judge in judges]
        write_json(
            partial / "clean.json", sorted(checks, key=lambda check: order.index(check["detector"]))
        )
        write_json(partial / "results.json", {"rows": rows})
    return rows


def _undefined(
    judge: LoadedDetector[Detector], original: Path, vehicles: int
) -> ConfigurationError:
    """Without a vehicle found before, there is no share of them that a camouflage hides (PAPER 38)."""
    name = judge.name
    if not vehicles:
        return ConfigurationError(
            f"{original} shows no vehicles to hide; render scenes with vehicles."
        )
    return ConfigurationError(
        f"{name} finds none of the {vehicles} vehicles of {original} at its threshold of {judge.threshold:.4g}, so no "
        "success rate (EASR) is defined for it; train it longer or on more images, or leave it out."
    )


def _check_names(judges: Sequence[LoadedDetector[Detector]], datasets: Sequence[Path]) -> None:
    """Tables and files go by name: two of one name would be mixed up."""
    for kind, names in (
        ("detectors", [judge.name for judge in judges]),
        ("datasets", [path.name for path in datasets]),
    ):
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ConfigurationError(
                f"Two {kind} are called {twice!r}; give each once, or evaluate them separately."
            )


def _scores(
    camouflage: str,
    renderer: str,
    judge: LoadedDetector[Detector],
    scenes: Sequence[Scene],
    images: Dataset,
    found: Sequence[Detections],
) -> list[SetScore]:
    area_m2 = (scenes[0].camera.size_px * scenes[0].camera.gsd_m) ** 2
    scores = []
    for match in MATCHES:
        comparison = Comparison(
            camouflage, renderer, judge.name, match, judge.threshold, images.gsd_m
        )
        alarms = count_false_alarms(images.boxes, found, comparison, ignore=images.ignore)
        precision = average_precision(found, images, criterion=match).ap
        density = false_alarms_per_km2(alarms, len(images), area_m2)
        scores.append(SetScore(camouflage, renderer, judge.name, match, precision, density))
    return scores


def _write_detections(path: Path, ids: Sequence[str], found: Sequence[Detections]) -> None:
    rows = [
        {
            "image": name,
            "boxes": [[round(value, 2) for value in box] for box in each.boxes.tolist()],
            "scores": [round(score, 5) for score in each.scores.tolist()],
        }
        for name, each in zip(ids, found, strict=True)
    ]
    write_jsonl(path, rows)
