"""The work of `skyproof reproduce`: checks the request, and runs or lists the steps."""

import os
import shlex
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import torch

from skyproof.assessment.run import Run
from skyproof.console import say
from skyproof.cycles.blender import find_blender
from skyproof.detectors.card import reference_folder
from skyproof.detectors.loaded import build_detector
from skyproof.device import choose_device
from skyproof.errors import ConfigurationError
from skyproof.reproduction.command import Reproduce
from skyproof.reproduction.held_out_detectors import (
    HeldOutDetector,
    new_tables,
    read_held_out,
    store_detectors,
    stored_tables,
)
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.plan import reproduction_plan
from skyproof.reproduction.preset import Preset, read_preset
from skyproof.reproduction.snakemake import run_side_by_side, snakemake_words


def reproduce(asked: Reproduce) -> None:
    """Runs every step that is not finished, or lists the steps in a dry run."""
    name, path, values, preset = read_preset(asked.preset)
    cores = _cores(asked)
    choose_device(asked.device)
    # Fails for a detector whose library is missing, before the ground is drawn.
    for detector in preset.detectors:
        build_detector(detector, preset.size, generator=torch.Generator())
    blender = _blender(asked)
    layout = PaperLayout(asked.out)
    given = read_held_out(asked.held_out)
    added = new_tables(layout, preset, given)
    names = {table: tuple(sorted(each.card.name for each in its)) for table, its in added.items()}
    tables = dict(sorted((stored_tables(layout) | names).items()))
    plan = reproduction_plan(
        preset, asked.out, device=asked.device, blender=blender, held_out=tables
    )
    run = Run(asked.out, {"preset": name, **values}, plan.steps)
    if asked.dry_run:
        say(f"Steps: {plan.in_words}.")
        say("By hand, or with options for a cluster's executor:")
        for words in _copies(path, preset, layout, added):
            say("  " + shlex.join(words))
        say("  " + shlex.join([*snakemake_words(asked.out, blender), "--cores", "2"]))
        return
    with run.begun(asked.device) as hold:
        store_detectors(layout, preset, new_tables(layout, preset, given))
        say(
            f"skyproof reproduce, preset {name}: {plan.in_words}; {cores} cores, run folder "
            f"{asked.out}"
        )
        if cores == 1:
            run.do()
        else:
            words = snakemake_words(asked.out, blender, asked.device)
            words += ["--executor", "local", "--cores", str(cores)]
            words += ["--resources", "gpu=1"] if preset.resources.gpu else []
            run_side_by_side(plan, run, words, cores, hold)
    page = layout.tables / "README.md"
    # A run without textures has none of the paper's tables.
    if page.exists():
        say(f"Tables: {page.resolve()}")
    say(f"Report: {layout.report.resolve()}")


def _cores(asked: Reproduce) -> int:
    """How many steps run at once; with several, Snakemake must be there."""
    cores = len(os.sched_getaffinity(0)) if asked.cores is None else asked.cores
    if (cores > 1 or asked.dry_run) and find_spec("snakemake") is None:
        raise ConfigurationError(
            "skyproof reproduce on several cores needs Snakemake; run pip install "
            "'skyproof[reproduce]' first, or give --cores 1."
        )
    return cores


def _blender(asked: Reproduce) -> Path | None:
    """The Blender of the Cycles column, if that is asked for."""
    if asked.cycles:
        # Not resolved: the Python of a virtual environment is a link, and loses its packages when
        # followed.
        return find_blender(asked.blender).path.absolute()
    if asked.blender is not None:
        raise ConfigurationError(
            "--blender is for the Cycles column; give --cycles too, or leave it out."
        )
    return None


def _copies(
    preset_file: Path,
    preset: Preset,
    layout: PaperLayout,
    added: Mapping[str, Sequence[HeldOutDetector]],
) -> list[list[str]]:
    """Returns the commands that copy the preset and detectors into the run folder."""
    copies = [
        (each.folder, layout.table(table).detector(each.card.name))
        for table, detectors in added.items()
        for each in detectors
    ]
    if not layout.config.exists():
        copies += [(reference_folder(name), layout.detector(name)) for name in preset.reference]
    copies.append((preset_file, layout.config))
    parents = dict.fromkeys(str(copy.parent) for _, copy in copies)
    return [
        *(["mkdir", "-p", parent] for parent in parents),
        *(["cp", "-r", str(source), str(copy)] for source, copy in copies),
    ]
