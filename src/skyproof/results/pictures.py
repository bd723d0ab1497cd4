"""Matched pairs as pictures, with found and missed vehicles and false alarms."""

import hashlib
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from skyproof.results.pairs.outcomes import Outcome

# Green, vermilion and yellow of Okabe and Ito; line style tells them apart without colour.
FOUND = "#00C48C"
MISSED = "#FF6A00"
FALSE_ALARM = "#F0E442"
_COUNT = 6
_ENLARGE = 2


def choose_scenes(scenes: Mapping[str, Sequence[Outcome]]) -> dict[str, str]:
    """Chooses scenes to show, with reasons: the first six by SHA-256 of their id, then the ones
    with most and with fewest vehicles hidden.
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
    """Draws one image (sRGB bytes) at twice its size, with a detector's detections.

    A vehicle has its box (pixel xyxy), whether it was found, and the score of its detection. False
    alarms have the threshold at least.
    """
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
    """Finds a vehicle's detection: the one with its score, among several the nearest."""
    centre = box.reshape(2, 2).mean(axis=0)

    def difference(index: int) -> tuple[float, float]:
        offset = boxes[index].reshape(2, 2).mean(axis=0) - centre
        return round(abs(float(scores[index]) - score), 4), float(np.hypot(*offset))

    return min(among, key=difference, default=-1)


def _rectangle(
    canvas: ImageDraw.ImageDraw, box: Float[np.ndarray, " 4"], colour: str, dash_px: int
) -> None:
    """Draws a frame 4 px outside a box of the original image; solid where `dash_px` is 0."""
    x0, y0, x1, y1 = (
        _ENLARGE * float(value) + outward
        for value, outward in zip(box, (-4, -4, 4, 4), strict=True)
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
