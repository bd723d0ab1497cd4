"""Writes a run folder of `skyproof reproduce` with made-up counts.

python -m tests.reproduction.fabricate FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from skyproof.files import write_json
from skyproof.results.outcomes import OutcomeCounts, Series
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import ScoreRecord, SetScore, write_record
from tests.results.counted import write_counts

DETECTORS = ("retinanet", "yolov5")
TILES = 20
PER_TILE = 10
FLEET = 40
CELLS = tuple(
    (f"tile-{tile:02d}", f"car-{(tile * PER_TILE + place) % FLEET:02d}")
    for tile in range(TILES)
    for place in range(PER_TILE)
)


def write_scores(
    folder,
    rates,
    *,
    found=1.0,
    spread=None,
    renderer="torch",
    by_overlap=None,
    leniently=None,
    checks=(),
    detectors=DETECTORS,
    tiles=TILES,
):
    """Writes one score folder.

    Args:
        folder: gets outcomes.parquet and sets.json.
        rates: per camouflage the share of vehicles found before that is lost, on every tile alike
            without `spread`.
        found: the share of vehicles found before.
        spread: generator that scatters the lost vehicles.
        renderer: that drew the images.
        by_overlap: the rates by overlap, where they differ.
        leniently: the rates by the lenient criterion, which is left out without them.
        checks: of the detectors on images without camouflage.
        detectors: that judge.
        tiles: how many of the tiles show vehicles.
    """
    # Every fourth tile shows the same vehicles; who is found and lost goes round.
    turn = (np.arange(PER_TILE)[None] + np.arange(TILES)[:, None]) % PER_TILE
    before = (turn < round(found * PER_TILE)).ravel()
    series, sets = {}, []
    by_rule = {"centre_1m": rates, "iou_50": by_overlap or rates}
    by_rule |= {"centre_in_box": leniently} if leniently else {}
    shown = (np.arange(TILES).repeat(PER_TILE) < tiles)[:, None]
    for detector in detectors:
        for match, hidden in by_rule.items():
            sets.append(SetScore("original", renderer, detector, match, 0.9, 1.0))
            for name, rate in hidden.items():
                if spread is None:
                    lost = (turn < round(rate * before.sum() / TILES)).ravel()
                else:
                    lost = before & (spread.random(len(CELLS)) < rate)
                columns = [np.ones(len(CELLS)), before & ~lost, lost, np.zeros(len(CELLS))]
                counts = np.stack(columns, axis=1).astype(np.int64) * shown
                series[Series(name, renderer, detector, match)] = counts
                sets.append(SetScore(name, renderer, detector, match, 0.9 - 0.5 * rate, 2.0))
    folder.mkdir(parents=True)
    write_counts(folder / "outcomes.parquet", OutcomeCounts(CELLS, series))
    write_rows(folder / "sets.json", sets)
    write_rows(folder / "baselines.json", checks)
    thresholds = dict.fromkeys(detectors, 0.5)
    write_record(folder, ScoreRecord(thresholds, renderer=renderer, sources=["procedural"]))


def write_looks(folder, faces, *, pairs=(), **more):
    """Writes what textures look like.

    Args:
        folder: where.
        faces: by name, the share of a texture at the faces of the RGB cube; a tenth of it is at
            the edges, and nothing at the corners.
        pairs: rows for every two repeats.
        more: further fields of looks.json.
    """
    rows = []
    for name, share in faces.items():
        ends = [share / 2, *[(1 - share) / 14] * 14, share / 2]
        at = {"faces": share, "edges": share / 10, "corners": 0.0}
        rows.append({"name": name, **at, "histogram": [ends] * 3})
    folder.mkdir(parents=True)
    write_json(
        folder / "looks.json", {"vehicles": 30, "textures": rows, "pairs": list(pairs), **more}
    )


def write_attack(folder, name, *, detectors=DETECTORS, fell=8, change=-0.1, added=0.01, **settings):
    """Writes a camouflage.json with what an attack records; `added` in the second half of it."""
    signs = {
        d: {"scenes": 8, "fell": fell, "p": 0.5**fell, "mean_change": change} for d in detectors
    }
    losses = {"before": dict.fromkeys(detectors, 0.1), "after": dict.fromkeys(detectors, 0.2)}
    attack = {
        "camouflage": name,
        "detectors": dict.fromkeys(detectors, "digest"),
        "settings": settings,
        "scenes": {},
    }
    convergence = {
        "steps": [30, 60],
        "hidden": [0.4, 0.4 + added],
        "scenes": 64,
        "converged": added <= 0.02,
    }
    record = {
        "attack": attack,
        "sign_test": signs,
        "discretisation": losses,
        "convergence": convergence,
    }
    write_json(
        folder / "camouflages" / name / "camouflage.json",
        {"format": 2, "camouflage": {}, "record": record},
    )


def fabricate(folder):
    """The whole paper, made up: to look at."""
    rng = np.random.default_rng(0)
    texture = {"U": 0.97, "Pix": 0.93, "Lc": 0.9, "PixLc": 0.92, "Fc": 0.45, "PixFc": 0.4}
    texture |= {
        "Ma": 0.7,
        "PixMa": 0.66,
        "LcMa": 0.6,
        "PixLcMa": 0.62,
        "FcMa": 0.2,
        "PixFcMa": 0.15,
    }
    rates = {}
    for repeat in range(3):
        for name, rate in texture.items():
            rates[f"T-{name}-{repeat}"] = rate + 0.02 * repeat
            rates[f"R-{name}-{repeat}"] = 0.08 * rate
            for pm in (0.1, 0.2, 0.4, 0.7, 1.0) if "Ma" not in name else (0.2,):
                rise = 1 - np.exp(-4 * pm)
                rates[f"C-{name}-seq@{pm:g}-{repeat}"] = rate + (0.99 - rate) * rise
                rates[f"R-C-{name}@{pm:g}-{repeat}"] = 0.2 * pm
                if name in ("Fc", "PixFc"):
                    rates[f"C-{name}-par@{pm:g}-{repeat}"] = rate + (0.97 - rate) * rise * 1.1
        for pm in (0.1, 0.2, 0.4, 0.7, 1.0):
            rates[f"S-O@{pm:g}-{repeat}"] = 0.95 * (1 - np.exp(-3 * pm))
            rates[f"R-S-O@{pm:g}-{repeat}"] = 0.15 * pm
        for detector in DETECTORS:
            rates[f"T-U_on_{detector}-{repeat}"] = 0.8
    rates |= {
        "T-U_step1-0": 0.1,
        "T-U_step10-0": 0.6,
        "T-Fc_step1-0": 0.3,
        "T-Fc_step10-0": 0.2,
        "T-Fc_relaxed-0": 0.6,
    }
    names = list(rates)
    for batch in range(0, len(names), 50):
        part = {name: rates[name] for name in names[batch : batch + 50]}
        write_scores(folder / "scores" / f"{batch:03d}", part, spread=rng)
        seen = {name: 0.1 + 0.7 * rate for name, rate in part.items() if "_" not in name}
        write_scores(
            folder / "scores" / f"{batch:03d}-cycles",
            seen,
            spread=rng,
            renderer="cycles",
            found=0.8,
        )
    for name in names:
        if not name.startswith("R-") and "_step" not in name and "_relaxed" not in name:
            alone = name.partition("_on_")[2].rpartition("-")[0]
            write_attack(folder, name, detectors=(alone,) if alone else DETECTORS)
    write_looks(
        folder / "looks",
        {name: 0.35 + 0.4 * rates[name] for name in names if name.startswith("T-")}
        | {name: 0.32 for name in names if name.startswith("R-") and "@" not in name},
    )
    return folder


if __name__ == "__main__":
    fabricate(Path(sys.argv[1]))
