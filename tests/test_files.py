"""Whole or not at all."""

import errno
import os
from pathlib import Path

import pytest

from skyproof.errors import RunFolderError, StoredFileError
from skyproof.files import (
    finished_folder,
    is_leftover,
    read_json,
    read_jsonl,
    refuse_foreign,
    write_beside,
    write_json,
    write_jsonl,
)


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


def test_json_round_trip_and_damage(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"ä": [1, None]})
    assert read_json(tmp_path / "a.json") == {"ä": [1, None]}
    write_jsonl(tmp_path / "a.jsonl", [1, {"b": 2}])
    assert read_jsonl(tmp_path / "a.jsonl") == [1, {"b": 2}]
    (tmp_path / "bad.json").write_bytes(b"\xff{")
    for read in (read_json, read_jsonl):
        with pytest.raises(StoredFileError, match=r"none\.json is missing"):
            read(tmp_path / "none.json")
        with pytest.raises(StoredFileError, match=r"bad\.json cannot be read"):
            read(tmp_path / "bad.json")
        with pytest.raises(StoredFileError, match="cannot be read"):
            read(tmp_path)


def test_unwritable_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunFolderError, match=r"file/a\.json"):
        write_json(tmp_path / "file" / "a.json", 1)
    with (
        pytest.raises(RunFolderError, match="file/tiles"),
        finished_folder(tmp_path / "file" / "tiles"),
    ):
        pytest.fail("the block must not run")
