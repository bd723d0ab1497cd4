"""All settings of a reproduction of the paper, as a preset or a JSON file of the same form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from skyproof.assessment.suite import AttackSteps
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.name import CamouflageName
from skyproof.detectors.reference_detectors import reference_folder
from skyproof.detectors.settings import Size, TrainingChanges
from skyproof.documents import check_document, read_document
from skyproof.errors import ConfigurationError
from skyproof.imagery.settings import tiling_for_images
from skyproof.ranges import Count, ImageSide, Seed, WholeNumber
from skyproof.reproduction.world import WorldSizes
from skyproof.scenes.sensor import BlurChoice

PRESETS = {
    name: Path(__file__).with_name(f"{name}.json")
    for name in ("quick", "paper", "reference", "trainings")
}
"""The paper's tables in small and in full, the training of the shipped detectors, and the headline
attacks on three trainings of each detector."""

Known = Literal["retinanet", "faster_rcnn", "yolov5", "yolov5_anchors"]
_Magnitude = Annotated[float, Meta(gt=0, le=1)]
_Magnitudes = Annotated[tuple[_Magnitude, ...], Meta(max_length=100)]
_Few = Annotated[int, Meta(ge=1, le=100)]
_Word = Annotated[str, Meta(max_length=100)]
_Textures = Annotated[tuple[_Word, ...], Meta(max_length=50)]
_REMEDY = "start from quick.json or paper.json"


@dataclass(frozen=True)
class Resources:
    """What a step that computes much asks of a cluster; None where it asks for nothing.

    Attributes:
        gpu: how many.
        mem_mb: memory in megabytes.
        runtime: minutes.
    """

    gpu: Annotated[int, Meta(ge=0, le=64)] | None = None
    mem_mb: Annotated[int, Meta(ge=1, le=10_000_000)] | None = None
    runtime: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None

    def asked(self) -> dict[str, int]:
        """Gives what is asked for, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Preset:
    """All settings of a reproduction.

    Attributes:
        seed: of everything; repeat k of an attack takes seed + k.
        detectors: attacked together, judged one by one (section 3.2).
        size: of the detectors, slim or full.
        world: how much ground, how many vehicles and scenes.
        training: per detector, what differs from its usual `TrainingSettings`; of those that come
            trained it is not used.
        attack: how everything is learnt; steps, seed and kept copies are said elsewhere here.
        attack_image_px: image side in attacks.
        attack_steps: by kind of attack.
        textures: constraints of the textures, such as PixFcMa; of the paper's 12, Fc and PixFc also
            make parallel combinations.
        repeats: attacks of each kind, from different seeds.
        texture_repeats: by texture, repeats of its own where they are more.
        draws: of each random control (section 5.4).
        magnitudes: PM of shapes alone and of combinations (section 5.5).
        combined_magnitudes: by texture, PM of its combinations where they are others.
        transfer: textures that are also attacked on single detectors, and on all but one.
        features: textures at whose vehicles the detectors' features are stored, of the first repeat
            and with a random control and the best plain paint beside it; the report shows them.
        weather: textures that are also learnt in all weathers; they, those learnt on clear days and
            their random controls are judged in every weather.
        weather_images: how many test images that takes, one weather each.
        check_scenes: test scenes on which detectors are checked before the attacks, with as many
            draws of each control; 0 for no check.
        cycles_repeats: repeats and random draws that the Cycles column has, where it is asked for.
        cycles_headlines: learnt camouflages of which the Cycles column has all repeats, as many
            draws of their controls, and the controls that are chosen and not learnt.
        ladder_steps: after which the first repeat of every attack is also scored as it is by then.
        ladder_magnitude: PM of the shapes and combinations for which that is done, and at which
            combinations are set beside their textures under random shapes.
        score_batch: camouflages scored in one step; a quarter of them where Cycles draws, which
            takes minutes for each.
        threads: CPU threads of each step.
        resources: what each step that renders, trains, attacks or scores asks of a cluster.
        reference: those of the detectors that are taken as they come with skyproof, with what their
            check found; the others are trained and checked in the run.
        best_of: of how many random draws the best is taken as a control of its own, beside the best
            plain paint and a random search; 0 for no such controls, which older runs have not.
        trainings: of every detector, from different seeds. On each the attacks on all detectors are
            learnt and scored anew, beside the same random draws; everything else is of the first.
        blur_sigma_px: blur of the vehicles: a number of pixels, or "paper" for the paper's 2.4;
            None for that of the ground under them.
        title: of the report.
        preset: name of the preset that a run folder's settings came from.
    """

    seed: Seed
    detectors: Annotated[tuple[Known, ...], Meta(min_length=1, max_length=4)]
    size: Size
    world: WorldSizes
    training: Mapping[Known, TrainingChanges]
    attack: AttackSettings
    attack_image_px: ImageSide
    attack_steps: AttackSteps
    textures: Annotated[tuple[_Word, ...], Meta(max_length=50)]
    repeats: _Few
    draws: _Few
    cycles_repeats: _Few
    magnitudes: _Magnitudes
    combined_magnitudes: Mapping[_Word, _Magnitudes]
    transfer: _Textures
    ladder_steps: Annotated[tuple[Count, ...], Meta(max_length=100)]
    ladder_magnitude: _Magnitude
    score_batch: Count
    threads: Annotated[int, Meta(ge=1, le=1024)]
    resources: Resources
    reference: Annotated[tuple[Known, ...], Meta(max_length=3)] = ()
    best_of: Annotated[int, Meta(ge=0, le=100)] = 0
    trainings: Annotated[int, Meta(ge=1, le=10)] = 1
    cycles_headlines: _Textures = ()
    features: _Textures = ()
    weather: _Textures = ()
    weather_images: Count = 160
    texture_repeats: Mapping[_Word, _Few] = field(default_factory=dict)
    blur_sigma_px: BlurChoice | None = None
    title: Annotated[str, Meta(max_length=300)] = ""
    check_scenes: WholeNumber = 60
    preset: Annotated[str, Meta(max_length=300)] = field(default="", compare=False)

    def __post_init__(self) -> None:
        for architecture in self.reference:
            reference_folder(architecture)
        for texture in (*self.textures, *self.combined_magnitudes, *self.texture_repeats):
            TextureConstraints.parse(texture)
        for setting in ("transfer", "features", "weather"):
            for text in getattr(self, setting):
                name = CamouflageName.parse(text)
                if name.kind != "texture" or name.random or name.variant or name.repeat:
                    raise ConfigurationError(
                        f"{setting} expects learnt textures such as T-U, got {text!r}."
                    )
                # Transfer may be asked of one detector alone; these compare with what is learnt.
                texture = text.removeprefix("T-")
                if setting != "transfer" and texture not in self.textures:
                    raise ConfigurationError(
                        f"{setting} names {text}, but textures has no {texture}; name it there."
                    )
        for texture, repeats in self.texture_repeats.items():
            if repeats < self.repeats:
                raise ConfigurationError(
                    f"texture_repeats expects at least the {self.repeats} repeats that every "
                    f"attack has, got {repeats} of {texture}; give more, or leave it out."
                )
        for text in self.cycles_headlines:
            name = CamouflageName.parse(text)
            if name.random or name.variant or name.repeat:
                raise ConfigurationError(
                    f"cycles_headlines expects learnt camouflages such as T-U, got {text!r}."
                )
        if len(set(self.reference)) < len(self.reference):
            raise ConfigurationError(
                f"reference expects each detector once, got {', '.join(self.reference)}."
            )
        strangers = [name for name in self.reference if name not in self.detectors]
        if strangers:
            raise ConfigurationError(
                f"reference names {strangers[0]}, which is none of the preset's detectors "
                f"({', '.join(self.detectors)}); name it there, too."
            )
        if self.trainings > 1 and self.reference:
            raise ConfigurationError(
                f"trainings {self.trainings} expects detectors that the run trains, all by one "
                f"recipe, but {self.reference[0]} comes trained once; take it out of reference."
            )
        world = self.world
        tile_px = tiling_for_images(world.image_px, gsd_m=world.gsd_m, imagery=False).size_px
        if math.ceil(self.attack_image_px * math.sqrt(2)) + 2 > tile_px:
            raise ConfigurationError(
                f"attack_image_px {self.attack_image_px} is larger than what can be cut from tiles "
                f"for images of {self.world.image_px} px; give at most world.image_px."
            )
        world.scenes("attack", self.attack_image_px).half_m(world.gsd_m)

    @classmethod
    def parse(cls, values: Mapping[str, Any], place: str = "The preset") -> Preset:
        """Takes plain values, as JSON has them.

        Raises:
            ConfigurationError: a setting is missing, unknown, or cannot be.
        """
        return check_document(values, cls, place, _REMEDY, error=ConfigurationError)


def read_preset(preset: str) -> tuple[str, Path, dict[str, Any], Preset]:
    """Reads a preset: "quick", "paper", "reference", or the path of a JSON file of their form.

    Returns:
        Its name, its file, its values as the file has them, and what they say.

    Raises:
        ConfigurationError: neither, or the file is no preset.
    """
    path = PRESETS.get(preset, Path(preset))
    if not path.is_file():
        raise ConfigurationError(
            f"--preset expects {', '.join(PRESETS)}, or a JSON file of the same form; {preset} "
            "is none."
        )
    values: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY, error=ConfigurationError)
    return path.stem, path, values, Preset.parse(values, str(path))
