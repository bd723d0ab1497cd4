"""What a reproduction attacks, draws and scores, by the names of its preset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.controls import chosen_controls, controls
from skyproof.camouflage.name import IN_WEATHER, CamouflageName, Order
from skyproof.reproduction.attack_job import AttackJob
from skyproof.reproduction.preset import Preset
from skyproof.scenes.weather import CONDITIONS
from skyproof.seeds import next_seed

_PARALLEL = ("Fc", "PixFc")


@dataclass(frozen=True)
class _Kind:
    """One camouflage to be learnt, before it is repeated."""

    name: CamouflageName
    kind: str
    detectors: tuple[str, ...]
    conditions: tuple[str, ...] = ("clear",)


class Jobs:
    """What a preset attacks, draws and scores.

    Attributes:
        attacks: the learnt camouflages, by name.
        controls: names of all random draws.
        chosen: the controls that are chosen by the detectors and not learnt, by name.
        shapes: names of random shapes, by the finished attack on whose texture they are put.
        featured: names of those at whose vehicles the detectors' features are stored.
        batches: what is scored together: names of score folders to folders of camouflages, relative
            to `camouflages/`. Controls come first: they wait for no attack.
        looked_at: of what it is measured what it looks like: every texture, learnt or drawn, and a
            shape and a combination of each kind.
        cycles_batches: what is scored together on Cycles: random controls and finished attacks on
            all detectors, as in the paper's "Blender" column.
        weather_batches: what is scored together on the test scenes in weather: random controls, and
            what was learnt on clear days and in all weathers.
        judged_batches: what detectors that only judge score together: `batches` but for what tells
            how attacks were learnt, which are copies kept on the way and attacks on some detectors.
        repeated: the attacks on all detectors, which are made again on every further training.
        repeated_batches: what is scored together there: random controls, and these attacks as they
            finally are.
    """

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        self._textures = [TextureConstraints.parse(text) for text in preset.textures]
        repeats = range(preset.repeats)
        jobs = [self._job(kind, repeat) for repeat in repeats for kind in self._kinds()]
        jobs += [
            self._job(_Kind(CamouflageName("texture", texture), "texture", preset.detectors), more)
            for texture in self._textures
            for more in range(preset.repeats, preset.texture_repeats.get(texture.name, 0))
        ]
        self.attacks = {job.name: job for job in jobs}
        self.controls = tuple(
            str(name.with_repeat(draw)) for name in self._controls() for draw in range(preset.draws)
        )
        self.chosen = {job.name: job for job in self._chosen()}
        self.shapes = self._shapes()
        folders = [folder for job in jobs for folder in job.folders]
        late = [*self.chosen, *(name for names in self.shapes.values() for name in names)]
        featured = {*self._featured()}
        self.featured = tuple(n for n in (*self.controls, *folders, *late) if n in featured)
        self.batches = self._batched(self.controls, folders, late)
        self.looked_at = tuple(
            name
            for name in (*self.attacks, *self.controls)
            if self._is_looked_at(CamouflageName.parse(name))
        )
        finished = [name for name in self.attacks if not CamouflageName.parse(name).variant]
        self.weather_batches = self._batched(*self._in_weather())
        self.judged_batches = self._batched(self.controls, finished, late)
        self.repeated = tuple(self.attacks[name] for name in finished)
        self.repeated_batches = self._batched(self.controls, finished)
        self.cycles_batches = self._batched(
            self._on_cycles(self.controls),
            self._on_cycles([*finished, *self.chosen]),
            size=max(preset.score_batch // 4, 1),
        )

    def _is_looked_at(self, name: CamouflageName) -> bool:
        """Says so of every texture, and of what is shown of learnt shapes and combinations."""
        if name.kind == "texture":
            return True
        shown = name.magnitude == self._preset.ladder_magnitude and name.repeat == "0"
        return shown and not name.random

    def _kinds(self) -> Iterator[_Kind]:
        preset = self._preset
        every = preset.detectors
        for texture in self._textures:
            yield _Kind(CamouflageName("texture", texture), "texture", every)
        for text in preset.transfer:
            name = CamouflageName.parse(text)
            for variant, detectors in _parts_of(every):
                yield _Kind(name.with_variant(variant), "texture", detectors)
        for text in preset.weather:
            learnt = CamouflageName.parse(text).with_variant(IN_WEATHER)
            yield _Kind(learnt, "texture", every, tuple(CONDITIONS))
        for magnitude in preset.magnitudes:
            yield _Kind(CamouflageName("shape", magnitude=magnitude), "shape", every)
        orders: tuple[tuple[Order, str], ...] = (("seq", "sequential"), ("par", "parallel"))
        for order, kind in orders:
            for texture in self._textures:
                if order == "par" and texture.name not in _PARALLEL:
                    continue
                for magnitude in self._grid(texture):
                    name = CamouflageName("combination", texture, magnitude, order)
                    yield _Kind(name, kind, every)

    def _controls(self) -> Iterator[CamouflageName]:
        for texture in self._textures:
            yield CamouflageName("texture", texture).control
        for magnitude in self._preset.magnitudes:
            yield CamouflageName("shape", magnitude=magnitude).control
        for texture in self._textures:
            for magnitude in self._grid(texture):
                yield CamouflageName("combination", texture, magnitude, "seq").control

    def _grid(self, texture: TextureConstraints) -> tuple[float, ...]:
        preset = self._preset
        return preset.combined_magnitudes.get(texture.name, preset.magnitudes)

    def _job(self, kind: _Kind, repeat: int) -> AttackJob:
        preset = self._preset
        name = kind.name.with_repeat(repeat)
        steps: int = getattr(preset.attack_steps, kind.kind)
        measured = name.magnitude in (None, preset.ladder_magnitude)
        climbs = repeat == 0 and not name.variant and measured
        rungs = [step for step in preset.ladder_steps if step < steps] if climbs else []
        kept = [str(name.with_variant(f"step{step}")) for step in rungs]
        learns_colours = name.constraints is not None and name.constraints.colours != "free"
        if rungs and learns_colours and name.order != "seq":
            kept.append(str(name.with_variant("relaxed")))
        texture = None
        if name.order == "seq":
            texture = str(CamouflageName("texture", name.constraints).with_repeat(repeat))
        return AttackJob(
            name=str(name),
            settings=replace(
                preset.attack,
                steps=steps,
                seed=next_seed(preset.seed, repeat),
                keep_at=tuple(rungs),
            ),
            detectors=kind.detectors,
            texture=texture,
            kept=tuple(kept),
            conditions=kind.conditions,
        )

    def _on_cycles(self, names: Sequence[str]) -> list[str]:
        """The repeats and draws that the Cycles column has: more of the headlines."""
        preset = self._preset
        headlines = [CamouflageName.parse(text) for text in preset.cycles_headlines]
        wanted = {*headlines}
        for name in headlines:
            wanted |= {name.control, *controls(name).chosen}

        def has(name: CamouflageName) -> bool:
            if name.choice is not None:
                return name in wanted
            count = preset.repeats if name.pooled in wanted else preset.cycles_repeats
            return int(name.repeat) < count

        return [name for name in names if has(CamouflageName.parse(name))]

    def _chosen(self) -> Iterator[AttackJob]:
        """The choices that stand beside the attacks, with as many steps as the longest of them."""
        preset = self._preset
        if not preset.best_of:
            return
        attacks = {
            # Under a sequential shape lies an optimised texture, too.
            CamouflageName.parse(job.name): job.settings.steps
            + (preset.attack_steps.texture if job.texture else 0)
            for job in self.attacks.values()
            if not CamouflageName.parse(job.name).variant
        }
        seed = next_seed(preset.seed, 0)
        for control, count in chosen_controls(attacks).items():
            settings = replace(preset.attack, steps=count, seed=seed)
            job = AttackJob(str(control), settings, preset.detectors)
            yield replace(job, best_of=preset.best_of)

    def _shapes(self) -> dict[str, list[str]]:
        """Random shapes on the texture of every combination, spread over its repeats.

        At one magnitude alone, as they tell what a learnt shape adds and not how much is best.
        """
        preset = self._preset
        shapes: dict[str, list[str]] = {}
        for job in self.attacks.values() if preset.best_of else ():
            name = CamouflageName.parse(job.name)
            control = controls(name).random_shape
            if control is None or name.variant or name.magnitude != preset.ladder_magnitude:
                continue
            # A sequential attack has its texture from another, a parallel one its own.
            draws = range(int(name.repeat), preset.draws, preset.repeats)
            names = [str(control.with_repeat(draw)) for draw in draws]
            shapes.setdefault(job.texture or job.name, []).extend(names)
        return {texture: names for texture, names in shapes.items() if names}

    def _featured(self) -> Iterator[str]:
        """The first repeat of each, the first draw of its control, and the best plain paint."""
        for text in self._preset.features:
            name = CamouflageName.parse(text)
            beside = controls(name)
            names = (name.with_repeat(0), beside.random.with_repeat(0), beside.plain_paint)
            yield from map(str, names)

    def _in_weather(self) -> tuple[list[str], list[str]]:
        """Draws of the controls, and repeats of what was learnt on clear days and in all weathers.

        Controls come first: they wait for no attack.
        """
        bases = [CamouflageName.parse(text) for text in self._preset.weather]
        wanted = {name for base in bases for name in (base, base.with_variant(IN_WEATHER))}
        randoms = {base.control for base in bases}
        return (
            [name for name in self.controls if CamouflageName.parse(name).pooled in randoms],
            [name for name in self.attacks if CamouflageName.parse(name).pooled in wanted],
        )

    def _batched(
        self, *groups: Sequence[str], size: int | None = None
    ) -> dict[str, tuple[str, ...]]:
        size = size or self._preset.score_batch
        batches = [
            tuple(folders[start : start + size])
            for folders in groups
            for start in range(0, len(folders), size)
        ]
        return {f"{number:03d}": batch for number, batch in enumerate(batches)}


def _parts_of(detectors: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Parts of the ensemble that an attack is to transfer from, each with the variant it gives."""
    if len(detectors) > 1:
        for detector in detectors:
            yield f"on_{detector}", (detector,)
    # Of two detectors, all but one is the other one.
    if len(detectors) > 2:
        for left_out in detectors:
            rest = tuple(detector for detector in detectors if detector != left_out)
            yield f"without_{left_out}", rest
