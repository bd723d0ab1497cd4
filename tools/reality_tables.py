"""The tables and the figure of docs/results/reality, from what tools/reality_gap.py left.

python tools/reality_tables.py --run RUN --out docs/results/reality
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib
import tyro
from reality_gap import Trial

from skyproof.files import write_beside, write_json

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Row = dict[str, Any]


@dataclass(frozen=True)
class RealityTables:
    """Writes trials.json, final.json, tables.md and blur.svg.

    Attributes:
        run: what tools/reality_gap.py wrote.
        out: folder to write to.
    """

    run: Path
    out: Path

    def write(self) -> None:
        """Reads, writes."""
        trials = [
            json.loads(path.read_text()) for path in sorted(self.run.glob("trials/*/check.json"))
        ]
        # Trials of before a setting existed had its default.
        trials = [{**row, "trial": {**asdict(Trial()), **row["trial"]}} for row in trials]
        final = json.loads((self.run / "final.json").read_text())
        self.out.mkdir(parents=True, exist_ok=True)
        write_json(self.out / "trials.json", {"rows": trials})
        write_json(self.out / "final.json", final)
        text = _trial_table(trials) + "\n" + _final_table(final["rows"])
        with write_beside(self.out / "tables.md") as temporary:
            temporary.write_text(text, encoding="utf-8")
        _draw_blur(trials, self.out / "blur.svg")


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f}"


def _cell(row: Row) -> str:
    low, high = row["ap_centre_1m_low"], row["ap_centre_1m_high"]
    return f"{_percent(row['ap_centre_1m'])} ({_percent(low)}–{_percent(high)})"


def _trial_table(trials: list[Row]) -> str:
    lines = [
        "| trial | AP on the tuning frames (95 %) | against the recipe | AP on its own renders |",
        "|---|---|---|---|",
    ]
    recipe = next(row["ap_centre_1m"] for row in trials if row["name"] == "recipe")
    for row in sorted(trials, key=lambda row: -row["ap_centre_1m"]):
        change = "" if row["name"] == "recipe" else f"{100 * (row['ap_centre_1m'] - recipe):+.0f}"
        lines.append(
            f"| {row['name']} | {_cell(row)} | {change} | {_percent(row['ap_rendered'])} |"
        )
    return "\n".join(lines) + "\n"


def _final_table(rows: list[Row]) -> str:
    sets = list(dict.fromkeys(row["dataset"] for row in rows))
    lines = [
        f"| detector | trained on | threshold | {' | '.join(sets)} |",
        "|---|---|---|" + "---|" * len(sets),
    ]
    for trained_on, detector in dict.fromkeys((row["trained_on"], row["detector"]) for row in rows):
        own = {
            row["dataset"]: row
            for row in rows
            if (row["trained_on"], row["detector"]) == (trained_on, detector)
        }
        threshold = next(iter(own.values()))["threshold"]
        lines.append(
            f"| {detector} | {trained_on} | {threshold:.2f} | "
            f"{' | '.join(_cell(own[name]) for name in sets)} |"
        )
    return "\n".join(lines) + "\n"


def _draw_blur(trials: list[Row], path: Path) -> None:
    """AP against the blur of rendered vehicles, all else as in the recipe (figure S5)."""
    swept = [row for row in trials if row["name"] == "recipe" or row["name"].startswith("blur ")]
    swept.sort(key=lambda row: row["trial"]["blur_sigma_px"])
    sigma = [row["trial"]["blur_sigma_px"] for row in swept]
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    values = [100 * row["ap_centre_1m"] for row in swept]
    below = [100 * (row["ap_centre_1m"] - row["ap_centre_1m_low"]) for row in swept]
    above = [100 * (row["ap_centre_1m_high"] - row["ap_centre_1m"]) for row in swept]
    axes.errorbar(
        sigma,
        values,
        yerr=[below, above],
        marker="o",
        capsize=3,
        label="photographs (KIT Munich, first place)",
    )
    axes.plot(
        sigma, [100 * row["ap_rendered"] for row in swept], "s--", color="0.6", label="own renders"
    )
    axes.axvline(2.4, color="0.8", zorder=0)
    axes.annotate("the paper's σ", (2.4, 5), rotation=90, ha="right", color="0.4", fontsize=8)
    axes.set_xticks([0.4, 0.7, 1.0, 1.4, 1.8, 2.4])
    axes.set(
        xlabel="blur of the rendered vehicles, σ in px",
        ylabel="AP, centre within 1 m (%)",
        ylim=(0, 102),
    )
    axes.legend(loc="lower left", frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    with write_beside(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(RealityTables).write()
