"""The steps of a further training of all detectors: their attacks anew, and their scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from skyproof.assessment.run import Step
from skyproof.layout import Layout
from skyproof.reproduction.attack_job import AttackJob
from skyproof.reproduction.preset import Preset
from skyproof.reproduction.steps import attack_step, score_step, train_step
from skyproof.seeds import next_seed


def training_steps(
    layout: Layout,
    preset: Preset,
    number: int,
    attacks: Iterable[AttackJob],
    batches: Mapping[str, Sequence[str]],
    *,
    device: str = "auto",
) -> list[Step]:
    """Returns what one more training takes, from detectors to scores.

    Detectors learn from the same images by the same recipe, and attacks go as they went on the
    run's own detectors; but all from other seeds, because an attack on another detector is another
    attack. Random controls are drawn once for all trainings.

    Args:
        layout: the run folder's.
        preset: what is reproduced.
        number: of the training; the run's own detectors are number 0.
        attacks: those of the run that are made again.
        batches: what is scored together: names of score folders to folders of camouflages.
        device: auto, cpu or cuda.
    """
    own = layout.training(number)
    seed = next_seed(preset.seed, number)
    sizes = preset.world
    steps = [
        train_step(
            own,
            sizes,
            name,
            preset.size,
            preset.training.get(name, {}),
            seed,
            device=device,
        )
        for name in preset.detectors
    ]
    repeats = max([preset.repeats, *preset.texture_repeats.values()])
    for job in attacks:
        # Of every repeat on every training another one.
        attack_seed = next_seed(job.settings.seed, number * repeats)
        settings = replace(job.settings, seed=attack_seed, keep_at=())
        again = replace(job, settings=settings, kept=())
        steps.append(
            attack_step(own, again, preset.attack_image_px, places=sizes.test_places, device=device)
        )
    steps += [
        score_step(own, sizes, name, folders, preset.detectors, preset.seed, device=device)
        for name, folders in batches.items()
    ]
    return [replace(step, name=f"training-{number}-{step.name}") for step in steps]
