"""All settings of a reproduction of the paper, as a preset or a JSON file of the same form."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from skyproof.assessment.suite import AttackSteps
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.detectors.card import reference_folder
from skyproof.detectors.settings import Size, TrainingChanges
from skyproof.documents import check_document, read_document
from skyproof.errors import ConfigurationError
from skyproof.imagery.settings import tiling_for_images
from skyproof.ranges import (
    Count,
    Fraction,
    GroundResolution,
    ImageSide,
    Seed,
    WholeNumber,
    check_ranges,
)
from skyproof.scenes.places import Places
from skyproof.scenes.sensor import BlurChoice
from skyproof.scenes.settings import TRAINING_MARGIN_M, SceneSettings
from skyproof.scenes.weather import CONDITIONS, MIXED_CONDITIONS
from skyproof.vehicles.settings import PaintVariety

PRESETS = {
    name: Path(__file__).with_name(f"{name}.json")
    for name in ("quick", "overnight", "paper", "reference")
}
"""The paper's tables in small, with more repeats and in full, and training of the shipped
detectors. The first two draw worlds that were not looked at during development."""

GSD_M = 0.125

Rendered = Literal["train", "validation", "test", "empty", "weather"]
"""The splits that are rendered: all but "attack", whose scenes are drawn during an attack, test
ground without vehicles, and the test scenes in weather."""

RENDERED: tuple[Rendered, ...] = ("train", "validation", "test")
"""The splits that a run with a training renders."""

EMPTY_IN_VALIDATION = 0.5
"""Share of validation images that show ground alone. It leaves 1.9 vehicles on 24 m x 24 m, between
the 1.2 and 3.2 of labelled photographs of two towns (Minsk, first flight; Munich, first place)."""

MOST_SCENES = 200
"""Number of first scenes at whose vehicles features are stored: some 600 vehicles, as many as a
scatter plot can show. Scenes are drawn independently, so the first are a fair sample."""

Known = Literal["retinanet", "faster_rcnn", "yolov5"]
_Magnitude = Annotated[float, Meta(gt=0, le=1)]
_Magnitudes = Annotated[tuple[_Magnitude, ...], Meta(max_length=100)]
_Few = Annotated[int, Meta(ge=1, le=100)]
_Word = Annotated[str, Meta(max_length=100)]
_Textures = Annotated[tuple[_Word, ...], Meta(max_length=50)]
_Text = Annotated[str, Meta(max_length=300)]
_REMEDY = "start from quick.json or paper.json"


@dataclass(frozen=True)
class WorldSizes:
    """How much ground, how many vehicles and scenes a run has.

    Attributes:
        tiles, vehicles: number in each split (train, validation, attack, test).
        training_vehicles: most vehicles in a training or validation image; others have 1 to 5.
        training_places: where vehicles stand in these images: uniform, removed or drivable.
        test_places: where they stand in attack and test images.
        parked_share: share of these images with a row of parked vehicles, if places are uniform.
        shaded_share: share of them with a vehicle in shade or beneath a crown, if there is one.
        empty_share: share of the training images that show ground alone.
        paints, shapes: paints of the vehicles in training and validation images, and the share of
            them with a random shape.
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
    shaded_share: Fraction = 0.3
    empty_share: Fraction = 0.2
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
        if split in ("train", "validation"):
            # A threshold that is chosen on clear days raises false alarms elsewhere, so validation
            # has what training has. It has more empty ground, though: precision depends on it.
            uniform = self.training_places == "uniform"
            return replace(
                usual,
                vehicles_maximum=self.training_vehicles,
                places=self.training_places,
                parked_share=self.parked_share if uniform else 0.0,
                shaded_share=self.shaded_share if uniform else 0.0,
                empty_share=self.empty_share if split == "train" else EMPTY_IN_VALIDATION,
                conditions=self.training_conditions,
                margin_m=TRAINING_MARGIN_M,
            )
        if split == "empty":
            return replace(usual, vehicles_minimum=0, vehicles_maximum=0)
        if split == "weather":
            conditions = tuple(name for name in CONDITIONS if name != "clear")
            return replace(usual, conditions=conditions)
        return usual


@dataclass(frozen=True)
class Resources:
    """Resources of a step that computes much on a cluster; None asks for nothing."""

    gpu: Annotated[int, Meta(ge=0, le=64)] | None = None
    mem_mb: Annotated[int, Meta(ge=1, le=10_000_000)] | None = None
    runtime: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None  # minutes


@dataclass(frozen=True)
class Preset:
    """All settings of a reproduction.

    Attributes:
        seed: seed of everything; repeat k of an attack takes seed + k.
        detectors: detectors that are attacked together and scored one by one (section 3.2).
        training: changes of `TrainingSettings` per detector that the run trains.
        attack: settings of all attacks but for steps and seed.
        textures: constraints of the textures, such as PixFcMa; Fc and PixFc also make parallel
            combinations.
        repeats: attacks of each kind, from different seeds.
        texture_repeats: larger number of repeats by texture.
        magnitudes: PM of shapes alone and of combinations (section 5.5).
        combined_magnitudes: other PM of combinations by texture.
        transfer: textures that are also optimised on single detectors, and on all but one.
        features: textures for which the detectors' features are stored, with a random control and
            the best plain paint.
        weather: textures that are also optimised in all weathers and scored in every weather.
        check_scenes: test scenes of the precheck; 0 for none.
        cycles_repeats: repeats and draws in the Cycles column.
        cycles_headlines: camouflages with all repeats, as many draws and the chosen controls in the
            Cycles column.
        control_magnitude: PM of random shapes on optimised textures, and of the pictured shapes.
        score_batch: camouflages scored in one step; a quarter of them on Cycles.
        reference: detectors that are taken as they come with skyproof.
        best_of: draws of the best-of-N control; 0 for no chosen control.
        searches: random searches of each attack's control.
        blur_sigma_px: blur of the vehicles in pixels, or "paper" for the paper's 2.4; None for the
            blur of the ground.
    """

    seed: Seed
    detectors: Annotated[tuple[Known, ...], Meta(min_length=1, max_length=4)]
    size: Size
    world: WorldSizes
    training: Mapping[Known, TrainingChanges]
    attack: AttackSettings
    attack_image_px: ImageSide
    attack_steps: AttackSteps
    textures: _Textures
    repeats: _Few
    draws: _Few
    cycles_repeats: _Few
    magnitudes: _Magnitudes
    combined_magnitudes: Mapping[_Word, _Magnitudes]
    transfer: _Textures
    control_magnitude: _Magnitude
    score_batch: Count
    threads: Annotated[int, Meta(ge=1, le=1024)]
    resources: Resources
    reference: Annotated[tuple[Known, ...], Meta(max_length=3)] = ()
    best_of: Annotated[int, Meta(ge=0, le=100)] = 0
    searches: Annotated[int, Meta(ge=1, le=100)] = 1
    cycles_headlines: _Textures = ()
    features: _Textures = ()
    weather: _Textures = ()
    weather_images: Count = 160
    texture_repeats: Mapping[_Word, _Few] = field(default_factory=dict)
    blur_sigma_px: BlurChoice | None = None
    title: _Text = ""
    check_scenes: WholeNumber = 60
    preset: _Text = field(default="", compare=False)

    def __post_init__(self) -> None:
        for mistake in self._mistakes():
            raise ConfigurationError(mistake)

    def _mistakes(self) -> Iterator[str]:
        """Yields mistakes that ranges of single settings do not show: names, and combinations."""
        for texture in (*self.textures, *self.combined_magnitudes, *self.texture_repeats):
            TextureConstraints.parse(texture)
        for setting in ("transfer", "features", "weather"):
            for text in getattr(self, setting):
                name = CamouflageName.parse(text)
                if name.kind != "texture" or name.random or name.variant or name.repeat:
                    yield f"{setting} expects optimised textures such as T-U, got {text!r}."
                # A transfer attack may have one detector alone; the others compare two attacks.
                texture = text.removeprefix("T-")
                if setting != "transfer" and texture not in self.textures:
                    yield f"{setting} names {text}, but textures has no {texture}; name it there."
        for text in self.cycles_headlines:
            name = CamouflageName.parse(text)
            if name.random or name.variant or name.repeat:
                yield f"cycles_headlines expects optimised camouflages such as T-U, got {text!r}."
        for texture, repeats in self.texture_repeats.items():
            if repeats < self.repeats:
                yield (
                    f"texture_repeats expects at least the {self.repeats} repeats that every "
                    f"attack has, got {repeats} of {texture}; give more, or leave it out."
                )
        world = self.world
        tile_px = tiling_for_images(world.image_px, gsd_m=world.gsd_m, imagery=False).size_px
        if math.ceil(self.attack_image_px * math.sqrt(2)) + 2 > tile_px:
            yield (
                f"attack_image_px {self.attack_image_px} is larger than what can be cut from tiles "
                f"for images of {world.image_px} px; give at most world.image_px."
            )
        # An attack has one vehicle per image, which must fit into it.
        attacked = replace(world.scenes("test"), vehicles_maximum=1, size_px=self.attack_image_px)
        attacked.half_m(world.gsd_m)
        for architecture in self.reference:
            reference_folder(architecture)
            if architecture not in self.detectors:
                yield (
                    f"reference names {architecture}, which is none of the preset's detectors "
                    f"({', '.join(self.detectors)}); name it there, too."
                )
        for setting, names in (("detectors", self.detectors), ("reference", self.reference)):
            if len(set(names)) < len(names):
                yield f"{setting} expects each detector once, got {', '.join(names)}."

    @classmethod
    def parse(cls, values: Mapping[str, Any], place: str = "The preset") -> "Preset":
        """Reads plain values as JSON has them; ConfigurationError for settings that cannot be."""
        return check_document(values, cls, place, _REMEDY, error=ConfigurationError)


def read_preset(preset: str) -> tuple[str, Path, dict[str, Any], Preset]:
    """Reads a preset by name or path of a JSON file; returns name, file, values and settings."""
    path = PRESETS.get(preset, Path(preset))
    if not path.is_file():
        raise ConfigurationError(
            f"--preset expects {', '.join(PRESETS)}, or a JSON file of the same form; {preset} "
            "is none."
        )
    values: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY, error=ConfigurationError)
    return path.stem, path, values, Preset.parse(values, str(path))
