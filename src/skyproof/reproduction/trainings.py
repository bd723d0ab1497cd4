"""Headline attacks on several trainings of every detector: how much one training decides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.name import CamouflageName
from skyproof.detectors.card import DetectorCard
from skyproof.errors import ConfigurationError
from skyproof.reproduction.cells import (
    Block,
    Heading,
    Table,
    TextTable,
    Topic,
    detector_of,
    interval_cells,
    number,
    rate,
    value,
)
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.outcomes import Cell, OutcomeCounts, repeat_of
from skyproof.results.result import MAIN_MATCH, MEAN
from skyproof.results.results import RENDERER, Results
from skyproof.results.score_folder import ScoreFolder, merge_scores
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample, overall_attack_success_rate
from skyproof.results.statistics.repeats import SEEDS, TRAININGS, Repeat
from skyproof.results.stored import read_detectors
from skyproof.words import detector_name


@dataclass(frozen=True)
class _Training:
    """Detectors of one training and outcomes by camouflage and detector; 0 is the run's own."""

    number: int
    cells: Sequence[Cell]
    counts: Mapping[tuple[str, str], Int[np.ndarray, "N 4"]]
    cards: Mapping[str, DetectorCard]

    @classmethod
    def of(cls, number: int, counts: OutcomeCounts, cards: Mapping[str, DetectorCard]) -> _Training:
        here = counts.of(RENDERER, MAIN_MATCH)
        series = {(key.camouflage, key.detector): each for key, each in here.series.items()}
        return cls(number, here.cells, series, cards)

    @property
    def in_sight(self) -> list[tuple[Cell, int]]:
        """How many vehicles stand in each cell, the same for all series."""
        counts = next(iter(self.counts.values()))[:, 0].tolist()
        return list(zip(self.cells, counts, strict=True))


def trainings_part(run: Reproduction) -> Topic:
    """Gives EASR and net EASR by detector of attacks on every training; nothing of one training."""
    trainings = read_trainings(run.results)
    if len(trainings) < 2:
        return Topic()
    sample = Sample.draw(trainings[0].cells, generator=np.random.default_rng(0))
    beside = _Trainings(trainings, sample)
    detectors = run.detectors
    labels = [(detector, [detector]) for detector in detectors]
    if len(detectors) > 1:
        labels.append((MEAN, list(detectors)))
    rows = [
        beside.row(name, label, chosen)
        for name in run.results.names
        if not name.random and not name.variant and beside.shared(name, detectors)
        for label, chosen in labels
    ]
    return Topic([Table("trainings", rows)], _blocks(trainings, rows))


def _blocks(trainings: Sequence[_Training], rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Says how far trainings lie apart."""
    heading = Heading("Other trainings of the detectors")
    if not rows:
        return [heading, "No attack was learnt on every training yet."]
    numbers = [training.number for training in trainings]
    others = " and ".join(map(str, numbers[1:]))
    seeds = max(row["seeds"] for row in rows)
    text = (
        f"All else on this page is about one training of each detector, number 0. Number {others} "
        f"learnt from the same images by the same recipe, from other seeds "
        f"({_standing(trainings)}). Every attack was learnt on each anew, "
        f"{'once' if seeds == 1 else f'from {seeds} seeds'}. EASR of each training, and their mean "
        "with an interval that covers tiles, vehicles and trainings; what seeds do is a part of "
        "how trainings differ."
    )
    net = (
        "Net of the random control; its draws are the same for every training, and the intervals "
        "cover them, too:"
    )
    return [
        heading,
        text,
        _grid(rows, numbers, "easr"),
        net,
        _grid([row for row in rows if row["net_easr"] is not None], numbers, "net_easr"),
    ]


@dataclass(frozen=True)
class _Trainings:
    """Trainings on one sample of tiles and vehicles."""

    each: Sequence[_Training]
    sample: Sample

    def shared(self, name: CamouflageName, detectors: Sequence[str]) -> list[str]:
        """Lists the repeats or draws of a camouflage that these detectors of all trainings saw."""
        known = dict.fromkeys(camouflage for camouflage, _ in self.each[0].counts)
        return [
            camouflage
            for camouflage in known
            if CamouflageName.read(camouflage).pooled == name
            and all((camouflage, d) in training.counts for training in self.each for d in detectors)
        ]

    def row(self, name: CamouflageName, label: str, detectors: Sequence[str]) -> dict[str, Any]:
        """Gives one attack's rates before some detectors, in percent and points."""
        repeats = self.shared(name, detectors)
        draws = self.shared(name.control, detectors)
        learnt = self._group(repeats, detectors)
        easr = mean_interval(learnt)
        rates = self._rates(learnt, len(repeats))
        row: dict[str, Any] = {
            "attack": str(name),
            "detector": label,
            "trainings": len(self.each),
            "seeds": len(repeats),
            **self._columns("easr", easr, rates.mean(axis=1)),
            "random_draws": len(draws),
        }
        if not draws:
            return row | {"random_easr": None, "net_easr": None}
        drawn = self._group(draws, detectors)
        net = difference_interval([learnt], [drawn])
        random = self._rates(drawn, len(draws)).mean(axis=1)
        row["random_easr"] = 100 * float(random.mean())
        return row | self._columns("net_easr", net, rates.mean(axis=1) - random)

    def _group(self, camouflages: Sequence[str], detectors: Sequence[str]) -> Group:
        """Gathers series by training, repeat and detector; draws are the same for all trainings."""
        stack = []
        repeats: list[list[Repeat]] = []
        for training in self.each:
            for camouflage in camouflages:
                own = repeat_of(camouflage)
                crossed = [own] if own.kind != SEEDS else []
                for detector in detectors:
                    stack.append(training.counts[camouflage, detector][:, 1:])
                    again = Repeat("detectors", str(training.number), TRAININGS)
                    repeats.append([*crossed, again])
        return Group(np.stack(stack), self.sample, repeats)

    def _rates(self, group: Group, repeats: int) -> Float[np.ndarray, "K R"]:
        """Gives EASR by training and repeat, mean over the detectors."""
        rates = overall_attack_success_rate(group.counts.sum(axis=1))
        by_repeat: Float[np.ndarray, "K R"] = rates.reshape(len(self.each), repeats, -1).mean(
            axis=-1
        )
        return by_repeat

    def _columns(
        self, name: str, interval: Interval, rates: Float[np.ndarray, " K"]
    ) -> dict[str, Any]:
        return {
            **{
                f"{name}_training_{training.number}": 100 * float(rate)
                for training, rate in zip(self.each, rates, strict=True)
            },
            **interval_cells(name, interval, 100.0),
            f"{name}_training_sd": 100 * float(rates.std(ddof=1)),
        }


def _grid(rows: Sequence[Mapping[str, Any]], numbers: Sequence[int], name: str) -> Block:
    if not rows:
        return "No random control was scored on every training."
    return TextTable.of(
        rows,
        [
            ("attack", "attack"),
            ("detector", detector_of),
            *((f"training {each}", value(f"{name}_training_{each}")) for each in numbers),
            ("EASR" if name == "easr" else "net EASR", rate(name)),
            ("SD of trainings", value(f"{name}_training_sd")),
        ],
    )


def _standing(trainings: Sequence[_Training]) -> str:
    """What every training of a detector reached in validation."""
    told = []
    for name in trainings[0].cards:
        cards = [training.cards.get(name) for training in trainings]
        scores = [None if card is None else card.validation.get("ap_centre_1m") for card in cards]
        shown = [number(None if score is None else 100 * score) for score in scores]
        told.append(f"{detector_name(name)} {', '.join(shown)}")
    return "AP in validation, in percent: " + "; ".join(told)


def read_trainings(results: Results) -> list[_Training]:
    """Gives the run's own training and, after it, the further ones that were scored."""
    layout = PaperLayout(results.folder)
    names = [path.name for path in layout.trainings.glob("*") if path.name.isdecimal()]
    own = _Training.of(0, results.counts, results.cards)
    trainings = [own]
    for which in sorted(int(name) for name in names if name == str(int(name)) and int(name)):
        place = layout.training(which)
        # What is hidden is being made, or a kill left it.
        if not any(path.is_dir() for path in place.scores.glob("[!.]*")):
            continue
        counts, _ = merge_scores(ScoreFolder.all_of(place.folder))
        if RENDERER not in {key.renderer for key in counts.series}:
            continue
        training = _Training.of(which, counts, read_detectors(place.detectors))
        _refuse_other_vehicles(own, training)
        trainings.append(training)
    return trainings


def _refuse_other_vehicles(own: _Training, training: _Training) -> None:
    if own.in_sight != training.in_sight:
        raise ConfigurationError(
            f"Training {training.number} was not scored on the vehicles and tiles of training "
            f"{own.number}; score both on the same scenes."
        )
    judges = [sorted({detector for _, detector in each.counts}) for each in (own, training)]
    if judges[0] != judges[1]:
        raise ConfigurationError(
            f"Training {training.number} was scored by {', '.join(judges[1])}, but training "
            f"{own.number} by {', '.join(judges[0])}; train and score every detector as often."
        )
