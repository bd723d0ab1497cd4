"""The steps that make camouflages: attacks, controls, and query attacks."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from skyproof.assessment.run import ATTACK_S, CONTROL_S, START_S, Step
from skyproof.assessment.subject import Subject
from skyproof.assessment.suite import texture_under
from skyproof.attacks.making import Maker, draw_random_control
from skyproof.attacks.queries import query_attack
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import QUERIED, TRANSFER, CamouflageName
from skyproof.console import progress_bar
from skyproof.detectors.card import REFERENCE_DETECTORS
from skyproof.randomness import generator_of

_QUERY_S = 0.02
"""Estimated seconds of a query on one core."""


def attacks(its: Subject) -> Iterator[Step]:
    """Yields the steps that optimise camouflages and choose controls."""
    suite, boxed = its.suite, its.black_box is not None
    chosen = suite.chosen_controls(its.seed, 1 if boxed else suite.searches)
    # At its end, a query attack is compared with a random search, so searches come first.
    asked = [name for name in chosen if boxed and name.choice == "search"]
    for name in asked:
        yield query(its, name)
    for name in suite.names:
        if boxed:
            yield from _transferred(its, name, name)
        else:
            yield attack(its, name, suite.attack(name, its.seed))
    for name, settings in chosen.items():
        if name not in asked:
            yield attack(its, name, settings)
    # Each of several detectors would need its own query attacks.
    if not boxed and its.fits_reference and len(its.names) == 1:
        for name in suite.names:
            if str(name) in suite.compared:
                yield from _transferred(its, name, name.with_variant(QUERIED))


def _transferred(its: Subject, name: CamouflageName, asked: CamouflageName) -> Iterator[Step]:
    """Yields an attack on the reference detectors, and the query attack `asked` that follows it."""
    transfer = name.with_variant(TRANSFER)
    yield attack(its, transfer, its.suite.attack(name, its.seed), transfer=True)
    yield query(its, asked, start=transfer)


def attack(
    its: Subject, name: CamouflageName, settings: AttackSettings, *, transfer: bool = False
) -> Step:
    """Optimises a camouflage or chooses a control; `transfer` attacks the reference detectors."""
    layout = its.layout
    folder = layout.camouflage(str(name))
    under = layout.camouflage(texture_under(name)) if name.order == "seq" else None
    best_of = its.suite.best_of

    def work() -> None:
        detectors = its.references if transfer else its.detectors
        maker = Maker(detectors, its.world, settings, its.device, its.palette)
        texture = None if under is None else load_camouflage(under)
        maker.make(name, folder, draws=best_of, texture=texture)

    attacked = REFERENCE_DETECTORS if transfer else its.names
    images = settings.images(name, best_of) * len(attacked)
    return Step(
        "attack" if name.choice is None else "choose",
        str(name),
        (folder / "camouflage.json",),
        work,
        (settings, attacked, best_of, its.attack_px),
        growing=True,
        effort_s=START_S + ATTACK_S * images * its.attack_px**2 / 1e6,
    )


def query(its: Subject, name: CamouflageName, start: CamouflageName | None = None) -> Step:
    """Makes a query attack; it starts from a finished camouflage, or from a random draw."""
    rival = name.control.with_variant("search") if start and its.black_box is not None else None
    made = its.layout.camouflages
    folder = made / str(name)
    settings = replace(its.suite.queries, seed=its.seed)

    def work() -> None:
        if start is None:
            generator = generator_of(its.seed, "texture", str(name))
            base = make_camouflage(name, generator=generator, palette=its.palette)
        else:
            base = load_camouflage(made / str(start))
            base.name = name
        base.to(its.device)
        other = None if rival is None else load_camouflage(made / str(rival)).to(its.device)
        (detector,) = its.detectors
        with progress_bar(f"query attack {name}") as update:
            query_attack(base, detector, its.world, settings, folder, rival=other, on_step=update)

    return Step(
        "ask",
        str(name),
        (folder / "camouflage.json",),
        work,
        (settings, str(start), str(rival), its.names, its.attack_px),
        growing=True,
        effort_s=START_S + _QUERY_S * settings.images,
    )


def controls(its: Subject) -> Iterator[Step]:
    """Yields the steps that draw random controls, and random shapes on optimised textures."""
    yield _drawn(its, its.suite.random_controls())
    for texture, names in its.suite.random_shapes().items():
        yield _drawn(its, names, texture)


def _drawn(its: Subject, texts: Sequence[str], texture: str | None = None) -> Step:
    layout = its.layout
    names = [CamouflageName.parse(text) for text in texts]

    def work() -> None:
        under = None if texture is None else load_camouflage(layout.camouflage(texture))
        for name in names:
            folder = layout.camouflage(str(name))
            draw_random_control(name, folder, seed=its.seed, palette=its.palette, texture=under)

    return Step(
        "control",
        "random" if texture is None else f"shapes-{texture}",
        tuple(layout.camouflage(text) / "camouflage.json" for text in texts),
        work,
        (texts, its.seed, texture),
        growing=True,
        effort_s=START_S + CONTROL_S * len(names),
    )


def scored(its: Subject, steps: Sequence[Step]) -> list[Path]:
    """Lists the camouflage folders that attacks write, with the copies that they keep."""
    folders = []
    for step in steps:
        folder = its.layout.camouflage(step.name)
        folders.append(folder)
        name = CamouflageName.parse(step.name)
        for images in its.suite.queries.keep_at if step.kind == "ask" else ():
            folders.append(folder / "snapshots" / str(name.after_queries(images)))
    return folders
