"""`skyproof demo`: from nothing to a first robustness report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import torch

from skyproof.attacks.settings import AttackSettings
from skyproof.cli.attack import Attack
from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cli.frames import read_frames
from skyproof.cli.rendering import Rendering
from skyproof.cli.stages import (
    evaluate_folders,
    paint_portrait,
    render_folder,
)
from skyproof.cli.train import Train
from skyproof.cli.world import (
    GSD_M,
    WorldSizes,
    write_fleet,
    write_ground,
    write_scene_files,
)
from skyproof.cycles.blender import find_blender
from skyproof.detectors.build import build_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.errors import ConfigurationError
from skyproof.files import read_json, write_bytes
from skyproof.plans.run_folder import RunFolder
from skyproof.report.report import write_report
from skyproof.scenes.splits import SPLITS
from skyproof.words import interval, percent

__all__ = ["Demo", "check_detectors", "run_demo"]


@dataclass(frozen=True)
class DemoSizes(WorldSizes):
    """How much of everything; the defaults fit 15 minutes on 2 CPU cores.

    Attributes:
        random_draws: random controls to compare with (PAPER 37).
    """

    random_draws: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.random_draws < 0:
            raise ConfigurationError(f"--sizes expects at least 0 random draws, but got {self}.")


@dataclass(frozen=True)
class Demo:
    """Builds vehicles, ground and detectors, attacks the detectors, compares matched pairs, writes a report.

    Stop it whenever you like and give the same command again: it goes on after the last finished step.

    Attributes:
        out: run folder; the report goes there.
        imagery: orthophotos to use as ground instead of procedural ones: GeoTIFFs, or JPEG/PNG with --gsd; a folder
            stands for the images in it.
        gsd: metres per pixel of images that do not say it themselves.
        blur_sigma_px: blur of the vehicles; where not given, the paper's 2.4 on procedural ground and the imagery's own
            on imagery.
        frames: real annotated frames to check the detectors on, `[NAME=]FOLDER[/PATTERN][:LABELS]@GSD` (COCO, YOLO or
            DOTA labels), e.g. kit/MOS*@0.116.
        frame_classes: class names that count as vehicles in them; other classes are ignored, not counted as mistakes.
        detectors: which to build and attack together.
        seed: of everything.
        device: auto, cpu or cuda.
        sizes: how much of everything.
        training: how every detector is trained.
        attack: how the texture is learnt.
        cycles: judge the test scenes as Blender Cycles draws them, too; a finished demo goes on with that part alone.
        blender: for --cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not given, what
            `make blender` made, then `blender` on the PATH.
    """

    out: Path = Path("runs/demo")
    imagery: tuple[Path, ...] = ()
    gsd: float | None = None
    blur_sigma_px: float | None = None
    frames: tuple[str, ...] = ()
    frame_classes: tuple[str, ...] = ("car", "minibus")
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    seed: int = 0
    device: str = "auto"
    sizes: DemoSizes = field(default_factory=DemoSizes)
    training: TrainingSettings = field(
        default_factory=lambda: TrainingSettings(steps=700, batch_size=8, validate_every=175)
    )
    attack: AttackSettings = field(default_factory=lambda: AttackSettings(steps=200))
    cycles: bool = False
    blender: Path | None = None

    def run(self) -> None:
        """Runs all stages that are not finished yet."""
        run_demo(self)


# Where a run is computed, or what is added to it, changes none of its results.
_NOT_SETTINGS = ("out", "imagery", "device", "cycles", "blender")


def run_demo(demo: Demo) -> None:
    """Runs all stages that are not finished yet, and prints where the report lies."""
    if demo.blender is not None and not demo.cycles:
        raise ConfigurationError(
            "--blender says which Blender draws for --cycles; give --cycles too."
        )
    device = choose_device(demo.device)
    names = [str(path) for path in demo.imagery]
    config = {
        "title": "How robust are these vehicle detectors to camouflage?",
        "imagery": names or "procedural",
        **{key: value for key, value in asdict(demo).items() if key not in _NOT_SETTINGS},
    }
    run = RunFolder(demo.out, config)
    report = run.path / "report.html"
    if report.exists() and (not demo.cycles or _shows_cycles(run.path)):
        say(f"This run is finished. Report: {report.resolve()}")
        return
    if demo.cycles:
        # Looked for first: a missing Blender should show before an hour's work, not after it.
        find_blender(demo.blender)
    if not report.exists():
        _attack_and_compare(demo, run, device)
    if demo.cycles:
        _compare_on_cycles(demo, run, device)
    say(f"Report: {report.resolve()}")


def _attack_and_compare(demo: Demo, run: RunFolder, device: torch.device) -> None:
    """From nothing to the report, on images of the differentiable renderer."""
    out, sizes, seed = run.path, demo.sizes, demo.seed
    check_detectors(demo.detectors)
    # Read first: a mistake in these folders should show before an hour's work, not after it.
    clean = read_frames(demo.frames, demo.frame_classes, GSD_M)
    run.start(str(device))
    say(f"skyproof demo on {device}, detectors {', '.join(demo.detectors)}, run folder {out}")

    ground = partial(
        write_ground,
        out,
        sizes,
        seed,
        imagery=demo.imagery,
        assumed_gsd_m=demo.gsd,
        blur_sigma_px=demo.blur_sigma_px,
    )
    run.stage("backgrounds", out / "backgrounds", ground)
    for split in SPLITS:
        run.stage("vehicles", out / "fleets" / split, partial(write_fleet, out, sizes, seed, split))
    run.stage("scenes", out / "scenes", partial(write_scene_files, out, sizes, seed))
    for split in ("train", "validation", "test"):
        place = out / "datasets" / split
        run.stage("render", place, partial(_render, out, split, place, device))
    for name in demo.detectors:
        folder = out / "detectors" / name
        run.stage(
            f"train {name}", folder / "detector.json", partial(_train, demo, name, folder, device)
        )
    trained, (attack, *controls) = _trained(demo), _camouflages(sizes)
    learnt = out / "camouflages" / attack
    run.stage("attack T-U", learnt / "camouflage.json", partial(_attack, demo, trained, device))
    for name in controls:
        folder = out / "camouflages" / name
        draw = Attack((name,), folder.parent, settings=AttackSettings(seed=seed))
        run.stage("random controls", folder / "camouflage.json", draw.run)
    worn = {name: out / "datasets" / f"test-{name}" for name in (attack, *controls)}
    for name, place in worn.items():
        camouflage = out / "camouflages" / name
        run.stage("render pairs", place, partial(_render, out, "test", place, device, camouflage))
    original = out / "datasets" / "test"
    work = partial(
        evaluate_folders,
        trained,
        original,
        worn,
        out / "evaluation",
        clean=clean,
        seed=seed,
        device=device,
    )
    run.stage("evaluate", out / "evaluation", work)
    write_bytes(out / "results.json", (out / "evaluation" / "results.json").read_bytes())
    run.stage(
        "pictures",
        learnt / "on_vehicle.png",
        lambda: paint_portrait(learnt, out / "fleets" / "test", learnt / "on_vehicle.png"),
    )
    run.finish()
    say("  report ...")
    write_report(out)
    _say_answer(out / "results.json")


def _compare_on_cycles(demo: Demo, run: RunFolder, device: torch.device) -> None:
    """The test scenes and the camouflages again, path-traced, judged by the same detectors; then the report anew."""
    rendering = Rendering(renderer="cycles", blender=demo.blender)
    out, seed = run.path, demo.seed
    run.start(str(device))
    say(f"skyproof demo on Blender Cycles, run folder {out}")
    original = out / "datasets" / "test-cycles"
    worn = {name: out / "datasets" / f"test-cycles-{name}" for name in _camouflages(demo.sizes)}
    run.stage(
        "render Cycles",
        original,
        partial(_render, out, "test", original, device, rendering=rendering),
    )
    for name, place in worn.items():
        camouflage = out / "camouflages" / name
        work = partial(_render, out, "test", place, device, camouflage, rendering=rendering)
        run.stage("render Cycles", place, work)
    results = out / "evaluation-cycles"
    compare = partial(
        evaluate_folders, _trained(demo), original, worn, results, seed=seed, device=device
    )
    run.stage("evaluate Cycles", results, compare)
    run.finish()
    say("  report ...")
    write_report(out)
    say("  On Blender Cycles images of the same scenes:")
    _say_answer(results / "results.json")


def _shows_cycles(out: Path) -> bool:
    """Whether the report was written after the evaluation of Cycles images: a stop may have come between them."""
    results = out / "evaluation-cycles"
    return (
        results.exists() and (out / "report.html").stat().st_mtime_ns >= results.stat().st_mtime_ns
    )


def _camouflages(sizes: DemoSizes) -> list[str]:
    return ["T-U", *(f"R-U-{draw}" for draw in range(sizes.random_draws))]


def _trained(demo: Demo) -> list[Path]:
    return [demo.out / "detectors" / name for name in demo.detectors]


def check_detectors(names: Sequence[str], size: str = "slim") -> None:
    """Shows a mistake before the ground is drawn, not when training begins."""
    if len(set(names)) != len(names) or not names:
        raise ConfigurationError("--detectors expects each detector once, and at least one.")
    for name in names:
        build_detector(name, size, generator=torch.Generator())


def _render(
    out: Path,
    split: str,
    place: Path,
    device: torch.device,
    camouflage: Path | None = None,
    rendering: Rendering | None = None,
) -> None:
    scenes, fleet, ground = (
        out / "scenes" / f"{split}.jsonl",
        out / "fleets" / split,
        out / "backgrounds",
    )
    render_folder(
        scenes, ground, fleet, place, camouflage=camouflage, rendering=rendering, device=device
    )


def _train(demo: Demo, name: str, folder: Path, device: torch.device) -> None:
    datasets = demo.out / "datasets"
    Train(
        name,
        datasets / "train",
        datasets / "validation",
        folder,
        settings=asdict(demo.training),
        seed=demo.seed,
        device=str(device),
    ).run()


def _attack(demo: Demo, detectors: Sequence[Path], device: torch.device) -> None:
    Attack(
        ("T-U",),
        demo.out / "camouflages",
        tuple(detectors),
        demo.out / "backgrounds",
        demo.out / "fleets" / "attack",
        image_px=demo.sizes.image_px,
        settings=replace(demo.attack, seed=demo.seed + demo.attack.seed),
        device=str(device),
    ).run()


def _say_answer(results: Path) -> None:
    for row in read_json(results)["rows"]:
        if row["camouflage"] == "T-U" and row["match"] == "centre_1m":
            say(
                f"  {row['detector']:<12} T-U hides {percent(row['easr'])} of the vehicles found before "
                f"(95 % interval {interval(row['easr_low'], row['easr_high'])}); "
                f"net of a random texture {percent(row['net_easr'])}"
            )
