"""Scenes as they are and under changes, rendered and shown to detectors batch by batch."""

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import Picture, PictureInMemory, Window
from skyproof.detectors.detector import Detections, Detector, TrainableDetector
from skyproof.detectors.inference import detect_by_each
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.errors import ConfigurationError
from skyproof.ranges import Match
from skyproof.render.dataset import AT_A_TIME, in_threads, placed_vehicles
from skyproof.render.frames import Frames, Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.results.outcomes import ORIGINAL
from skyproof.results.precheck import Kind
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet

_BATCH_SIZE = 8


@dataclass(frozen=True, eq=False)
class SceneChange:
    """A change of scenes before they are rendered; None leaves the scene as it is."""

    name: str  # in the outcomes
    camouflage: Camouflage | None = None  # of all vehicles
    blur_sigma_px: float | None = None  # of the vehicles
    sun_elevation_deg: float | None = None
    kind: Kind | None = None  # in the precheck; None for a camouflage under test
    other_classes: bool = False  # whether objects of other classes are looked for, too

    def lit(self, scene: Scene) -> Scene:
        """Returns the scene under the changed sun."""
        if self.sun_elevation_deg is None:
            return scene
        elevation_rad = math.radians(self.sun_elevation_deg)
        return replace(scene, sun=replace(scene.sun, elevation_rad=elevation_rad))


@dataclass(frozen=True, eq=False)
class SceneView:
    """Scenes under one change, and the detections in them."""

    name: str  # of the change; "original" without one
    images: Dataset  # one per scene, with its vehicles; rendered ones are rendered on demand
    found: Mapping[str, Sequence[Detections]]  # by detector and image
    # The same of other classes, where they are known and asked for.
    others: Mapping[str, Sequence[Detections]] = field(default_factory=dict)
    _matched: dict[tuple[str, Match], MatchTable] = field(default_factory=dict, repr=False)

    def called_another_class(self, detector: Detector) -> Bool[np.ndarray, " T"] | None:
        """Returns for each vehicle in sight whether a detector finds only another class on it.

        It uses the lenient rule at the frozen threshold; None if other classes are not known.
        """
        others = self.others.get(detector.name)
        if others is None:
            return None
        called = match_images(others, self.images, criterion=LENIENT_MATCH)
        missed = ~self.matched(detector.name, LENIENT_MATCH).found_at(detector.threshold)
        return np.asarray(missed & called.found_at(detector.threshold))

    def matched(self, detector: str, match: Match) -> MatchTable:
        """A detector's detections matched with the vehicles by a rule, computed once."""
        key = (detector, match)
        if key not in self._matched:
            self._matched[key] = match_images(self.found[detector], self.images, criterion=match)
        return self._matched[key]


@dataclass(frozen=True)
class SceneRenderer:
    """Vehicles, renderer and device for scenes."""

    fleet: Fleet
    renderer: Renderer
    device: torch.device | str = "cpu"

    def under(self, change: SceneChange) -> Callable[[Sequence[Scene]], Frames]:
        """Returns a function that renders scenes under a change; several threads may call it."""
        renderer = self.renderer
        if change.blur_sigma_px is not None:
            if not isinstance(renderer, TorchRenderer):
                raise ConfigurationError(
                    "Only the differentiable renderer draws vehicles at another sharpness than "
                    "that of their ground; give TorchRenderer."
                )
            settings = replace(renderer.settings, blur_sigma_px=change.blur_sigma_px)
            renderer = TorchRenderer(renderer.backgrounds, settings)
        camouflage = None if change.camouflage is None else change.camouflage.to(self.device)

        @torch.no_grad()
        def draw(scenes: Sequence[Scene]) -> Frames:
            vehicles = placed_vehicles(self.fleet, scenes).to(self.device)
            lit = [change.lit(scene) for scene in scenes]
            return renderer(lit, vehicles if camouflage is None else camouflage(vehicles))

        return draw


def views(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    changes: Iterable[SceneChange],
    stage: SceneRenderer,
    *,
    unchanged: Dataset | None = None,
    other_classes: bool = False,
    progress: Callable[[int], None],
) -> Iterator[SceneView]:
    """Yields the view of the scenes as they are, then one under each change.

    Images have 8 bits a channel, as in files. On a CPU several batches at a time are rendered and
    shown to networks, even while the caller uses a view; only the caller's thread calls
    black-box detectors. `unchanged` are the scenes as they are, if they are rendered already;
    `other_classes` asks for objects of other classes in them. `progress` gets the number of images
    of each finished batch.
    """
    _check(detectors, scenes)
    if unchanged is None:
        changes = itertools.chain([SceneChange(ORIGINAL, other_classes=other_classes)], changes)
    rendered = _render_and_detect(detectors, scenes, changes, stage, progress)
    if unchanged is None:
        before = next(rendered)
    else:
        before = look(detectors, ORIGINAL, unchanged, other_classes=other_classes)
        progress(len(scenes))
    for each in detectors:
        _refuse_blind(each, before)
    yield before
    yield from rendered


def look(
    detectors: Sequence[Detector], name: str, images: Dataset, *, other_classes: bool
) -> SceneView:
    """Runs every detector on existing images, on request also for its other classes."""
    asked = {each.name: each for each in detectors}
    known = ((each.name, each.of_other_classes()) for each in detectors if other_classes)
    others = {name: each for name, each in known if each is not None}
    found = detect_by_each([*asked.values(), *others.values()], images)
    of_vehicles = dict(zip(asked, found[: len(asked)], strict=True))
    of_others = dict(zip(others, found[len(asked) :], strict=True))
    return SceneView(name, images, of_vehicles, of_others)


def counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[int], None]:
    """Turns a callback for (done, total), if any, into one for the number of further images."""
    done = 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None:
            progress(done, total)

    return count


_Batch = tuple[SceneChange, Callable[[Sequence[Scene]], Frames], Sequence[Scene]]
"""A change, the function that draws scenes under it, and some scenes."""


def _render_and_detect(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    changes: Iterable[SceneChange],
    stage: SceneRenderer,
    progress: Callable[[int], None],
) -> Iterator[SceneView]:
    gsd_m = scenes[0].camera.gsd_m
    threads = torch.get_num_threads()
    several = stage.renderer.concurrent and torch.device(stage.device).type == "cpu"
    trainable = several and all(isinstance(each, TrainableDetector) for each in detectors)
    count = min(threads, AT_A_TIME) if trainable else threads if several else 1

    def work() -> Iterator[_Batch]:
        for change in changes:
            draw = stage.under(change)
            for start in range(0, len(scenes), _BATCH_SIZE):
                yield change, draw, scenes[start : start + _BATCH_SIZE]

    def draw_and_look(batch: _Batch) -> tuple[_Batch, Frames, Dataset, SceneView | None]:
        change, draw, some = batch
        frames = draw(some)
        unlabelled = [torch.zeros(0, 4)] * len(some)
        shown = Dataset.of_images(list(_bytes(frames)), unlabelled, gsd_m=gsd_m)
        return batch, frames, shown, seen(change, shown) if trainable else None

    def seen(change: SceneChange, shown: Dataset) -> SceneView:
        return look(detectors, change.name, shown, other_classes=change.other_classes)

    with in_threads(draw_and_look, work(), count) as drawn:
        if not trainable:
            # Rendering is done ahead, so detectors mostly have the cores to themselves.
            torch.set_num_threads(threads)
        batches = math.ceil(len(scenes) / _BATCH_SIZE)
        while True:
            pictures: list[Picture] = []
            boxes: list[Tensor] = []
            visible: list[Tensor] = []
            found: dict[str, list[Detections]] = defaultdict(list)
            others: dict[str, list[Detections]] = defaultdict(list)
            # Asking for one batch more would delay the view until that batch is drawn.
            for (change, draw, batch), frames, shown, known in itertools.islice(drawn, batches):
                # Black-box detectors have not seen the images yet.
                view = known or seen(change, shown)
                for every, own in ((found, view.found), (others, view.others)):
                    for name, detections in own.items():
                        every[name] += detections
                sizes = zip(shown.sizes_px, batch, strict=True)
                pictures += [_Rendered(size, partial(draw, [one])) for size, one in sizes]
                owner = frames.scene_index.cpu()
                # Rounded as in a dataset folder, which keeps corner, width and height.
                corners, ends = frames.boxes.cpu().split(2, dim=1)
                labels = torch.cat([corners, corners + (ends - corners)], dim=1)
                boxes += [labels[owner == index] for index in range(len(batch))]
                fractions = frames.visible_fraction.float().cpu()
                visible += [fractions[owner == index] for index in range(len(batch))]
                progress(len(batch))
            if not pictures:
                return
            ignore = [torch.zeros(0, 4)] * len(scenes)
            ids = [scene.id for scene in scenes]
            images = Dataset(pictures, boxes, ignore, ids, gsd_m, visible_fractions=visible)
            yield SceneView(change.name, images, found, others)


@dataclass(frozen=True, eq=False)
class _Rendered:
    """A picture that is rendered again on demand."""

    size_px: tuple[int, int]
    draw: Callable[[], Frames]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        return _bytes(self.draw())[0].cpu()

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        return PictureInMemory(self.read()).windows(windows)


def _bytes(frames: Frames) -> UInt8[Tensor, "B 3 H W"]:
    return (frames.image * 255).round().byte()


def _check(detectors: Sequence[Detector], scenes: Sequence[Scene]) -> None:
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
    """Refuses two things of one name, because tables and files go by name."""
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(
                f"Two {kind} are called {name!r}; give each once, or take them one after the other."
            )


def _refuse_blind(detector: Detector, unchanged: SceneView) -> None:
    """Refuses a detector that finds no vehicle before a change, because no rate is defined then."""
    matches = unchanged.matched(detector.name, MAIN_MATCH)
    if not matches.vehicles:
        raise ConfigurationError("The scenes show no vehicles to hide; give scenes that do.")
    if not matches.found_at(detector.threshold).any():
        raise ConfigurationError(
            f"{detector.name} finds none of the {matches.vehicles} vehicles of these scenes at its "
            f"threshold of {detector.threshold:.4g}, so no success rate (EASR) is defined for it; "
            "train it longer or on more images, or leave it out."
        )
