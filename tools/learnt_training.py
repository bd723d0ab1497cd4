"""Measures what vehicles that were learnt from photographs are worth to detectors.

    python tools/learnt_training.py --data DATA --generators layered=RUN/layered gan=RUN/gan \\
        --out RUN/training

It makes docs/results/learnt/training.json. For every generator of `skyproof learn-vehicles`, small
RetinaNets are trained on images of drawn vehicles, of learnt ones, and of half and half: as in the
recipe of tools/reality_gap.py, with the same scenes, as many images and as many steps. Then they
look at photographs of places that no generator learnt from. DATA holds kit_ais_munich/ and
minsk_drone/. Finished trainings in RUN are kept.

Average precision is given for each place, and at the detectors' thresholds how many vehicles of
each kind are found and how many false alarms there are. The interval of a difference is a bootstrap
over the place's frames, crossed with the trainings; both sides of it see the same frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean as mean
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from reality_gap import TRIALS, photographed_sets, rendered_sets, train_detector

from skyproof.cli.device import choose_device
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.files import write_json
from skyproof.generator.fleet import sample_learnt_fleet
from skyproof.generator.folder import load_generator
from skyproof.geometry.colour import srgb_to_cielab
from skyproof.randomness import generator_of
from skyproof.vehicles.fleet import Fleet, FleetSettings, mix_fleets, sample_fleet

PLACES = {
    "KIT Munich, second place": ("kit_ais_munich/MunichStreet02*@0.121",),
    "Minsk, other flights": (
        "minsk_drone/DJI_0013*@0.055",
        "minsk_drone/DJI_0010*@0.04",
        "minsk_drone/DJI_0012*@0.04",
    ),
}
DRAWN = "drawn"
_FLEET = 64
_REPLICATES = 1000
_DARK, _BRIGHT, _COLOURED = 35.0, 65.0, 18.0


@dataclass(frozen=True)
class LearntTraining:
    """Trains on drawn and on learnt vehicles, and looks at photographs.

    Attributes:
        data: holds kit_ais_munich and minsk_drone.
        generators: NAME=FOLDER each.
        out: folder for everything.
        images: sizes of the training sets.
        seeds: trainings of each; fleets, scenes and weights are drawn anew.
    """

    data: Path
    generators: tuple[str, ...]
    out: Path
    images: tuple[int, ...] = (1600, 160)
    seeds: int = 3

    def run(self) -> None:
        """Trains what is not trained yet, looks, prints and writes."""
        arms = self._arms()
        for images, seed, arm in product(self.images, range(self.seeds), arms):
            self._train(arm, images, seed)
        write_json(self.out / "training.json", {"rows": self._look(list(arms))})

    def _train(self, arm: str, images: int, seed: int) -> None:
        folder = self._folder(arm, images, seed)
        if (folder / "retinanet" / "detector.json").exists():
            return
        started = time.time()
        fleet = f"{arm}-{seed}"
        if not (self.out / "fleets" / fleet).exists():
            self._arms()[arm](seed).save(self.out / "fleets" / fleet)
        trial = replace(TRIALS["recipe"], fleet=fleet, images=images, seed=seed)
        training, validation = rendered_sets(self.out, trial)
        train_detector(folder, "retinanet", training, validation, trial)
        print(f"{arm}, {images} images, {seed}: {time.time() - started:.0f} s", flush=True)

    def _folder(self, arm: str, images: int, seed: int) -> Path:
        return self.out / "trained" / f"{arm}-{images}-{seed}"

    def _arms(self) -> dict[str, Callable[[int], Fleet]]:
        """Says how the fleet of each is made from a seed."""

        def drawn(seed: int, count: int = _FLEET) -> Fleet:
            return sample_fleet(FleetSettings(count), generator=generator_of(seed, "drawn"))

        def learnt(folder: str, seed: int, count: int = _FLEET) -> Fleet:
            # Numbers of their own, so that two fleets can be mixed.
            settings = FleetSettings(count, first_number=1000)
            return sample_learnt_fleet(
                load_generator(folder), settings, generator=generator_of(seed, "learnt")
            )

        arms: dict[str, Callable[[int], Fleet]] = {DRAWN: drawn}
        for text in self.generators:
            name, _, folder = text.partition("=")
            arms[name] = lambda seed, folder=folder: learnt(folder, seed)  # type: ignore[misc]
            arms[f"drawn+{name}"] = lambda seed, folder=folder: mix_fleets(  # type: ignore[misc]
                [drawn(seed, _FLEET // 2), learnt(folder, seed, _FLEET // 2)]
            )
        return arms

    def _look(self, arms: Sequence[str]) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for place, texts in PLACES.items():
            named = [f"{place}={text}" for text in texts]
            (frames,) = photographed_sets(self.data, named)
            kinds = self._kinds(frames.images, texts)
            for images in self.images:
                seen = {arm: self._seen(arm, images, frames.images) for arm in arms}
                for arm in arms:
                    row: dict[str, Any] = {"place": place, "images": images, "fleet": arm}
                    row |= _compared(seen[arm].tables, seen[DRAWN].tables)
                    row["recall"] = _recalls(seen[arm], kinds)
                    row["false_alarms"] = _false_alarms(seen[arm])
                    rows.append(row)
                    print(row, flush=True)
        return rows

    def _seen(self, arm: str, images: int, frames: Dataset) -> _Seen:
        judges = [
            load_detector(self._folder(arm, images, seed) / "retinanet")
            for seed in range(self.seeds)
        ]
        for judge in judges:
            judge.detector.to(choose_device("auto"))
        tables = [
            match_images(detect_all(judge.detector, frames), frames, criterion="centre_1m")
            for judge in judges
        ]
        return _Seen(tables, [judge.threshold for judge in judges])

    def _kinds(self, frames: Dataset, texts: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
        """Says of each vehicle, in the order of a match table, which kinds it belongs to."""
        (minibuses,) = photographed_sets(self.data, [f"it={text}#minibus" for text in texts])
        colours: list[str] = []
        large: list[bool] = []
        for index, boxes in enumerate(frames.boxes):
            image = frames.image(index)
            others = minibuses.images.boxes[index]
            for box in boxes:
                if bool((box[2:] > box[:2]).all()):
                    colours.append(_colour(image, box))
                    large.append(bool((others == box).all(1).any()) if len(others) else False)
        named = np.array(colours)
        kinds = {name: named == name for name in ("dark", "grey", "bright", "coloured")}
        return kinds | {"minibus": np.array(large)}


@dataclass(frozen=True)
class _Seen:
    """What three trainings of one kind found in a place, and their thresholds."""

    tables: list[MatchTable]
    thresholds: list[float]


def _colour(image: torch.Tensor, box: torch.Tensor) -> str:
    """Names a vehicle's colour: the median of the middle third of its box, both ways."""
    middle, size = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 6
    left, top = (middle - size).floor().long().clamp(min=0).tolist()
    right, bottom = (middle + size).ceil().long().tolist()
    inside = image[:, top : max(bottom, top + 1), left : max(right, left + 1)].flatten(1)
    lightness, green, blue = srgb_to_cielab((inside.float() / 255).median(1).values[None])[0]
    if float(torch.hypot(green, blue)) >= _COLOURED:
        return "coloured"
    if float(lightness) < _DARK:
        return "dark"
    return "bright" if float(lightness) > _BRIGHT else "grey"


def _recalls(seen: _Seen, kinds: Mapping[str, NDArray[np.bool_]]) -> dict[str, Any]:
    """Gives the share of the vehicles of each kind that is found, mean over trainings."""
    found = np.stack(
        [table.found_at(at) for table, at in zip(seen.tables, seen.thresholds, strict=True)]
    ).mean(0)
    return {
        name: {"vehicles": int(those.sum()), "found": round(float(found[those].mean()), 3)}
        for name, those in {"all": np.ones(len(found), dtype=bool), **kinds}.items()
        if those.any()
    }


def _false_alarms(seen: _Seen) -> list[int]:
    """Counts the detections on no vehicle, of each training at its threshold."""
    pairs = zip(seen.tables, seen.thresholds, strict=True)
    return [table.counts_at(threshold)[1] for table, threshold in pairs]


def _compared(tables: Sequence[MatchTable], drawn: Sequence[MatchTable]) -> dict[str, Any]:
    """Gives mean average precision over trainings, and how much more it is than with drawn ones."""
    generator = np.random.default_rng(0)
    frames = tables[0].images
    means, differences = [], []
    for _ in range(_REPLICATES):
        weights = np.bincount(generator.integers(0, frames, frames), minlength=frames)
        trainings = generator.integers(0, len(tables), len(tables))
        others = generator.integers(0, len(drawn), len(drawn))
        own = [average_precision(tables[index], weights) for index in trainings]
        theirs = [average_precision(drawn[index], weights) for index in others]
        means.append(mean(own))
        differences.append(mean(own) - mean(theirs))
    by_training = [average_precision(table) for table in tables]
    more = mean(by_training) - mean(average_precision(table) for table in drawn)
    return {
        "ap": _with_limits(mean(by_training), means),
        "ap_by_training": [round(each, 4) for each in by_training],
        "more_than_drawn": None if tables is drawn else _with_limits(more, differences),
    }


def _with_limits(estimate: float, replicates: Sequence[float]) -> list[float]:
    low, high = np.nanquantile(replicates, (0.025, 0.975)).tolist()
    return [round(value, 4) for value in (estimate, low, high)]


if __name__ == "__main__":
    tyro.cli(LearntTraining).run()
