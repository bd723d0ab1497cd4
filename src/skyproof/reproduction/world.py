"""Sizes of the made-up world of a reproduction: ground, vehicles, scenes and images."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import Count, Fraction, GroundResolution, check_ranges
from skyproof.scenes.places import Places
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.weather import CONDITIONS, MIXED_CONDITIONS
from skyproof.vehicles.settings import PaintVariety

GSD_M = 0.125

Rendered = Literal["train", "validation", "test", "empty", "weather"]
"""The splits that are rendered: all but "attack", whose scenes are drawn during an attack, test
ground without vehicles, and the test scenes in weather."""

RENDERED: tuple[Rendered, ...] = ("train", "validation", "test")
"""The splits that a run with a training renders."""

MOST_SCENES = 200
"""Scenes, the first, at whose vehicles features are stored: some 600 vehicles, as many as a picture
of points can show. Scenes are drawn independently, so the first are a fair sample."""


@dataclass(frozen=True)
class WorldSizes:
    """How much ground, how many vehicles and scenes a run has.

    Attributes:
        gsd_m: metres per pixel of ground and images.
        image_px: image side.
        tiles: drawn ground tiles per split (train, validation, attack, test).
        vehicles: vehicles in the fleet of each split.
        validation_images: number of images that choose weights and threshold.
        test_images: number of images that are attacked and reported.
        training_vehicles: largest number of vehicles in a training image; others have 1 to 5.
        training_places: where vehicles stand in training images: uniform, removed or drivable.
        test_places: where they stand in validation, attack and test images.
        parked_share: share of the training images with a row of parked vehicles, if places are
            uniform.
        training_conditions: weather and light of the training images, each equally likely.
        paints: paints of the vehicles in training and validation images.
        shapes: share of these vehicles with a random shape.
    """

    gsd_m: GroundResolution = GSD_M
    # Detectors take no smaller ones.
    image_px: Annotated[int, Meta(ge=96, le=16_384)] = 192
    tiles: tuple[Count, Count, Count, Count] = (64, 12, 24, 40)
    vehicles: tuple[Count, Count, Count, Count] = (128, 32, 32, 32)
    training_images: Count = 2000
    validation_images: Count = 120
    test_images: Count = 120
    training_vehicles: Count = 7
    training_places: Places = "uniform"
    test_places: Places = "uniform"
    parked_share: Fraction = 0.5
    training_conditions: tuple[str, ...] = MIXED_CONDITIONS
    paints: PaintVariety = field(default_factory=PaintVariety)
    shapes: Fraction = 0.25

    def __post_init__(self) -> None:
        check_ranges(self)
        # Refuses an image that no vehicle fits into, and more vehicles than a scene may have.
        for scenes in (self.scenes("train"), self.scenes("test")):
            scenes.half_m(self.gsd_m)

    def scenes(self, split: Rendered) -> SceneSettings:
        """Returns the settings of a split's scenes."""
        usual = SceneSettings(size_px=self.image_px, places=self.test_places)
        if split == "train":
            # Some training images are empty, so that detectors see ground alone, too.
            return replace(
                usual,
                vehicles_minimum=0,
                vehicles_maximum=self.training_vehicles,
                places=self.training_places,
                parked_share=self.parked_share if self.training_places == "uniform" else 0.0,
                conditions=self.training_conditions,
            )
        if split == "empty":
            return replace(usual, vehicles_minimum=0, vehicles_maximum=0)
        if split == "weather":
            conditions = tuple(name for name in CONDITIONS if name != "clear")
            return replace(usual, conditions=conditions)
        return usual
