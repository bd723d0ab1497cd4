"""From outcomes to the table of results: one row per camouflage, renderer, detector and match criterion, and means."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from skyproof.evaluate.intervals import Interval, cluster_interval, holm, mcnemar_p, mean_interval, resample
from skyproof.evaluate.outcomes import MATCHES, Outcome
from skyproof.evaluate.rates import attack_success_rate, enhancement_rate, overall_attack_success_rate

__all__ = ["MEAN", "ORIGINAL", "SetScore", "cluster_counts", "matched_control", "pooled_name", "summarise"]

MEAN = "mean"
ORIGINAL = "original"
_DRAW = re.compile(r"(R-.+)-\d+")


@dataclass(frozen=True)
class SetScore:
    """One detector on one whole set of images.

    Attributes:
        camouflage: as in the outcomes; "original" for the images without camouflage.
        renderer, detector, match: as in the outcomes.
        average_precision: in [0, 1].
        false_alarms_per_km2: at the frozen threshold.
    """

    camouflage: str
    renderer: str
    detector: str
    match: str
    average_precision: float
    false_alarms_per_km2: float


def pooled_name(camouflage: str) -> str:
    """The row a camouflage belongs to: draws "R-U-0", "R-U-1" of a random control share the row "R-U" (PAPER 34)."""
    draw = _DRAW.fullmatch(camouflage)
    return draw.group(1) if draw else camouflage


def matched_control(camouflage: str) -> str:
    """The random control of a camouflage: the same constraints without learning, "T-PixMa" to "R-PixMa" (PAPER 34)."""
    return "R-" + camouflage.partition("-")[2]


def cluster_counts(outcomes: Sequence[Outcome], clusters: Mapping[str, int]) -> Int[np.ndarray, "C 3"]:
    """Pair counts (both, lost, gained) per background tile; `clusters` maps each tile to its row."""
    counts = np.zeros((len(clusters), 3), dtype=np.int64)
    for outcome in outcomes:
        if outcome.detected_original:
            counts[clusters[outcome.background], 0 if outcome.detected_adversarial else 1] += 1
        elif outcome.detected_adversarial:
            counts[clusters[outcome.background], 2] += 1
    return counts


def summarise(
    outcomes: Sequence[Outcome], sets: Sequence[SetScore], *, generator: np.random.Generator
) -> list[dict[str, Any]]:
    """The rows of `results.json`: fractions, with None where undefined (PAPER 34, 37-41).

    The draws of a random control are averaged, and net EASR is a camouflage's EASR minus that average, on the same
    resampled tiles. Row "mean" is the unweighted mean over detectors (PAPER 39); it is undefined where one detector
    found no vehicle before. Holm's correction runs over the detectors' rows of one match criterion, controls excluded.

    Args:
        outcomes: of every camouflage, renderer, detector and match.
        sets: average precision and false alarms of every set, "original" included; missing ones give None.
        generator: of the bootstrap.
    """
    rows: list[dict[str, Any]] = []
    scores = {(s.camouflage, s.renderer, s.detector, s.match): s for s in sets}
    for match in MATCHES:
        for renderer in _unique(o.renderer for o in outcomes if o.match == match):
            here = [o for o in outcomes if o.match == match and o.renderer == renderer]
            rows.extend(_Table(here, scores, generator).rows(renderer, match))
    for match in MATCHES:
        tested = [row for row in rows if row["match"] == match and row["mcnemar_p"] is not None]
        for row, corrected in zip(tested, holm([row["mcnemar_p"] for row in tested]), strict=True):
            row["mcnemar_p_holm"] = corrected
    return rows


class _Table:
    """The counts of one renderer and one match criterion, and their rows."""

    def __init__(
        self,
        outcomes: Sequence[Outcome],
        scores: Mapping[tuple[str, str, str, str], SetScore],
        generator: np.random.Generator,
    ) -> None:
        clusters = {tile: index for index, tile in enumerate(sorted({o.background for o in outcomes}))}
        groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
        for outcome in outcomes:
            groups[outcome.camouflage, outcome.detector].append(outcome)
        self.counts = {key: cluster_counts(group, clusters) for key, group in groups.items()}
        self.vehicles = {key: len(group) for key, group in groups.items()}
        self.tiles = {key: len({o.background for o in group}) for key, group in groups.items()}
        self.detectors = _unique(o.detector for o in outcomes)
        self.draws: dict[str, list[str]] = defaultdict(list)
        for camouflage in _unique(o.camouflage for o in outcomes):
            self.draws[pooled_name(camouflage)].append(camouflage)
        self.scores = scores
        self.weights = resample(len(clusters), generator=generator)

    def rows(self, renderer: str, match: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for name, members in self.draws.items():
            present = [d for d in self.detectors if all((member, d) in self.counts for member in members)]
            selections = [(detector, [detector]) for detector in present]
            if len(present) > 1:
                selections.append((MEAN, present))
            rows.extend(self._row(name, label, chosen, renderer, match) for label, chosen in selections)
        return rows

    def _row(self, name: str, label: str, detectors: list[str], renderer: str, match: str) -> dict[str, Any]:
        members = self.draws[name]
        control = [] if name.startswith("R-") else self.draws.get(matched_control(name), [])
        control = [draw for draw in control if all((draw, d) in self.counts for d in detectors)]
        own = self._stack(members, detectors)
        easr = mean_interval(own, overall_attack_success_rate, self.weights, (-math.inf, 1.0))
        asr = mean_interval(own, attack_success_rate, self.weights, (0.0, 1.0))
        er = mean_interval(own, enhancement_rate, self.weights, (0.0, math.inf))
        row: dict[str, Any] = {
            "camouflage": name,
            "renderer": renderer,
            "detector": label,
            "vehicles": self.vehicles[members[0], detectors[0]],
            "easr": easr.estimate,
            "easr_low": easr.low,
            "easr_high": easr.high,
            "net_easr": None,
            "net_easr_low": None,
            "net_easr_high": None,
            "asr": asr.estimate,
            "er": er.estimate,
        }
        if control:
            random = self._stack(control, detectors)
            chance = mean_interval(random, overall_attack_success_rate, self.weights, (-math.inf, 1.0))
            net = cluster_interval(np.concatenate([own, random]), _net(len(own)), self.weights)
            net = _no_surer_than_its_parts(net, easr, chance)
            row |= {"net_easr": net.estimate, "net_easr_low": net.low, "net_easr_high": net.high}
        row |= self._set_scores(members, detectors, renderer, match)
        row |= {"clusters": self.tiles[members[0], detectors[0]], "draws": len(members)}
        row |= {"asr_low": asr.low, "asr_high": asr.high, "er_low": er.low, "er_high": er.high}
        row["random_easr"] = chance.estimate if control else None
        row |= {"random_draws": len(control), "mcnemar_p": None, "mcnemar_p_holm": None}
        total = own.sum(axis=(0, 1))
        if label != MEAN and len(members) == 1 and not name.startswith("R-"):
            row["mcnemar_p"] = mcnemar_p(int(total[1]), int(total[2]))
        return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}

    def _stack(self, camouflages: list[str], detectors: list[str]) -> Int[np.ndarray, "S C 3"]:
        return np.stack([self.counts[camouflage, d] for camouflage in camouflages for d in detectors])

    def _set_scores(self, members: list[str], detectors: list[str], renderer: str, match: str) -> dict[str, Any]:
        """AP before and after, APD (PAPER 41) and false alarms; nan where any of the sets was not scored."""

        def mean_of(camouflages: list[str], field: str) -> float:
            found = [self.scores.get((c, renderer, d, match)) for c in camouflages for d in detectors]
            return float(np.mean([math.nan if score is None else getattr(score, field) for score in found]))

        before, after = mean_of([ORIGINAL], "average_precision"), mean_of(members, "average_precision")
        return {
            "ap_original": before,
            "ap_adversarial": after,
            "apd": before - after,
            "match": match,
            "false_alarms_per_km2_original": mean_of([ORIGINAL], "false_alarms_per_km2"),
            "false_alarms_per_km2_adversarial": mean_of(members, "false_alarms_per_km2"),
        }


def _mean(rate: Any) -> Any:
    """The unweighted mean of a rate over detectors (and draws), of summed counts `[..., S, 3]`."""
    return lambda counts: rate(counts).mean(axis=-1)


def _no_surer_than_its_parts(net: Interval, easr: Interval, chance: Interval) -> Interval:
    """Widens a net interval where resampling sees no spread in one part, because every tile agrees.

    That part's exact limit then enters by the square-and-add rule for differences of independent rates (MOVER; Zou and
    Donner 2008).
    """
    lower = math.hypot(easr.estimate - easr.low, chance.high - chance.estimate)
    upper = math.hypot(easr.high - easr.estimate, chance.estimate - chance.low)
    unanimous = easr.unanimous or chance.unanimous
    if not unanimous or math.isnan(lower + upper):
        return net
    return Interval(net.estimate, min(net.low, net.estimate - lower), max(net.high, net.estimate + upper))


def _net(own: int) -> Any:
    """Mean EASR of the first `own` series minus that of the rest."""

    def difference(counts: np.ndarray) -> Any:
        easr = overall_attack_success_rate(counts)
        return easr[..., :own].mean(axis=-1) - easr[..., own:].mean(axis=-1)

    return difference


def _unique(values: Any) -> list[str]:
    return list(dict.fromkeys(values))
