"""What a reproduction attacks, draws and scores, by the names of its preset."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import (
    IN_WEATHER,
    CamouflageName,
    Order,
    TextureConstraints,
    chosen_controls,
)
from skyproof.cli.attack import BEST_OF
from skyproof.reproduction.preset import Preset
from skyproof.results.score_folder import is_pictured
from skyproof.scenes.weather import CONDITIONS
from skyproof.seeds import next_seed

_ORDERS: tuple[Order, ...] = ("seq", "par")
_PARALLEL = ("Fc", "PixFc")


@dataclass(frozen=True)
class AttackJob:
    """One camouflage that is optimised, or chosen as a control, by detectors attacked together."""

    name: CamouflageName
    settings: AttackSettings
    detectors: tuple[str, ...]
    texture: str | None = None  # the finished texture under a sequential shape
    best_of: int = BEST_OF
    conditions: tuple[str, ...] = ("clear",)


class Jobs:
    """What a preset attacks, draws and scores.

    A batch is scored in one step: the name of its score folder, and camouflages relative to
    `camouflages/`. Controls come first, because they wait for no attack.

    Attributes:
        controls: names of the random draws.
        chosen: plain-paint, best-of-N and search controls, by name.
        shapes: names of random shapes, by the finished attack whose texture they have.
        pictured: the first repeat of each finished attack.
        looked_at: all textures, and an optimised shape and combination of each kind.
        cycles_batches: random controls and finished attacks on all detectors, as in the paper's
            "Blender" column.
        held_out_batches: everything but transferred attacks and those in weather.
    """

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        kinds = [*self._kinds()]
        jobs = [self._repeat(kind, repeat) for repeat in range(preset.repeats) for kind in kinds]
        for kind in kinds:
            if kind.name.kind == "texture" and not kind.name.variant:
                wanted = preset.texture_repeats.get(kind.name.family.removeprefix("T-"), 0)
                jobs += [self._repeat(kind, repeat) for repeat in range(preset.repeats, wanted)]
        plain = [kind.name for kind in kinds if not kind.name.variant and kind.name.order != "par"]
        drawn = [name.control.with_repeat(n) for name in plain for n in range(preset.draws)]
        self.attacks = {str(job.name): job for job in jobs}
        self.controls = tuple(map(str, drawn))
        self.chosen = {str(job.name): job for job in self._chosen()}
        self.shapes = self._shapes()

        folders = [str(job.name) for job in jobs]
        late = [*self.chosen, *(name for names in self.shapes.values() for name in names)]
        featured = {*self._featured()}
        self.featured = tuple(n for n in (*self.controls, *folders, *late) if n in featured)
        learnt = [job.name for job in jobs]
        self.looked_at = tuple(str(name) for name in (*learnt, *drawn) if self._is_shown(name))

        finished = [job.name for job in jobs if not job.name.variant]
        self.pictured = tuple(str(name) for name in finished if is_pictured(name))
        self.batches = self._batched(self.controls, folders, late)
        self.held_out_batches = self._batched(self.controls, finished, late)
        self.cycles_batches = self._batched(
            self._on_cycles(drawn),
            self._on_cycles([*finished, *(job.name for job in self.chosen.values())]),
            size=max(preset.score_batch // 4, 1),
        )
        bases = [CamouflageName.parse(text) for text in preset.weather]
        self.weather_batches = self._batched(
            [name for name in drawn if name.pooled in {base.control for base in bases}],
            [name for name in learnt if name.variant in ("", IN_WEATHER) and name.base in bases],
        )

    def _kinds(self) -> Iterator[AttackJob]:
        """Every attack before it is repeated."""
        preset = self._preset
        textures = [TextureConstraints.parse(text) for text in preset.textures]
        every = (preset.attack, preset.detectors)
        for texture in textures:
            yield AttackJob(CamouflageName("texture", texture), *every)
        for text in preset.transfer:
            name = CamouflageName.parse(text)
            for variant, detectors in _parts_of(preset.detectors):
                yield AttackJob(name.with_variant(variant), preset.attack, detectors)
        for text in preset.weather:
            name = CamouflageName.parse(text).with_variant(IN_WEATHER)
            yield AttackJob(name, *every, conditions=tuple(CONDITIONS))
        for magnitude in preset.magnitudes:
            yield AttackJob(CamouflageName("shape", magnitude=magnitude), *every)
        for order in _ORDERS:
            for texture in textures:
                if order == "seq" or texture.name in _PARALLEL:
                    grid = preset.combined_magnitudes.get(texture.name, preset.magnitudes)
                    for magnitude in grid:
                        name = CamouflageName("combination", texture, magnitude, order)
                        yield AttackJob(name, *every)

    def _repeat(self, kind: AttackJob, repeat: int) -> AttackJob:
        """One repeat of an attack."""
        preset = self._preset
        name = kind.name.with_repeat(repeat)
        steps = preset.attack_steps.of(name)
        seed = next_seed(preset.seed, repeat)
        settings = replace(kind.settings, steps=steps, seed=seed)
        under = CamouflageName("texture", name.constraints).with_repeat(repeat)
        texture = str(under) if name.order == "seq" else None
        return replace(kind, name=name, settings=settings, texture=texture)

    def _chosen(self) -> Iterator[AttackJob]:
        """The controls of every attack, with as many steps as the longest attack."""
        preset = self._preset
        attacks = {
            # Under a sequential shape lies an optimised texture, too.
            job.name: job.settings.steps + (preset.attack_steps.texture if job.texture else 0)
            for job in self.attacks.values()
            if preset.best_of and not job.name.variant
        }
        for control, count in chosen_controls(attacks, preset.searches).items():
            seed = next_seed(preset.seed, control.number)
            settings = replace(preset.attack, steps=count, seed=seed)
            yield AttackJob(control, settings, preset.detectors, best_of=preset.best_of)

    def _shapes(self) -> dict[str, list[str]]:
        """Random shapes, of one magnitude, on the texture of every combination, by its repeats."""
        preset = self._preset
        shapes: dict[str, list[str]] = {}
        for job in self.attacks.values() if preset.best_of else ():
            control = job.name.random_shape
            if control is None or control.magnitude != preset.control_magnitude:
                continue
            # A sequential attack has its texture from another, a parallel one its own.
            draws = range(int(job.name.repeat), preset.draws, preset.repeats)
            names = [str(control.with_repeat(draw)) for draw in draws]
            shapes.setdefault(job.texture or str(job.name), []).extend(names)
        return {texture: names for texture, names in shapes.items() if names}

    def _featured(self) -> Iterator[str]:
        """The first repeat of each, the first draw of its control, and the best plain paint."""
        for text in self._preset.features:
            name = CamouflageName.parse(text)
            plain, *_ = name.chosen_controls
            names = (name.with_repeat(0), name.control.with_repeat(0), plain)
            yield from map(str, names)

    def _is_shown(self, name: CamouflageName) -> bool:
        if name.kind == "texture":
            return True
        shown = name.magnitude == self._preset.control_magnitude and name.repeat == "0"
        return shown and not name.random

    def _on_cycles(self, names: Iterable[CamouflageName]) -> list[CamouflageName]:
        """Returns the repeats and draws of the Cycles column: more of `cycles_headlines`."""
        preset = self._preset
        wanted = {*map(CamouflageName.parse, preset.cycles_headlines)}
        wanted |= {each for name in wanted for each in (name.control, *name.chosen_controls)}

        def has(name: CamouflageName) -> bool:
            if name.choice is not None:
                return name.pooled in wanted and name.number < preset.cycles_repeats
            count = preset.repeats if name.pooled in wanted else preset.cycles_repeats
            return int(name.repeat) < count

        return [name for name in names if has(name)]

    def _batched(
        self, *groups: Sequence[str | CamouflageName], size: int | None = None
    ) -> dict[str, tuple[str, ...]]:
        size = size or self._preset.score_batch
        batches = [
            tuple(map(str, folders[start : start + size]))
            for folders in groups
            for start in range(0, len(folders), size)
        ]
        return {f"{number:03d}": batch for number, batch in enumerate(batches)}


def _parts_of(detectors: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The variants of a transfer attack, each with the detectors that it attacks."""
    if len(detectors) > 1:
        for detector in detectors:
            yield f"on_{detector}", (detector,)
    # With two detectors, all but one would only be the other one.
    if len(detectors) > 2:
        for left_out in detectors:
            rest = tuple(detector for detector in detectors if detector != left_out)
            yield f"without_{left_out}", rest
