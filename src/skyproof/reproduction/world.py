"""The steps from nothing to rendered images: ground, vehicles, scenes, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.assessment.run import START_S, Step
from skyproof.cli.ground import Ground
from skyproof.cli.render import Render
from skyproof.cli.vehicles import Vehicles
from skyproof.cycles.settings import Rendering
from skyproof.imagery.settings import tiling_for_images
from skyproof.layout import Layout
from skyproof.ranges import Count, Fraction, GroundResolution, check_ranges
from skyproof.reproduction.own_steps import draw_scenes
from skyproof.reproduction.plan import command_step, function_step
from skyproof.scenes.places import Places
from skyproof.scenes.sensor import BlurChoice
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from skyproof.scenes.weather import CONDITIONS, MIXED_CONDITIONS
from skyproof.vehicles.settings import PaintVariety

GSD_M = 0.125

Rendered = Literal["train", "validation", "test", "empty", "weather"]
"""What there can be images of: the splits but for "attack", which draws its own as it goes; test
ground without vehicles, where every detection is a false alarm; and the test scenes in weather, as
far as they go, each under one of all conditions but a clear day."""

RENDERED: tuple[Rendered, ...] = ("train", "validation", "test")
"""The splits of which every run has images."""

# Seconds on one core for a million pixels, and for a vehicle; for the time left alone.
_GROUND_S = 2.6
_VEHICLE_S = 0.08
_RENDER_S = {"torch": 3.2, "cycles": 30.0}


@dataclass(frozen=True)
class WorldSizes:
    """How much ground, how many vehicles and scenes a run has.

    Attributes:
        gsd_m: metres per pixel of ground and images, in which vehicles are of true size.
        image_px: image side.
        tiles: procedural ground tiles per split (train, validation, attack, test).
        vehicles: vehicles in the fleet of each split.
        training_images: rendered images to train on.
        validation_images: images that choose weights and threshold.
        test_images: images to attack and report on.
        training_vehicles: the most vehicles in one training image; validation and test images have
            1 to 5.
        training_places: where vehicles stand in training images: uniform, removed or drivable.
        test_places: where they stand in validation, attack and test images.
        parked_share: share of the training images whose vehicles stand in a row, as parked ones do,
            where places are uniform.
        training_conditions: weather and light of the training images, each equally likely; all
            others show clear days.
        paints: of the vehicles that detectors learn from and choose their threshold by.
        shapes: share of these vehicles whose surface is pushed out at random.
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
        for split in ("train", "test"):
            self.scenes(split).half_m(self.gsd_m)

    def scenes(self, split: str, image_px: int | None = None) -> SceneSettings:
        """Returns how the scenes of a split are drawn; one vehicle an image in an attack.

        Args:
            split: its name.
            image_px: image side; that of the run where not given.
        """
        usual = SceneSettings(size_px=image_px or self.image_px, places=self.test_places)
        if split == "train":
            # Some training images are empty, so that ground alone is learnt too.
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
        return replace(usual, vehicles_maximum=1) if split == "attack" else usual

    def count(self, split: Rendered) -> int:
        """Returns how many images a rendered split has."""
        counts: dict[Rendered, int] = {
            "train": self.training_images,
            "validation": self.validation_images,
            "test": self.test_images,
            "empty": self.test_images,
            "weather": self.test_images,
        }
        return counts[split]

    def megapixels(self, images: int) -> float:
        """Returns how many million pixels so many images have."""
        return images * self.image_px**2 / 1e6


def world_steps(
    layout: Layout,
    sizes: WorldSizes,
    seed: int,
    *,
    splits: Sequence[Rendered] = RENDERED,
    blur_sigma_px: BlurChoice | None = None,
    device: str = "auto",
) -> list[Step]:
    """Returns the steps from nothing to rendered images of some splits."""
    ground = ground_step(layout, sizes, seed, blur_sigma_px=blur_sigma_px)
    scenes = [scene_step(layout, sizes, split, seed) for split in splits]
    rendered = [render_step(layout, sizes, split, device=device) for split in splits]
    return [ground, vehicles_step(layout, sizes, seed), *scenes, *rendered]


def ground_step(
    layout: Layout,
    sizes: WorldSizes,
    seed: int,
    *,
    blur_sigma_px: BlurChoice | None = None,
) -> Step:
    """Returns the step that draws ground."""
    tiling = tiling_for_images(sizes.image_px, gsd_m=sizes.gsd_m, imagery=False)
    command = Ground(
        out=layout.backgrounds,
        tiles=sizes.tiles,
        blur_sigma_px=blur_sigma_px,
        seed=seed,
        tiling=tiling,
    )
    effort_s = START_S + _GROUND_S * sum(sizes.tiles) * tiling.size_px**2 / 1e6
    return command_step("ground", "ground", command, (), (layout.backgrounds,), effort_s=effort_s)


def vehicles_step(layout: Layout, sizes: WorldSizes, seed: int) -> Step:
    """Returns the step that draws the four fleets."""
    command = Vehicles(
        out=layout.fleets,
        counts=sizes.vehicles,
        seed=seed,
        paints=sizes.paints,
        shapes=sizes.shapes,
    )
    effort_s = START_S + _VEHICLE_S * sum(sizes.vehicles)
    return command_step("vehicles", "fleets", command, (), (layout.fleets,), effort_s=effort_s)


def scene_step(layout: Layout, sizes: WorldSizes, split: Rendered, seed: int) -> Step:
    """Returns the step that draws the scenes of a split."""
    ground = _ground_of(split)
    arguments = {
        "backgrounds": layout.backgrounds,
        "fleet": layout.fleets / ground,
        "out": layout.scenes(split),
        "split": ground,
        "count": sizes.count(split),
        "settings": sizes.scenes(split),
        "seed": seed,
    }
    inputs = (layout.backgrounds, layout.fleets)
    return function_step(
        "scenes", split, draw_scenes, arguments, inputs, (layout.scenes(split),), effort_s=START_S
    )


def render_s(rendering: Rendering) -> float:
    """Returns about how long a million pixels take on one core, in seconds."""
    return _RENDER_S[rendering.renderer]


def render_step(
    layout: Layout,
    sizes: WorldSizes,
    split: Rendered,
    *,
    rendering: Rendering | None = None,
    device: str = "auto",
) -> Step:
    """Returns the step that draws a split without camouflage, on either renderer."""
    chosen = rendering or Rendering()
    name = split if chosen.renderer == "torch" else f"{split}-{chosen.renderer}"
    command = Render(
        **vars(chosen),
        scenes=layout.scenes(split),
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / _ground_of(split),
        out=layout.dataset(name),
        device=device,
    )
    effort_s = START_S + render_s(chosen) * sizes.megapixels(sizes.count(split))
    inputs = (layout.backgrounds, layout.fleets, layout.scenes(split))
    return command_step(
        "render",
        name,
        command,
        inputs,
        (layout.dataset(name),),
        extra=chosen.renderer == "cycles",
        effort_s=effort_s,
    )


def _ground_of(split: Rendered) -> Split:
    """The split whose ground and vehicles are shown."""
    if split == "empty" or split == "weather":
        return "test"
    return split
