"""One way to open a picture: known formats, a stated limit, one sentence."""

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.errors import ImageryError, StoredFileError
from skyproof.pictures import LARGEST_PX, open_picture, read_pixels


def chunk(kind: bytes, data: bytes) -> bytes:
    """One part of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def claiming(path: Path, width_px: int, height_px: int) -> Path:
    """A small PNG whose header claims a size."""
    header = struct.pack(">IIBBBBB", width_px, height_px, 8, 2, 0, 0, 0)
    rows = chunk(b"IDAT", zlib.compress(bytes(3000)))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + rows + chunk(b"IEND", b""))
    return path


def refused(path: Path, **options: object) -> str:
    with pytest.raises(StoredFileError) as caught:
        read_pixels(path, "replace it", **options)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert message.endswith("replace it.")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".jp2"])
def test_pixels_come_as_they_were_written(tmp_path: Path, suffix: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    lossless = {".webp": {"lossless": True}}.get(suffix, {})
    Image.fromarray(pixels).save(tmp_path / f"a{suffix}", **lossless)
    np.testing.assert_array_equal(read_pixels(tmp_path / f"a{suffix}", ""), pixels)


def test_the_first_of_a_cameras_pair_is_read(tmp_path: Path) -> None:
    first = Image.new("RGB", (16, 16), (10, 200, 30))
    first.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[Image.new("RGB", (16, 16))])
    assert abs(read_pixels(tmp_path / "a.jpg", "")[8, 8].astype(int) - (10, 200, 30)).max() < 9


def test_other_modes_become_three_bands(tmp_path: Path) -> None:
    grey = np.arange(64, dtype=np.uint8).reshape(8, 8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    assert (read_pixels(tmp_path / "grey.png", "") == grey[..., None]).all()
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png")
    assert (read_pixels(tmp_path / "palette.png", "") == grey[..., None]).all()


@pytest.mark.parametrize("side_px", [13_378, 30_000, 10**6, 2**31 - 1])
def test_a_header_that_claims_too_much_costs_no_memory(tmp_path: Path, side_px: int) -> None:
    path = claiming(tmp_path / "a.png", side_px, side_px)
    tracemalloc.start()
    assert "too large to be read at once" in refused(path)
    assert f"{LARGEST_PX:,}" in refused(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_what_pillow_only_warns_of_is_opened_in_silence(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    with open_picture(claiming(tmp_path / "a.png", 12_000, 12_000), "") as picture:
        assert picture.size == (12_000, 12_000)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.png", b"", "cannot be read as a picture"),
        ("text.png", b"no picture", "cannot be read as a picture"),
        ("script.eps", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "cannot be read as"),
        ("program.gif", b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", "cannot be read as a picture"),
        ("zeros.tif", b"II*\0" + bytes(1000), "cannot be read as a picture"),
    ],
)
def test_what_is_no_picture_is_refused(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    assert words in refused(tmp_path / name)


def test_a_damaged_picture_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    for suffix in (".png", ".jpg", ".tif", ".bmp", ".webp"):
        path = tmp_path / f"whole{suffix}"
        Image.fromarray(pixels).save(path)
        whole = path.read_bytes()
        for part in (3, 20, len(whole) // 2):
            (tmp_path / f"part{suffix}").write_bytes(whole[:part])
            assert "cannot be read as a picture" in refused(tmp_path / f"part{suffix}")
    # Decoders written in C talk, too.
    assert capfd.readouterr() == ("", "")
    assert not recwarn.list


def test_missing_and_other_size(tmp_path: Path) -> None:
    assert "is missing" in refused(tmp_path / "none.png")
    assert "cannot be read as a picture" in refused(tmp_path)
    Image.new("RGB", (4, 5)).save(tmp_path / "a.png")
    assert read_pixels(tmp_path / "a.png", "", size_px=(4, 5)).shape == (5, 4, 3)
    assert "has 4 x 5 px, expected are 5 x 4" in refused(tmp_path / "a.png", size_px=(5, 4))
    with pytest.raises(ImageryError):
        open_picture(tmp_path / "none.png", "", error=ImageryError)
