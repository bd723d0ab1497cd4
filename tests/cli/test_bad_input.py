"""Bad input to a whole run gives one sentence with the file and the remedy, and exit code 2.

Nothing is left half-done, and nothing is lost.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import from_origin

from tests.cli.conftest import TINY, Skyproof, bytes_of


def picture(path: Path, size_px: int = 640) -> Path:
    """A patchy image without georeference."""
    coarse = np.random.default_rng(0).integers(
        0, 255, (size_px // 8, size_px // 8, 3), dtype=np.uint8
    )
    Image.fromarray(coarse).resize((size_px, size_px)).save(path)
    return path


def geotiff(path: Path, gsd_m: float | None, size_px: int = 640) -> Path:
    """An orthophoto in UTM 32; without a transform when `gsd_m` is None."""
    pixels = np.random.default_rng(0).integers(0, 255, (3, size_px, size_px), dtype=np.uint8)
    place = (
        {}
        if gsd_m is None
        else {"transform": from_origin(500_000, 5_500_000, gsd_m, gsd_m), "crs": "EPSG:32632"}
    )
    with rasterio.open(
        path, "w", driver="GTiff", width=size_px, height=size_px, count=3, dtype="uint8", **place
    ) as f:
        f.write(pixels)
    return path


def truncated(path: Path) -> Path:
    picture(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def text(path: Path) -> Path:
    path.write_text("not an image")
    return path


CASES: dict[str, tuple[str, Callable[[Path], object], list[str], str]] = {
    "missing": ("photo.tif", lambda path: None, [], "check --imagery"),
    "text": ("photo.tif", text, ["--gsd", "0.125"], "convert it"),
    "cut off": ("photo.png", truncated, ["--gsd", "0.125"], "convert it"),
    "empty file": ("photo.jpg", lambda path: path.touch(), ["--gsd", "0.125"], "convert it"),
    "empty folder": ("photo", lambda path: path.mkdir(), [], "give the folder of the images"),
    "no transform": ("photo.tif", lambda path: geotiff(path, None), [], "--gsd"),
    "plain image": ("photo.png", picture, [], "--gsd"),
    "too coarse": ("photo.tif", lambda path: geotiff(path, 0.6), [], "finer imagery"),
    "too coarse by flag": ("photo.png", picture, ["--gsd", "0.6"], "check the metres per pixel"),
    "too small": ("photo.tif", lambda path: geotiff(path, 0.125, 100), [], "16.0 m on each side"),
    "too small for four splits": (
        "photo.tif",
        lambda path: geotiff(path, 0.125, 200),
        [],
        "larger images",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_imagery(case: str, tmp_path: Path, skyproof: Skyproof) -> None:
    name, make, given, remedy = CASES[case]
    path = tmp_path / name
    make(path)
    answer = skyproof(*TINY, "--out", tmp_path / "run", "--imagery", path, *given)
    whose = "" if case == "too small for four splits" else str(path)
    answer.refused(whose, remedy)
    left = {entry.name for entry in (tmp_path / "run").glob("*")}
    assert left <= {"config.json", "environment.json", "steps.json", "timings.json"}


def test_zero_gsd(tmp_path: Path, skyproof: Skyproof) -> None:
    for gsd in ("0", "-0.1", "nan"):
        answer = skyproof(
            *TINY,
            "--out",
            tmp_path / "run",
            "--imagery",
            picture(tmp_path / "a.png"),
            f"--gsd={gsd}",
        )
        answer.refused("--gsd", "from 0.001")


def test_corrected_imagery_goes_on_in_the_same_folder(tmp_path: Path, skyproof: Skyproof) -> None:
    photo = picture(tmp_path / "photo.png")
    before = photo.read_bytes()
    call = (*TINY, "--out", tmp_path / "run", "--imagery", photo)
    skyproof(*call).refused("--gsd")

    def stop(*given: object, **more: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skyproof.imagery.clearing.clear.clear_backgrounds", stop)
        assert skyproof(*call, "--gsd", 0.125).code == 130
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["gsd"], config["imagery"]) == (0.125, [str(photo)])
    assert photo.read_bytes() == before
    # Once a stage is finished other settings are another run.
    skyproof(*call, "--gsd", 0.2).refused("other settings (gsd)", "another --out")


def test_detector_folder_of_another_version(copied, skyproof: Skyproof) -> None:
    folder = copied("camouflages/T-U", "report.html")
    card = folder / "detectors" / "retinanet" / "detector.json"
    good = card.read_text()
    weights = (folder / "detectors" / "retinanet" / "weights.safetensors").read_bytes()
    for bad, words in (
        (
            json.dumps({**json.loads(good), "format": 99}),
            ("format 99", "train or import the detector again"),
        ),
        (good[: len(good) // 2], ("is not JSON", "train or import the detector again")),
        ("[]", ("expected an object, got a list", "train or import the detector again")),
        (json.dumps({**json.loads(good), "name": "other"}), ("unknown detector",)),
    ):
        card.write_text(bad)
        skyproof(*TINY, "--out", folder).refused(str(card), *words)
        assert not (folder / "camouflages" / "T-U").exists()
        assert not (folder / "report.html").exists()
    card.write_text(good)
    damaged = folder / "detectors" / "retinanet" / "weights.safetensors"
    damaged.write_bytes(weights[:1000])
    skyproof(*TINY, "--out", folder).refused(str(damaged), "train the detector again")
    damaged.unlink()
    skyproof(*TINY, "--out", folder).refused(str(damaged), "is missing")
    damaged.write_bytes(weights)
    assert skyproof(*TINY, "--out", folder).code == 0


def test_out_holds_something_else(tmp_path: Path, skyproof: Skyproof) -> None:
    mine = tmp_path / "mine"
    (mine / "tiles").mkdir(parents=True)
    (mine / "tiles" / "holiday.png").write_bytes(b"precious")
    (mine / "results.json").write_text("precious")
    before = bytes_of(mine)
    skyproof(*TINY, "--out", mine).refused(str(mine), "not a run of skyproof", "another --out")
    (mine / "config.json").write_text('{"other": "program"}')
    skyproof(*TINY, "--out", mine).refused(str(mine), "another --out")
    (mine / "config.json").write_text("no json")
    skyproof(*TINY, "--out", mine).refused(str(mine / "config.json"))
    (mine / "config.json").unlink()
    assert bytes_of(mine) == before
    note = tmp_path / "note"
    note.write_text("precious")
    skyproof(*TINY, "--out", note).refused(str(note), "another --out")
    skyproof(*TINY, "--out", note / "below").refused(str(note / "below"), "another --out")
    assert note.read_text() == "precious"


def test_folder_of_the_users_is_not_taken_for_a_leftover(copied, skyproof: Skyproof) -> None:
    folder = copied("backgrounds", "report.html")
    (folder / "backgrounds.partial").mkdir()
    (folder / "backgrounds.partial" / "holiday.png").write_bytes(b"precious")
    assert skyproof(*TINY, "--out", folder).code == 0
    assert (folder / "backgrounds.partial" / "holiday.png").read_bytes() == b"precious"


def test_settings_that_cannot_work(tmp_path: Path, skyproof: Skyproof) -> None:
    for device in ("cuda:77", "meta", "toaster"):
        call = ("assess", "retinanet", "--out", tmp_path / "run", "--device", device)
        skyproof(*call).refused(f"--device {device}")
        assert not (tmp_path / "run").exists(), device


def test_wrong_flags(tmp_path: Path, skyproof: Skyproof) -> None:
    for arguments in (
        [],
        ["dmeo"],
        ["demo", "--wrong", "3"],
        ["demo", "--seed", "three"],
        ["train", "--detector", "retinanet"],
    ):
        answer = skyproof(*arguments)
        assert answer.code == 2
        assert answer.err
        assert "Traceback" not in answer.err
    for arguments in (["--help"], ["demo", "--help"], ["report", "--help"]):
        answer = skyproof(*arguments)
        assert (answer.code, answer.err) == (0, "")
        assert "usage: skyproof" in answer.out


def test_installed_entry_point_returns_the_code(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").touch()
    done = subprocess.run(
        [sys.executable, "-m", "skyproof", "demo", "--out", str(tmp_path / "run")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f"skyproof: {tmp_path / 'run'} is not empty and not a run of skyproof; choose another "
        "--out."
    ]
