"""palette, attack, control, score and measure: what they leave, and the one sentence for what cannot work."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.results.pairs.outcomes import read_outcomes
from tests.cli.conftest import Skyproof, bytes_of

STEPS = [
    "--settings.steps",
    2,
    "--settings.batch-size",
    1,
    "--settings.balance-batches",
    1,
    "--device",
    "cpu",
]


@pytest.fixture
def attack(finished: Path, tmp_path: Path, skyproof: Skyproof):
    def call(name: str, *more: object, out: str | None = None):
        world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/attack"]
        detectors = ["--detectors", finished / "detectors/retinanet"]
        place = tmp_path / "camouflages" / (out or name)
        return skyproof("attack", "--name", name, *detectors, *world, "--out", place, *STEPS, *more)

    return call


@pytest.fixture
def palette(finished: Path, tmp_path: Path, skyproof: Skyproof) -> Path:
    path = tmp_path / "palette.json"
    answer = skyproof("palette", "--backgrounds", finished / "backgrounds", "--out", path)
    assert answer.code == 0, answer.err
    return path


def test_from_palette_to_table(
    finished: Path, tmp_path: Path, skyproof: Skyproof, attack, palette: Path
) -> None:
    made = tmp_path / "camouflages"
    colours = {tuple(row) for row in json.loads(palette.read_text())["colours_srgb"]}
    assert len(colours) == 5
    answer = attack("T-PixFcMa-0", "--palette", palette, "--settings.keep-at", 1)
    assert answer.code == 0, answer.err
    with Image.open(made / "T-PixFcMa-0" / "texture.png") as image:
        assert {tuple(pixel) for pixel in np.array(image).reshape(-1, 3).tolist()} <= colours
    record = json.loads((made / "T-PixFcMa-0" / "camouflage.json").read_text())["record"]
    assert record["sign_test"]["retinanet"]["scenes"] == 1
    assert set(record["discretisation"]) == {"before", "after"}
    assert (made / "T-PixFcMa-0" / "snapshots" / "T-PixFcMa_step1-0" / "camouflage.json").exists()

    answer = attack("C-PixFcMa-seq@0.2-0", "--texture", made / "T-PixFcMa-0")
    assert answer.code == 0, answer.err
    answer = skyproof(
        "control",
        "--name",
        "R-PixFcMa-0",
        "R-PixFcMa-1",
        "R-C-PixFcMa@0.2-0",
        "--out",
        made,
        "--palette",
        palette,
    )
    assert answer.code == 0, answer.err
    before = bytes_of(made)
    names = [
        "T-PixFcMa-0",
        "R-PixFcMa-0",
        "R-PixFcMa-1",
        "C-PixFcMa-seq@0.2-0",
        "R-C-PixFcMa@0.2-0",
    ]
    folders = [made / name for name in names]
    out = tmp_path / "scores" / "first"
    call = [
        *("score", "--detectors", finished / "detectors/retinanet", "--camouflages", *folders),
        *("--scenes", finished / "scenes/test.jsonl", "--backgrounds", finished / "backgrounds"),
        *(
            "--fleet",
            finished / "fleets/test",
            "--original",
            finished / "datasets/test",
            "--out",
            out,
        ),
    ]
    answer = skyproof(*call, "--device", "cpu")
    assert answer.code == 0, answer.err
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert {row["camouflage"] for row in rows} == {
        "T-PixFcMa",
        "R-PixFcMa",
        "C-PixFcMa-seq@0.2",
        "R-C-PixFcMa@0.2",
    }
    learnt = [row for row in rows if row["camouflage"] == "T-PixFcMa"]
    assert all(row["random_draws"] == 2 for row in learnt)
    # The images are gone, the evaluation is whole, nothing was changed on the way.
    assert [path.name for path in out.parent.iterdir()] == ["first"]
    assert bytes_of(made) == before
    skyproof(*call, "--device", "cpu").refused(str(out), "not overwritten")

    answer = skyproof(
        "measure",
        "--camouflages",
        *folders,
        "--fleet",
        finished / "fleets/test",
        "--out",
        tmp_path / "measures.json",
    )
    assert answer.code == 0, answer.err
    measured = {
        row["name"]: row for row in json.loads((tmp_path / "measures.json").read_text())["rows"]
    }
    assert measured["T-PixFcMa-0"]["score"]["total"] == 3
    assert measured["C-PixFcMa-seq@0.2-0"]["shape"]["largest_displacement_m"] > 0


def test_a_camouflage_is_judged_under_weather(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    scenes, clear, out = tmp_path / "weather.jsonl", tmp_path / "clear", tmp_path / "scores"
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test"]
    conditions = ["--settings.conditions", "rain", "low_sun", "jpeg"]
    call = ["scenes", *world, "--out", scenes, "--count", 8, "--settings.size-px", 128, *conditions]
    assert skyproof(*call).code == 0
    assert {
        row["weather"]["condition"] for row in map(json.loads, scenes.read_text().splitlines())
    } == {
        "rain",
        "low_sun",
        "jpeg",
    }
    skyproof(*call).refused(str(scenes), "not overwritten")
    skyproof(*call[:-3], "hail", "--out", tmp_path / "x").refused("hail")
    skyproof(*call, "--count", 0, "--out", tmp_path / "x").refused("--count")
    assert (
        skyproof("render", "--scenes", scenes, *world, "--out", clear, "--device", "cpu").code == 0
    )
    answer = skyproof(
        *(
            "score",
            "--detectors",
            finished / "detectors/retinanet",
            "--camouflages",
            finished / "camouflages/T-U",
        ),
        *("--scenes", scenes, *world, "--original", clear, "--out", out, "--device", "cpu"),
    )
    assert answer.code == 0, answer.err
    assert {outcome.condition for outcome in read_outcomes(out / "outcomes.parquet")} == {
        "rain",
        "low_sun",
        "jpeg",
    }


def test_a_texture_without_constraints_and_a_shape_need_nothing_else(attack) -> None:
    assert attack("S-O@0.4").code == 0
    assert attack("C-Lc-par@0.1", "--turn-steps", 1, "--conditions", "clear", "haze").code == 0


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("T-LcFc", [], ["Lc and Fc exclude each other"]),
        ("T-Pix", ["--blocks", 1024], ["512 texels a side, got 1024"]),
        ("S-O@1.2", [], ["from 0 to 1", "got 1.2"]),
        ("S-O@-0.1", [], ["from 0 to 1"]),
        ("S-O@0", [], ["magnitude 0", "nothing to learn"]),
        ("T-Fc", [], ["T-Fc expects fixed colours", "--palette"]),
        ("T-Lc", ["--colours", 1], ["at least 2 colours, got 1"]),
        ("C-Pix-seq@0.2", [], ["T-Pix", "--texture"]),
        ("R-U", [], ["random control", "skyproof control"]),
        ("T-Invisible", [], ["Unknown texture constraints"]),
        ("T-U", ["--conditions", "hail"], ["hail", "overcast"]),
        ("T-Pix", ["--settings.weights", "paper"], ["use balanced weights"]),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_cannot_work_is_one_sentence(
    attack, tmp_path: Path, name: str, more: list[object], words: list[str]
):
    attack(name, *more, out="x").refused(*words)
    assert not (tmp_path / "camouflages").exists()


def test_palettes_that_cannot_work(
    attack, finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    one = tmp_path / "one.json"
    one.write_text('{"colours_srgb": [[1, 2, 3]]}')
    attack("T-Fc", "--palette", one, out="x").refused(str(one), "at least 2 colours")
    attack("T-Fc", "--palette", tmp_path / "none.json", out="x").refused("none.json")
    skyproof(
        "palette", "--backgrounds", finished / "backgrounds", "--out", one, "--colours", 1
    ).refused("at least 2")
    skyproof("control", "--name", "T-U", "--out", tmp_path / "x").refused(
        "T-U is learnt, not drawn"
    )


def test_a_fleet_without_paint_is_refused(
    attack, copied, tmp_path: Path, skyproof: Skyproof
) -> None:
    from skyproof.vehicles.fleet import Fleet
    from skyproof.vehicles.vehicle import Part

    folder = copied()
    fleet = Fleet.load(folder / "fleets/attack")
    fleet.parts.fill_(Part.GLASS)
    fleet.save(tmp_path / "bare")
    attack("T-Ma", "--fleet", tmp_path / "bare", out="x").refused("covers nothing", "leave out Ma")
