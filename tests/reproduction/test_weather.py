"""Success by weather against cells worked out by hand."""

import csv

import pytest

from skyproof.reproduction.report import write_reproduction_report
from skyproof.results.outcomes import Outcome, write_outcomes
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import ScoreRecord, SetScore, write_record

DETECTORS = ("retinanet", "yolov5")
LEARNT = ("T-U-0", "T-U-1", "T-U_weather-0", "T-U_weather-1", "R-U-0", "R-U-1")
# Tables of the paper expect three of its attacks.
NAMES = (*LEARNT, "T-Pix-0", "T-Ma-0")
# Of ten vehicles on a tile, how many are lost, one more or fewer by turns: learnt on clear days, in
# all weathers, random.
LOST = {
    "clear": {"T-U": 8, "T-U_weather": 6, "R-U": 1, "T-Pix": 5, "T-Ma": 5},
    "haze": {"T-U": 2, "T-U_weather": 7, "R-U": 1, "T-Pix": 5, "T-Ma": 5},
    "low_sun": {"T-U": 9, "T-U_weather": 2, "R-U": 1, "T-Pix": 5, "T-Ma": 5},
}
TILES = 16


def write(folder, conditions, names=NAMES, detectors=DETECTORS):
    """Writes a score folder: ten vehicles on each of the tiles per condition."""

    def lost(condition, name, tile):
        return LOST[condition][name.rpartition("-")[0]] + (1 if tile % 2 else -1)

    outcomes = [
        Outcome(
            scene=f"{condition}-{tile}",
            placement=place,
            vehicle=f"car-{(tile * 10 + place) % 40:04d}",
            body_type="car",
            background=f"tile-{tile}",
            camouflage=name,
            renderer="torch",
            detector=detector,
            match=match,
            # In low sun half of them are found before.
            detected_original=condition != "low_sun" or place % 2 == 0,
            detected_adversarial=(place + tile) % 10 >= lost(condition, name, tile)
            and (condition != "low_sun" or place % 2 == 0),
            score_original=0.9,
            score_adversarial=0.8,
            distance_original_m=0.1,
            distance_adversarial_m=0.1,
            visible_fraction=1.0,
            sun_elevation_deg=30.0 + tile,
            sun_azimuth_deg=90.0,
            tilt_deg=10.0 + tile,
            camera_azimuth_deg=0.0,
            heading_deg=10.0,
            heading_to_sun_deg=80.0,
            condition=condition,
        )
        for name in names
        for detector in detectors
        for match in ("centre_1m", "iou_50")
        for condition in conditions
        for tile in range(TILES)
        for place in range(10)
    ]
    folder.mkdir(parents=True)
    write_outcomes(folder / "outcomes.parquet", outcomes)
    sets = [
        SetScore(name, "torch", detector, match, 0.9, 1.0)
        for name in ("original", *names)
        for detector in detectors
        for match in ("centre_1m", "iou_50")
    ]
    write_rows(folder / "sets.json", sets)
    write_rows(folder / "baselines.json", [])
    write_record(folder, ScoreRecord(dict.fromkeys(detectors, 0.5), renderer="torch"))


def rows(folder):
    with open(folder / "tables" / "weather.csv", newline="", encoding="utf-8") as file:
        return {(row["condition"], row["detector"]): row for row in csv.DictReader(file)}


def numbers(row, *names):
    return [float(row[name]) for name in names]


def test_clear_days_and_every_weather_by_hand(tmp_path):
    write(tmp_path / "scores" / "000", ["clear"])
    write(tmp_path / "weather" / "scores" / "000", ["haze", "low_sun"], LEARNT)
    write_reproduction_report(tmp_path)
    found = rows(tmp_path)
    conditions = ("clear", "haze", "low_sun", "all weathers")
    judges = (*DETECTORS, "mean")
    assert list(found) == [(condition, judge) for condition in conditions for judge in judges]
    names = ("vehicles", "found_before", "clear", "all", "random", "net_clear", "net_all", "gain")
    assert numbers(found["clear", "mean"], *names) == pytest.approx(
        [160, 100, 80, 60, 10, 70, 50, -20], abs=1e-3
    )
    haze = found["haze", "yolov5"]
    assert numbers(haze, *names) == pytest.approx([160, 100, 20, 70, 10, 10, 60, 50], abs=1e-3)
    assert float(haze["gain_low"]) < 50 < float(haze["gain_high"])
    assert numbers(found["low_sun", "mean"], "vehicles", "found_before") == [160, 50]
    assert numbers(found["all weathers", "mean"], "vehicles", "found_before") == [320, 75]
    # Weighted by the vehicles found before: 160 in haze, 80 in low sun.
    mean = (160 * 20 + 80 * numbers(found["low_sun", "mean"], "clear")[0]) / 240
    assert numbers(found["all weathers", "mean"], "clear") == pytest.approx([mean], abs=1e-3)
    page = (tmp_path / "tables" / "README.md").read_text()
    assert "each in one of 2 weathers" in page
    assert "| T-U | low sun | 160 | 50.0 |" in page
    # Learning in all weathers surely hides more in haze, and surely less in low sun.
    assert (
        float(found["low_sun", "mean"]["gain_high"]) < 0 < float(found["haze", "mean"]["gain_low"])
    )
    assert (tmp_path / "tables" / "weather.png").stat().st_size > 10_000
    assert "<h3>In weather</h3>" in (tmp_path / "report.html").read_text()
    # What was scored in weather is not mixed up with clear days.
    results = (tmp_path / "tables" / "textures.csv").read_text()
    assert "\nT-U,–,2,2," in results


def test_a_single_detector_has_no_mean(tmp_path):
    write(tmp_path / "scores" / "000", ["clear"], detectors=DETECTORS[:1])
    write(tmp_path / "weather" / "scores" / "000", ["haze"], detectors=DETECTORS[:1])
    write_reproduction_report(tmp_path)
    assert {judge for _, judge in rows(tmp_path)} == {"retinanet"}
    assert "| T-U | haze | 160 |" in (tmp_path / "tables" / "README.md").read_text()


def test_runs_without_weather_have_no_such_section(tmp_path):
    write(tmp_path / "scores" / "000", ["clear"])
    write_reproduction_report(tmp_path)
    assert not list((tmp_path / "tables").glob("weather*"))
    assert "In weather" not in (tmp_path / "tables" / "README.md").read_text()


def test_what_was_not_judged_on_clear_days_has_no_such_row(tmp_path):
    write(tmp_path / "scores" / "000", ["clear"], [n for n in NAMES if "weather" not in n])
    write(tmp_path / "weather" / "scores" / "000", ["haze"])
    write_reproduction_report(tmp_path)
    assert {condition for condition, _ in rows(tmp_path)} == {"haze", "all weathers"}
