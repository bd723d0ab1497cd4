"""Score folders: every camouflage measured, with all that a report needs."""

import hashlib
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detector
from skyproof.detectors.validation import average_precision
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, inside, write_beside, write_bytes
from skyproof.measure.baseline import BaselineSet, measure_baselines
from skyproof.measure.likeness import compare_kinds
from skyproof.measure.measure import compare, vehicles_seen
from skyproof.measure.views import (
    SceneChange,
    SceneRenderer,
    SceneView,
    counter,
    look,
    refuse_twice,
    views,
)
from skyproof.pictures import write_png
from skyproof.render.portrait import portrait
from skyproof.results.likeness import Likeness
from skyproof.results.outcomes import MATCHES, Outcome, write_outcomes
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import (
    LIKENESS,
    Baseline,
    Pair,
    ScoreRecord,
    SetScore,
    is_pictured,
    write_record,
)
from skyproof.results.statistics.intervals import false_alarms_per_km2
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet

# Green, vermilion and yellow of Okabe and Ito; line style tells them apart without colour.
FOUND = "#00C48C"
MISSED = "#FF6A00"
FALSE_ALARM = "#F0E442"
_COUNT = 6
_ENLARGE = 2


def score(
    detectors: Sequence[Detector],
    folder: str | Path,
    scenes: Sequence[Scene] = (),
    changes: Sequence[SceneChange] = (),
    stage: SceneRenderer | None = None,
    *,
    unchanged: Dataset | None = None,
    baselines: Sequence[BaselineSet] = (),
    seed: int = 0,
    sources: Sequence[str] = (),
    worn: Mapping[Path, Camouflage] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Outcome]:
    """Writes a score folder: outcomes, baselines and pictures, whole or not at all.

    Without a stage no scenes are rendered; `unchanged` are the scenes as they are, if they are
    rendered already. The sources are the ground's, or ["procedural"]. `worn` has the camouflages by
    folder, if pictures of them are to be kept. `progress` gets (images done, images in all). The
    outcomes come detector by detector, then change by change.
    """
    refuse_twice("detectors", [each.name for each in detectors])
    refuse_twice("camouflages", [change.name for change in changes])
    refuse_twice("sets of frames", [each.name for each in baselines])
    images = (len(scenes) * (1 + len(changes))) if stage else 0
    count = counter(progress, images + sum(len(each.images) for each in baselines))
    rows: list[Baseline] = []
    outcomes: list[Outcome] = []
    before: SceneView | None = None
    if stage is not None and unchanged is not None:
        _refuse_other_rendering(unchanged, scenes, stage)
    with finished_folder(Path(folder)) as partial:
        if stage is not None:
            wanted = [
                replace(change, other_classes=is_pictured(CamouflageName.read(change.name)))
                for change in changes
            ]
            shown = views(
                detectors,
                scenes,
                wanted,
                stage,
                unchanged=unchanged,
                other_classes=True,
                progress=count,
            )
            before = next(shown)
            writer = _Writer(partial, detectors, scenes, stage.renderer.name, before)
            rows = writer.baselines(seed)
            for after in shown:
                writer.add(after)
            outcomes = writer.write()
        likeness: list[Likeness] = []
        for each in baselines:
            view = look(detectors, each.name, each.images, other_classes=True)
            rows += measure_baselines(detectors, each, view, seed=seed)
            if before is not None:
                likeness += compare_kinds(detectors, each, view, scenes, before, seed=seed)
            count(len(each.images))
        if likeness:
            write_rows(partial / LIKENESS, likeness)
        thresholds = {each.name: each.threshold for each in detectors}
        rows.sort(key=lambda row: [*thresholds].index(row.detector))
        write_rows(partial / "baselines.json", rows)
        if worn and stage is not None:
            _add_patterns(partial, worn, stage.fleet)
        renderer = None if stage is None else stage.renderer.name
        write_record(partial, ScoreRecord(thresholds, seed, renderer, list(sources)))
    return outcomes


def _refuse_other_rendering(
    unchanged: Dataset, scenes: Sequence[Scene], stage: SceneRenderer
) -> None:
    """Refuses unchanged images that differ from the scenes in more than the camouflage."""
    drawn = [(scene.id, len(scene.placements)) for scene in scenes]
    if drawn != list(zip(unchanged.ids, map(len, unchanged.boxes), strict=True)):
        raise StoredFileError(
            f"{unchanged.folder} has other images or vehicles than its scenes.jsonl says; copy the "
            "whole folder again, or make the dataset again."
        )
    renderer = stage.renderer
    if unchanged.renderer != renderer.name:
        raise ConfigurationError(
            f"{unchanged.folder} was rendered by {unchanged.renderer}, not by {renderer.name}; "
            f"give --renderer {unchanged.renderer}, or the same scenes rendered by "
            f"{renderer.name}."
        )
    if unchanged.rendering != renderer.record(scenes):
        raise ConfigurationError(
            f"{unchanged.folder} was rendered with other settings than are asked for here, or by "
            "another version of skyproof or Blender; render it anew."
        )


@dataclass(frozen=True)
class _Writer:
    """Takes one view after another, and keeps what the score folder holds of each."""

    _folder: Path
    _detectors: Sequence[Detector]
    _scenes: Sequence[Scene]
    _renderer: str
    _before: SceneView
    _pairs: list[Pair] = field(default_factory=list)
    # Tables are ordered by detector, then by camouflage.
    _outcomes: dict[str, list[Outcome]] = field(default_factory=lambda: defaultdict(list))
    _sets: dict[str, list[SetScore]] = field(default_factory=lambda: defaultdict(list))

    def baselines(self, seed: int) -> list[Baseline]:
        name = "Blender Cycles test" if self._renderer == "cycles" else "rendered test"
        places = [scene.background.tile for scene in self._scenes]
        images = BaselineSet(name, self._before.images, real=False, places=places)
        return measure_baselines(self._detectors, images, self._before, seed=seed)

    def add(self, after: SceneView) -> None:
        """Compares a view with that of the unchanged scenes."""
        for number, detector in enumerate(self._detectors):
            found = compare(self._scenes, self._before, after, detector, self._renderer)
            self._outcomes[detector.name] += found
            self._sets[detector.name] += self._set_scores(detector, after)
            if number == 0 and is_pictured(CamouflageName.read(after.name)):
                self._draw(after, detector, found)

    def write(self) -> list[Outcome]:
        """Writes all but the pictures, which exist already, and returns the outcomes."""
        outcomes = [outcome for rows in self._outcomes.values() for outcome in rows]
        write_outcomes(self._folder / "outcomes.parquet", outcomes)
        sets = [self._set_scores(each, self._before) for each in self._detectors]
        rows = [row for part in (*sets, *self._sets.values()) for row in part]
        write_rows(self._folder / "sets.json", rows)
        write_rows(self._folder / "pairs" / "pairs.json", self._pairs)
        return outcomes

    def _set_scores(self, detector: Detector, view: SceneView) -> list[SetScore]:
        rows = []
        called = self._called_another_class(detector, view)
        for match in MATCHES:
            matches = view.matched(detector.name, match)
            _, false_alarms = matches.counts_at(detector.threshold)
            ap = average_precision(matches)
            per_km2 = false_alarms_per_km2(false_alarms, view.images.area_m2)
            other = called if match == LENIENT_MATCH else math.nan
            place = (view.name, self._renderer, detector.name, match)
            rows.append(SetScore(*place, ap, per_km2, other))
        return rows

    def _called_another_class(self, detector: Detector, view: SceneView) -> float:
        """The share of the vehicles found before on which only another class is detected."""
        called = None if view is self._before else view.called_another_class(detector)
        if called is None:
            return math.nan
        before, after = (
            vehicles_seen(one, detector, LENIENT_MATCH) for one in (self._before, view)
        )
        others = set(itertools.compress(after, called))
        found = [place for place, (hit, *_) in before.items() if hit]
        return sum(place in others for place in found) / len(found) if found else math.nan

    def _draw(self, after: SceneView, detector: Detector, outcomes: Sequence[Outcome]) -> None:
        """Draws the chosen scenes of one camouflage; all camouflages share those without it."""
        scenes: dict[str, list[Outcome]] = {}
        for outcome in outcomes:
            if outcome.match == MAIN_MATCH:
                scenes.setdefault(outcome.scene, []).append(outcome)
        for scene, why in choose_scenes(scenes).items():
            rows = scenes[scene]
            before = [(o.placement, o.detected_original, o.score_original) for o in rows]
            then = [(o.placement, o.detected_adversarial, o.score_adversarial) for o in rows]
            self._pairs.append(
                Pair(
                    camouflage=after.name,
                    detector=detector.name,
                    scene=scene,
                    why=why,
                    vehicles=len(rows),
                    found_before=sum(row.detected_original for row in rows),
                    found_after=sum(row.detected_adversarial for row in rows),
                    original=self._picture(self._before, scene, detector, before),
                    adversarial=self._picture(after, scene, detector, then),
                )
            )

    def _picture(
        self,
        view: SceneView,
        scene: str,
        detector: Detector,
        vehicles: Sequence[tuple[int, bool, float]],
    ) -> str:
        """Draws the detections in one image unless its file exists; returns the file."""
        file = f"{view.name}/{scene}.jpg"
        path = self._folder / "pairs" / file
        if path.exists():
            return file
        index = list(view.images.ids).index(scene)
        found = view.found[detector.name][index]
        boxes = view.images.boxes[index].numpy()
        picture = draw_scene(
            view.images.image(index).permute(1, 2, 0).numpy(),
            [(boxes[place], hit, score) for place, hit, score in vehicles],
            found.boxes.cpu().numpy(),
            found.scores.cpu().numpy(),
            detector.threshold,
        )
        with write_beside(path) as temporary:
            picture.save(temporary, "JPEG", quality=85, subsampling=0)
        return file


def _add_patterns(folder: Path, worn: Mapping[Path, Camouflage], fleet: Fleet) -> None:
    """Adds pictures of the pictured camouflages."""
    for place, camouflage in worn.items():
        if not is_pictured(CamouflageName.read(place.name)):
            continue
        own = folder / "patterns" / place.name
        picture = portrait(fleet, camouflage.cpu())
        write_png(own / "on_vehicle.png", picture.permute(1, 2, 0).numpy())
        for file in ("texture.png", "steps.jsonl"):
            if (place / file).exists():
                write_bytes(own / file, inside(place, file, place).read_bytes())


def choose_scenes(scenes: Mapping[str, Sequence[Outcome]]) -> dict[str, str]:
    """Chooses scenes to show, and says why each was chosen.

    These are the first six by SHA-256 of their id, then those with most and fewest hidden vehicles.
    """
    order = sorted(scenes, key=lambda scene: hashlib.sha256(scene.encode()).hexdigest())
    chosen = dict.fromkeys(order[:_COUNT], "Chosen by hash")

    def hidden(scene: str) -> int:
        return sum(int(o.detected_original) - int(o.detected_adversarial) for o in scenes[scene])

    # Only scenes in which something was found before can show success or failure.
    others = [scene for scene in order[_COUNT:] if any(o.detected_original for o in scenes[scene])]
    if len(others) >= 2:
        chosen[max(others, key=hidden)] = "Most vehicles hidden"
        others = [scene for scene in others if scene not in chosen]
        kept = min(others, key=lambda scene: (hidden(scene), -len(scenes[scene])))
        chosen[kept] = "Fewest vehicles hidden"
    return chosen


def draw_scene(
    image: UInt8[np.ndarray, "H W 3"],
    vehicles: Sequence[tuple[Float[np.ndarray, " 4"], bool, float]],
    boxes: Float[np.ndarray, "K 4"],
    scores: Float[np.ndarray, " K"],
    threshold: float,
) -> Image.Image:
    """Draws an image (sRGB bytes) at twice its size, with vehicles (box, found, score)."""
    height, width = image.shape[:2]
    size = (width * _ENLARGE, height * _ENLARGE)
    picture = Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)
    canvas = ImageDraw.Draw(picture)
    alarms = set(np.flatnonzero(scores >= scores.dtype.type(threshold)).tolist())
    for box, found, score in vehicles:
        _rectangle(canvas, box, FOUND if found else MISSED, dash_px=0 if found else 8)
        if found:
            alarms.discard(_nearest(boxes, scores, alarms, box, score))
    for index in alarms:
        _rectangle(canvas, boxes[index], FALSE_ALARM, dash_px=3)
    return picture


def _nearest(
    boxes: Float[np.ndarray, "K 4"],
    scores: Float[np.ndarray, " K"],
    among: set[int],
    box: Float[np.ndarray, " 4"],
    score: float,
) -> int:
    """Finds a vehicle's detection: the one with its score, or the nearest of several such."""
    centre = box.reshape(2, 2).mean(axis=0)

    def difference(index: int) -> tuple[float, float]:
        offset = boxes[index].reshape(2, 2).mean(axis=0) - centre
        return round(abs(float(scores[index]) - score), 4), float(np.hypot(*offset))

    return min(among, key=difference, default=-1)


def _rectangle(
    canvas: ImageDraw.ImageDraw, box: Float[np.ndarray, " 4"], colour: str, dash_px: int
) -> None:
    """Draws a frame 4 px outside a box of the original image; solid where `dash_px` is 0."""
    x0, y0, x1, y1 = _ENLARGE * box.astype(np.float64) + (-4, -4, 4, 4)
    corners = [np.array(corner) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))]
    for start, end in itertools.pairwise(corners):
        length = max(float(np.hypot(*(end - start))), 1e-6)
        dash = dash_px or length
        for begin in np.arange(0.0, length, 2 * dash):
            ends = [
                tuple(start + (end - start) * min(at / length, 1.0)) for at in (begin, begin + dash)
            ]
            # A dark line beneath keeps every colour legible on bright ground.
            canvas.line(ends, fill="#101010", width=5)
            canvas.line(ends, fill=colour, width=3)
