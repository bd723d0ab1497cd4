"""EXIF orientation: pixels and labels stand upright in tiles and frames."""

import json

import numpy as np
import pytest
from PIL import Image

from skyproof.errors import ImageryError
from skyproof.imagery.frames import read_frames_folder
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import ImageLabels, Label
from skyproof.imagery.settings import LabelSettings
from skyproof.pictures import read_pixels
from tests.imagery.made import all_tiles, noise, smooth_noise, tile


def _stored(upright, orientation):
    """Pixels `[H, W, 3]` as a camera stores them, by the EXIF standard's words on row 0, column 0.

    The first letter is the side of the upright picture that the stored row 0 shows, the second the
    one that the stored column 0 shows.
    """
    sides = {1: "TL", 2: "TR", 3: "BR", 4: "BL", 5: "LT", 6: "RT", 7: "RB", 8: "LB"}[orientation]
    stored = upright
    if "B" in sides:
        stored = stored[::-1]
    if "R" in sides:
        stored = stored[:, ::-1]
    return np.ascontiguousarray(stored if sides[0] in "TB" else stored.swapaxes(0, 1))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_pictures_stand_upright_in_tiles_and_frames(tmp_path, orientation, suffix):
    upright = smooth_noise(128, 192)
    # One bright car, whose box was drawn on the upright picture.
    upright[:, 20:44, 100:116] = 255
    exif = Image.Exif()
    exif[274] = orientation
    stored = Image.fromarray(_stored(upright.transpose(1, 2, 0), orientation))
    (tmp_path / "frames").mkdir()
    stored.save(tmp_path / "frames" / f"a{suffix}", exif=exif, quality=100, subsampling=0)
    (tmp_path / "frames" / "a.txt").write_text(f"0 {108 / 192} {32 / 128} {16 / 192} {24 / 128}")
    (tmp_path / "frames" / "data.yaml").write_text("names: [car]")
    labels = read_labels(tmp_path / "frames"), LabelSettings(tmp_path / "frames", ("car",))
    backgrounds, record = tile(
        [tmp_path / "frames"], tmp_path / "set", labels=labels, source_gsd_m=0.125
    )
    tiles = all_tiles(backgrounds)
    assert len(tiles) == 6
    for one in tiles:
        left, top = one.offset_px
        expected = upright[:, top : top + 64, left : left + 64].astype(int)
        assert np.abs(backgrounds.pixels(one.id).numpy() - expected).max() <= 6 * (suffix == ".jpg")
    assert record.sources[0]["size_px"] == [192, 128]
    assert any("EXIF" in note for note in record.notes) == (orientation > 1)
    documents = (json.loads(file.read_text()) for file in tmp_path.glob("set/*/annotations.json"))
    rows = [row for document in documents for row in document["annotations"]]
    assert [row["bbox"] for row in rows if not row["iscrowd"]] == [[36, 20, 16, 24]]
    frames = read_frames_folder(
        tmp_path / "frames", gsd_m=0.125, target_gsd_m=0.125, classes=["car"], border_px=0.0
    )
    assert np.abs(frames.image(0).numpy() - upright.astype(int)).max() <= 6 * (suffix == ".jpg")
    assert frames.boxes[0].tolist() == [pytest.approx([100, 20, 116, 44], abs=1e-3)]


def test_labels_of_the_stored_pixels_are_refused_where_they_state_the_size(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(smooth_noise(192, 256).transpose(1, 2, 0)).save(tmp_path / "a.jpg", exif=exif)
    corners = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))
    images = {"a": (Label("car", corners),)}
    settings = LabelSettings(tmp_path / "a.json")
    upright = ImageLabels(("car",), images, {"a": (192, 256)})
    tile([tmp_path / "a.jpg"], tmp_path / "set", labels=(upright, settings), source_gsd_m=0.125)
    stored = ImageLabels(("car",), images, {"a": (256, 192)})
    with pytest.raises(ImageryError, match=r"192 x 256 px but .* says 256 x 192; .*EXIF orient"):
        tile([tmp_path / "a.jpg"], tmp_path / "b", labels=(stored, settings), source_gsd_m=0.125)


def test_damaged_exif_data_are_worth_nothing(tmp_path):
    picture = Image.fromarray(smooth_noise(64, 128).transpose(1, 2, 0))
    for name, exif in {
        "a": b"Exif\0\0MM\0*\0\0\xff",
        "b": b"Exif\0\0junk",
        "c": b"\xff" * 40,
    }.items():
        picture.save(tmp_path / f"{name}.jpg", exif=exif)
    _, record = tile([tmp_path], tmp_path / "set", source_gsd_m=0.125)
    assert [one["size_px"] for one in record.sources] == [[128, 64]] * 3
    assert read_pixels(tmp_path / "b.jpg", "").shape == (64, 128, 3)


def test_georeferenced_pixels_stay_as_they_are_stored(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    array = noise(128, 192)
    Image.fromarray(array.transpose(1, 2, 0)).save(tmp_path / "a.png", exif=exif)
    (tmp_path / "a.pgw").write_text("0.125\n0\n0\n-0.125\n1550000.0625\n5189999.9375\n")
    backgrounds, record = tile([tmp_path / "a.png"], tmp_path / "set", crs="EPSG:2193")
    assert record.sources[0]["size_px"] == [192, 128]
    for one in all_tiles(backgrounds):
        assert (
            backgrounds.pixels(one.id).numpy()
            == array[:, one.offset_px[1] :, one.offset_px[0] :][:, :64, :64]
        ).all()


def test_an_orientation_behind_the_pixels_counts_nowhere(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    array = smooth_noise(64, 128)
    Image.fromarray(array.transpose(1, 2, 0)).save(tmp_path / "a.png", exif=exif)
    data = (tmp_path / "a.png").read_bytes()
    start = data.index(b"eXIf") - 4
    end = start + 12 + int.from_bytes(data[start : start + 4], "big")
    rest, chunk = data[:start] + data[end:], data[start:end]
    last = rest.index(b"IEND") - 4
    (tmp_path / "a.png").write_bytes(rest[:last] + chunk + rest[last:])
    (tmp_path / "a.txt").write_text("0 0.25 0.25 0.1 0.1")
    (tmp_path / "data.yaml").write_text("names: [car]")
    frames = read_frames_folder(
        tmp_path, gsd_m=0.125, target_gsd_m=0.125, classes=["car"], border_px=0.0
    )
    assert (frames.image(0).numpy() == array).all()
    _, record = tile([tmp_path / "a.png"], tmp_path / "set", source_gsd_m=0.125)
    assert record.sources[0]["size_px"] == [128, 64]
