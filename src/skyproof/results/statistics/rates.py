"""Success rates from matched pairs: the same vehicle in the original and in the adversarial image.

Every function takes pair counts `[..., 3]` whose last axis is (both, lost, gained): detected in
both images (V_dd), detected in the original only (V_dm), detected in the adversarial only (V_md).
So one formula serves a single number and thousands of bootstrap replicates.
"""

import numpy as np
import numpy.typing as npt
from jaxtyping import Float, Num


def attack_success_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Gives ASR = |V_dm| / |V_dd ∪ V_dm|, the share of found vehicles now missed; else nan."""
    return _divide(counts[..., 1], counts[..., 0] + counts[..., 1])


def enhancement_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Gives ER = |V_md| / |V_dd ∪ V_dm|, vehicles found only since; it may exceed 1."""
    return _divide(counts[..., 2], counts[..., 0] + counts[..., 1])


def overall_attack_success_rate(counts: Num[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Gives EASR = ASR − ER, which is 1 − TP_adversarial / TP_original at the fixed threshold."""
    return _divide(counts[..., 1] - counts[..., 2], counts[..., 0] + counts[..., 1])


def false_alarms_per_km2(false_alarms: int, area_m2: float) -> float:
    """Detections on no vehicle per square kilometre of imaged ground; nan without images."""
    return 1e6 * false_alarms / area_m2 if area_m2 > 0 else float("nan")


def _divide(numerator: npt.ArrayLike, denominator: npt.ArrayLike) -> Float[np.ndarray, "*shape"]:
    below = np.asarray(denominator, dtype=np.float64)
    return np.divide(numerator, below, out=np.full_like(below, np.nan), where=below > 0)
