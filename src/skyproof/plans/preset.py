"""All settings of a reproduction of the paper, as a preset or a JSON file of the same form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.errors import ConfigurationError
from skyproof.files import read_json

__all__ = ["PRESETS", "Preset", "read_preset"]

PRESETS = {name: Path(__file__).with_name(f"{name}.json") for name in ("quick", "paper")}


@dataclass(frozen=True)
class Preset:
    """All settings of a reproduction, plain JSON values.

    Attributes:
        seed: of everything; repeat k of an attack takes seed + k.
        detectors: attacked together, judged one by one (section 3.2).
        size: of the detectors, slim or full.
        world: how much ground, how many vehicles and scenes: values of `WorldSizes`.
        training: per detector, what differs from its usual `TrainingSettings`.
        attack: values of `AttackSettings`, the same for all.
        attack_image_px: image side in attacks.
        attack_steps: by kind: texture, shape, sequential, parallel.
        textures: constraints of the textures, such as PixFcMa; of the paper's 12, Fc and PixFc also
            make parallel combinations.
        repeats: attacks of each kind, from different seeds.
        draws: of each random control (section 5.4).
        magnitudes: PM of shapes alone and of combinations (section 5.5).
        combined_magnitudes: by texture, PM of its combinations where they are others.
        transfer: textures that are also attacked on single detectors, and on all but one.
        cycles_repeats: repeats and random draws that the Cycles column has, where it is asked for.
        ladder_steps: after which the first repeat of every attack is also scored as it is by then.
        ladder_magnitude: PM of the shapes and combinations for which that is done.
        score_batch: camouflages scored in one step.
        threads: CPU threads of each step.
        resources: what each step that renders, trains, attacks or scores asks of a cluster, such as
            gpu, mem_mb, runtime (minutes).
    """

    seed: int
    detectors: tuple[str, ...]
    size: str
    world: Mapping[str, Any]
    training: Mapping[str, Mapping[str, Any]]
    attack: Mapping[str, Any]
    attack_image_px: int
    attack_steps: Mapping[str, int]
    textures: tuple[str, ...]
    repeats: int
    draws: int
    cycles_repeats: int
    magnitudes: tuple[float, ...]
    combined_magnitudes: Mapping[str, tuple[float, ...]]
    transfer: tuple[str, ...]
    ladder_steps: tuple[int, ...]
    ladder_magnitude: float
    score_batch: int
    threads: int
    resources: Mapping[str, int]

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> Preset:
        """Reads JSON values; further keys are left to others.

        Raises:
            ConfigurationError: a setting is missing or cannot be.
        """
        names = [field.name for field in fields(cls)]
        missing = [name for name in names if name not in values]
        if missing:
            raise ConfigurationError(
                f"The preset lacks {', '.join(missing)}; start from quick.json or paper.json."
            )
        lists = {"detectors", "textures", "magnitudes", "transfer", "ladder_steps"}
        given: dict[str, Any] = {
            name: tuple(values[name]) if name in lists else values[name] for name in names
        }
        given["magnitudes"] = tuple(map(float, given["magnitudes"]))
        others = values["combined_magnitudes"].items()
        given["combined_magnitudes"] = {
            texture: tuple(map(float, grid)) for texture, grid in others
        }
        preset = cls(**given)
        counted = ("repeats", "draws", "cycles_repeats", "score_batch", "threads")
        counts = {name: getattr(preset, name) for name in counted}
        if min(counts.values()) < 1 or not preset.detectors:
            raise ConfigurationError(
                f"A preset expects at least one detector and counts of at least 1, got {counts}."
            )
        for texture in (*preset.textures, *preset.combined_magnitudes):
            TextureConstraints.parse(texture)
        grids = (preset.magnitudes, *preset.combined_magnitudes.values())
        unfit = [pm for grid in grids for pm in grid if not 0 < pm <= 1]
        if unfit:
            raise ConfigurationError(
                f"A preset expects magnitudes above 0 and up to 1, got {unfit}."
            )
        if set(preset.attack_steps) != {"texture", "shape", "sequential", "parallel"}:
            raise ConfigurationError(
                "A preset expects attack_steps for texture, shape, sequential and parallel."
            )
        return preset


def read_preset(preset: str) -> tuple[str, Path]:
    """Finds a preset's name and file: "quick", "paper", or the path of a JSON file of their form.

    Raises:
        ConfigurationError: neither, or the file is no preset.
        StoredFileError: the file cannot be read.
    """
    path = PRESETS.get(preset, Path(preset))
    if not path.is_file():
        raise ConfigurationError(
            f"--preset expects {' or '.join(PRESETS)}, or a JSON file of the same form; {preset} "
            "is none."
        )
    values = read_json(path)
    if not isinstance(values, dict):
        raise ConfigurationError(f"{path} is no preset: it holds no JSON object.")
    Preset.parse(values)
    return path.stem, path
