"""What a reproduction consists of: a preset, and the camouflages, controls and scoring jobs it expands to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.errors import ConfigurationError
from skyproof.files import read_json

__all__ = ["PRESETS", "SNAKEFILE", "AttackJob", "Plan", "Preset", "read_preset"]

SNAKEFILE = Path(__file__).with_name("Snakefile")
PRESETS = {name: Path(__file__).with_name(f"{name}.json") for name in ("quick", "paper")}

_PARALLEL = ("Fc", "PixFc")


@dataclass(frozen=True)
class Preset:
    """All settings of a reproduction, plain JSON values (PAPER 25).

    Attributes:
        seed: of everything; repeat k of an attack takes seed + k.
        detectors: attacked together, judged one by one (PAPER 20).
        size: of the detectors, slim or full.
        world: options of `skyproof world --sizes.*`.
        training: per detector, options of `skyproof train`.
        attack: options of `skyproof attack --settings.*`, the same for all.
        attack_image_px: image side in attacks.
        attack_steps: by kind: texture, shape, sequential, parallel.
        textures: constraints of the textures, such as PixFcMa; of the paper's 12, Fc and PixFc also make parallel
            combinations.
        repeats: attacks of each kind, from different seeds.
        draws: of each random control (PAPER 34).
        magnitudes: PM of shapes alone and of combinations (PAPER 52, 53).
        combined_magnitudes: by texture, PM of its combinations where they are others.
        transfer: textures that are also attacked on single detectors, and on all but one.
        cycles_repeats: repeats and random draws that the Cycles column has, where it is asked for.
        ladder_steps: after which the first repeat of every attack is also scored as it is by then.
        ladder_magnitude: PM of the shapes and combinations for which that is done.
        score_batch: camouflages scored in one job.
        threads: of each job.
        resources: of each job that renders, trains, attacks or scores, such as gpu, mem_mb, runtime (minutes).
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
    """Name and file of a preset: "quick", "paper", or the path of a JSON file of the same form.

    Raises:
        ConfigurationError: neither, or the file is no preset.
        StoredFileError: the file cannot be read.
    """
    path = PRESETS.get(preset, Path(preset))
    if not path.is_file():
        raise ConfigurationError(
            f"--preset expects {' or '.join(PRESETS)}, or a JSON file of the same form; {preset} is none."
        )
    values = read_json(path)
    if not isinstance(values, dict):
        raise ConfigurationError(f"{path} is no preset: it holds no JSON object.")
    Preset.parse(values)
    return path.stem, path


@dataclass(frozen=True)
class AttackJob:
    """One attack.

    Attributes:
        name: of the camouflage, with its repeat.
        kind: texture, shape, sequential or parallel.
        seed: of the attack.
        detectors: attacked together.
        fixed_colours: whether it needs the palette.
        texture: name of the finished texture a sequential attack puts its shape on.
        keep_at: steps after which a copy is kept.
        relaxed: whether the copy from before the last rounding is scored too (PAPER 32).
    """

    name: str
    kind: Literal["texture", "shape", "sequential", "parallel"]
    seed: int
    detectors: tuple[str, ...]
    fixed_colours: bool = False
    texture: str | None = None
    keep_at: tuple[int, ...] = ()
    relaxed: bool = False

    @property
    def folders(self) -> tuple[str, ...]:
        """What it leaves to be scored, relative to `camouflages/`: itself and its kept copies."""
        base, _, repeat = self.name.rpartition("-")
        variants = [
            *(f"step{step}" for step in self.keep_at),
            *(["relaxed"] if self.relaxed else []),
        ]
        return (
            self.name,
            *(f"{self.name}/snapshots/{base}_{variant}-{repeat}" for variant in variants),
        )


class Plan:
    """A preset, expanded.

    Attributes:
        attacks: by name.
        controls: names of all random draws.
        batches: what is scored together: batch name to folders relative to `camouflages/`.
        cycles_batches: what is scored on Cycles together, empty where nothing is: random controls and finished attacks
            on all detectors, as in the paper's "Blender" column (PAPER 35).
    """

    def __init__(self, preset: Preset, *, cycles: bool = False) -> None:
        self.preset = preset
        self._textures = [TextureConstraints.parse(text) for text in preset.textures]
        self.attacks = {job.name: job for job in self._attacks()}
        self.controls = tuple(
            f"{base}-{draw}" for base in self._control_bases() for draw in range(preset.draws)
        )
        folders = [folder for job in self.attacks.values() for folder in job.folders]
        self.batches = self._scored(self.controls, folders)
        finished = [name for name in self.attacks if "_" not in name]
        self.cycles_batches = (
            self._scored(*map(self._first, (self.controls, finished))) if cycles else {}
        )

    @property
    def measured(self) -> list[str]:
        """The attacks whose practicality is measured: the first repeat of each, variants excluded."""
        return [name for name in self.attacks if name.endswith("-0") and "_" not in name]

    @property
    def jobs(self) -> dict[str, int]:
        """How many jobs of every rule there are."""
        jobs = {
            "world": 1,
            "render": 3,
            "train": len(self.preset.detectors),
            "attack": len(self.attacks),
            "control": 1,
            "measure": 1,
            "score": len(self.batches),
        }
        if self.cycles_batches:
            jobs |= {"render_cycles": 1, "score_cycles": len(self.cycles_batches)}
        return {**jobs, "tables": 1}

    def _first(self, names: Sequence[str]) -> list[str]:
        """The repeats and draws that the Cycles column has."""
        return [name for name in names if int(name.rpartition("-")[2]) < self.preset.cycles_repeats]

    def _scored(
        self, controls: Sequence[str], attacks: Sequence[str]
    ) -> dict[str, tuple[str, ...]]:
        """Scoring jobs by name; controls by themselves and first: they wait for no attack."""
        size = self.preset.score_batch
        batches = [*_batched(controls, size), *_batched(attacks, size)]
        return {f"{number:03d}": batch for number, batch in enumerate(batches)}

    def _control_bases(self) -> list[str]:
        textures = [f"R-{texture.name}" for texture in self._textures]
        shapes = [f"R-S-O@{pm:g}" for pm in self.preset.magnitudes]
        combined = [
            f"R-C-{texture.name}@{pm:g}" for texture in self._textures for pm in self._grid(texture)
        ]
        return textures + shapes + combined

    def _grid(self, texture: TextureConstraints) -> tuple[float, ...]:
        return self.preset.combined_magnitudes.get(texture.name, self.preset.magnitudes)

    def _attacks(self) -> list[AttackJob]:
        jobs = []
        parallel = [texture for texture in self._textures if texture.name in _PARALLEL]
        for repeat in range(self.preset.repeats):
            for texture in self._textures:
                jobs.append(self._job(f"T-{texture.name}", repeat, "texture", texture))
            for base, detectors in self._transfers():
                texture = TextureConstraints.parse(base.partition("_")[0].removeprefix("T-"))
                jobs.append(self._job(base, repeat, "texture", texture, detectors=detectors))
            for pm in self.preset.magnitudes:
                jobs.append(self._job(f"S-O@{pm:g}", repeat, "shape", None, pm=pm))
            for texture, pm in [(each, pm) for each in self._textures for pm in self._grid(each)]:
                under = f"T-{texture.name}-{repeat}"
                jobs.append(
                    self._job(
                        f"C-{texture.name}-seq@{pm:g}",
                        repeat,
                        "sequential",
                        texture,
                        pm=pm,
                        under=under,
                    )
                )
            for texture, pm in [(each, pm) for each in parallel for pm in self._grid(each)]:
                jobs.append(
                    self._job(f"C-{texture.name}-par@{pm:g}", repeat, "parallel", texture, pm=pm)
                )
        return jobs

    def _transfers(self) -> list[tuple[str, tuple[str, ...]]]:
        """Names of textures attacked on a part of the detectors, and on which."""
        every = self.preset.detectors
        alone = [
            (f"{base}_on_{one}", (one,))
            for base in self.preset.transfer
            for one in every
            if len(every) > 1
        ]
        # Of two detectors, all but one is the other one.
        without = [
            (f"{base}_without_{one}", tuple(other for other in every if other != one))
            for base in self.preset.transfer
            for one in every
            if len(every) > 2
        ]
        return alone + without

    def _job(
        self,
        base: str,
        repeat: int,
        kind: Literal["texture", "shape", "sequential", "parallel"],
        texture: TextureConstraints | None,
        *,
        pm: float | None = None,
        under: str | None = None,
        detectors: tuple[str, ...] | None = None,
    ) -> AttackJob:
        climbs = repeat == 0 and "_" not in base and pm in (None, self.preset.ladder_magnitude)
        steps = self.preset.attack_steps[kind]
        keep_at = tuple(step for step in self.preset.ladder_steps if step < steps) if climbs else ()
        learns_colours = texture is not None and under is None and texture.colours != "free"
        return AttackJob(
            name=f"{base}-{repeat}",
            kind=kind,
            seed=self.preset.seed + repeat,
            detectors=detectors or self.preset.detectors,
            fixed_colours=texture is not None and under is None and texture.colours == "fixed",
            texture=under,
            keep_at=keep_at,
            relaxed=bool(keep_at) and learns_colours,
        )


def _batched(folders: Sequence[str], size: int) -> list[tuple[str, ...]]:
    return [tuple(folders[start : start + size]) for start in range(0, len(folders), size)]
