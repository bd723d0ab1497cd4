"""An assessment: its steps in order, and the functions that run and plan it."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from skyproof.assessment.answers import say_answers, say_expected, say_verdict
from skyproof.assessment.attacking import attacks, controls, scored
from skyproof.assessment.command import Request, own_options
from skyproof.assessment.judging import (
    enough_ground,
    precheck,
    report,
    score,
    scored_names,
    still_open,
)
from skyproof.assessment.look import first_look, limits
from skyproof.assessment.preparing import fleets, prepare, rendered, scenes
from skyproof.assessment.run import SOURCES, Run, RunEnded, Step
from skyproof.assessment.subject import Subject, checked_object, subject_of
from skyproof.assessment.suite import SUITE, read_suite
from skyproof.console import say
from skyproof.cycles.blender import find_blender
from skyproof.cycles.settings import Rendering
from skyproof.detectors.answers import Answering, BlackBoxDetector
from skyproof.detectors.detector import Detector
from skyproof.files import file_digest
from skyproof.ranges import check_ranges

_SCORED_AT_ONCE = 24


def assess_steps(its: Subject) -> Iterator[Step]:
    """Yields the steps from detectors and imagery to a report, in order."""
    layout, requirement = its.layout, its.request.requirement
    yield from prepare(its)
    yield fleets(its, layout)
    yield scenes(its, layout, "test")
    if requirement is not None:
        yield enough_ground(its, requirement)
    yield rendered(its, layout, "test")
    if its.suite.check_scenes:
        yield precheck(its)
        if requirement is not None:
            yield still_open(its, requirement)
    made = [*attacks(its)]
    yield from made
    drawn = [*controls(its)]
    yield from drawn
    optimised = scored(its, made)
    folders = [*optimised, *(place.parent for step in drawn for place in step.outputs)]
    scores = [
        score(its, f"test-{number}", folders[start : start + _SCORED_AT_ONCE], first=number == 0)
        for number, start in enumerate(range(0, len(folders), _SCORED_AT_ONCE))
    ]
    yield scenes(its, layout, "empty")
    yield rendered(its, layout, "empty")
    if its.request.cycles:
        rendering = Rendering(renderer="cycles", blender=its.request.blender)
        scores.append(rendered(its, layout, "test", rendering=rendering))
        # Cycles takes a minute or more per camouflage, so best-of-N stands in for random controls.
        finished = [folder for folder in optimised if folder.parent == layout.camouflages]
        scores.append(score(its, "test-cycles", finished, rendering=rendering))
    yield from scores
    yield report(its, scores, requirement)


def _prepared(
    request: Request, suite_file: Path, black_box: BlackBoxDetector | None
) -> tuple[Subject, Run]:
    """Checks a request as far as its options allow, and returns its run, which has not begun."""
    its = subject_of(request, read_suite(suite_file), black_box)
    what = "is this vehicle detector" if len(its.names) == 1 else "are these vehicle detectors"
    steps = [*assess_steps(its)]
    suite = {
        "version": its.suite.version,
        "sha256": file_digest(suite_file),
        "scored": scored_names(steps),
    }
    config = {
        "title": f"How robust {what} to camouflage?",
        **request.config(),
        "names": list(its.names),
        "suite": suite,
        SOURCES: dict(its.sources),
    }
    return its, Run(request.out, config, steps)


@own_options()
def run_assessment(
    request: Request, suite_file: Path = SUITE, black_box: BlackBoxDetector | None = None
) -> Path:
    """Runs all unfinished steps and prints the results; returns the report's path."""
    its, run = _prepared(request, suite_file, black_box)
    # Mistakes should show before an hour of work, not after it.
    if not request.out.exists():
        seen = first_look(its, run.steps)
    else:
        seen = [*limits(its)]
        if request.cycles:
            find_blender(request.blender)
    try:
        with run.begun(str(its.device)):
            say(f"skyproof, {', '.join(its.names)} on {its.device}, run folder {request.out}")
            for sentence in seen:
                say(f"  note: {sentence}")
            run.do()
    except RunEnded as ended:
        say_verdict(its.layout)
        say(str(ended))
    else:
        say_answers(its.layout, its.suite.attacks)
        if its.layout.verdict.exists():
            say_verdict(its.layout)
        if not request.imagery and request.seed == 0 and len(its.names) == 1:
            say_expected(its.layout, its.suite)
    say(f"Report: {its.layout.report.resolve()}")
    return its.layout.report


@own_options()
def plan_assessment(request: Request, suite_file: Path = SUITE) -> None:
    """Prints the first look, with the size of the test and the time; writes nothing."""
    its, run = _prepared(request, suite_file, None)
    for line in first_look(its, run.steps):
        say(line)


def assess(
    detector: str | Path | Sequence[str | Path] | Detector | Answering,
    out: str | Path,
    *,
    name: str | None = None,
    imagery: str | Path | Sequence[str | Path] = (),
    gsd: float | None = None,
    labels: str | Path | None = None,
    label_classes: Sequence[str] = (),
    vehicle_classes: Sequence[str] = (),
    architecture: str | None = None,
    detector_gsd: float | None = None,
    accept: float | None = None,
    reject: float | None = None,
    producer_risk: float = 0.05,
    consumer_risk: float = 0.05,
    cycles: bool = False,
    blender: str | Path | None = None,
    go_on: bool = False,
    seed: int = 0,
    device: str = "auto",
) -> Path:
    """Tests detectors with the suite of attacks, as `skyproof assess` does, and writes a report.

    Only the answers of a callable are used: attacks are optimised on the reference detectors and
    continued by query attacks. Its threshold is frozen on the labels or, without labels, on
    rendered vehicles. A stopped run continues when the same call is made again.

    Args:
        detector: a detector folder, "retinanet" or "faster_rcnn", or several of them, which are
            attacked together; or a checkpoint or ONNX file; or a callable: it takes sRGB images
            `[B, 3, H, W]` in [0, 1] and returns boxes `[K, 4]` (left, top, right, bottom in pixels)
            and scores `[K]` for each image; or a MAITE model.
        out: run folder.
        name: name of a callable in tables; its own `name` or `__name__` if None.
        imagery: orthophotos or folders of them; without any, ground is drawn.
        gsd: metres per pixel of imagery that does not state it.
        labels: file or folder of labels of the vehicles in the imagery.
        label_classes: vehicle classes of the labels; FIELD=CLASS also names the field of a vector
            file.
        vehicle_classes: vehicle classes of a file, of a MAITE model, or of a callable whose
            answers also have `labels` (numbers as text).
        architecture: architecture of a torchvision checkpoint.
        detector_gsd: metres per pixel that a file or a callable was made for.
        accept: share of found vehicles that the worst attack may hide.
        reject: share of hidden vehicles from which a detector is rejected.
        producer_risk: largest chance that a detector at `accept` is rejected.
        consumer_risk: largest chance that a detector at `reject` is accepted.
        cycles: whether to render the test scenes with Blender Cycles as well.
        blender: a Blender 4.5 executable, or a Python that has bpy 4.5.
        go_on: whether to go on although labelled vehicles have an impossible length, or although
            no detector passed its precheck and a verdict was asked for.
        seed: seed of everything that is drawn.
        device: "auto", "cpu" or "cuda".

    Returns:
        The report's path.

    Raises:
        ConfigurationError: an argument is out of range, or does not fit the others.
        DetectorAnswerError: the callable failed, or its answer is impossible.
        SkyproofError: another error stopped a step.
    """
    black_box = None
    if isinstance(detector, str | Path):
        places = [Path(detector)]
    elif isinstance(detector, Sequence):
        places = [Path(place) for place in detector]
    else:
        black_box = checked_object(detector, name, vehicle_classes, architecture)
        places = [Path(black_box.name)]
    request = Request(
        detectors=tuple(places),
        out=Path(out),
        imagery=tuple(map(Path, [imagery] if isinstance(imagery, str | Path) else imagery)),
        gsd=gsd,
        labels=None if labels is None else Path(labels),
        label_classes=tuple(label_classes),
        vehicle_classes=tuple(vehicle_classes),
        architecture=architecture,
        detector_gsd=detector_gsd,
        accept=accept,
        reject=reject,
        producer_risk=producer_risk,
        consumer_risk=consumer_risk,
        cycles=cycles,
        blender=None if blender is None else Path(blender),
        go_on=go_on,
        seed=seed,
        device=device,
    )
    check_ranges(request)
    return run_assessment(request, black_box=black_box)
