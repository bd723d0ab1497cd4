"""The detectors, ground and vehicles of an assessment, each loaded once; made from a request."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.assessment.command import Request
from skyproof.assessment.suite import Suite
from skyproof.attacks.world import World
from skyproof.camouflage.palette import ground_palette
from skyproof.cli.ground import inspect_shown
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.blueprint import FOLDER_FILES, FOLDER_WEIGHTS
from skyproof.detectors.card import (
    REFERENCE_DETECTORS,
    detector_folder,
    read_card,
    reference_folder,
)
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.loaded import load_detector, load_ensemble
from skyproof.detectors.onnx_file import OnnxFile
from skyproof.device import choose_device
from skyproof.errors import ConfigurationError, SkyproofError
from skyproof.files import file_digest
from skyproof.imagery.labels.files import label_files, read_labels
from skyproof.imagery.labels.label import Labels
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.sources import Source
from skyproof.layout import Layout
from skyproof.maite.models import ModelDetector, is_maite_model
from skyproof.results.statistics.acceptance import Requirement, fewest_tiles
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.placing import known_places
from skyproof.scenes.settings import side_px
from skyproof.scenes.splits import Split

REFERENCE_GSD_M = 0.125
"""Resolution of the reference detectors, and of detectors that state none."""

ENOUGH_PLACES: Mapping[Split, int] = {"test": 50, "attack": 25}
"""Fewest places of labelled vehicles for all vehicles to stand there. 120 scenes hold about 240
vehicles, and scores of vehicles on one place correlate by up to 0.23 (measured on two flights), so
on 46 places the variance of a rate doubles. There are half as many attack tiles."""

_SIDES = (".shp", ".dbf", ".prj")
"""The files of a Shapefile."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The detectors, ground and vehicles of an assessment, which its steps share.

    `sources` holds the SHA-256 of the user's files by path; a black box is a Python object or an
    ONNX file. `told` holds the notes on imagery of the first look, which are not printed again.
    """

    request: Request
    suite: Suite
    names: tuple[str, ...]
    gsd_m: float
    device: torch.device
    sources: Mapping[str, str]
    black_box: BlackBoxDetector | None = None
    told: list[str] = field(default_factory=list)

    @property
    def source_settings(self) -> SourceSettings:
        """The settings that the user gives for the imagery."""
        return SourceSettings(gsd_m=self.request.gsd)

    @cached_property
    def labels(self) -> Labels | None:
        """The labels of the imagery."""
        path, classes = self.request.labels, self.request.label_classes
        return None if path is None else read_labels(path, classes)

    @cached_property
    def inspected(self) -> list[Source]:
        """The images of the imagery, placed in one plane where they show the same ground."""
        labels = None
        with suppress(SkyproofError):
            # Mistakes in labels are reported where the labels are used.
            labels = self.labels
        return inspect_shown(self.request.imagery, self.source_settings, labels)

    @property
    def layout(self) -> Layout:
        return Layout(self.request.out)

    @property
    def folders(self) -> tuple[Path, ...]:
        """The detectors' folders in the run folder."""
        return tuple(map(self.layout.detector, self.names))

    @property
    def seed(self) -> int:
        return self.request.seed

    @cached_property
    def places(self) -> Places:
        """Places of vehicles: those of labelled ones if cleared imagery shows enough of them."""
        if not self.request.imagery:
            return "uniform"
        return places_of(BackgroundSet.open(self.layout.backgrounds))

    @property
    def image_px(self) -> int:
        """Side of the test images."""
        return side_px(self.suite.image_m, self.gsd_m)

    @property
    def attack_px(self) -> int:
        """Side of the images in attacks."""
        return side_px(self.suite.attack_m, self.gsd_m)

    def megapixels(self, images: int) -> float:
        """Returns the million pixels of so many test images, to estimate time."""
        return images * self.image_px**2 / 1e6

    @property
    def labelled(self) -> bool:
        return self.request.labels is not None

    @property
    def fits_reference(self) -> bool:
        """Whether the reference detectors have the same resolution, so attacks can start there."""
        return math.isclose(self.gsd_m, REFERENCE_GSD_M)

    def load(self, folder: Path) -> Detector:
        """Loads a detector of the run folder; a black-box detector gets the card of its folder."""
        if self.black_box is not None:
            self.black_box.set_card(read_card(folder))
            return self.black_box
        return load_detector(folder)

    @cached_property
    def detectors(self) -> Sequence[Detector]:
        """The detectors of the run folder, on the device."""
        if self.black_box is not None:
            return [self.load(self.folders[0])]
        return load_ensemble(self.folders, self.device, self.gsd_m)

    @cached_property
    def references(self) -> Sequence[TrainableDetector]:
        """The reference detectors, on the device."""
        folders = [reference_folder(name) for name in REFERENCE_DETECTORS]
        return load_ensemble(folders, self.device, self.gsd_m)

    @cached_property
    def world(self) -> World:
        """The ground, vehicles and renderer of attacks."""
        return World.open(
            self.layout.backgrounds,
            self.layout.fleets / "attack",
            size_px=self.attack_px,
            places=self.places,
        )

    @cached_property
    def palette(self) -> Float[Tensor, "colours 3"]:
        """The ground's colours; a camouflage without a palette takes none of them."""
        return ground_palette(self.world.backgrounds)


def places_of(ground: BackgroundSet) -> Places:
    """Decides where vehicles stand on cleared imagery: where labelled ones did, if they suffice."""
    tiles = {split: ground.tiles(split) for split in ENOUGH_PLACES}
    if all(
        sum(len(known_places(tile)) for tile in tiles[split]) >= count
        for split, count in ENOUGH_PLACES.items()
    ):
        return "removed"
    known = all(any(tile.drivable for tile in of_split) for of_split in tiles.values())
    return "drivable" if known else "uniform"


def subject_of(request: Request, suite: Suite, black_box: BlackBoxDetector | None) -> Subject:
    """Checks the request, and reads the detectors' cards."""
    request.refuse_contradictions(objects=black_box is not None)
    if request.requirement is not None:
        _refuse_what_scenes_cannot_show(request.requirement, suite.test_images)
    usual_m = request.detector_gsd or REFERENCE_GSD_M
    places = [] if black_box is not None else [*request.detectors]
    folders = [detector_folder(place) for place in places]
    if black_box is not None:
        known = [(black_box.name, usual_m)]
    elif folders[0].suffix.lower() == ".onnx" and folders[0].is_file():
        # It answers like a callable, and resizes images to its own resolution.
        classes = request.vehicle_classes
        file = OnnxFile(folders[0], classes, request.detector_gsd, REFERENCE_GSD_M)
        black_box = BlackBoxDetector(file, request.checkpoint_name, vehicle_classes=classes)
        known = [(black_box.name, REFERENCE_GSD_M)]
    elif folders[0].is_file():
        known = [(request.checkpoint_name, usual_m)]
    else:
        known = [(card.name, card.gsd_m) for card in map(read_card, folders)]
    names = [name for name, _ in known]
    for number, (name, gsd_m) in enumerate(known):
        if name in names[:number]:
            raise ConfigurationError(
                f"{places[number]} is a second {name}; give each kind of detector once."
            )
        if not math.isclose(gsd_m, known[0][1]):
            raise ConfigurationError(
                f"{places[number]} sees {gsd_m:g} m per pixel and {places[0]} {known[0][1]:g}; "
                "assess them in runs of their own."
            )
    read = [*places, *([] if request.labels is None else [request.labels])]
    device = choose_device(request.device)
    sources = {str(path): _digest(detector_folder(path)) for path in read}
    its = Subject(request, suite, tuple(names), known[0][1], device, sources, black_box)
    if black_box is not None and not its.fits_reference:
        raise ConfigurationError(
            f"Attacks on a callable start from the reference detectors, which see "
            f"{REFERENCE_GSD_M} m per pixel, got {its.gsd_m:g}; give it images of "
            f"{REFERENCE_GSD_M} m and resize them in the function."
        )
    return its


def _refuse_what_scenes_cannot_show(requirement: Requirement, scenes: int) -> None:
    """Refuses a requirement that needs more tiles than there are test scenes."""
    needed = fewest_tiles(requirement.reject, requirement.consumer_risk)
    if needed >= scenes:
        raise ConfigurationError(
            f"To accept a detector at --reject {requirement.reject:g} with --consumer-risk "
            f"{requirement.consumer_risk:g} takes {needed} test tiles at least, and the suite has "
            f"{scenes} scenes, which do not all stand on tiles of their own; ask for a larger "
            "share or a larger risk."
        )


def checked_object(
    detector: object, name: str | None, vehicle_classes: Sequence[str], architecture: str | None
) -> BlackBoxDetector:
    """Checks a Python object, and returns it as a black-box detector."""
    of_files: dict[str, object] = {"architecture": architecture}
    if is_maite_model(detector):
        detector = ModelDetector(detector, vehicle_classes=vehicle_classes)
        vehicle_classes = ()
    elif isinstance(detector, Detector):
        of_files["vehicle_classes"] = vehicle_classes
    for option, value in of_files.items():
        if value:
            raise ConfigurationError(
                f"{option} is for checkpoint files, and the detector is an object, which decides "
                "it itself; leave the option out."
            )
    return BlackBoxDetector(detector, name, vehicle_classes=vehicle_classes)


def _digest(path: Path) -> str:
    """Returns the SHA-256 of a checkpoint, detector card or labels, so that a change is noticed."""
    total = hashlib.sha256()
    for file in _files(path):
        total.update(f"{file.name} {file_digest(file)}\n".encode())
    return total.hexdigest()


def _files(path: Path) -> list[Path]:
    # The card of a detector holds the digest of its weights.
    if (path / "detector.json").is_file():
        return [path / "detector.json"]
    if path.is_dir():
        return label_files(path)
    if path.suffix.lower() == ".shp":
        return [side for suffix in _SIDES if (side := path.with_suffix(suffix)).is_file()]
    names = FOLDER_FILES if path.name in FOLDER_WEIGHTS else ()
    return [path, *filter(Path.is_file, map(path.with_name, names))]
