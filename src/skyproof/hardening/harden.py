"""Hardens the detector of an assessment, and says how to assess the result."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from math import isclose
from pathlib import Path
from typing import Any

from skyproof.assessment.subject import places_of
from skyproof.assessment.suite import read_suite, side_px
from skyproof.attacks.world import World
from skyproof.cli.ground import Ground
from skyproof.cli.import_detector import say_card
from skyproof.cli.render import Render, draw_scenes
from skyproof.cli.vehicles import Vehicles
from skyproof.console import progress_bar, say
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import read_card
from skyproof.detectors.loaded import load_ensemble
from skyproof.detectors.settings import SIZES, TrainingSettings
from skyproof.device import choose_device
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.hardening.command import Harden
from skyproof.hardening.training import harden
from skyproof.imagery.settings import tiling_for_images
from skyproof.layout import Layout
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.settings import SceneSettings
from skyproof.seeds import next_seed

_TILES, _VEHICLES, _VALIDATION_SCENES = (1, 1, 120, 1), (200, 1, 1, 1), 120
_IMAGES_PER_STEP, _LEARNING_RATE = 16, 1e-3
_DRAWN_PX, _OTHER_GROUND = 192, 1_000_003
_REMEDY = "give a run of skyproof assess"


def harden_run(request: Harden) -> None:
    """Does all steps that are not finished, as `Harden` says."""
    layout, out = Layout(request.run_folder), Layout(request.out)
    config: dict[str, Any] = read_document(layout.config, dict[str, Any], _REMEDY)
    names = config.get("names", [])
    if not config.get("suite") or len(names) != 1:
        raise ConfigurationError(
            f"{layout.folder} is no assessment of a single detector; assess the detector alone "
            "(skyproof assess), and give that run."
        )
    place = layout.detector(names[0])
    card = read_card(place)
    if card.size not in SIZES:
        raise ConfigurationError(
            f"{card.name} was not trained by skyproof, which can train only its own networks "
            "further; add the images that the report names to its own training."
        )
    (detector,) = load_ensemble([place], choose_device("auto"), card.gsd_m)
    imagery, labelled = config.get("imagery") != "procedural", config.get("labels") is not None
    photographs = [*map(Dataset.open, request.data)]
    photographs += [Dataset.open(layout.tiles / "attack")] if labelled else []
    other = next((each for each in photographs if not isclose(each.gsd_m, card.gsd_m)), None)
    if other is not None:
        raise ConfigurationError(f"{other.folder} is not of {card.gsd_m} m per pixel; resample it.")
    if not photographs:
        say("  note: without labelled photographs (--data) it may find fewer vehicles on them.")
    if not out.fleets.exists():
        Vehicles(out.fleets, counts=_VEHICLES, seed=request.seed).run()
    if not imagery and not out.backgrounds.exists():
        tiling = tiling_for_images(_DRAWN_PX, gsd_m=card.gsd_m, imagery=False)
        # An assessment draws its ground from its own seed.
        seed = next_seed(request.seed, _OTHER_GROUND)
        Ground(out.backgrounds, tiles=_TILES, seed=seed, tiling=tiling).run()
    backgrounds = (layout if imagery else out).backgrounds
    world = World.open(
        backgrounds,
        out.fleets / "train",
        size_px=side_px(read_suite().attack_m, card.gsd_m),
        places=places_of(BackgroundSet.open(backgrounds)) if imagery else "uniform",
    )
    validation = layout.tiles / "validation" if labelled else _rendered(layout, out, card.gsd_m)
    settings = TrainingSettings(request.steps, _IMAGES_PER_STEP, _LEARNING_RATE)
    folder = out.detector(names[0])
    with progress_bar(f"harden {card.name}") as update:
        hardened = harden(
            detector,
            world,
            Dataset.joined(photographs) if photographs else None,
            Dataset.open(validation),
            settings,
            folder,
            seed=request.seed,
            on_step=lambda row: update(row["step"], settings.steps),
        )
    say_card(hardened, folder)
    say(f"Assess it anew: {_assess(config, folder)}")


def _rendered(layout: Layout, out: Layout, gsd_m: float) -> Path:
    """Renders vehicles and empty ground to freeze a threshold on, apart from attack and test."""
    images, scenes = out.dataset("validation"), out.scenes("validation")
    ground, fleet = layout.backgrounds, layout.fleets / "validation"
    if not scenes.exists():
        draw_scenes(
            backgrounds=ground,
            fleet=fleet,
            out=scenes,
            split="validation",
            count=_VALIDATION_SCENES,
            settings=SceneSettings(size_px=side_px(read_suite().image_m, gsd_m), empty_share=0.25),
            seed=0,
        )
    if not images.exists():
        Render(scenes=scenes, backgrounds=ground, fleet=fleet, out=images).run()
    return images


def _assess(config: Mapping[str, Any], detector: Path) -> str:
    """The command that assesses a hardened detector as its parent was."""
    words = ["skyproof", "assess", str(detector)]
    for name in ("imagery", "gsd", "labels", "label_classes", "accept", "reject", "seed"):
        value = config.get(name)
        if value and value != "procedural":
            given = value if isinstance(value, list) else [value]
            words += [f"--{name.replace('_', '-')}", *map(str, given)]
    return shlex.join([*words, "--out", f"{detector.parent.parent}-assessed"])
