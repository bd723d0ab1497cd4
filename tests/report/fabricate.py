"""Writes a small run folder of made-up images and numbers.

python tests/report/fabricate.py FOLDER [--cycles]
"""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from skyproof.files import write_json, write_jsonl
from skyproof.measure.score import choose_scenes
from skyproof.results.outcomes import MATCHES, Outcome, read_outcomes, write_outcomes
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import Pair, ScoreRecord, SetScore, write_record

DETECTORS = ("retinanet", "faster_rcnn")
HIDES = {"T-U": 0.8, "R-U-0": 0.04, "R-U-1": 0.08}
BODIES = ("saloon", "hatchback", "estate", "pick-up", "van")


def fabricate(folder, scenes=40):
    """Writes the folder; everything follows from one seed."""
    rng = np.random.default_rng(1)
    names = ["test", *(f"test-{camouflage}" for camouflage in HIDES)]
    pictures = {}
    outcomes = []
    for index in range(scenes):
        scene, ground = f"scene-{index:04d}", rng.normal(110, 14, (192, 192, 3))
        count, sun, tilt = int(rng.integers(1, 5)), rng.uniform(15, 65), rng.uniform(0, 20)
        corners = [(x, y) for x in (20, 110) for y in (20, 110)][:count]
        boxes = [(x, y, x + 36, y + 16) for x, y in corners]
        for place in range(len(boxes)):
            body, heading = str(rng.choice(BODIES)), rng.uniform(0, 360)
            for d in DETECTORS:
                before = rng.random() < 0.95
                for camouflage, rate in HIDES.items():
                    after = (
                        rng.random() > rate * (0.6 + 0.01 * sun) if before else rng.random() < 0.05
                    )
                    for match in MATCHES:
                        outcomes.append(
                            Outcome(
                                scene=scene,
                                placement=place,
                                vehicle=f"{body}-0001",
                                body_type=body,
                                background=f"tile-{index // 2}",
                                camouflage=camouflage,
                                renderer="torch",
                                detector=d,
                                match=match,
                                detected_original=bool(before),
                                detected_adversarial=bool(after),
                                score_original=0.9 if before else 0.0,
                                score_adversarial=0.8 if after else 0.0,
                                distance_original_m=0.1 if before else float("nan"),
                                distance_adversarial_m=0.2 if after else float("nan"),
                                visible_fraction=1.0,
                                sun_elevation_deg=sun,
                                sun_azimuth_deg=120.0,
                                tilt_deg=tilt,
                                camera_azimuth_deg=30.0,
                                heading_deg=heading,
                                heading_to_sun_deg=abs((heading - 120 + 180) % 360 - 180),
                            )
                        )
        for name in names:
            picture = Image.fromarray(ground.clip(0, 255).astype(np.uint8))
            for box in boxes:
                fill = (
                    (200, 40, 40)
                    if name == "test"
                    else tuple(int(v) for v in rng.integers(60, 180, 3))
                )
                ImageDraw.Draw(picture).rectangle(box, fill=fill)
            pictures[name, scene] = picture
    score = folder / "scores" / "main"
    write_outcomes(score / "outcomes.parquet", outcomes)
    _write_pairs(score, outcomes, pictures)
    sets = [
        SetScore(
            camouflage,
            "torch",
            d,
            match,
            {"original": 0.97, "T-U": 0.4}.get(camouflage, 0.94),
            12.0,
        )
        for camouflage in ("original", *HIDES)
        for d in DETECTORS
        for match in MATCHES
    ]
    write_rows(score / "sets.json", sets)
    write_record(score, ScoreRecord(dict.fromkeys(DETECTORS, 0.5), renderer="torch"))
    _write_rest(folder, rng)
    return folder


def _write_pairs(score, outcomes, pictures):
    """Pictures of T-U's scenes, as a score folder keeps them."""
    scenes = {}
    for o in outcomes:
        if (o.camouflage, o.detector, o.match) == ("T-U", DETECTORS[0], "centre_1m"):
            scenes.setdefault(o.scene, []).append(o)
    pairs = []
    for scene, why in choose_scenes(scenes).items():
        files = (f"original/{scene}.jpg", f"T-U/{scene}.jpg")
        for name, file in zip(("test", "test-T-U"), files, strict=True):
            path = score / "pairs" / file
            path.parent.mkdir(parents=True, exist_ok=True)
            pictures[name, scene].save(path, quality=85)
        before = sum(o.detected_original for o in scenes[scene])
        after = sum(o.detected_adversarial for o in scenes[scene])
        pairs.append(
            Pair("T-U", DETECTORS[0], scene, why, len(scenes[scene]), before, after, *files)
        )
    write_rows(score / "pairs" / "pairs.json", pairs)


def _write_rest(folder, rng):
    title = "How robust are two vehicle detectors to camouflage? (fabricated)"
    write_json(
        folder / "config.json",
        {"title": title, "imagery": "procedural", "attack": {"steps": 300, "rate": 0.02}},
    )
    write_json(
        folder / "environment.json",
        {
            "skyproof": "0.1.0",
            "python": "3.11",
            "torch": "2.11",
            "device": "cpu",
            "seed": 0,
            "commands": ["skyproof demo"],
        },
    )
    write_json(
        folder / "timings.json",
        [{"stage": "train", "seconds": 812.3}, {"stage": "attack", "seconds": 301.0}],
    )
    clean = [
        {
            "detector": d, "dataset": dataset, "images": 60, "vehicles": 140, "ap_centre_1m": ap,
            "ap_iou_50": ap - 0.05,
            "precision": 0.9, "recall": ap, "threshold": 0.5, "note": note, "real": real,
            "ap_centre_1m_low": ap - 0.02, "ap_centre_1m_high": ap + 0.02,
            "clustered_by": by, "clusters": clusters,
            **dict.fromkeys(("precision_low", "precision_high", "recall_low", "recall_high")),
        }
        for d in DETECTORS
        for dataset, real, ap, by, clusters, note in (
            ("rendered test", False, 0.97, "places", 20, ""),
            ("KIT AIS Munich", True, 0.21, "images", 60, "real frames, resampled to 0.125 m"),
        )
    ]  # fmt: skip
    write_json(folder / "scores" / "main" / "baselines.json", {"rows": clean})
    for d in DETECTORS:
        validation = {"ap_centre_1m": 0.98, "ap_iou_50": 0.95, "f1": 0.94}
        about = {
            "format": 1,
            "name": d,
            "size": "slim",
            "threshold": 0.5,
            "gsd_m": 0.125,
            "parameters": 712_345,
            "validation": validation,
        }
        about["trained_on"] = f"renders for {d}"
        write_json(folder / "detectors" / d / "detector.json", about)
        losses = 2 * np.exp(-np.arange(400) / 80) + 0.1 + 0.05 * rng.random(400)
        rows = [{"step": i, "loss": float(loss)} for i, loss in enumerate(losses)]
        write_jsonl(folder / "detectors" / d / "steps.jsonl", rows)
    attacked = {"attack": {"detectors": dict.fromkeys(DETECTORS, "digest")}}
    write_json(folder / "camouflages" / "T-U" / "camouflage.json", {"record": attacked})
    attack = folder / "scores" / "main" / "patterns" / "T-U"
    fading = np.exp(-np.arange(300) / 100)
    rows = [
        {
            "step": i,
            "loss": float(f),
            "losses": {d: float(f * (0.5 + 0.1 * rng.random())) for d in DETECTORS},
        }
        for i, f in enumerate(fading)
    ]
    write_jsonl(attack / "steps.jsonl", rows)
    for file, size in (("texture.png", (512, 512)), ("on_vehicle.png", (640, 480))):
        small = Image.fromarray(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8))
        small.resize(size, Image.Resampling.NEAREST).save(attack / file)


def fabricate_cycles(folder):
    """Adds what `demo --cycles` adds: there T-U hides less, random patterns more, all is blue."""
    rng = np.random.default_rng(2)
    first, cycles = folder / "scores" / "main", folder / "scores" / "main-cycles"
    shutil.copytree(first / "pairs", cycles / "pairs")
    for picture in (cycles / "pairs").rglob("*.jpg"):
        Image.new("RGB", (384, 384), (30, 60, 200)).save(picture)
    outcomes = []
    for outcome in read_outcomes(first / "outcomes.parquet"):
        hidden = rng.random() < (0.3 if outcome.camouflage == "T-U" else 0.15)
        found = outcome.detected_original and not hidden
        outcomes.append(dataclasses.replace(outcome, renderer="cycles", detected_adversarial=found))
    write_outcomes(cycles / "outcomes.parquet", outcomes)
    sets = [
        SetScore(
            camouflage,
            "cycles",
            d,
            match,
            {"original": 0.88, "T-U": 0.6}.get(camouflage, 0.8),
            15.0,
        )
        for camouflage in ("original", *HIDES)
        for d in DETECTORS
        for match in MATCHES
    ]
    write_rows(cycles / "sets.json", sets)
    write_record(cycles, ScoreRecord(dict.fromkeys(DETECTORS, 0.5), renderer="cycles"))
    seen = {"ap_centre_1m": 0.88, "ap_centre_1m_low": 0.84, "ap_centre_1m_high": 0.91}
    rows = json.loads((first / "baselines.json").read_text())["rows"]
    clean = [row | seen for row in rows if row["dataset"] == "rendered test"]
    named = [row | {"dataset": "Blender Cycles test"} for row in clean]
    write_json(cycles / "baselines.json", {"rows": named})
    return folder


if __name__ == "__main__":
    fabricate(Path(sys.argv[1]))
    print(
        json.dumps(
            str(fabricate_cycles(Path(sys.argv[1])) if "--cycles" in sys.argv else sys.argv[1])
        )
    )
