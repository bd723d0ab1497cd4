"""Success rates from matched pairs: the same vehicle in the original and in the adversarial image (PAPER 38).

Every function takes pair counts `[..., 3]` whose last axis is (both, lost, gained): detected in both images (V_dd),
detected in the original only (V_dm), detected in the adversarial only (V_md). So one formula serves a single number
and thousands of bootstrap replicates.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from jaxtyping import Bool, Float, Num

__all__ = [
    "attack_success_rate",
    "enhancement_rate",
    "false_alarms_per_km2",
    "overall_attack_success_rate",
    "pair_counts",
    "success_difference",
]


def pair_counts(
    original: Bool[np.ndarray, " V"], adversarial: Bool[np.ndarray, " V"]
) -> Num[np.ndarray, " 3"]:
    """Counts vehicles by (both, lost, gained); those missed in both images count nowhere.

    Args:
        original: `[V]` whether each vehicle was detected in its original image.
        adversarial: `[V]` the same vehicles in the adversarial images.
    """
    both, lost, gained = original & adversarial, original & ~adversarial, ~original & adversarial
    return np.array([both.sum(), lost.sum(), gained.sum()], dtype=np.int64)


def attack_success_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """ASR = |V_dm| / |V_dd ∪ V_dm|: of the vehicles found before, the share no longer found. nan where none was."""
    return _divide(counts[..., 1], counts[..., 0] + counts[..., 1])


def enhancement_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """ER = |V_md| / |V_dd ∪ V_dm|: vehicles found only since the attack, over those found before; may exceed 1."""
    return _divide(counts[..., 2], counts[..., 0] + counts[..., 1])


def overall_attack_success_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """EASR = ASR − ER, equal to 1 − TP_adversarial / TP_original at the fixed threshold. nan where none was found."""
    return _divide(counts[..., 1] - counts[..., 2], counts[..., 0] + counts[..., 1])


def success_difference(
    own: int,
) -> Callable[[Num[np.ndarray, "*shape S 3"]], Float[np.ndarray, "*shape"]]:
    """Of stacked series: the mean EASR of the first `own` minus that of the rest (net EASR, PAPER 37)."""

    def difference(counts: Num[np.ndarray, "*shape S 3"]) -> Float[np.ndarray, "*shape"]:
        easr = overall_attack_success_rate(counts)
        return np.asarray(easr[..., :own].mean(axis=-1) - easr[..., own:].mean(axis=-1))

    return difference


def false_alarms_per_km2(false_alarms: int, images: int, image_area_m2: float) -> float:
    """Detections on no vehicle per square kilometre of imaged ground (PAPER 38: counted apart). nan without images."""
    area_km2 = images * image_area_m2 / 1e6
    return false_alarms / area_km2 if area_km2 > 0 else float("nan")


def _divide(numerator: npt.ArrayLike, denominator: npt.ArrayLike) -> Float[np.ndarray, "*shape"]:
    below = np.asarray(denominator, dtype=np.float64)
    return np.divide(numerator, below, out=np.full_like(below, np.nan), where=below > 0)
