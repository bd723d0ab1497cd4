"""Scenes drawn as they are and under changes, and looked at by detectors, batch by batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import Picture, PictureInMemory, Window
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.inference import detect_by_each
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.errors import ConfigurationError
from skyproof.render.dataset import in_threads, placed_vehicles
from skyproof.render.frames import Frames, Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.results.pairs.outcomes import ORIGINAL, Match
from skyproof.results.result import MAIN_MATCH
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet

_BATCH_SIZE = 8


@dataclass(frozen=True, eq=False)
class Change:
    """How scenes are changed before they are drawn; what is None stays as it is.

    Attributes:
        name: as the outcomes show it.
        camouflage: what the vehicles wear.
        blur_sigma_px: how sharp the vehicles are drawn.
        sun_elevation_deg: where the sun stands.
    """

    name: str
    camouflage: Camouflage | None = None
    blur_sigma_px: float | None = None
    sun_elevation_deg: float | None = None

    def lit(self, scene: Scene) -> Scene:
        """The scene under the changed sun."""
        if self.sun_elevation_deg is None:
            return scene
        elevation_rad = math.radians(self.sun_elevation_deg)
        return replace(scene, sun=replace(scene.sun, elevation_rad=elevation_rad))


@dataclass(frozen=True, eq=False)
class View:
    """Scenes as they are, or under one change, and what the detectors find in them.

    Attributes:
        name: of the change; "original" where nothing is changed.
        images: one per scene, with its vehicles; those drawn here are drawn again when they are
            asked for.
        found: per detector and image its detections.
    """

    name: str
    images: Dataset
    found: Mapping[str, Sequence[Detections]]
    _matched: dict[tuple[str, Match], MatchTable] = field(default_factory=dict, repr=False)

    def matched(self, detector: str, match: Match) -> MatchTable:
        """A detector's detections, matched with the vehicles by a rule; worked out once."""
        key = (detector, match)
        if key not in self._matched:
            self._matched[key] = match_images(self.found[detector], self.images, criterion=match)
        return self._matched[key]


@dataclass(frozen=True)
class Stage:
    """What scenes are drawn with.

    Attributes:
        fleet: holds every vehicle that the scenes name.
        renderer: draws them.
        device: where.
    """

    fleet: Fleet
    renderer: Renderer
    device: torch.device | str = "cpu"

    def under(self, change: Change) -> Callable[[Sequence[Scene]], Frames]:
        """Gives what draws scenes under a change; several threads may call it."""
        renderer = self.renderer
        if change.blur_sigma_px is not None:
            if not isinstance(renderer, TorchRenderer):
                raise ConfigurationError(
                    "Only the differentiable renderer draws vehicles at another sharpness than "
                    "that of their ground; give TorchRenderer."
                )
            settings = replace(renderer.settings, blur_sigma_px=change.blur_sigma_px)
            renderer = TorchRenderer(renderer.backgrounds, settings)
        worn = None if change.camouflage is None else change.camouflage.to(self.device)

        @torch.no_grad()
        def draw(scenes: Sequence[Scene]) -> Frames:
            vehicles = placed_vehicles(self.fleet, scenes).to(self.device)
            lit = [change.lit(scene) for scene in scenes]
            return renderer(lit, vehicles if worn is None else worn(vehicles))

        return draw


def views(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    changes: Iterable[Change],
    stage: Stage,
    *,
    unchanged: Dataset | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[View]:
    """Yields the scenes as they are, then under each change, as all detectors see them.

    Images have 8 bits a channel, as in files, and those of more than 1024 px a side are looked at
    in windows (`detect_by_each`). A batch is drawn while the detectors look at the one before.

    Args:
        detectors: with their cards.
        scenes: of one image size.
        changes: of different names.
        stage: what the scenes are drawn with.
        unchanged: the scenes as they are, where they are drawn already.
        progress: called with the number of images of each batch that was looked at.

    Raises:
        ConfigurationError: no scene shows a vehicle, a detector is made for another resolution or
            finds no vehicle without a change, or two detectors have one name.
        StoredFileError: a tile or an image is missing or damaged.
    """
    _refuse_what_cannot_work(detectors, scenes)
    if unchanged is None:
        before = _draw_and_look(detectors, scenes, Change(ORIGINAL), stage, progress)
    else:
        before = look(detectors, ORIGINAL, unchanged)
        if progress:
            progress(len(scenes))
    for each in detectors:
        _refuse_blind(each, before)
    yield before
    for change in changes:
        yield _draw_and_look(detectors, scenes, change, stage, progress)


def look(detectors: Sequence[Detector], name: str, images: Dataset) -> View:
    """Has every detector look at images that are there."""
    found = detect_by_each(detectors, images)
    names = [each.name for each in detectors]
    return View(name, images, dict(zip(names, found, strict=True)))


def counter(
    progress: Callable[[int, int], None] | None, total: int
) -> Callable[[int], None] | None:
    """Turns what is called with (done, total) into what is called with each further number."""
    if progress is None:
        return None
    done = 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        progress(done, total)

    return count


def _draw_and_look(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    change: Change,
    stage: Stage,
    progress: Callable[[int], None] | None,
) -> View:
    """Draws the scenes under a change, and has every detector look at them."""
    draw = stage.under(change)
    batches = [scenes[start : start + _BATCH_SIZE] for start in range(0, len(scenes), _BATCH_SIZE)]
    gsd_m = scenes[0].camera.gsd_m
    pictures: list[Picture] = []
    boxes: list[Tensor] = []
    visible: list[Tensor] = []
    found: dict[str, list[Detections]] = {each.name: [] for each in detectors}
    threads = torch.get_num_threads()
    several = stage.renderer.concurrent and torch.device(stage.device).type == "cpu"
    with in_threads(draw, batches, threads if several else 1) as drawn:
        # Drawing is done ahead, so most of the time the detectors have the cores to themselves.
        torch.set_num_threads(threads)
        for batch, frames in zip(batches, drawn, strict=True):
            pixels = _bytes(frames)
            nothing = [torch.zeros(0, 4)] * len(batch)
            shown = Dataset.of_images(list(pixels), nothing, gsd_m=gsd_m)
            for name, answers in look(detectors, change.name, shown).found.items():
                found[name] += answers
            size_px = (pixels.shape[3], pixels.shape[2])
            pictures += [_Drawn(size_px, partial(draw, [scene])) for scene in batch]
            owner = frames.scene_index.cpu()
            labels = _as_stored(frames.boxes.cpu())
            boxes += [labels[owner == index] for index in range(len(batch))]
            fractions = frames.visible_fraction.float().cpu()
            visible += [fractions[owner == index] for index in range(len(batch))]
            if progress:
                progress(len(batch))
    images = Dataset(
        pictures=pictures,
        boxes=boxes,
        ignore=[torch.zeros(0, 4)] * len(scenes),
        ids=[scene.id for scene in scenes],
        gsd_m=gsd_m,
        visible_fractions=visible,
    )
    return View(change.name, images, found)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A picture that is drawn again whenever somebody looks at it."""

    size_px: tuple[int, int]
    draw: Callable[[], Frames]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        return _bytes(self.draw())[0].cpu()

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        return PictureInMemory(self.read()).windows(windows)


def _bytes(frames: Frames) -> UInt8[Tensor, "B 3 H W"]:
    return (frames.image * 255).round().byte()


def _as_stored(boxes: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """The boxes as a dataset folder gives them back, which keeps corner, width and height."""
    corner = boxes[:, :2]
    return torch.cat([corner, corner + (boxes[:, 2:] - corner)], dim=1)


def _refuse_what_cannot_work(detectors: Sequence[Detector], scenes: Sequence[Scene]) -> None:
    if not detectors:
        raise ConfigurationError("Expected at least one detector, got none; give detector folders.")
    if not any(scene.placements for scene in scenes):
        raise ConfigurationError(
            f"Expected scenes with vehicles, got {len(scenes)} scenes without any; sample others."
        )
    refuse_twice("detectors", [each.name for each in detectors])
    gsd_m = scenes[0].camera.gsd_m
    for each in detectors:
        if not math.isclose(each.card.gsd_m, gsd_m):
            raise ConfigurationError(
                f"{each.name} was made for {each.card.gsd_m} m per pixel but the scenes have "
                f"{gsd_m} m; give a detector and ground of one resolution."
            )


def refuse_twice(kind: str, names: Sequence[str]) -> None:
    """Tables and files go by name: two of one name would be mixed up.

    Raises:
        ConfigurationError: a name comes twice.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigurationError(
            f"Two {kind} are called {twice!r}; give each once, or take them one after the other."
        )


def _refuse_blind(detector: Detector, unchanged: View) -> None:
    """Without a vehicle found before, there is no share of them that a change hides."""
    matches = unchanged.matched(detector.name, MAIN_MATCH)
    if not matches.vehicles:
        raise ConfigurationError("The scenes show no vehicles to hide; give scenes that do.")
    if not matches.found_at(detector.threshold).any():
        raise ConfigurationError(
            f"{detector.name} finds none of the {matches.vehicles} vehicles of these scenes at its "
            f"threshold of {detector.threshold:.4g}, so no success rate (EASR) is defined for it; "
            "train it longer or on more images, or leave it out."
        )
