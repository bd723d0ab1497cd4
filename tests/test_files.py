"""Whole or not at all."""

import errno
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skyproof.documents import read_document
from skyproof.errors import NotFiniteError, RunFolderError, SkyproofError, StoredFileError
from skyproof.files import (
    alone,
    finished_folder,
    inside,
    is_leftover,
    new_file,
    refuse_existing,
    refuse_foreign,
    refuse_links,
    write_beside,
    write_json,
    write_jsonl,
)
from skyproof.imagery.rasters import open_raster
from skyproof.main import run
from skyproof.pictures import open_picture
from skyproof.storage import read_tensors


def write_half(path: Path, error: BaseException) -> None:
    with write_beside(path) as temporary:
        temporary.write_text("half")
        raise error


def fill_half(path: Path, error: BaseException) -> None:
    with finished_folder(path) as partial:
        (partial / "a.png").touch()
        raise error


def full() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_write_beside_replaces_only_when_the_block_ends_well(tmp_path: Path) -> None:
    path = tmp_path / "new" / "table.csv"
    with write_beside(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == ".csv"
        assert is_leftover(temporary)
        temporary.write_text("first")
        assert not path.exists()
    assert path.read_text() == "first"
    for error, seen in (
        (full(), RunFolderError),
        (KeyError("x"), KeyError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ):
        with pytest.raises(seen):
            write_half(path, error)
        assert path.read_text() == "first"
        assert [entry.name for entry in path.parent.iterdir()] == ["table.csv"]


def test_full_disk_names_file_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(
        RunFolderError, match=r"table\.csv: No space left on device; free space"
    ) as caught:
        write_half(tmp_path / "table.csv", full())
    assert "\n" not in str(caught.value)


def test_a_name_like_a_leftovers_is_written_whole_too(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"\.mine\.partial\.csv: "):
        write_half(tmp_path / ".mine.partial.csv", full())
    assert list(tmp_path.iterdir()) == []


def test_encoder_error_on_a_full_disk_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for free, words in ((0, "No space left on device"), (2**30, "encoder error -2")):
        monkeypatch.setattr(
            "shutil.disk_usage", lambda place, free=free: type("Usage", (), {"free": free})
        )
        with pytest.raises(RunFolderError, match=words), write_beside(tmp_path / "a.png"):
            raise OSError("encoder error -2 when writing image file")


def test_finished_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "tiles"
    leftover = tmp_path / "new" / ".tiles.partial"
    leftover.mkdir(parents=True)
    (leftover / "old.png").touch()  # what a kill left
    with finished_folder(path) as partial:
        assert is_leftover(partial)
        assert not list(partial.iterdir())
        (partial / "a.png").touch()
        assert not path.exists()
    assert [entry.name for entry in path.parent.iterdir()] == ["tiles"]
    assert [entry.name for entry in path.iterdir()] == ["a.png"]
    for error, seen in (
        (full(), RunFolderError),
        (KeyError("x"), KeyError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ):
        with pytest.raises(seen):
            fill_half(tmp_path / "other", error)
        assert [entry.name for entry in tmp_path.iterdir()] == ["new"]


def test_finished_folder_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "tiles").mkdir()
    (tmp_path / "tiles" / "mine").touch()
    with (
        pytest.raises(RunFolderError, match="not overwritten"),
        finished_folder(tmp_path / "tiles"),
    ):
        pytest.fail("the block must not run")
    assert [entry.name for entry in (tmp_path / "tiles").iterdir()] == ["mine"]


def test_refuse_foreign(tmp_path: Path) -> None:
    refuse_foreign(tmp_path / "missing", ())
    refuse_foreign(tmp_path, ())
    (tmp_path / "steps.jsonl").touch()
    (tmp_path / ".steps.partial.jsonl").touch()
    refuse_foreign(tmp_path, {"steps.jsonl"})
    with pytest.raises(RunFolderError, match=r"steps\.jsonl"):
        refuse_foreign(tmp_path, ())
    with pytest.raises(RunFolderError, match="is a file"):
        refuse_foreign(tmp_path / "steps.jsonl", ())


def test_json_round_trip(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"ä": [1, None]})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"ä": [1, None]}
    write_jsonl(tmp_path / "a.jsonl", [1, {"b": 2}])
    lines = (tmp_path / "a.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == [1, {"b": 2}]


def test_unwritable_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunFolderError, match=r"file/a\.json"):
        write_json(tmp_path / "file" / "a.json", 1)
    with (
        pytest.raises(RunFolderError, match="file/tiles"),
        finished_folder(tmp_path / "file" / "tiles"),
    ):
        pytest.fail("the block must not run")


HOLDER = """
import sys, time
from pathlib import Path
from skyproof.files import alone
with alone(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def holder(place: Path) -> subprocess.Popen[str]:
    """Another process that holds a place."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(place)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_process_is_told_who_holds_a_place(tmp_path: Path) -> None:
    place = tmp_path / "run"
    other = holder(place)
    try:
        for _ in range(2):
            with pytest.raises(RunFolderError) as caught, alone(place):
                pytest.fail("the block must not run")
            for word in (str(place), f"process {other.pid}", "skyproof", "another --out"):
                assert word in str(caught.value)
            assert "\n" not in str(caught.value)
        with pytest.raises(RunFolderError, match=f"process {other.pid}"), finished_folder(place):
            pytest.fail("the block must not run")
        with pytest.raises(RunFolderError, match=f"process {other.pid}"), new_file(place):
            pytest.fail("the block must not run")
    finally:
        other.send_signal(signal.SIGKILL)
        other.wait()
    # What its death left is no obstacle.
    assert is_leftover(tmp_path / ".run.lock")
    assert (tmp_path / ".run.lock").exists()
    with alone(place):
        (tmp_path / "seen").touch()
    assert [entry.name for entry in tmp_path.iterdir()] == ["seen"]


def test_a_lock_is_free_after_an_error_and_its_file_gone(tmp_path: Path) -> None:
    with pytest.raises(KeyError), alone(tmp_path / "run"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    with alone(tmp_path / "run") as hold:
        hold.note("the steps of a plan")
        with pytest.raises(RunFolderError, match="the steps of a plan"), alone(tmp_path / "run"):
            pytest.fail("the block must not run")
        with alone(tmp_path / "other"):
            (tmp_path / "mine").touch()
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine"]


def test_a_lock_is_of_the_place_and_not_of_its_spelling(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with alone(tmp_path / "run"):
        for spelling in (tmp_path / "link" / "run", tmp_path / "x" / ".." / "run"):
            with pytest.raises(RunFolderError), alone(spelling):
                pytest.fail("the block must not run")


def test_a_lock_never_writes_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("precious")
    (tmp_path / ".run.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(RunFolderError, match="run"), alone(tmp_path / "run"):
        pytest.fail("the block must not run")
    assert (tmp_path / "victim").read_text() == "precious"


@pytest.mark.parametrize("name", ["/", "a/../../../../../../../../..", "loop", "loop/x", "a\0b"])
def test_a_place_without_a_name_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    for writer in (alone, finished_folder, new_file):
        with pytest.raises(RunFolderError, match="is no place for a result"), writer(Path(name)):
            pytest.fail("the block must not run")


def test_the_working_folder_exists_already(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunFolderError, match="exists already"), finished_folder(Path()):
        pytest.fail("the block must not run")


def test_a_lock_empties_no_file_of_two_names(tmp_path: Path) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("kept")
    (tmp_path / ".run.lock").hardlink_to(mine)
    with (
        pytest.raises(RunFolderError, match=r"\.run\.lock is a link to another file"),
        alone(tmp_path / "run"),
    ):
        pass
    assert mine.read_text() == "kept"


def test_devices_and_pipes_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tif")
    (tmp_path / "link.tif").symlink_to("/dev/zero")
    readers: tuple[Callable[[Path], object], ...] = (
        lambda path: read_document(path, Any, "copy it again"),
        lambda path: read_tensors(path, "copy it again"),
        lambda path: open_picture(path, "copy it again"),
        open_raster,
    )
    for reader in readers:
        for name in ("pipe.tif", "link.tif"):
            with pytest.raises(SkyproofError, match=f"{name} is a device, pipe or socket"):
                reader(tmp_path / name)


def test_a_document_has_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.json").write_text("[1, 2]")
    monkeypatch.setattr("skyproof.documents._LARGEST_BYTES", 5)
    with pytest.raises(StoredFileError, match=r"a\.json has 0 MiB, more than the 0 MiB"):
        read_document(tmp_path / "a.json", Any, "split it")


def test_new_file_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "new" / "palette.json"
    with new_file(path):
        path.write_text("first")
        with pytest.raises(RunFolderError, match="another process"), new_file(path):
            pytest.fail("the block must not run")
    assert path.read_text() == "first"
    with pytest.raises(RunFolderError, match="not overwritten"), new_file(path):
        pytest.fail("the block must not run")
    assert path.read_text() == "first"
    assert [entry.name for entry in path.parent.iterdir()] == ["palette.json"]
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(RunFolderError, match="not overwritten"):
        refuse_existing(tmp_path / "link")


def test_a_link_in_place_of_a_leftover_is_not_written_through(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    out = tmp_path / "out"
    out.mkdir()
    (out / ".a.partial.json").symlink_to(victim)
    write_json(out / "a.json", 1)
    assert (out / "a.json").read_text() == "1\n"
    (out / ".tiles.partial").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(RunFolderError, match="tiles"), finished_folder(out / "tiles"):
        pytest.fail("the block must not run")
    assert victim.read_text() == "precious"


def test_a_link_to_a_folder_elsewhere_is_not_written_through(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    elsewhere.mkdir()
    (out / "deep" / "own").mkdir(parents=True)
    (out / "deep" / "inner").symlink_to(out / "deep" / "own")
    (out / "file.json").symlink_to(tmp_path / "missing.json")
    (tmp_path / "link").symlink_to(out)
    refuse_links(out)
    refuse_links(tmp_path / "link")
    refuse_links(tmp_path / "missing")
    (out / "deep" / "R-U").symlink_to(elsewhere)
    for folder in (out, tmp_path / "link"):
        with pytest.raises(RunFolderError, match=r"R-U is a link to a folder elsewhere.*--out\.$"):
            refuse_links(folder)
    # Camouflages are added to a folder that exists.
    words = ["attack", "R-U", "--out", str(out / "deep"), "--device", "cpu"]
    assert run(words) == 2
    assert "R-U is a link to a folder elsewhere" in capsys.readouterr().err
    assert list(elsewhere.iterdir()) == []


def test_references_stay_inside_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    (folder / "images").mkdir(parents=True)
    (tmp_path / "secret.png").touch()
    (folder / "images" / "out.png").symlink_to(tmp_path / "secret.png")
    (folder / "images" / "in.png").symlink_to(folder / "images" / "a.png")
    (folder / "images" / "round.png").symlink_to(folder / "images" / "round.png")
    (folder / "up").symlink_to(tmp_path)
    document = folder / "annotations.json"
    for good in ("images/a.png", "images/in.png", "missing.png"):
        assert inside(folder, good, document) == folder / good
    bad = ["images/out.png", "up/secret.png", "images/round.png", "../secret.png", "a\0b"]
    for reference in [*bad, str(tmp_path / "secret.png")]:
        with pytest.raises(StoredFileError, match="leads out of its folder") as caught:
            inside(folder, reference, document)
        assert str(caught.value).startswith(f"{document} names ")
    # A link to the folder itself is the user's own choice.
    (tmp_path / "link").symlink_to(folder)
    assert inside(tmp_path / "link", "images/a.png", document)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nothing_that_is_not_finite_is_written(tmp_path: Path, bad: float) -> None:
    write_json(tmp_path / "a.json", 1)
    for write, value in ((write_json, {"a": [bad]}), (write_jsonl, [{"a": 1}, {"b": bad}])):
        with pytest.raises(NotFiniteError, match=r"a\.json would hold a number that is not finite"):
            write(tmp_path / "a.json", value)
    assert (tmp_path / "a.json").read_text() == "1\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_a_read_only_disk_is_no_full_one(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="make this place writable") as caught:
        write_half(tmp_path / "a", OSError(errno.EROFS, os.strerror(errno.EROFS)))
    assert "free space" not in str(caught.value)


def test_file_systems_without_fsync_are_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fsync(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("skyproof.files.os.fsync", fsync)
    for number in (errno.EINVAL, errno.ENOTSUP):
        write_json(tmp_path / f"{number}.json", 1)
    number = errno.EIO
    with pytest.raises(RunFolderError, match="Input/output error"):
        write_json(tmp_path / "a.json", 1)
    assert not (tmp_path / "a.json").exists()
