"""The steps that measure: precheck, test of the camouflages, and the report."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from skyproof.assessment.preparing import VEHICLE_CLASSES, YOURS
from skyproof.assessment.run import DETECT_S, RENDER_S, START_S, RunEnded, Step, precheck_images
from skyproof.assessment.subject import Subject
from skyproof.cli.precheck import Precheck
from skyproof.cli.score import Score
from skyproof.console import say
from skyproof.cycles.settings import Rendering
from skyproof.errors import ImageryError
from skyproof.files import write_json
from skyproof.results.precheck import PrecheckRecord, findings, read_precheck, worst
from skyproof.results.statistics.acceptance import USUAL_IN_SCENE, Requirement, fewest_tiles
from skyproof.results.statistics.planning import tiles_to_show
from skyproof.scenes.scene import read_scenes
from skyproof.words import counted, detector_name, percent


def refuse_few_tiles(said: str, tiles: int, requirement: Requirement, scenes: int) -> None:
    """Raises an error that begins with `said` if no detector can be accepted on so few tiles."""
    needed = fewest_tiles(requirement.reject, requirement.consumer_risk)
    if tiles < needed:
        raise ImageryError(
            f"{said}, and on fewer than {needed} no detector can be accepted at "
            f"{percent(requirement.reject)} with these risks, not even one that loses none "
            f"of {USUAL_IN_SCENE:g} vehicles a scene; "
            f"give imagery with about {tiles_to_show(needed, scenes):,} test tiles that have "
            "drivable ground, or leave out --accept and --reject."
        )


def enough_ground(its: Subject, requirement: Requirement) -> Step:
    """Stops a run without enough test tiles for a verdict, before anything is attacked."""
    scenes, out = its.layout.scenes("test"), its.layout.folder / "enough.json"

    def work() -> None:
        drawn = read_scenes(scenes)
        tiles = len({scene.background.tile for scene in drawn})
        needed = fewest_tiles(requirement.reject, requirement.consumer_risk)
        said = f"The {len(drawn)} scenes of {scenes} stand on {counted(tiles, 'test tile')}"
        refuse_few_tiles(said, tiles, requirement, len(drawn))
        say(f"Test tiles: {tiles}; no verdict is possible on fewer than {needed}.")
        write_json(out, {"test_tiles": tiles, "fewest": needed})

    # Another requirement may be asked of a run that has ended.
    words = "count the test tiles"
    return Step("size", "size", (out,), work, requirement, (scenes,), renewed=True, words=words)


def precheck(its: Subject) -> Step:
    """Prechecks the detectors."""
    layout, suite = its.layout, its.suite
    scenes = min(suite.check_scenes, suite.test_images)
    frames = _frames(its)
    check = Precheck(
        its.folders,
        layout.backgrounds,
        layout.fleets / "test",
        layout.scenes("test"),
        scenes,
        draws=suite.check_draws,
        frames=frames,
        frame_classes=VEHICLE_CLASSES,
        seed=its.seed,
        device=its.request.device,
    )
    images = precheck_images(scenes, suite.check_draws)
    return Step(
        "check",
        "detectors",
        tuple(layout.precheck(name) for name in its.names),
        lambda: check.run(its.detectors),
        (its.names, scenes, suite.check_draws, its.seed, frames),
        effort_s=START_S + _looked_at_s(its, "torch", images),
    )


def still_open(its: Subject, requirement: Requirement) -> Step:
    """Ends a run with a report if its prechecks say that no detector can be accepted.

    A run whose attacks are scored already goes on, as does one with `--go-on`.
    """
    layout, out = its.layout, its.layout.folder / "open.json"
    checks = tuple(map(layout.precheck, its.names))

    def work() -> None:
        checked = {name: read_precheck(layout.detector(name)) for name in its.names}
        failed = [why for each in checked.items() if (why := _hopeless(*each))]
        scored = any(layout.scores.glob("[!.]*/score.json"))
        if len(failed) == len(checked) and not its.request.go_on and not scored:
            _write_report(its, requirement)
            raise RunEnded(
                "The run ends before the attacks, because a detector that failed its precheck, or "
                "does not see rendered vehicles like photographed ones, cannot be accepted. "
                "Improve it, or give the same command with --go-on to measure the attacks."
            )
        write_json(out, {"failed": failed})

    words = "judge the prechecks"
    return Step("size", "open", (out,), work, its.request.go_on, checks, renewed=True, words=words)


def _hopeless(name: str, record: PrecheckRecord) -> str:
    """Says why a precheck leaves no chance of acceptance; empty if a chance remains."""
    unlike = record.likeness_by_main_rule
    if unlike is not None and unlike.judges_nobody:
        return unlike.sentence
    found = worst(findings(record))
    return f"{detector_name(name)}: {found.words}" if found.outcome == "failed" else ""


def score(
    its: Subject,
    title: str,
    camouflages: Sequence[Path],
    *,
    first: bool = False,
    rendering: Rendering | None = None,
) -> Step:
    """Tests every detector with and without camouflages.

    The `first` test adds the labelled test tiles, and test scenes without vehicles.
    """
    layout = its.layout
    chosen = rendering or Rendering()
    original = layout.dataset("test" if rendering is None else f"test-{chosen.renderer}")
    empty = f"ground without vehicles={layout.dataset('empty')}@{its.gsd_m}"
    frames = (*_frames(its), empty) if first else ()
    measured = Score(
        **vars(chosen),
        detectors=its.folders,
        out=layout.score(title),
        original=original,
        camouflages=tuple(camouflages),
        backgrounds=layout.backgrounds,
        fleet=layout.fleets / "test",
        frames=frames,
        frame_classes=VEHICLE_CLASSES,
        seed=its.seed,
        device=its.request.device,
    )
    images = its.suite.test_images * (1 + len(camouflages)) + its.suite.empty_images * first
    return Step(
        "score",
        title,
        (measured.out,),
        lambda: measured.measure(its.detectors),
        (its.names, camouflages, its.seed, frames, chosen),
        inputs=tuple(camouflages),
        extra=rendering is not None,
        effort_s=START_S + _looked_at_s(its, chosen.renderer, images),
    )


def scored_names(steps: Sequence[Step]) -> list[str]:
    """Lists the camouflages that a complete run scores on the renderer of the attacks."""
    scores = [step for step in steps if step.kind == "score" and not step.extra]
    return [camouflage.name for step in scores for camouflage in step.inputs]


def _write_report(its: Subject, requirement: Requirement | None) -> Path:
    # Matplotlib is loaded when a report is written, because the first look must answer at once.
    from skyproof.report.report import write_report

    return write_report(its.layout.folder, requirement)


def report(its: Subject, scores: Sequence[Step], requirement: Requirement | None) -> Step:
    """Merges all scores and writes the report."""
    layout = its.layout
    checks = [layout.precheck(name) for name in its.names]

    def work() -> None:
        say(f"Report: {_write_report(its, requirement).resolve()}")

    return Step(
        "report",
        "report",
        (layout.results, layout.report),
        work,
        None if requirement is None else asdict(requirement),
        inputs=(*checks, *(folder for step in scores for folder in step.outputs)),
        renewed=True,
        effort_s=2 * START_S,
    )


def _frames(its: Subject) -> tuple[str, ...]:
    """Names the labelled test tiles, if any; no threshold was frozen on them."""
    return (f"{YOURS}={its.layout.tiles / 'test'}@{its.gsd_m}",) if its.labelled else ()


def _looked_at_s(its: Subject, renderer: str, images: int) -> float:
    """Estimated seconds to render so many images and run all detectors on them."""
    return (RENDER_S[renderer] + DETECT_S * len(its.names)) * its.megapixels(images)
