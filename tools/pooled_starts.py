"""What intervals would gain and lose if an attack's spread over starts were learnt from others.

An attack's few starts say little of how far starts lie apart. The other attacks of a table could
help: their variances give the prior by maximum likelihood, as Smyth (2004) does for genes. This
simulates tables in which one attack's starts lie farther apart than the others', and prints how
often 95 % intervals of the starts alone hold the truth, beside those of the prior that skyproof
uses (`SEEDS`), which counts for every attack alike.

    python tools/pooled_starts.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Float
from scipy import special, stats

from skyproof.results.statistics.repeats import SEEDS

# Rates of some two hundred vehicles are no finer than this.
_SMALLEST_SD = 0.005
_SDS = np.geomspace(_SMALLEST_SD, 0.2, 30)
_WEIGHTS = np.array([1, 1.5, 2, 3, 4, 6, 8, 12, 24, 50])


@dataclass(frozen=True)
class Table:
    """What is simulated.

    Attributes:
        attacks: how many a table has.
        sd: standard deviation of the starts of all but one of them.
        other_sd: that of the one.
        starts: of each attack.
        tables: how many are simulated.
        seed: decides them.
    """

    attacks: int = 12
    sd: float = 0.025
    other_sd: float = 0.1
    starts: int = 3
    tables: int = 2000
    seed: int = 0


def main(table: Table) -> None:
    """Simulates, and prints one line for each way."""
    rng = np.random.default_rng(table.seed)
    sds = np.full(table.attacks, table.sd)
    sds[0] = table.other_sd
    held: dict[str, list[Float[np.ndarray, " A"]]] = {"pooled": [], "fixed": []}
    widths: dict[str, list[Float[np.ndarray, " A"]]] = {"pooled": [], "fixed": []}
    for _ in range(table.tables):
        errors = rng.standard_normal((table.attacks, table.starts)) * sds[:, None]
        variances = np.maximum(errors.var(axis=1, ddof=1), _SMALLEST_SD**2)
        for name, (usual_sd, weight) in {
            "pooled": _fitted(variances, table.starts - 1),
            "fixed": (SEEDS.usual_sd, 1.0),
        }.items():
            half_widths = _half_widths(variances, table.starts, usual_sd, weight)
            held[name].append(np.abs(errors.mean(axis=1)) < half_widths)
            widths[name].append(half_widths)
    for name in held:
        shares = 100 * np.mean(held[name], axis=0)
        mean_widths = 100 * np.mean(widths[name], axis=0)
        print(
            f"{name}: held {shares[1:].mean():.1f} % of the others, half-width "
            f"{mean_widths[1:].mean():.1f} points; {shares[0]:.1f} % of the one, "
            f"{mean_widths[0]:.1f} points"
        )


def _fitted(variances: Float[np.ndarray, " A"], degrees: int) -> tuple[float, float]:
    """Gives the most likely standard deviation and weight, in repeats, of what all show."""
    ratios = variances[:, None, None] / _SDS[None, :, None] ** 2
    density = stats.f.logpdf(ratios, degrees, _WEIGHTS) - 2 * np.log(_SDS)[None, :, None]
    sd, weight = np.unravel_index(density.sum(axis=0).argmax(), density.shape[1:])
    return float(_SDS[sd]), float(_WEIGHTS[weight])


def _half_widths(
    variances: Float[np.ndarray, " A"], starts: int, usual_sd: float, weight: float
) -> Float[np.ndarray, " A"]:
    """Gives Student's, with what is expected counted as `weight` repeats."""
    degrees = weight + starts - 1
    variance = (weight * usual_sd**2 + (starts - 1) * variances) / degrees
    return special.stdtrit(degrees, 0.975) * np.sqrt(variance / starts)


if __name__ == "__main__":
    main(tyro.cli(Table))
