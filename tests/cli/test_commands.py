"""render, train, attack, evaluate and report on the folders of the tiny run."""

import json
import shutil
from pathlib import Path

from tests.cli.conftest import WORN, Answer, Skyproof, bytes_of

CPU = ["--device", "cpu"]


def test_render(finished: Path, worn: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "drawn"
    call = [
        "render",
        "--scenes",
        finished / "scenes/test.jsonl",
        "--backgrounds",
        finished / "backgrounds",
    ]
    call += ["--fleet", finished / "fleets/test", *CPU]
    answer = skyproof(*call, "--out", out)
    assert answer.code == 0, answer.err
    # A step of the demo drew the same.
    drawn = bytes_of(out)
    assert drawn == bytes_of(finished / "datasets/test")
    skyproof(*call, "--out", out).refused(str(out), "not overwritten")
    camouflaged = bytes_of(worn / "test-T-U")
    changed = {name for name in drawn if drawn[name] != camouflaged[name]}
    # The labels are the same, but for whose camouflage it is.
    assert changed == {name for name in drawn if name.endswith(".png")} | {"annotations.json"}
    call = call[:5]
    missing = tmp_path / "missing"
    for flag, words in (
        ("--scenes", ("missing",)),
        ("--backgrounds", ("missing",)),
        ("--fleet", ("missing",)),
        ("--camouflage", ("missing",)),
    ):
        known = dict(zip(call[1::2], call[2::2], strict=True)) | {
            "--fleet": finished / "fleets/test"
        }
        flags = [part for pair in ({**known, flag: missing}).items() for part in pair]
        skyproof("render", *flags, "--out", tmp_path / "x", *CPU).refused(str(missing), *words)
        assert not (tmp_path / "x").exists()
    empty = tmp_path / "empty.jsonl"
    empty.touch()
    call[2] = empty
    skyproof(*call, "--fleet", finished / "fleets/test", "--out", tmp_path / "x").refused(
        str(empty), "no scene"
    )
    # Another split's fleet: the scenes name vehicles that it does not have.
    call[2] = finished / "scenes/test.jsonl"
    skyproof(*call, "--fleet", finished / "fleets/train", "--out", tmp_path / "x", *CPU).refused(
        "No vehicle"
    )
    assert not (tmp_path / "x").exists()


def test_other_formats_are_named(copied, tmp_path: Path, skyproof: Skyproof) -> None:
    folder = copied()
    for file, bad in (
        ("backgrounds/index.json", '{"format_version": 99}'),
        ("fleets/test/fleet.json", '{"format": 99}'),
        ("camouflages/T-U/camouflage.json", '{"format": 99}'),
        ("camouflages/T-U/camouflage.json", '{"format": 1, "kind": "UniversalTexture"}'),
        ("camouflages/T-U/camouflage.safetensors", "damaged"),
        ("fleets/test/fleet.safetensors", "damaged"),
        ("scenes/test.jsonl", '{"id": 1}\n'),
        ("scenes/test.jsonl", "{"),
    ):
        good = (folder / file).read_bytes()
        (folder / file).write_text(bad)
        answer = skyproof(
            *(
                "render",
                "--scenes",
                folder / "scenes/test.jsonl",
                "--backgrounds",
                folder / "backgrounds",
            ),
            *("--fleet", folder / "fleets/test", "--camouflage", folder / "camouflages/T-U"),
            *("--out", tmp_path / "x", *CPU),
        )
        answer.refused(str((folder / file).parent), "again")
        assert not (tmp_path / "x").exists()
        (folder / file).write_bytes(good)


def test_train(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "detector"
    sets = ["--data", finished / "datasets/train", "--validation", finished / "datasets/validation"]
    call = [
        "train",
        "--detector",
        "retinanet",
        *sets,
        "--settings.steps",
        2,
        "--settings.batch-size",
        2,
        *CPU,
    ]
    answer = skyproof(*call, "--out", out)
    assert answer.code == 0, answer.err
    assert "threshold" in answer.out
    stored = bytes_of(out)
    assert set(stored) == {"detector.json", "steps.jsonl", "weights.safetensors"}
    assert skyproof(*call, "--out", out).code == 0
    skyproof(*call, "--out", out, "--seed", 1).refused(str(out), "choose another --out")
    assert bytes_of(out) == stored
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "weights.safetensors").write_text("precious")
    skyproof(*call, "--out", mine).refused(str(mine), "weights.safetensors", "another --out")
    assert (mine / "weights.safetensors").read_text() == "precious"
    skyproof(*call, "--out", mine / "weights.safetensors").refused("is a file")
    call[2] = "yolo99"
    skyproof(*call, "--out", tmp_path / "x").refused("yolo99")
    call[2], call[4] = "retinanet", tmp_path / "missing"
    skyproof(*call, "--out", tmp_path / "x").refused(str(tmp_path / "missing"), "missing")
    assert not (tmp_path / "x").exists()


def test_train_renders_images_as_it_needs_them(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    validation = finished / "datasets/validation"
    call = ["train", "--detector", "retinanet", "--validation", validation, *CPU]
    call += ["--settings.steps", 2, "--settings.batch-size", 2]
    answer = skyproof(*call, "--data", finished, "--out", tmp_path / "drawn")
    assert answer.code == 0, answer.err
    card = json.loads((tmp_path / "drawn/detector.json").read_text())
    assert card["trained_on"] == "rendered on the ground of finished"
    assert "images are rendered on the ground of" in answer.out
    assert card["image_size_px"] == [192, 192]
    images = finished / "datasets/train"
    assert skyproof(*call, "--data", finished, images, "--out", tmp_path / "both").code == 0
    both = json.loads((tmp_path / "both/detector.json").read_text())
    assert both["training"]["images"] == 12
    assert both["trained_on"].endswith("; rendered on the ground of finished")
    assert both["weights_sha256"] != card["weights_sha256"]
    other = tmp_path / "other"
    other.symlink_to(finished)
    refused = skyproof(*call, "--data", finished, other, "--out", tmp_path / "x")
    refused.refused("--data expects one folder", "got 2", "skyproof render")
    (tmp_path / "bare/backgrounds").mkdir(parents=True)
    bare = skyproof(*call, "--data", tmp_path / "bare", "--out", tmp_path / "x")
    bare.refused(str(tmp_path / "bare/backgrounds/index.json"), "is missing")
    # Tiles of 96 px have no room for images of 24 m.
    tiny = tmp_path / "tiny"
    tiled = skyproof("ground", "--out", tiny / "backgrounds", "--tiling.size-px", 96)
    assert tiled.code == 0, tiled.err
    (tiny / "fleets").symlink_to(finished / "fleets")
    small = skyproof(*call, "--data", tiny, "--out", tmp_path / "x")
    small.refused("no train tile of at least 192 px", "cut larger tiles")
    assert not (tmp_path / "x").exists()
    # A folder of labelled images is read, whatever else it holds.
    mixed = shutil.copytree(images, tmp_path / "mixed")
    (mixed / "backgrounds").mkdir()
    assert skyproof(*call, "--data", mixed, "--out", tmp_path / "read").code == 0
    assert json.loads((tmp_path / "read/detector.json").read_text())["training"]["images"] == 12


def test_attack(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    detector = finished / "detectors/retinanet"
    out = tmp_path / "made"
    texture = out / "T-U"
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/attack"]
    steps = ["--settings.steps", 2, "--settings.batch-size", 1, "--settings.balance-batches", 1]

    def attack(*detectors: Path, out: Path = out, more: tuple[object, ...] = ()) -> Answer:
        return skyproof(
            *("attack", "T-U", "--detectors", *detectors, *world, "--out", out),
            *(*steps, *CPU, *more),
        )

    answer = attack(detector)
    assert answer.code == 0, answer.err
    stored = bytes_of(texture)
    files = {"camouflage.json", "camouflage.safetensors", "texture.png", "steps.jsonl"}
    assert files <= set(stored)
    assert attack(detector).code == 0
    attack(detector, more=("--settings.seed", 3)).refused(str(texture))
    assert bytes_of(texture) == stored
    attack(detector, detector, out=tmp_path / "x").refused("once")
    missing = tmp_path / "missing"
    attack(missing, out=tmp_path / "x").refused(str(missing))
    mine = tmp_path / "mine"
    (mine / "T-U").mkdir(parents=True)
    (mine / "T-U" / "texture.png").write_text("precious")
    attack(detector, out=mine).refused(str(mine), "texture.png")
    assert bytes_of(mine) == {"T-U/texture.png": b"precious"}
    (texture / "camouflage.safetensors").write_text("damaged")
    attack(detector).refused(str(texture), "again")


def test_scoring_again_measures_the_same(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    call = [
        *("score", "--detectors", finished / "detectors/retinanet"),
        *("--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test", *CPU),
    ]
    names = [finished / "camouflages" / name for name in WORN]
    original = ["--original", finished / "datasets/test"]
    out = tmp_path / "scores"
    answer = skyproof(*call, *original, "--camouflages", *names, "--out", out)
    assert answer.code == 0, answer.err
    assert "EASR" in answer.out
    for name in ("outcomes.parquet", "sets.json"):
        assert (out / name).read_bytes() == (finished / "scores/test-0" / name).read_bytes()
    again = [*call, *original, "--out", out, "--camouflages"]
    skyproof(*again, *names).refused(str(out), "not overwritten")
    again[again.index(out)] = tmp_path / "x"
    skyproof(*again, tmp_path / "missing").refused("missing")
    skyproof(*again, names[0], names[0]).refused("different names")
    other = tmp_path / "test"
    shutil.copytree(finished / "datasets/test", other)
    image = next((other / "images").iterdir())
    image.write_bytes(image.read_bytes()[:500])
    again[again.index(finished / "datasets/test")] = other
    skyproof(*again, *names).refused(str(image), "again")
    rows = (other / "scenes.jsonl").read_text().splitlines(keepends=True)
    (other / "scenes.jsonl").write_text("".join(rows[1:]))
    skyproof(*again, *names).refused("other images or vehicles than its scenes.jsonl")
    assert not (tmp_path / "x").exists()


def test_score_expects_both_sides(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    detectors = ["score", "--detectors", finished / "detectors/retinanet", "--out", tmp_path / "x"]
    camouflages = ["--camouflages", finished / "camouflages/T-U"]
    original = ["--original", finished / "datasets/test"]
    skyproof(*detectors).refused("--original", "--frames")
    skyproof(*detectors, *camouflages).refused("both sides")
    skyproof(*detectors, *original).refused("--camouflages")
    skyproof(*detectors, *original, *camouflages).refused("--backgrounds and --fleet")


def test_score_at_another_resolution(copied, tmp_path: Path, skyproof: Skyproof) -> None:
    folder = copied()
    card = folder / "detectors/retinanet/detector.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "gsd_m": 0.25}))
    skyproof(
        *("score", "--detectors", card.parent, "--original", folder / "datasets/test", *CPU),
        *("--camouflages", folder / "camouflages/T-U", "--out", tmp_path / "x"),
        *("--backgrounds", folder / "backgrounds", "--fleet", folder / "fleets/test"),
    ).refused(str(card.parent), "0.25 m per pixel")


def test_what_was_scored_by_hand_is_reported(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    call = [
        *("score", "--detectors", finished / "detectors/retinanet"),
        *("--original", finished / "datasets/test", "--fleet", finished / "fleets/test"),
        *("--camouflages", finished / "camouflages/T-U", finished / "camouflages/R-U-0"),
        *("--backgrounds", finished / "backgrounds", "--out", tmp_path / "mine/scores/first"),
        *("--frames", f"valid={finished}/datasets/validation@0.125"),
    ]
    answer = skyproof(*call, "--frame-classes", "vehicle", *CPU)
    assert answer.code == 0, answer.err
    assert "valid" in answer.out
    assert skyproof("report", tmp_path / "mine").code == 0
    page = (tmp_path / "mine/report.html").read_text()
    assert page.count('without camouflage"') >= 6
    assert page.count(' with T-U"') >= 6
    assert "procedurally generated ground" in page
    assert "Texture map of T-U" in page
    assert "Vehicles as built and with T-U" in page
    assert "<strong>valid</strong> (rendered)" in page


def test_report(copied, tmp_path: Path, skyproof: Skyproof) -> None:
    folder = copied("report.html")
    answer = skyproof("report", folder)
    assert answer.code == 0, answer.err
    assert (folder / "report.html").exists()
    skyproof("report", tmp_path / "missing").refused(str(tmp_path / "missing"), "holds no scores")
    (folder / "report.html").unlink()
    for file, bad in (
        ("config.json", "{"),
        ("scores/test-0/score.json", "{"),
        ("scores/test-0/score.json", '{"rows": []}'),
        ("scores/test-0/outcomes.parquet", "damaged"),
        ("scores/test-0/baselines.json", "{"),
        ("scores/test-0/pairs/pairs.json", "{}"),
        ("scores/test-0/patterns/T-U/texture.png", "damaged"),
        ("detectors/retinanet/detector.json", "[]"),
        ("config.json", "[]"),
        ("environment.json", "[]"),
        ("timings.json", "{}"),
        ("scores/test-0/patterns/T-U/steps.jsonl", "[1]"),
        ("scores/test-0/patterns/T-U/steps.jsonl", '{"step": 1}'),
    ):
        good = (folder / file).read_bytes()
        (folder / file).write_text(bad)
        skyproof("report", folder).refused(str(folder / file))
        assert not (folder / "report.html").exists()
        (folder / file).write_bytes(good)
