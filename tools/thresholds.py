"""What a camouflage hides at other thresholds than the frozen one, read off a finished score.

A threshold frozen higher makes hiding easier. Whoever compares two detectors therefore has to
compare them at one threshold, too:

    python tools/thresholds.py runs/a/scores/main runs/b/scores/main --thresholds 0.3 0.4 0.5
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet

from skyproof.results.statistics.rates import overall_attack_success_rate


def main() -> None:
    """Prints, per score folder and detector, the EASR of every camouflage at every threshold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scores", nargs="+", type=Path, help="folders with an outcomes.parquet")
    parser.add_argument("--thresholds", nargs="+", type=float, default=[0.2, 0.3, 0.4, 0.5])
    arguments = parser.parse_args()
    for folder in arguments.scores:
        rows = parquet.read_table(
            folder / "outcomes.parquet",
            filters=[("match", "==", "centre_1m"), ("renderer", "==", "torch")],
        ).to_pandas()
        for detector, own in rows.groupby("detector", sort=False):
            print(f"{folder}, {detector}: recall without camouflage and EASR in %")
            print(f"{'threshold':>10}  {'recall':>6}  " + _line(list(own.camouflage.unique())))
            for threshold in arguments.thresholds:
                recall, rates = _at(own, threshold)
                print(f"{threshold:10.2f}  {recall:6.0f}  " + _line([f"{r:.0f}" for r in rates]))


def _at(rows: pd.DataFrame, threshold: float) -> tuple[float, list[float]]:
    rates = []
    recall = 0.0
    for _, each in rows.groupby("camouflage", sort=False):
        before = each.score_original.to_numpy() >= threshold
        after = each.score_adversarial.to_numpy() >= threshold
        recall = 100 * before.mean()
        counts = [(before & after).sum(), (before & ~after).sum(), (~before & after).sum()]
        rate = overall_attack_success_rate(np.array(counts))
        rates.append(100 * float(rate))
    return recall, rates


def _line(cells: list[str]) -> str:
    return "  ".join(f"{cell:>12}" for cell in cells)


if __name__ == "__main__":
    main()
