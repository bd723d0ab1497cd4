"""`skyproof assess` and `skyproof demo`, and the request that they make: config.json holds it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta
from tyro.conf import Positional

from skyproof.detectors.card import detector_folder, reference_folder, require_detector_name
from skyproof.errors import ConfigurationError, SkyproofError
from skyproof.ranges import Fraction, GroundResolution, Risk, Seed

if TYPE_CHECKING:
    from skyproof.results.statistics.acceptance import Requirement

_Class = Annotated[str, Meta(max_length=200)]
_UNDECIDED = ("out", "device", "cycles", "blender", "go_on", "plan")
"""Options that change no results: where a run is computed, and what is added to it."""

_OPTIONS = {
    "give it with --source.crs, or the metres": "write it into the image, or give the metres",
    " (or --source.crs)": "",
    ", or larger tiles (--tiling.size-px)": "",
    "give images with some": "label more vehicles of the imagery, or leave out --labels",
    "give frames with labels, or leave them": "label more vehicles, or leave --labels",
    "--source.gsd-m": "--gsd",
    "--labels.classes": "--label-classes",
    "--labels.path": "--labels",
}
"""Advice in errors of the commands that an assessment runs, and its wording for `assess`."""


@contextmanager
def own_options() -> Iterator[None]:
    """Rewrites errors of the steps so that they name the options of `assess`."""
    try:
        yield
    except SkyproofError as error:
        message = str(error)
        for theirs, ours in _OPTIONS.items():
            message = message.replace(theirs, ours)
        if message == str(error):
            raise
        raise type(error)(message) from error


@dataclass(frozen=True)
class Request:
    """Tests detectors on your imagery with a fixed suite of attacks, and accepts or rejects them.

    It tiles the imagery, clears it of vehicles, freezes thresholds on its labels, prechecks the
    detectors, and measures every attack beside its controls. A stopped run resumes with the same
    command.

    Attributes:
        detectors: detector folders, "retinanet" or "faster_rcnn", which are attacked together and
            tested one by one, or a checkpoint of Ultralytics, torchvision or transformers, or ONNX.
        out: run folder to write.
        imagery: orthophotos of at least 24 m on each side, or folders of them, as GeoTIFF, or JPEG
            or PNG with `--gsd`. Without any, ground is drawn, and the result says nothing about
            your sites.
        gsd: metres per pixel of imagery that does not state it.
        labels: vehicle labels of the imagery: COCO, YOLO, DOTA or VisDrone text, Pascal VOC,
            GeoJSON, GeoPackage or Shapefile. They freeze the threshold.
        label_classes: vehicle classes of the labels, if they have several classes. FIELD=CLASS
            also names the field of a vector file.
        vehicle_classes: vehicle classes of a file: names, or numbers if it has none (torchvision).
        architecture: architecture of a torchvision checkpoint, as for `skyproof import`.
        detector_gsd: metres per pixel that a file was made for (0.125, or as an ONNX file says).
        accept: share of found vehicles that the worst attack may hide. With `--reject` the report
            accepts or rejects each detector.
        reject: share of hidden vehicles from which a detector is rejected.
        producer_risk: largest chance that a detector at `--accept` is rejected.
        consumer_risk: largest chance that a detector at `--reject` is accepted.
        cycles: render the test scenes with Blender Cycles as well, even after a finished run.
        blender: Blender 4.5, or a Python with bpy 4.5 (default: that of `make blender`, then the
            one on the PATH).
        go_on: go on although labelled vehicles have an impossible length, or although no detector
            passed its precheck and a verdict was asked for.
        seed: seed of everything that is drawn.
        device: auto, cpu or cuda.
        plan: only estimate the scenes, tiles and time that the request needs.
    """

    detectors: Positional[tuple[Path, ...]]
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
    go_on: bool = False
    seed: Seed = 0
    device: str = "auto"
    plan: bool = False

    def run(self) -> None:
        from skyproof.assessment.assess import plan_assessment, run_assessment

        if self.plan:
            plan_assessment(self)
        else:
            run_assessment(self)

    @property
    def requirement(self) -> "Requirement | None":
        """The requirement that decides whether a detector is accepted; None if there is none."""
        from skyproof.results.statistics.acceptance import requirement_of

        return requirement_of(self.accept, self.reject, self.producer_risk, self.consumer_risk)

    @property
    def checkpoint_name(self) -> str:
        """The run folder's name, for a checkpoint: trainers call their files "best" and "last"."""
        return self.out.resolve().name

    def config(self) -> dict[str, object]:
        """Returns the options that decide the results, for config.json."""
        settings = {key: value for key, value in asdict(self).items() if key not in _UNDECIDED}
        imagery = [str(path) for path in self.imagery] or "procedural"
        return {**settings, "imagery": imagery}

    def refuse_contradictions(self, *, objects: bool) -> None:
        """Refuses options that contradict each other; Python `objects` have no files to check."""
        needed = {
            "--blender": (self.blender, self.cycles, "--cycles"),
            "--gsd": (self.gsd, self.imagery, "--imagery"),
            "--labels": (self.labels, self.imagery, "--imagery"),
            "--label-classes": (self.label_classes, self.labels, "--labels"),
        }
        for option, (value, other, name) in needed.items():
            if value and not other:
                raise ConfigurationError(f"{option} needs {name}; give {name} too.")
        for path in (*self.imagery, *([] if self.labels is None else [self.labels])):
            if not path.exists():
                raise ConfigurationError(f"{path} is not there; check --imagery and --labels.")
        if not self.detectors:
            raise ConfigurationError("assess expects at least one detector, got none.")
        if not objects:
            for place in self.detectors:
                self._refuse_detector(place)

    def _refuse_detector(self, place: Path) -> None:
        folder = detector_folder(place)
        if not folder.exists():
            raise ConfigurationError(
                f"{place} is not there; give a detector folder, a checkpoint file, or the name of "
                "a detector that comes with skyproof (retinanet, faster_rcnn)."
            )
        if folder.is_dir():
            given = (self.vehicle_classes, self.architecture, self.detector_gsd)
            options = ("--vehicle-classes", "--architecture", "--detector-gsd")
            for option, value in zip(options, given, strict=True):
                if value:
                    raise ConfigurationError(
                        f"{option} is for checkpoint files, and {place} is a folder, which says it "
                        "itself; leave the option out."
                    )
        elif place.suffix.lower() == ".onnx" and (self.architecture or len(self.detectors) > 1):
            raise ConfigurationError(
                f"{place} is an ONNX file, which is assessed alone and holds its architecture; "
                "leave out --architecture and other detectors."
            )
        elif len(self.detectors) > 1:
            raise ConfigurationError(
                f"{place} is a checkpoint file, which is assessed alone; make a detector folder of "
                "it first (skyproof import), and give that beside the others."
            )
        elif not self.vehicle_classes and place.suffix.lower() != ".dlpk":
            raise ConfigurationError(
                f"{place} is a checkpoint file, whose classes may be anything; say with "
                "--vehicle-classes which of them are vehicles."
            )
        else:
            remedy = "it is called like the run folder, so choose another --out"
            require_detector_name(self.checkpoint_name, remedy)


@dataclass(frozen=True)
class Demo:
    """Assesses a reference detector on drawn ground with two attacks, before and after hardening.

    It takes about six minutes on two CPU cores. A stopped run resumes with the same command.

    Attributes:
        out: run folder to write, with that of the hardened detector in `hardened`.
        seed: seed of everything that is drawn.
        device: auto, cpu or cuda.
        cycles: render the test scenes with Blender Cycles as well, even after a finished run.
        blender: Blender 4.5, or a Python with bpy 4.5 (default: that of `make blender`, then the
            one on the PATH).
    """

    out: Path = Path("runs/demo")
    seed: Seed = 0
    device: str = "auto"
    cycles: bool = False
    blender: Path | None = None

    def run(self) -> None:
        from skyproof.assessment.demo import run_demo

        before, hardened = map(reference_folder, ("retinanet", "retinanet_hardened"))
        run_demo(Request((before,), **vars(self)), hardened)
