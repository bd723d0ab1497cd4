"""The steps after the images: detectors, camouflages, scores, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from skyproof.assessment.run import START_S, Step
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.attack import Attack
from skyproof.cli.precheck import Precheck
from skyproof.cli.score import Score
from skyproof.cli.train import Train
from skyproof.cycles.settings import Rendering
from skyproof.detectors.settings import TRAINING_PRESETS, TrainingChanges
from skyproof.layout import Layout
from skyproof.reproduction.attack_job import AttackJob
from skyproof.reproduction.plan import command_step
from skyproof.reproduction.world import WorldSizes, render_s
from skyproof.scenes.places import Places

# Seconds on one core for a million pixels before one detector; for the time left alone.
_TRAIN_S = 2.0
_ATTACK_S = 4.0
_DETECT_S = 3.0
_TRIALS = 62
"""Changes that a check tries on every scene, but for random controls."""
_CONTROLS = 6


def train_step(
    layout: Layout,
    sizes: WorldSizes,
    name: str,
    size: str,
    changes: TrainingChanges,
    seed: int,
    *,
    device: str = "auto",
) -> Step:
    """Returns the step that trains one detector on the rendered images."""
    training = layout.dataset("train")
    validation = layout.dataset("validation")
    command = Train(
        detector=name,
        data=training,
        validation=validation,
        out=layout.detector(name),
        size=size,
        settings=changes,
        seed=seed,
        device=device,
    )
    settings = replace(TRAINING_PRESETS[name, size], **changes)
    megapixels = sizes.megapixels(settings.steps * settings.batch_size)
    return command_step(
        "train",
        name,
        command,
        (training, validation),
        (layout.detector(name) / "detector.json",),
        growing=True,
        effort_s=START_S + _TRAIN_S * megapixels,
    )


def check_step(
    layout: Layout,
    sizes: WorldSizes,
    names: Sequence[str],
    scenes: int,
    draws: int,
    seed: int,
    *,
    device: str = "auto",
) -> Step:
    """Returns the step that tells whether the detectors are worth attacking.

    Args:
        layout: the run folder's.
        sizes: of the run.
        names: of all detectors.
        scenes: how many of the test scenes are taken, at most.
        draws: of every random control.
        seed: of the controls and the bootstrap.
        device: auto, cpu or cuda.
    """
    folders = tuple(layout.detector(name) for name in names)
    scenes = min(scenes, sizes.test_images)
    command = Precheck(
        detectors=folders,
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / "test",
        scenes=layout.scenes("test"),
        scenes_count=scenes,
        draws=draws,
        seed=seed,
        device=device,
    )
    inputs = [layout.backgrounds, layout.fleets, layout.scenes("test")]
    inputs += [folder / "detector.json" for folder in folders]
    images = scenes * (1 + _TRIALS + _CONTROLS * draws)
    each_s = render_s(Rendering()) + _DETECT_S * len(names)
    return command_step(
        "check",
        "detectors",
        command,
        tuple(inputs),
        tuple(layout.precheck(name) for name in names),
        effort_s=START_S + each_s * sizes.megapixels(images),
    )


def attack_step(
    layout: Layout,
    job: AttackJob,
    image_px: int,
    *,
    places: Places = "uniform",
    device: str = "auto",
) -> Step:
    """Returns the step that optimises or chooses one camouflage, on vehicles at these places."""
    texture = layout.camouflage(job.texture) if job.texture else None
    folders = tuple(layout.detector(name) for name in job.detectors)
    command = Attack(
        names=(job.name,),
        out=layout.camouflages,
        detectors=folders,
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / "attack",
        texture=texture,
        image_px=image_px,
        conditions=job.conditions,
        places=places,
        draws=job.best_of,
        settings=job.settings,
        device=device,
    )
    inputs = [layout.backgrounds, layout.fleets]
    inputs += [folder / "detector.json" for folder in folders]
    if texture:
        inputs.append(texture / "camouflage.json")
    chosen = CamouflageName.parse(job.name).choice is not None
    return command_step(
        "choose" if chosen else "attack",
        job.name,
        command,
        tuple(inputs),
        (layout.camouflage(job.name) / "camouflage.json",),
        growing=True,
        effort_s=START_S + _ATTACK_S * job.images * image_px**2 / 1e6,
    )


def control_step(
    layout: Layout, names: Sequence[str], seed: int, *, texture: str | None = None
) -> Step:
    """Returns the step that draws random controls.

    Args:
        layout: the run folder's.
        names: of the controls, with their draws.
        seed: of the draws.
        texture: name of the finished camouflage on whose texture random shapes are put.
    """
    under = layout.camouflage(texture) if texture else None
    command = Attack(
        names=tuple(names),
        out=layout.camouflages,
        backgrounds=layout.backgrounds,
        texture=under,
        settings=AttackSettings(seed=seed),
    )
    inputs = [layout.backgrounds] + ([under / "camouflage.json"] if under else [])
    outputs = tuple(layout.camouflage(name) / "camouflage.json" for name in names)
    return command_step(
        "control",
        f"shapes-{texture}" if texture else "random",
        command,
        tuple(inputs),
        outputs,
        growing=True,
        effort_s=START_S + 0.1 * len(names),
    )


def score_step(
    layout: Layout,
    sizes: WorldSizes,
    name: str,
    camouflages: Sequence[str],
    detectors: Sequence[str],
    seed: int,
    *,
    empty: bool = False,
    rendering: Rendering | None = None,
    weather: bool = False,
    judged: Layout | None = None,
    device: str = "auto",
) -> Step:
    """Returns the step that judges detectors on the test scenes, with and without camouflages.

    Args:
        layout: the run folder's.
        sizes: of the run.
        name: of the score folder.
        camouflages: folders relative to `camouflages/`.
        detectors: names of all that judge.
        seed: of the bootstrap.
        empty: whether false alarms are also counted on ground without vehicles.
        rendering: the renderer; the differentiable one where not given.
        weather: whether the test scenes in weather are meant.
        judged: where detectors that only judge lie, and what they judged; where not given, the
            run's own do.
        device: auto, cpu or cuda.
    """
    chosen = rendering or Rendering()
    own = judged or layout
    drawn = "test" if chosen.renderer == "torch" else f"test-{chosen.renderer}"
    original = layout.dataset("weather" if weather else drawn)
    out = (layout.weather if weather else own).score(name)
    frames = (f"ground without vehicles={layout.dataset('empty')}@{sizes.gsd_m}",)
    command = Score(
        **vars(chosen),
        detectors=tuple(own.detector(detector) for detector in detectors),
        out=out,
        original=original,
        camouflages=tuple(_camouflage(layout, folder) for folder in camouflages),
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / "test",
        frames=frames if empty else (),
        frame_classes=("vehicle",) if empty else ("car", "minibus"),
        seed=seed,
        device=device,
    )
    inputs = [original, layout.backgrounds, layout.fleets]
    inputs += [own.detector(detector) / "detector.json" for detector in detectors]
    inputs += [layout.dataset("empty")] if empty else []
    # Copies kept on the way lie inside the folder of their attack.
    attacks = dict.fromkeys(folder.partition("/")[0] for folder in camouflages)
    inputs += [_camouflage(layout, attack) / "camouflage.json" for attack in attacks]
    images = sizes.test_images * (1 + len(camouflages))
    each_s = render_s(chosen) + _DETECT_S * len(detectors)
    return command_step(
        "score",
        # No table's name has a dot, so that no two steps have one name.
        f"judges.{judged.folder.name}.{name}" if judged else f"weather-{name}" if weather else name,
        command,
        tuple(inputs),
        (out,),
        extra=chosen.renderer == "cycles",
        effort_s=START_S + each_s * sizes.megapixels(images),
    )


def _camouflage(layout: Layout, folder: str) -> Path:
    """A camouflage's folder; what is drawn and not learnt is the same for every training."""
    drawn = CamouflageName.parse(folder.partition("/")[0]).random
    return (layout.shared if drawn else layout).camouflage(folder)
