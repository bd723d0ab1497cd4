"""Measures what closes the gap between renders and photographs, for docs/results/reality.

    python tools/reality_gap.py --data DATA --out RUN --stage tune
    python tools/reality_gap.py --data DATA --out RUN --stage final
    python tools/reality_gap.py --data DATA --out RUN --stage look

The first trains shortly for every trial and looks at the tuning frames, the second does the long
trainings, the third looks at the held-out frames with the final detectors.

DATA holds kit_ais_munich/ and minsk_drone/. What is finished in RUN is kept. Every look at the
held-out frames adds a line to RUN/looks.jsonl.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import torch
import tyro

from skyproof.cli.device import choose_device
from skyproof.cli.frames import read_frames
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.build import build_detector
from skyproof.detectors.detector import Detections, Detector, TrainableDetector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import LoadedDetector, load_detector
from skyproof.detectors.matching import match_images
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import train
from skyproof.files import finished_folder, write_json, write_jsonl
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.measure.baseline import BaselineSet, measure_baseline
from skyproof.randomness import generator_of
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.sensor import PAPER_BLUR_SIGMA_PX
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import SPLITS
from skyproof.scenes.weather import MIXED_CONDITIONS
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

GSD_M, IMAGE_PX = 0.125, 192
CLASSES = ("car", "minibus")
TUNING = "KIT Munich, first place=kit_ais_munich/MOS*@0.116"
HELD_OUT = (
    "KIT Munich, second place=kit_ais_munich/MunichStreet02*@0.121",
    "Minsk=minsk_drone/DJI_0005*@0.055",
    "Minsk=minsk_drone/DJI_0013*@0.055",
    "Minsk=minsk_drone/DJI_0010*@0.04",
    "Minsk=minsk_drone/DJI_0012*@0.04",
)


@dataclass(frozen=True)
class Trial:
    """One way to render training images, and how long to train on them.

    Attributes:
        ground: folders below RUN; "procedural" and "without-clutter" (no bins, sheds, containers
            ...) are made there, "cleared" is imagery that was cleared of vehicles and put there
            before.
        match_colours: the rendered images' mean and spread per channel become those of the tuning
            frames.
        blur_sigma_px, noise, light: of the renderer.
        parked_share, vehicles_maximum, tilt_maximum_deg, conditions: of the scenes.
        vehicles: in the fleet.
        fleet: folder below RUN/fleets, by `skyproof vehicles`; so many drawn vehicles where not
            given.
        jitter: of the training's augmentation.
        images, steps, seed: of the training.
    """

    ground: tuple[str, ...] = ("procedural",)
    match_colours: bool = False
    blur_sigma_px: float = 0.7
    noise: float = 0.006
    light: Light = Light()  # noqa: RUF009 (frozen)
    parked_share: float = 0.5
    vehicles_maximum: int = 7
    tilt_maximum_deg: float = 20.0
    conditions: tuple[str, ...] = ("clear",)
    vehicles: int = 64
    fleet: str | None = None
    jitter: float = 1.0
    images: int = 1600
    steps: int = 700
    seed: int = 0


# The recipe, then the recipe with one thing changed; "as the demo" has the blur and places that the
# demo had then, those of the paper.
TRIALS: dict[str, Trial] = {
    "recipe": Trial(),
    "as the demo": Trial(blur_sigma_px=PAPER_BLUR_SIGMA_PX, parked_share=0.0),
    "blur 2.4": Trial(blur_sigma_px=PAPER_BLUR_SIGMA_PX),
    "uniform places": Trial(parked_share=0.0),
    "blur 1.0": Trial(blur_sigma_px=1.0),
    "blur 0.4": Trial(blur_sigma_px=0.4),
    "mixed weather": Trial(conditions=MIXED_CONDITIONS),
    "second seed": Trial(seed=1),
    "soft shadows": Trial(light=Light(sky=(0.4, 0.42, 0.47))),
    "cleared ground": Trial(ground=("cleared",)),
    "both grounds": Trial(ground=("procedural", "cleared")),
    "blur 1.4": Trial(blur_sigma_px=1.4),
    "240 vehicles": Trial(vehicles=240),
    "jitter 0": Trial(jitter=0.0),
    "blur 1.8": Trial(blur_sigma_px=1.8),
    "jitter 2": Trial(jitter=2.0),
    "near vertical": Trial(tilt_maximum_deg=5.0),
    "JPEG": Trial(conditions=("clear", "jpeg")),
    "no noise": Trial(noise=0.0),
    "16 vehicles": Trial(vehicles=16),
    "colours of the tuning frames": Trial(match_colours=True),
    "wrapped meshes too": Trial(fleet="train-mixed"),
    "ground without clutter": Trial(ground=("without-clutter",)),
}

DETECTORS = ("retinanet", "faster_rcnn", "yolov5")
PHOTOGRAPHS = "photographs"
FINAL: dict[str, Trial] = {
    "before": TRIALS["as the demo"],
    # Both grounds and all weather cost nothing on the tuning frames; other places may need them,
    # and more vehicles.
    "renders": Trial(
        ground=("procedural", "cleared"),
        conditions=MIXED_CONDITIONS,
        vehicles=240,
        images=3000,
        steps=2400,
    ),
    PHOTOGRAPHS: Trial(steps=1000),
}


@dataclass(frozen=True)
class RealityGap:
    """Trains on renders, checks on photographs.

    Attributes:
        data: holds kit_ais_munich and minsk_drone.
        out: folder for everything.
        stage: tune (every trial, on the tuning frames), final (the long trainings) or look (the
            held-out frames).
        only: of the trials, these.
    """

    data: Path
    out: Path
    stage: Literal["tune", "final", "look"] = "tune"
    only: tuple[str, ...] = ()

    def run(self) -> None:
        """Does the stage's unfinished part."""
        {"tune": self._tune, "final": self._final, "look": self._look}[self.stage]()

    def _tune(self) -> None:
        (frames,) = photographed_sets(self.data, (TUNING,))
        for name in self.only or TRIALS:
            place = self.out / "trials" / name.replace(" ", "-").replace(",", "")
            if (place / "check.json").exists():
                continue
            started = time.time()
            training, validation = rendered_sets(self.out, TRIALS[name])
            if TRIALS[name].match_colours:
                training, validation = (
                    _recoloured(each, frames.images) for each in (training, validation)
                )
            trained = train_detector(place, "retinanet", training, validation, TRIALS[name])
            found = detect_all(trained.detector, frames.images)
            row = check_detector(trained, frames, found)
            row["ap_rendered"] = trained.card.validation["ap_centre_1m"]
            write_json(place / "check.json", {"name": name, "trial": asdict(TRIALS[name]), **row})
            print(
                f"{name}: AP {row['ap_centre_1m']:.3f}, {time.time() - started:.0f} s", flush=True
            )

    def _final(self) -> None:
        for name, trial in FINAL.items():
            if self.only and name not in self.only:
                continue
            folder = self.out / "final" / name
            if all((folder / detector / "detector.json").exists() for detector in DETECTORS):
                continue
            training, validation = (
                self._photographs() if name == PHOTOGRAPHS else rendered_sets(self.out, trial)
            )
            for detector in DETECTORS:
                started = time.time()
                card = train_detector(folder, detector, training, validation, trial).card
                print(
                    f"{name} {detector}: {card.validation}, {time.time() - started:.0f} s",
                    flush=True,
                )

    def _photographs(self) -> tuple[Dataset, Dataset]:
        """Cuts the tuning frames' tiles (docs/results/reality/README.md).

        They show one place, so three splits serve the training.
        """
        parts = [Dataset.open(self.out / "tiles" / split) for split in ("train", "attack", "test")]
        return Dataset.joined(parts), Dataset.open(self.out / "tiles" / "validation")

    def _look(self) -> None:
        """Checks every final detector on the held-out frames.

        The rendered test images that are there are looked at too.
        """
        sets = photographed_sets(self.data, HELD_OUT)
        for name, dataset in (("rendered", "test"), ("Cycles", "test-cycles")):
            if (folder := self.out / "datasets" / dataset).exists():
                sets += read_frames([f"{name}={folder}@{GSD_M}"], ("vehicle",), GSD_M)
        folders = [self.out / "final" / name / detector for name in FINAL for detector in DETECTORS]
        # The one that saw no pixel of any photograph.
        folders.insert(len(DETECTORS), self.out / "trials" / "recipe" / "retinanet")
        looks = self.out / "looks.jsonl"
        past = (
            [json.loads(line) for line in looks.read_text().splitlines()] if looks.exists() else []
        )
        write_jsonl(
            looks, [*past, {"time": time.strftime("%Y-%m-%d %H:%M"), "detectors": len(folders)}]
        )
        rows = []
        for folder in folders:
            judge = load_detector(folder)
            for each in sets:
                found = detect_all(judge.detector, each.images)
                row = check_detector(judge, each, found)
                rows.append({"trained_on": folder.parent.name, **row})
                print(
                    f"{folder.parent.name:<12} {judge.name:<12} {each.name:<32} "
                    f"{row['ap_centre_1m']:.3f}",
                    flush=True,
                )
        write_json(self.out / "final.json", {"looks": len(past) + 1, "rows": rows})


def check_detector(
    judge: LoadedDetector[Detector], frames: BaselineSet, found: Sequence[Detections]
) -> dict[str, Any]:
    """Gives the check of a detector on photographs, as plain JSON values."""
    centre = match_images(found, frames.images, criterion="centre_1m")
    overlap = match_images(found, frames.images, criterion="iou_50")
    return measure_baseline(
        judge, frames, centre, overlap, generator=np.random.default_rng(0)
    ).json()


def photographed_sets(data: Path, texts: Sequence[str]) -> list[BaselineSet]:
    """Reads frames below a folder, as `--frames` writes them."""
    placed = [f"{name}={data}/{place}" for name, place in (text.split("=", 1) for text in texts)]
    return read_frames(placed, CLASSES, GSD_M)


def _generator(*names: str | int) -> torch.Generator:
    return generator_of(0, *names)


def _ground(run: Path, name: str) -> BackgroundSet:
    folder = run / name
    if name in ("procedural", "without-clutter") and not folder.exists():
        with ExitStack() as spared, finished_folder(folder) as partial:
            if name == "without-clutter":
                for kinds in ("built_up", "open_country"):
                    spared.enter_context(patch(f"skyproof.ground.{kinds}.add_clutter"))
            write_procedural_backgrounds(
                partial, dict(zip(SPLITS, (64, 12, 24, 40), strict=True)), 386, seed=0
            )
    return BackgroundSet.open(folder)


def _fleet(run: Path, split: str, count: int) -> Fleet:
    folder = run / "fleets" / f"{split}-{count}"
    if not folder.exists():
        sample_fleet(FleetSettings(count=count), generator=_generator("fleet", split)).save(folder)
    return Fleet.load(folder)


@torch.no_grad()
def _render(run: Path, trial: Trial, split: str, count: int, least: int, most: int) -> Dataset:
    """A split's images with vehicles, in memory; the grounds share them out."""
    if split == "train" and trial.fleet is not None:
        fleet = Fleet.load(run / "fleets" / trial.fleet)
    else:
        fleet = _fleet(run, split, trial.vehicles if split == "train" else 16)
    device = choose_device("auto")
    images: list[torch.Tensor] = []
    boxes: list[torch.Tensor] = []
    for name in trial.ground:
        ground = _ground(run, name)
        settings = SceneSettings(
            size_px=IMAGE_PX,
            vehicles_minimum=least,
            vehicles_maximum=most,
            tilt_maximum_rad=math.radians(trial.tilt_maximum_deg),
            conditions=trial.conditions,
            parked_share=trial.parked_share,
        )
        draws = _generator("scenes", trial.seed, split, name)
        scenes = sample_scenes(
            settings,
            ground,
            split,
            fleet.sizes_m,
            count // len(trial.ground),
            generator=draws,
            prefix=split,
        )
        renderer = TorchRenderer(
            ground,
            RenderSettings(
                blur_sigma_px=trial.blur_sigma_px,
                noise=trial.noise,
                light=trial.light,
            ),
        )
        for start in range(0, len(scenes), 8):
            batch = scenes[start : start + 8]
            frames = renderer(batch, placed_vehicles(fleet, batch).to(device))
            images += list((frames.image * 255).round().byte().cpu())
            boxes += [
                frames.boxes[frames.scene_index == index].cpu() for index in range(len(batch))
            ]
    ids = [f"{split}-{number}" for number in range(len(images))]
    return Dataset.of_images(images, boxes, gsd_m=GSD_M, ids=ids)


def _recoloured(images: Dataset, like: Dataset) -> Dataset:
    """Gives the images the colours of `like`.

    Each channel gets the mean and the standard deviation that it has over all of `like`.
    """
    own, wanted = (
        torch.cat([image.flatten(1)[:, ::7].double() for image in each.images(range(len(each)))], 1)
        for each in (images, like)
    )
    scale = (wanted.std(1) / own.std(1))[:, None, None]
    shift = wanted.mean(1)[:, None, None] - scale * own.mean(1)[:, None, None]
    changed = [
        (image * scale + shift).round().clamp(0, 255).byte()
        for image in images.images(range(len(images)))
    ]
    return Dataset.of_images(
        changed, images.boxes, gsd_m=images.gsd_m, ignore=images.ignore, ids=images.ids
    )


def rendered_sets(run: Path, trial: Trial) -> tuple[Dataset, Dataset]:
    """Renders what a trial trains on and validates with, in memory."""
    training = _render(run, trial, "train", trial.images, 0, trial.vehicles_maximum)
    return training, _render(run, trial, "validation", 96, 1, 5)


def train_detector(
    folder: Path, name: str, training: Dataset, validation: Dataset, trial: Trial
) -> LoadedDetector[TrainableDetector]:
    """Trains a slim detector as a trial says, into FOLDER/NAME."""
    weights = _generator("weights", trial.seed, name)
    detector = build_detector(name, "slim", generator=weights).to(choose_device("auto"))
    settings = TrainingSettings(
        steps=trial.steps, batch_size=8, validate_every=trial.steps // 2, jitter=trial.jitter
    )
    draws = _generator("training", trial.seed)
    card = train(detector, training, validation, settings, folder / name, generator=draws)
    return LoadedDetector(detector, card)


if __name__ == "__main__":
    tyro.cli(RealityGap).run()
