"""attack, score and measure: what they leave, and the one sentence for what cannot work."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_candidates
from skyproof.reproduction.practicality import practicality_account
from skyproof.results.outcomes import read_outcomes
from skyproof.results.results import Results
from skyproof.vehicles.fleet import Fleet
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
    def call(name: str | list[str], *more: object):
        world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/attack"]
        detectors = ["--detectors", finished / "detectors/retinanet"]
        place = ["--out", tmp_path / "camouflages"]
        names = [name] if isinstance(name, str) else name
        return skyproof("attack", *names, *detectors, *world, *place, *STEPS, *more)

    return call


def test_from_names_to_a_table(finished: Path, tmp_path: Path, skyproof: Skyproof, attack) -> None:
    made = tmp_path / "camouflages"
    answer = attack("T-PixFcMa-0", "--settings.keep-at", 1)
    assert answer.code == 0, answer.err
    # The palette is that of the backgrounds.
    (said,) = [line for line in answer.out.splitlines() if line.startswith("Palette: ")]
    hexadecimal = said.removeprefix("Palette: ").replace("#", "").split(", ")
    colours = {tuple(bytes.fromhex(colour)) for colour in hexadecimal}
    assert len(colours) == 5
    with Image.open(made / "T-PixFcMa-0" / "texture.png") as image:
        assert {tuple(pixel) for pixel in np.array(image).reshape(-1, 3).tolist()} <= colours
    record = json.loads((made / "T-PixFcMa-0" / "camouflage.json").read_text())["record"]
    assert record["sign_test"]["retinanet"]["scenes"] == 1
    assert set(record["discretisation"]) == {"before", "after"}
    assert (made / "T-PixFcMa-0" / "snapshots" / "T-PixFcMa_step1-0" / "camouflage.json").exists()

    answer = attack("C-PixFcMa-seq@0.2-0", "--texture", made / "T-PixFcMa-0")
    assert answer.code == 0, answer.err
    answer = skyproof(
        *("attack", "R-PixFcMa-0", "R-PixFcMa-1", "R-C-PixFcMa@0.2-0"),
        *("--out", made, "--palette", finished / "backgrounds"),
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
        *("--backgrounds", finished / "backgrounds"),
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
    rows = [row.json() for row in Results.open(out).rows]
    assert {row["camouflage"] for row in rows} == {
        "T-PixFcMa",
        "R-PixFcMa",
        "C-PixFcMa-seq@0.2",
        "R-C-PixFcMa@0.2",
    }
    learnt = [row for row in rows if row["camouflage"] == "T-PixFcMa"]
    assert all(row["random_draws"] == 2 for row in learnt)
    # The images are gone, the score folder is whole, nothing was changed on the way.
    assert [path.name for path in out.parent.iterdir()] == ["first"]
    assert bytes_of(made) == before
    skyproof(*call, "--device", "cpu").refused(str(out), "not overwritten")

    fleet = Fleet.load(finished / "fleets/test")
    texture, shape = (
        practicality_account(load_camouflage(made / name), fleet.batch(fleet.ids))
        for name in ("T-PixFcMa-0", "C-PixFcMa-seq@0.2-0")
    )
    assert texture["score"]["total"] == 3
    assert shape["shape"]["largest_displacement_m"] > 0


def test_a_camouflage_is_judged_under_weather(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    clear, out = tmp_path / "clear", tmp_path / "scores"
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test"]
    conditions = ["--settings.conditions", "rain", "low_sun", "jpeg"]
    size = ["--count", 8, "--settings.size-px", 128]
    call = ["render", *world, "--out", clear, "--device", "cpu", *size, *conditions]
    assert skyproof(*call).code == 0
    scenes = (clear / "scenes.jsonl").read_text().splitlines()
    assert {row["weather"]["condition"] for row in map(json.loads, scenes)} == {
        "rain",
        "low_sun",
        "jpeg",
    }
    skyproof(*call).refused(str(clear), "exists already")
    file = clear / "scenes.jsonl"
    again = ["render", "--scenes", file, *world, "--out", tmp_path / "x", *size]
    skyproof(*again).refused("--count is for sampled scenes")
    skyproof(*call[:-3], "hail", "--out", tmp_path / "x").refused("hail")
    skyproof(*call, "--count", 0, "--out", tmp_path / "x").refused("--count")
    answer = skyproof(
        *(
            "score",
            "--detectors",
            finished / "detectors/retinanet",
            "--camouflages",
            finished / "camouflages/T-U",
        ),
        *(*world, "--original", clear, "--out", out, "--device", "cpu"),
    )
    assert answer.code == 0, answer.err
    assert {outcome.condition for outcome in read_outcomes(out / "outcomes.parquet")} == {
        "rain",
        "low_sun",
        "jpeg",
    }


def test_a_texture_without_constraints_and_a_shape_need_nothing_else(attack) -> None:
    assert attack("S-O@0.4").code == 0
    assert (
        attack("C-Lc-par@0.1", "--camouflage.turn-steps", 1, "--conditions", "clear", "haze").code
        == 0
    )


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("T-LcFc", [], ["Lc and Fc exclude each other"]),
        (
            "T-Pix",
            ["--camouflage.blocks", 1024],
            ["blocks expects a whole number from 1 up to 512, got 1024"],
        ),
        ("S-O@1.2", [], ["from 0 to 1", "got 1.2"]),
        ("S-O@-0.1", [], ["from 0 to 1"]),
        ("S-O@0", [], ["magnitude 0", "nothing to optimise"]),
        ("T-Fc", ["--camouflage.colours", 1], ["colours expects a whole number from 2"]),
        ("T-Lc", ["--camouflage.colours", 1], ["colours expects a whole number from 2"]),
        ("C-Pix-seq@0.2", [], ["T-Pix", "--texture"]),
        ("T-Invisible", [], ["Unknown texture constraints"]),
        ("R-PixFc_plain", [], ["only U (all over) and Ma", "R-Ma_plain"]),
        ("R-C-Fc@0.2_plain", [], ["only U (all over) and Ma", "R-C-Ma@0.2_plain"]),
        ("R-C-Fc-seq@0.2", [], ["T-Fc", "--texture"]),
        ("R-U_best", ["--draws", 1], ["draws expects a whole number from 2 up to 100, got 1"]),
        ("T-U", ["--conditions", "hail"], ["hail", "overcast"]),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_cannot_work_is_one_sentence(
    attack, tmp_path: Path, name: str, more: list[object], words: list[str]
):
    attack(name, *more).refused(*words)
    assert not (tmp_path / "camouflages").exists()


def test_palettes_that_cannot_work(attack, tmp_path: Path) -> None:
    one = tmp_path / "one.json"
    one.write_text('{"colours_srgb": [[1, 2, 3]]}')
    attack("T-Fc", "--palette", one).refused(str(one), "2 to 256 colours")
    attack("T-Fc", "--palette", tmp_path / "none.json").refused("none.json")
    assert not (tmp_path / "camouflages").exists()


def test_what_is_missing_is_asked_for(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "made"
    skyproof("attack", "R-Fc", "--out", out).refused("--palette or --backgrounds")
    skyproof("attack", "T-U", "--out", out).refused("T-U needs", "--detectors", "--fleet")
    skyproof("attack", "R-U_plain", "--out", out).refused("R-U_plain", "--detectors", "--fleet")
    # Everything is read before anything is made.
    skyproof("attack", "R-U", "T-LcFc", "--out", out).refused("Lc and Fc exclude each other")
    assert not out.exists()


@pytest.fixture
def every_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Controls are chosen from as many as users have."""
    monkeypatch.setattr("skyproof.camouflage.make.make_candidates", make_candidates)


@pytest.mark.usefixtures("every_candidate")
def test_controls_are_chosen_on_the_attacks_scenes(tmp_path: Path, attack) -> None:
    made = tmp_path / "camouflages"
    names = ["R-Ma_plain", "R-PixFc_best", "R-PixFc_search", "R-Ma_pattern"]
    answer = attack(names, "--draws", 3)
    assert answer.code == 0, answer.err
    records = {
        name: json.loads((made / name / "camouflage.json").read_text())["record"] for name in names
    }
    paints = records["R-Ma_plain"]["chosen"]
    assert len(paints["of"]) == len(paints["hidden"]) == 27
    best = records["R-PixFc_best"]["chosen"]
    assert best["of"] == ["R-PixFc-0", "R-PixFc-1", "R-PixFc-2"]
    patterns = records["R-Ma_pattern"]["chosen"]["of"]
    assert patterns == ["R-Ma_stripes-0", "R-Ma_blobs-0", "R-Ma_noise-0"]
    assert set(records["R-PixFc_search"]) >= {"attack", "weights", "discretisation"}
    assert "sign_test" not in records["R-PixFc_search"]
    before = bytes_of(made)
    assert attack(names, "--draws", 3).code == 0
    assert bytes_of(made) == before
    # A control of other draws, colours or detectors is no control of this attack.
    attack(names, "--draws", 2).refused("R-PixFc_best holds a control that was made otherwise")
    attack("R-Ma_plain", "--settings.seed", 1).refused("R-Ma_plain holds a control that was made")
    assert bytes_of(made) == before


@pytest.mark.usefixtures("every_candidate")
def test_shapes_have_their_controls_too(tmp_path: Path, attack) -> None:
    from skyproof.camouflage.displacement import DisplacementMap
    from skyproof.camouflage.folder import load_camouflage
    from skyproof.camouflage.make import Combination

    made = tmp_path / "camouflages"
    answer = attack(["R-S-O@0.4_plain", "R-C-Ma@0.4_plain", "R-Ma-0", "T-Ma"])
    assert answer.code == 0, answer.err
    even = load_camouflage(made / "R-S-O@0.4_plain")
    assert isinstance(even, DisplacementMap)
    assert even.magnitude == 0.4
    assert (even.map() == 1).all()
    painted = load_camouflage(made / "R-C-Ma@0.4_plain")
    assert isinstance(painted, Combination)
    assert (painted.shape.map() == 1).all()
    assert painted.texture.bytes().flatten(1).unique(dim=1).shape[1] == 1
    chosen = json.loads((made / "R-C-Ma@0.4_plain/camouflage.json").read_text())["record"]
    assert len(chosen["chosen"]["of"]) == 27
    # A random shape on the texture of an attack, from its folder or from a combination's.
    texture = made / "T-Ma"
    assert attack("C-Ma-seq@0.4", "--texture", texture).code == 0
    for folder in (texture, made / "C-Ma-seq@0.4"):
        name = "R-C-Ma-seq@0.4-0" if folder == texture else "R-C-Ma-seq@0.4-1"
        answer = attack(name, "--texture", folder)
        assert answer.code == 0, answer.err
        drawn = load_camouflage(made / name)
        assert isinstance(drawn, Combination)
        learnt = load_camouflage(texture)
        assert (drawn.texture.bytes() == learnt.bytes()).all()
        reach = drawn.shape.map()
        assert 0.2 < reach.std() < 0.35  # uniform in [0, 1] has 0.29
    first = load_camouflage(made / "R-C-Ma-seq@0.4-0").shape.map()
    assert (first != reach).any()


def test_finished_camouflages_are_kept_and_others_added(
    finished: Path, tmp_path: Path, skyproof: Skyproof, attack
) -> None:
    made = tmp_path / "camouflages"
    assert attack("T-U").code == 0
    before = bytes_of(made)
    both = attack(["R-U-0", "T-U"])
    assert both.code == 0, both.err
    after = bytes_of(made)
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[0] for name in after} == {"T-U", "R-U-0"}
    attack("T-U", "--settings.learning-rate", 0.3).refused("other settings")


def test_a_fleet_without_paint_is_refused(
    attack, copied, tmp_path: Path, skyproof: Skyproof
) -> None:
    from skyproof.vehicles.fleet import Fleet
    from skyproof.vehicles.vehicle import Part

    folder = copied()
    fleet = Fleet.load(folder / "fleets/attack")
    fleet.parts.fill_(Part.GLASS)
    fleet.save(tmp_path / "bare")
    attack("T-Ma", "--fleet", tmp_path / "bare").refused("covers nothing", "leave out Ma")


def test_a_control_never_lands_among_foreign_files_or_elsewhere(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "made"
    mine = out / "R-U-0" / "texture.png"
    mine.parent.mkdir(parents=True)
    mine.write_text("precious")
    skyproof("attack", "R-U-0", "--out", out).refused("R-U-0 exists already")
    assert mine.read_text() == "precious"
    skyproof("attack", "R-U_../../x", "--out", out).refused("names no camouflage")
    skyproof("attack", "T-U_/etc/x", "--out", out).refused("names no camouflage")
    assert [path.name for path in tmp_path.iterdir()] == ["made"]
    for seed in (-1, -(2**63), 2**63 - 1):
        out = tmp_path / str(seed)
        answer = skyproof("attack", "R-U", "--out", out, "--settings.seed", seed)
        assert answer.code == 0, answer.err
        assert (out / "R-U" / "camouflage.json").exists()
