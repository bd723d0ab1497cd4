"""Matched pairs as pictures: the same scene without and with camouflage, vehicles and false alarms drawn in."""

from __future__ import annotations

import base64
import hashlib
import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from skyproof.errors import StoredFileError
from skyproof.files import read_json, read_jsonl
from skyproof.report.run import MAIN_MATCH, Run
from skyproof.results.pairs.outcomes import Outcome

__all__ = ["Pair", "image_uri", "make_pairs"]

# Green, vermilion and yellow of Okabe and Ito; line style tells them apart without colour.
FOUND, MISSED, FALSE_ALARM = "#00C48C", "#FF6A00", "#F0E442"
PAIR_COUNT = 6
_ENLARGE = 2


@dataclass(frozen=True)
class Pair:
    """Two pictures of one scene as data URIs, a caption, and why it was chosen."""

    scene: str
    original: str
    adversarial: str
    caption: str


def make_pairs(
    run: Run, camouflage: str, renderer: str, detector: str, count: int = PAIR_COUNT
) -> list[Pair]:
    """The first `count` scenes by SHA-256 of their id, then the one with most vehicles hidden and the one with fewest.

    Empty where images, labels, detections, the threshold or outcomes are missing.
    """
    rows = [
        o
        for o in run.outcomes or ()
        if (o.camouflage, o.renderer, o.detector, o.match)
        == (camouflage, renderer, detector, MAIN_MATCH)
    ]
    evaluation, plain = run.evaluation(renderer)
    before = _Set.read(run.folder / "datasets" / plain, evaluation, detector)
    after = _Set.read(run.folder / "datasets" / f"{plain}-{camouflage}", evaluation, detector)
    threshold = run.detectors.get(detector, {}).get("threshold")
    if not rows or before is None or after is None or threshold is None:
        return []
    scenes: dict[str, list[Outcome]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    pairs = []
    for scene, why in _choose(scenes, count).items():
        original = before.draw(scene, scenes[scene], float(threshold), False)
        adversarial = after.draw(scene, scenes[scene], float(threshold), True)
        if original and adversarial:
            found = sum(o.detected_original for o in scenes[scene])
            kept = sum(o.detected_adversarial for o in scenes[scene])
            caption = f"{why}. {found} of {len(scenes[scene])} vehicles found before, {kept} after."
            pairs.append(Pair(scene, original, adversarial, caption))
    return pairs


def _choose(scenes: Mapping[str, Sequence[Outcome]], count: int) -> dict[str, str]:
    order = sorted(scenes, key=lambda scene: hashlib.sha256(scene.encode()).hexdigest())
    chosen = dict.fromkeys(order[:count], "Chosen by hash")

    def hidden(scene: str) -> int:
        return sum(int(o.detected_original) - int(o.detected_adversarial) for o in scenes[scene])

    # Only scenes in which something was found before can show success or failure.
    rest = [scene for scene in order[count:] if any(o.detected_original for o in scenes[scene])]
    if len(rest) >= 2:
        chosen[max(rest, key=hidden)] = "Most vehicles hidden"
        rest = [scene for scene in rest if scene not in chosen]
        kept = min(rest, key=lambda scene: (hidden(scene), -len(scenes[scene])))
        chosen[kept] = "Fewest vehicles hidden"
    return chosen


@dataclass(frozen=True)
class _Set:
    """One data set's labels and one detector's detections in it, by scene."""

    images: Path
    boxes: Mapping[str, Mapping[int, Sequence[float]]]
    detections: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, dataset: Path, evaluation: Path, detector: str) -> _Set | None:
        labels = dataset / "annotations.json"
        found = evaluation / "detections" / dataset.name / f"{detector}.jsonl"
        if not (labels.exists() and found.exists()):
            return None
        coco = read_json(labels)
        try:
            scene_of = {image["id"]: Path(image["file_name"]).stem for image in coco["images"]}
            boxes: dict[str, dict[int, Sequence[float]]] = {
                scene: {} for scene in scene_of.values()
            }
            for annotation in coco["annotations"]:
                own = boxes[scene_of[annotation["image_id"]]]
                x, y, width, height = map(float, annotation["bbox"])
                own[annotation.get("placement_index", len(own))] = (x, y, x + width, y + height)
        except (KeyError, TypeError, ValueError) as error:
            raise StoredFileError(
                f"{labels} is not COCO as this version writes it ({error}); render again."
            ) from error
        return cls(
            labels.parent / "images", boxes, {row["image"]: row for row in read_jsonl(found)}
        )

    def draw(
        self, scene: str, outcomes: Sequence[Outcome], threshold: float, after: bool
    ) -> str | None:
        path = self.images / f"{scene}.png"
        if not path.exists() or scene not in self.boxes or scene not in self.detections:
            return None
        try:
            with Image.open(path) as opened:
                size = (opened.width * _ENLARGE, opened.height * _ENLARGE)
                picture = opened.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        except OSError as error:
            raise StoredFileError(
                f"{path} is not a readable image ({error}); render again."
            ) from error
        canvas = ImageDraw.Draw(picture)
        row = self.detections[scene]
        alarms = {i for i, score in enumerate(row["scores"]) if score >= threshold}
        for outcome in outcomes:
            box = self.boxes[scene].get(outcome.placement)
            if box is None:
                continue
            detected = outcome.detected_adversarial if after else outcome.detected_original
            score = outcome.score_adversarial if after else outcome.score_original
            _rectangle(canvas, box, FOUND if detected else MISSED, dash_px=0 if detected else 8)
            if detected:
                alarms.discard(_nearest(row, alarms, box, score))
        for index in alarms:
            _rectangle(
                canvas, [float(value) for value in row["boxes"][index]], FALSE_ALARM, dash_px=3
            )
        return image_uri(picture)


def _nearest(row: Mapping[str, Any], among: set[int], box: Sequence[float], score: float) -> int:
    """Which of the detections is the one that the outcome recorded: the same score, then the nearest centre."""
    centre = np.array(box).reshape(2, 2).mean(axis=0)

    def difference(index: int) -> tuple[float, float]:
        offset = np.array(row["boxes"][index]).reshape(2, 2).mean(axis=0) - centre
        return round(abs(row["scores"][index] - score), 4), float(np.hypot(*offset))

    return min(among, key=difference, default=-1)


def _rectangle(
    canvas: ImageDraw.ImageDraw, box: Sequence[float], colour: str, dash_px: int
) -> None:
    """A frame 4 px outside a box of the original image; solid where `dash_px` is 0."""
    x0, y0, x1, y1 = (
        _ENLARGE * value + outward for value, outward in zip(box, (-4, -4, 4, 4), strict=True)
    )
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


def image_uri(picture: Image.Image, lossless: bool = False) -> str:
    """A picture as a data URI: JPEG for scenes, PNG where texels matter."""
    buffer = io.BytesIO()
    if lossless:
        picture.save(buffer, "PNG", optimize=True)
    else:
        picture.save(buffer, "JPEG", quality=85, subsampling=0)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
