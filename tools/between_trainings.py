"""How much camouflages of one training hide from the detectors of the others.

    python tools/between_trainings.py --run-folder runs/trainings --out between

Judges the named camouflages of every training of a finished run of the preset `trainings` by the
detectors of all its trainings, and writes `between.csv`: EASR in percent, and its mean over the
detectors. What is judged already is kept when the command is given again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pyarrow.parquet as parquet
import tyro

from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.layout import Layout
from skyproof.main import run
from skyproof.results.statistics.rates import overall_attack_success_rate


@dataclass(frozen=True)
class Between:
    """What is judged.

    Attributes:
        run_folder: a finished run with several trainings.
        out: folder for the scores and the table.
        trainings: how many the run has.
        detectors: names.
        names: of the camouflages.
    """

    run_folder: Path
    out: Path
    trainings: int = 3
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    names: tuple[str, ...] = ("T-U-0", "T-PixFc-0", "T-PixFcMa-0", "T-Ma-0")


def main(between: Between) -> None:
    """Judges, and writes the table."""
    worn = [
        _marked(between, name, training)
        for name in between.names
        for training in range(between.trainings)
    ]
    easr = [_judged(between, judge, worn) for judge in range(between.trainings)]
    rows = []
    for name in between.names:
        for training in range(between.trainings):
            for judge, rates_by_camouflage in enumerate(easr):
                rates = rates_by_camouflage[_variant(name, training)]
                row = {"attack": name.removesuffix("-0"), "learnt_on_training": training}
                row |= {"judged_by_training": judge}
                row |= {each: rates[each] for each in between.detectors}
                rows.append({**row, "mean": rates[list(between.detectors)].mean()})
    table = pd.DataFrame(rows)
    table.to_csv(between.out / "between.csv", index=False, float_format="%.4f")
    print(table.to_string(index=False, float_format="%.1f"))


def _judged(between: Between, judge: int, worn: list[Path]) -> pd.DataFrame:
    """EASR in percent of all camouflages before the detectors of one training."""
    layout = Layout(between.run_folder)
    own = layout.training(judge)
    scores = between.out / f"by_training_{judge}"
    if not scores.exists():
        call = ["score", "--out", scores, "--original", layout.dataset("test")]
        call += ["--backgrounds", layout.backgrounds, "--fleet", layout.fleets / "test"]
        call += ["--detectors", *(own.detector(name) for name in between.detectors)]
        if run(list(map(str, [*call, "--camouflages", *worn]))) != 0:
            raise SystemExit(2)
    return _easr(scores)


def _variant(name: str, training: int) -> str:
    return str(CamouflageName.parse(name).with_variant(f"of{training}"))


def _marked(between: Between, name: str, training: int) -> Path:
    """A copy of a training's camouflage under a name that tells whose it is."""
    copy = between.out / "camouflages" / _variant(name, training)
    if not copy.exists():
        own = Layout(between.run_folder).training(training)
        camouflage = load_camouflage(own.camouflage(name))
        camouflage.name = camouflage.name.with_variant(f"of{training}")
        save_camouflage(copy, camouflage, {"of": name, "training": training})
    return copy


def _easr(scores: Path) -> pd.DataFrame:
    """EASR in percent, by detector and camouflage."""
    rows = parquet.read_table(
        scores / "outcomes.parquet",
        columns=["camouflage", "detector", "detected_original", "detected_adversarial"],
        filters=[("match", "==", "centre_1m")],
    ).to_pandas()
    before, after = rows.detected_original, rows.detected_adversarial
    pairs = {"both": before & after, "lost": before & ~after, "gained": ~before & after}
    counts = rows.assign(**pairs).groupby(["detector", "camouflage"], observed=True)[[*pairs]].sum()
    easr = pd.Series(100 * overall_attack_success_rate(counts.to_numpy()), counts.index)
    return easr.unstack("camouflage")


if __name__ == "__main__":
    main(tyro.cli(Between))
