"""The detectors, ground and vehicles of an assessment, each loaded once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.assessment.request import Request
from skyproof.assessment.suite import Suite
from skyproof.attacks.world import World
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import read_card
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.loaded import load_detector, load_ensemble
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, reference_folder
from skyproof.layout import Layout
from skyproof.scenes.places import Places

REFERENCE_GSD_M = 0.125
"""Resolution of the reference detectors, and of detectors that state none."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The detectors, ground and vehicles of an assessment, which its steps share.

    Attributes:
        request: the request.
        suite: the suite of attacks.
        names: names of the detectors.
        gsd_m: metres per pixel of the detectors' images.
        device: device of the detectors.
        sources: SHA-256 of the user's files, by path.
        black_box: the detector, if it is a Python object; else None.
    """

    request: Request
    suite: Suite
    names: tuple[str, ...]
    gsd_m: float
    device: torch.device
    sources: Mapping[str, str]
    black_box: BlackBoxDetector | None = None

    @property
    def layout(self) -> Layout:
        """The paths in the run folder."""
        return Layout(self.request.out)

    @property
    def seed(self) -> int:
        """Seed of everything that is drawn."""
        return self.request.seed

    @property
    def places(self) -> Places:
        """Places of vehicles, which in photographs exclude roofs and trees."""
        return "drivable" if self.request.imagery else "uniform"

    @property
    def image_px(self) -> int:
        """Side of the test images."""
        return self.suite.image_px(self.gsd_m)

    @property
    def attack_px(self) -> int:
        """Side of the images in attacks."""
        return self.suite.attack_px(self.gsd_m)

    @property
    def test_megapixels(self) -> float:
        """Million pixels of all test images, to estimate time."""
        return self.suite.test_images * self.image_px**2 / 1e6

    @property
    def labelled(self) -> bool:
        """Whether the imagery has labels."""
        return self.request.labels is not None

    @property
    def fits_reference(self) -> bool:
        """Whether the reference detectors have the same resolution, and can start attacks."""
        return math.isclose(self.gsd_m, REFERENCE_GSD_M)

    @property
    def cards(self) -> list[Path]:
        """The cards of the detectors in the run folder."""
        return [self.layout.detector(name) / "detector.json" for name in self.names]

    def load(self, folder: Path) -> Detector:
        """Loads a detector of the run folder; a black-box detector gets the card of its folder."""
        if self.black_box is not None:
            self.black_box.set_card(read_card(folder))
            return self.black_box
        return load_detector(folder)

    @cached_property
    def detectors(self) -> Sequence[Detector]:
        """The detectors of the run folder, on the device."""
        folders = [self.layout.detector(name) for name in self.names]
        if self.black_box is not None:
            return [self.load(folders[0])]
        return load_ensemble(folders, self.device, self.gsd_m)

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

    def palette(self, name: CamouflageName) -> Float[Tensor, "colours 3"] | None:
        """The ground's colours, for a camouflage with a palette."""
        return self._ground_palette if name.takes_palette else None

    @cached_property
    def _ground_palette(self) -> Float[Tensor, "colours 3"]:
        return ground_palette(self.world.backgrounds)
