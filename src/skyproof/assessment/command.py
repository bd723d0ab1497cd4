"""`skyproof assess`: how robust one detector is on somebody's imagery, and whether it passes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta
from tyro.conf import Positional

from skyproof.assessment.assessment import Given, assessment_plan
from skyproof.assessment.enough import refuse_what_scenes_cannot_show
from skyproof.assessment.plan import Plan
from skyproof.assessment.sources import SOURCES, source_digests
from skyproof.assessment.suite import read_suite, suite_digest
from skyproof.assessment.world import GSD_M
from skyproof.cli.console import say
from skyproof.detectors.card import require_detector_name
from skyproof.documents import check_document
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.layout import Layout
from skyproof.ranges import Fraction, GroundResolution, Risk, Seed, check_ranges, is_name

if TYPE_CHECKING:
    from skyproof.detectors.detector import Detector

_SEVERAL = ("label_classes", "vehicle_classes")
_Class = Annotated[str, Meta(max_length=200)]


@dataclass(frozen=True)
class Assess:
    """Puts one detector to the suite of attacks on your imagery, and says whether it passes.

    Imagery is tiled and cleared of its vehicles, the threshold frozen on its labels, the detector
    checked, every attack of the suite learnt on it and judged beside its controls. Stop it
    whenever you like and give the same command again: it goes on after the last finished step.

    Attributes:
        detector: detector folder, or checkpoint file of Ultralytics or torchvision.
        out: run folder; the report goes there.
        imagery: orthophotos or photographs, or folders of them: GeoTIFFs, or JPEG/PNG with --gsd.
            Without any, ground is drawn, and the answer says nothing of your places.
        gsd: metres per pixel of images that do not say it themselves.
        labels: of the vehicles in the imagery: COCO, YOLO or DOTA text, GeoJSON, GeoPackage or
            Shapefile. Without any, the threshold stays as it is, and nothing is said of
            photographs.
        label_classes: which of the labels' classes are vehicles; may be left out where they know
            one class.
        vehicle_classes: of a checkpoint: its classes that are vehicles (names of Ultralytics,
            numbers of torchvision).
        architecture: of a checkpoint of torchvision, as for `skyproof import`.
        detector_gsd: metres per pixel that a checkpoint was made for; 0.125 where not given.
        accept: share of found vehicles that the detector may lose to the worst attack; with
            `reject`, the report says whether it is accepted, and verdict.json is written.
        reject: the share lost from which on it is refused.
        producer_risk: chance at most that a detector which loses `accept` is rejected.
        consumer_risk: chance at most that one which loses `reject` is accepted.
        cycles: judge the test scenes as Blender Cycles draws them, too; a finished run goes on
            with that part alone.
        blender: for --cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not
            given, what `make blender` made, then `blender` on the PATH.
        seed: decides everything that is drawn.
        device: auto, cpu or cuda.
    """

    detector: Positional[Path]
    out: Path
    imagery: tuple[Path, ...] = ()
    gsd: GroundResolution | None = None
    labels: Path | None = None
    label_classes: tuple[_Class, ...] = ()
    vehicle_classes: Annotated[tuple[_Class, ...], Meta(max_length=1000)] = ()
    architecture: str | None = None
    detector_gsd: GroundResolution | None = None
    accept: Fraction | None = None
    reject: Fraction | None = None
    producer_risk: Risk = 0.05
    consumer_risk: Risk = 0.05
    cycles: bool = False
    blender: Path | None = None
    seed: Seed = 0
    device: str = "auto"

    def run(self, box: Detector | None = None) -> None:
        """Does all steps that are not finished yet, and prints the answer.

        Args:
            box: the detector, where only its answers are known; it stands in for the folder.
        """
        from skyproof.assessment.run_folder import RunFolder
        from skyproof.assessment.serial import run_serially
        from skyproof.cli.device import choose_device
        from skyproof.cycles.blender import find_blender

        self._refuse_what_cannot_work(box)
        device = choose_device(self.device)
        given = self._given(box)
        plan = assessment_plan(given, read_suite(), self.out, box)
        # Mistakes are looked for first: they should show before an hour's work, not after it.
        run = RunFolder(self.out, self._config(given), plan, partial(self._plan_of, box))
        if self.cycles:
            find_blender(self.blender)
        with alone(self.out):
            # Somebody else may have begun meanwhile.
            run = RunFolder(self.out, self._config(given), plan, partial(self._plan_of, box))
            run.start(str(device))
            say(f"skyproof assess {given.name} on {device}, run folder {self.out}")
            for sentence in self._unsaid(given):
                say(f"  note: {sentence}")
            run_serially(plan, run)
            run.finish()
        self._say_answer()

    def _refuse_what_cannot_work(self, box: Detector | None) -> None:
        """Shows a mistake in the options before anything is made.

        Raises:
            ConfigurationError: options that contradict each other, or speak of what is not there.
        """
        if requirement := self._requirement():
            refuse_what_scenes_cannot_show(
                requirement["reject"], requirement["consumer_risk"], read_suite().test_images
            )
        if self.blender is not None and not self.cycles:
            raise ConfigurationError(
                "--blender says which Blender draws for --cycles; give --cycles too."
            )
        about_imagery: dict[str, object] = {
            "--gsd": self.gsd,
            "--labels": self.labels,
            "--label-classes": self.label_classes or None,
        }
        for option, value in about_imagery.items():
            if value is not None and not self.imagery:
                raise ConfigurationError(f"{option} speaks of imagery; give --imagery too.")
        if self.label_classes and self.labels is None:
            raise ConfigurationError(
                "--label-classes says which classes of --labels are vehicles; give --labels too."
            )
        for path in (*self.imagery, *([] if self.labels is None else [self.labels])):
            if not path.exists():
                raise ConfigurationError(f"{path} is not there; check --imagery and --labels.")
        if box is not None:
            return
        if not self.detector.exists():
            raise ConfigurationError(
                f"{self.detector} is not there; give a detector folder or a checkpoint file."
            )
        of_checkpoint: dict[str, object] = {
            "--vehicle-classes": self.vehicle_classes or None,
            "--architecture": self.architecture,
            "--detector-gsd": self.detector_gsd,
        }
        if self.detector.is_dir():
            for option, value in of_checkpoint.items():
                if value is not None:
                    raise ConfigurationError(
                        f"{option} is for checkpoint files, and {self.detector} is a folder, which "
                        "says it itself; leave the option out."
                    )
        elif not self.vehicle_classes:
            raise ConfigurationError(
                f"{self.detector} is a checkpoint file, whose classes may be anything; say with "
                "--vehicle-classes which of them are vehicles."
            )
        else:
            remedy = "it is called like the run folder, so choose another --out"
            require_detector_name(self._name_of_checkpoint, remedy)

    @property
    def _name_of_checkpoint(self) -> str:
        # "best" and "last" are what trainers call their files.
        return self.out.resolve().name

    def _requirement(self) -> dict[str, float]:
        from skyproof.results.statistics.acceptance import requirement_of

        asked = requirement_of(self.accept, self.reject, self.producer_risk, self.consumer_risk)
        return {} if asked is None else asdict(asked)

    def _given(self, box: Detector | None) -> Given:
        from skyproof.detectors.card import read_card

        if box is not None:
            name, gsd_m = box.name, self.detector_gsd or GSD_M
        elif self.detector.is_dir():
            card = read_card(self.detector)
            name, gsd_m = card.name, card.gsd_m
        else:
            name, gsd_m = self._name_of_checkpoint, self.detector_gsd or GSD_M
        return Given(
            name=name,
            detector=self.detector if box is None else None,
            gsd_m=gsd_m,
            imagery=self.imagery,
            imagery_gsd_m=self.gsd,
            labels=self.labels,
            label_classes=self.label_classes,
            vehicle_classes=self.vehicle_classes,
            architecture=self.architecture,
            requirement=self._requirement(),
            cycles=self.cycles,
            blender=self.blender,
            seed=self.seed,
            device=self.device,
        )

    def _config(self, given: Given) -> dict[str, object]:
        # Where a run is computed, or what is added to it, changes none of its results.
        left_out = ("device", "cycles", "blender")
        settings = {key: value for key, value in asdict(given).items() if key not in left_out}
        suite = read_suite()
        sources = [given.detector, given.labels]
        return {
            "title": "How robust is this vehicle detector to camouflage?",
            **settings,
            "imagery": [str(path) for path in self.imagery] or "procedural",
            "detectors": [given.name],
            "suite": {"version": suite.version, "sha256": suite_digest()},
            SOURCES: source_digests(path for path in sources if path is not None),
        }

    def _plan_of(self, box: Detector | None, config: dict[str, Any]) -> Plan:
        """The steps that a run folder's config stands for."""
        told = ("title", "detectors", "suite", SOURCES)
        settings = {key: value for key, value in config.items() if key not in told}
        if settings.get("imagery") == "procedural":
            settings["imagery"] = []
        settings |= {"device": self.device, "cycles": self.cycles, "blender": self.blender}
        place = str(self.out / "config.json")
        given: Given = check_document(settings, Given, place, "choose another --out")
        return assessment_plan(given, read_suite(), self.out, box)

    def _unsaid(self, given: Given) -> list[str]:
        """What this run cannot say."""
        unsaid = []
        if not self.imagery:
            unsaid.append(
                "without --imagery, ground is drawn: the answer says nothing of your places"
            )
        elif self.labels is None:
            unsaid.append(
                "without --labels, the threshold is not chosen on photographs, only what the "
                "detector itself finds is cleared, and nothing tells how well it finds real "
                "vehicles"
            )
        if not math.isclose(given.gsd_m, GSD_M):
            unsaid.append(
                f"the detector sees {given.gsd_m:g} m per pixel, and those that carry attacks by "
                f"answers alone to it see {GSD_M}: whether its gradients mislead attacks is not "
                "tried"
            )
        return unsaid

    def _say_answer(self) -> None:
        from skyproof.assessment.answers import say_answers, say_expected, say_verdict

        layout = Layout(self.out)
        suite = read_suite()
        say_answers(layout, suite.attacks)
        if layout.verdict.exists():
            say_verdict(layout)
        if not self.imagery and self.seed == 0:
            say_expected(layout, suite)
        say(f"Report: {layout.report.resolve()}")


def assess(
    detector: str | Path | Detector,
    out: str | Path,
    *,
    imagery: Sequence[str | Path] | str | Path = (),
    labels: str | Path | None = None,
    **options: Any,
) -> Path:
    """Puts one detector to the suite of attacks, as `skyproof assess` does, and writes a report.

    Of a detector that is an object, only `name` and `detect` are used: attacks are learnt on the
    detectors that come with skyproof, and carried on by what it answers. Its threshold is frozen on
    the labels; without any, on rendered vehicles. What stops half-way, a server too, goes on when
    the same is asked again. A MAITE model of object detection is such a detector, too, under its
    `id`; one that takes bytes instead of floats is given as `skyproof.maite.ModelDetector`.

    Args:
        detector: a detector folder, a checkpoint file, an object with `name` and `detect`, or a
            MAITE model, of which `vehicle_classes` names the classes that are vehicles.
        out: run folder.
        imagery: photographs, or folders of them; drawn ground where not given.
        labels: of the vehicles in them.
        options: by name, what else `skyproof assess` takes: gsd, label_classes, vehicle_classes,
            architecture, detector_gsd, accept, reject, producer_risk, consumer_risk, cycles,
            blender, seed, device.

    Returns:
        The report's path.

    Raises:
        ConfigurationError: options of no such name, or that cannot work together.
        DetectorAnswerError: the object stopped answering, or gave what is no answer.
        SkyproofError: whatever else stops a step, in a sentence.
    """
    places = [imagery] if isinstance(imagery, str | Path) else imagery
    known = {field.name for field in fields(Assess)} - {"detector", "out", "imagery", "labels"}
    unknown = next((name for name in options if name not in known), None)
    if unknown is not None:
        raise ConfigurationError(
            f"assess takes no option {unknown!r}; choose from {', '.join(sorted(known))}."
        )
    several = {name: tuple(options[name]) for name in _SEVERAL if name in options}
    stored = isinstance(detector, str | Path)
    box = None if stored else _checked(detector, {**options, **several})
    command = Assess(
        detector=Path(str(detector) if box is None else box.name),
        out=Path(out),
        imagery=tuple(map(Path, places)),
        labels=None if labels is None else Path(labels),
        **{**options, **several},
    )
    check_ranges(command)
    command.run(box)
    return Layout(command.out).report


def _checked(detector: object, options: Mapping[str, Any]) -> Detector:
    """The object, with its answers checked.

    Raises:
        ConfigurationError: it has no name that can be a file's, or nothing to ask it by; or an
            option speaks of files.
    """
    from skyproof.detectors.answers import CheckedAnswers
    from skyproof.detectors.detector import Detector
    from skyproof.maite.models import ModelDetector, is_maite_model

    of_files = ["architecture", *([] if is_maite_model(detector) else ["vehicle_classes"])]
    for name in of_files:
        if options.get(name):
            raise ConfigurationError(
                f"{name} is for checkpoint files, and the detector is an object, which decides it "
                "itself; leave the option out."
            )
    if is_maite_model(detector):
        detector = ModelDetector(detector, vehicle_classes=options.get("vehicle_classes", ()))
    own = getattr(detector, "name", None)
    if not isinstance(detector, Detector) or not isinstance(own, str) or not is_name(own):
        raise ConfigurationError(
            "assess expects a folder, a file, a MAITE model, or an object with detect and a plain "
            f"name (no separators, not dots alone), got {type(detector).__name__} named "
            f"{str(own)[:100]!r}."
        )
    return CheckedAnswers(detector)
