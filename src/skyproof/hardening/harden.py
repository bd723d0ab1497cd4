"""Hardens the detector of an assessment, and says how to assess the result."""

import shlex
from collections.abc import Mapping
from math import isclose
from pathlib import Path
from typing import Any

from msgspec import to_builtins

from skyproof.assessment.subject import places_of
from skyproof.assessment.suite import SUITE, read_suite
from skyproof.attacks.world import World
from skyproof.cli.ground import Ground
from skyproof.cli.import_detector import say_card
from skyproof.cli.render import Render, draw_scenes
from skyproof.cli.vehicles import Vehicles
from skyproof.console import progress_bar, say
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import PARENT_FILE, read_card
from skyproof.detectors.loaded import load_ensemble
from skyproof.detectors.settings import TrainingSettings
from skyproof.device import choose_device
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.files import file_digest, write_json
from skyproof.hardening.command import Harden
from skyproof.hardening.images import refuse_other_images, render_images, strongest
from skyproof.hardening.training import ATTACKS, SHARES, SHARES_WITHOUT_LABELS, harden
from skyproof.imagery.settings import tiling_for_images
from skyproof.layout import Layout
from skyproof.report.hardened import as_parent
from skyproof.results.results import Results
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.settings import SceneSettings, side_px
from skyproof.seeds import next_seed
from skyproof.words import percent

_TILES, _VEHICLES, _VALIDATION_SCENES = (1, 1, 480, 1), (200, 1, 1, 1), 120
_IMAGES_PER_STEP, _LEARNING_RATE, _JITTER = 16, 1e-3, 2.0
# Larger networks learn at a fifth of the rate, as is usual; this was not measured here.
_FEW_PARAMETERS = 10_000_000
_DRAWN_PX, _OTHER_GROUND = 192, 1_000_003
_REMEDY = "give a run of skyproof assess"


def harden_run(request: Harden) -> None:
    """Runs all unfinished steps, as `Harden` describes."""
    layout, out = Layout(request.run_folder), Layout(request.out)
    config: dict[str, Any] = read_document(layout.config, dict[str, Any], _REMEDY)
    names = config.get("names", [])
    if not config.get("suite") or len(names) != 1:
        raise ConfigurationError(
            f"{layout.folder} is no assessment of a single detector; assess the detector alone "
            "(skyproof assess), and give that run."
        )
    card = read_card(layout.detector(names[0]))
    if not layout.results.exists():
        raise ConfigurationError(
            f"{layout.folder} is not finished; give its command of skyproof assess again first."
        )
    if out.folder.resolve() == layout.folder.resolve():
        raise ConfigurationError(f"--out expects another folder than {layout.folder}.")
    results = Results.open(layout.folder)
    if not card.trainable:
        names = strongest(results)
        refuse_other_images(request, card, names)
        render_images(request, card, names, *_ground(request, layout, out, config, card.gsd_m))
        return
    folder = out.detector(names[0])
    device = choose_device("auto")
    (detector,) = load_ensemble([layout.detector(names[0])], device, card.gsd_m)
    # The results of the assessment are kept beside the hardened detector.
    parent = as_parent(results, ATTACKS, detector.weights_sha256)
    photographs = _photographs(request, layout, config, card.gsd_m)
    settings = TrainingSettings(
        request.steps,
        _IMAGES_PER_STEP,
        _LEARNING_RATE if card.parameters <= _FEW_PARAMETERS else _LEARNING_RATE / 5,
        jitter=_JITTER,
    )
    backgrounds, places = _ground(request, layout, out, config, card.gsd_m)
    size_px = side_px(read_suite().attack_m, card.gsd_m)
    world = World.open(backgrounds, out.fleets / "train", size_px=size_px, places=places)
    validation = _validation(layout, out, config, card.gsd_m)
    with progress_bar(f"harden {card.name}") as update:
        hardened = harden(
            detector,
            world,
            photographs,
            validation,
            settings,
            folder,
            seed=request.seed,
            shares=SHARES if _labelled(config) else SHARES_WITHOUT_LABELS,
            on_step=lambda row: update(row["step"], settings.steps),
        )
    write_json(folder / PARENT_FILE, to_builtins(parent))
    say_card(hardened, folder)
    made = hardened.training
    say(
        f"  {percent(made['trained_share'])} of the trained weights are mixed with those before. "
        f"AP on the validation images falls by {100 * made['ap_lost']:.1f} points."
    )
    say(f"Assess it anew: {_assess(config, folder)}")
    if config["suite"].get("sha256") != file_digest(SUITE):
        say(
            "  note: that command draws other scenes than this run. Assess the original detector "
            "with it, too; otherwise the two cannot be compared."
        )


def _photographs(
    request: Harden, layout: Layout, config: Mapping[str, Any], gsd_m: float
) -> Dataset | None:
    """The user's labelled photographs and the attack tiles of the assessment; None without any."""
    photographs = [*map(Dataset.open, request.data)]
    photographs += [Dataset.open(layout.tiles / "attack")] if _labelled(config) else []
    other = next((each for each in photographs if not isclose(each.gsd_m, gsd_m)), None)
    if other is not None:
        raise ConfigurationError(f"{other.folder} is not of {gsd_m} m per pixel; resample it.")
    if not photographs:
        say("  note: without labelled photographs (--data) it may find fewer vehicles on them.")
    return Dataset.joined(photographs) if photographs else None


def _ground(
    request: Harden, layout: Layout, out: Layout, config: Mapping[str, Any], gsd_m: float
) -> tuple[Path, Places]:
    """The attack tiles, or drawn ground of another seed, and where vehicles stand there.

    Also draws the fleet of `out`, in many paints, if it is missing.
    """
    if not out.fleets.exists():
        Vehicles(out.fleets, counts=_VEHICLES, seed=request.seed).run()
    if config.get("imagery") != "procedural":
        return layout.backgrounds, places_of(BackgroundSet.open(layout.backgrounds))
    if not out.backgrounds.exists():
        tiling = tiling_for_images(_DRAWN_PX, gsd_m=gsd_m, imagery=False)
        # An assessment draws its ground from its own seed.
        seed = next_seed(request.seed, _OTHER_GROUND)
        Ground(out.backgrounds, tiles=_TILES, seed=seed, tiling=tiling).run()
    return out.backgrounds, "uniform"


def _labelled(config: Mapping[str, Any]) -> bool:
    return config.get("labels") is not None


def _validation(layout: Layout, out: Layout, config: Mapping[str, Any], gsd_m: float) -> Dataset:
    """Images to freeze a threshold on, apart from attack and test: labelled ones, or renders."""
    if _labelled(config):
        return Dataset.open(layout.tiles / "validation")
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
    return Dataset.open(images)


def _assess(config: Mapping[str, Any], detector: Path) -> str:
    """The command that assesses a hardened detector as its parent was."""
    words = ["skyproof", "assess", str(detector)]
    for name in ("imagery", "gsd", "labels", "label_classes", "accept", "reject", "seed"):
        value = config.get(name)
        if value and value != "procedural":
            given = value if isinstance(value, list) else [value]
            words += [f"--{name.replace('_', '-')}", *map(str, given)]
    return shlex.join([*words, "--out", f"{detector.parent.parent}-assessed"])
