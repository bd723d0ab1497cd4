"""The measurement that all tests share: every vehicle without and with each change."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import Detector
from skyproof.measure.views import SceneChange, SceneRenderer, SceneView, counter, views
from skyproof.ranges import Match
from skyproof.render.frames import Renderer
from skyproof.results.outcomes import MATCHES, Outcome
from skyproof.scenes.scene import Placement, Scene
from skyproof.vehicles.fleet import Fleet

_OUT_OF_SIGHT = (False, 0.0, math.nan)


def measure(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    camouflages: Mapping[str, Camouflage],
    *,
    fleet: Fleet,
    renderer: Renderer,
    folder: str | Path | None = None,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> list[Outcome]:
    """Tests every detector on every vehicle, without and with each camouflage.

    Args:
        detectors: detectors with cards.
        scenes: scenes of one image size, and of the detectors' resolution.
        camouflages: camouflages by their names in tables.
        fleet: vehicles of the scenes.
        renderer: renderer of the scenes.
        folder: score folder to write, such as `my_run/scores/mine`, for `Results.open` and
            `write_report`; None writes nothing.
        device: device of the renderer.
        progress: called with (images done, images in all).

    Returns:
        One outcome for each detector, camouflage, rule and vehicle in sight, in this order.

    Raises:
        ConfigurationError: no scene shows a vehicle, a detector is made for another resolution or
            finds no vehicle without camouflage, or two detectors have one name.
        StoredFileError: a tile is missing or damaged.
        RunFolderError: the folder exists, or the disk cannot take it.
    """
    changes = [SceneChange(name, camouflage) for name, camouflage in camouflages.items()]
    stage = SceneRenderer(fleet, renderer, device)
    if folder is not None:
        from skyproof.measure.score import score

        return score(detectors, folder, scenes, changes, stage, progress=progress)
    count = counter(progress, len(scenes) * (1 + len(changes)))
    before, *changed = views(detectors, scenes, changes, stage, progress=count)
    return [
        outcome
        for detector in detectors
        for after in changed
        for outcome in compare(scenes, before, after, detector, renderer.name)
    ]


def compare(
    scenes: Sequence[Scene],
    before: SceneView,
    after: SceneView,
    detector: Detector,
    renderer: str,
    matches: Sequence[Match] = MATCHES,
) -> list[Outcome]:
    """Returns a detector's outcomes under one change, by each rule for every vehicle in sight."""
    outcomes = []
    for match in matches:
        seen_after = vehicles_seen(after, detector, match)
        for (image, index), seen_before in vehicles_seen(before, detector, match).items():
            scene = scenes[image]
            changed = seen_after.get((image, index), _OUT_OF_SIGHT)
            outcomes.append(
                Outcome(
                    scene=scene.id,
                    placement=index,
                    camouflage=after.name,
                    renderer=renderer,
                    detector=detector.name,
                    match=match,
                    detected_original=seen_before[0],
                    detected_adversarial=changed[0],
                    score_original=seen_before[1],
                    score_adversarial=changed[1],
                    distance_original_m=seen_before[2],
                    distance_adversarial_m=changed[2],
                    visible_fraction=float(before.images.visible_fractions[image][index]),
                    **_situation(scene, scene.placements[index]),
                )
            )
    return outcomes


def vehicles_seen(
    view: SceneView, detector: Detector, match: Match
) -> dict[tuple[int, int], tuple[bool, float, float]]:
    """By image and index in it: whether a vehicle in sight is found, its score and distance."""
    matches = view.matched(detector.name, match)
    columns = (
        matches.image_of_vehicle,
        matches.index_of_vehicle,
        matches.found_at(detector.threshold),
        matches.score_of_vehicle,
        matches.distance_of_vehicle_m,
    )
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {(image, index): (found, score, far) for image, index, found, score, far in rows}


def _situation(scene: Scene, placement: Placement) -> dict[str, Any]:
    """The surroundings of a vehicle, as outcomes hold them."""
    sun_azimuth_deg = math.degrees(scene.sun.azimuth_rad) % 360
    heading_deg = math.degrees(placement.heading_rad) % 360
    turned_deg = (heading_deg - sun_azimuth_deg) % 360
    return {
        "vehicle": placement.vehicle,
        "body_type": placement.vehicle.rpartition("-")[0] or placement.vehicle,
        "background": scene.background.tile,
        "sun_elevation_deg": math.degrees(scene.sun.elevation_rad),
        "sun_azimuth_deg": sun_azimuth_deg,
        "tilt_deg": math.degrees(scene.camera.tilt_rad),
        "camera_azimuth_deg": math.degrees(scene.camera.azimuth_rad) % 360,
        "heading_deg": heading_deg,
        "heading_to_sun_deg": min(turned_deg, 360 - turned_deg),
        "condition": scene.weather.condition,
    }
