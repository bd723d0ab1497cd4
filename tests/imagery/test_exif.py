"""Time, place and resolution that photographs state."""

from datetime import datetime

import numpy as np
import pytest
from PIL import Image

from skyproof.errors import ImageryError
from skyproof.imagery.exif import Exif, exif_words
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.sources import SourceReader, inspect_source
from tests.imagery.made import smooth_noise

DJI = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="{}" '
    'drone-dji:GimbalPitchDegree="{}"/></rdf:RDF></x:xmpmeta>'
)


def photograph(path, *, gps=None, taken=None, focal_mm=None, xmp=None, width=400):
    exif = Image.Exif()
    camera = exif.get_ifd(0x8769)
    if taken is not None:
        camera[36867] = taken
    if focal_mm is not None:
        camera[41989], camera[40962] = focal_mm, width
    if gps is not None:
        exif.get_ifd(0x8825).update(gps)
    options = {} if xmp is None else {"xmp": xmp.encode()}
    Image.fromarray(smooth_noise(300, 400).transpose(1, 2, 0)).save(path, exif=exif, **options)
    return path


def read(path, gsd_m=0.05):
    with SourceReader() as reader:
        return inspect_source(path, SourceSettings(gsd_m=gsd_m), reader)


def gps(north="N", latitude=(53.0, 54.0, 36.0), east="E", longitude=(27.0, 33.0, 0.0)):
    return {1: north, 2: latitude, 3: east, 4: longitude}


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        (gps(), (27.55, 53.91)),
        (gps("S", east="W"), (-27.55, -53.91)),
        (gps(latitude=(0.0, 0.0, 0.0), longitude=(0.0, 0.0, 0.0)), None),
        (gps(latitude=(99.0, 0.0, 0.0)), None),
        (gps(latitude=(53.0, 54.0)), None),
        (None, None),
    ],
)
def test_places(tmp_path, place, expected):
    found = read(photograph(tmp_path / "a.jpg", gps=place)).exif.place
    assert found == (None if expected is None else pytest.approx(expected, abs=1e-6))


@pytest.mark.parametrize(
    ("taken", "expected"),
    [
        ("2026:05:03 11:02:00", datetime(2026, 5, 3, 11, 2)),
        ("0000:00:00 00:00:00", None),
        ("yesterday", None),
        (None, None),
    ],
)
def test_times(tmp_path, taken, expected):
    assert read(photograph(tmp_path / "a.jpg", taken=taken)).exif.taken == expected


@pytest.mark.parametrize(
    ("height", "pitch", "focal_mm", "width", "stated"),
    [
        ("+60.00", "-90.00", 24, 400, True),
        ("+60.00", "-45.00", 24, 400, False),
        ("-2.00", "-90.00", 24, 400, False),
        ("high", "-90.00", 24, 400, False),
        ("+60.00", "-90.00", 0, 400, False),
        # A part of the photograph, or the photograph in another size.
        ("+60.00", "-90.00", 24, 4000, False),
    ],
)
def test_the_resolution_by_height_and_focal_length(
    tmp_path, height, pitch, focal_mm, width, stated
):
    xmp = DJI.format(height, pitch)
    path = photograph(tmp_path / "a.jpg", focal_mm=focal_mm, xmp=xmp, width=width)
    # A film of 36 x 24 mm behind 24 mm sees 1.5 m by 1 m from 1 m: its diagonal serves.
    expected_m = 60 * np.hypot(1.5, 1.0) / 500
    found_m = read(path, gsd_m=0.2).exif.gsd_m
    assert found_m == (pytest.approx(expected_m) if stated else None)
    with pytest.raises(ImageryError, match=r"does not say how large") as caught:
        read(path, gsd_m=None)
    assert ("--source.gsd-m, by its camera's height about 0.22)" in str(caught.value)) == stated
    assert not any("height" in note for note in read(path, gsd_m=0.25).notes)
    doubted = [note for note in read(path, gsd_m=0.1).notes if "height" in note]
    assert len(doubted) == stated
    assert all("suggests about 21.6 rather than 10.0 cm per pixel" in note for note in doubted)


def test_one_sentence_tells_when_and_where():
    assert list(exif_words([Exif(), Exif()])) == []
    first = Exif(datetime(2026, 5, 3, 11, 2, 9), (27.56, 53.9))
    assert list(exif_words([first])) == [
        "By their EXIF data, 1 of 1 images were taken at 2026-05-03 11:02, at latitude 53.90 and "
        "longitude 27.56"
    ]
    last = Exif(datetime(2026, 5, 3, 11, 40), (27.56, 53.94))
    assert list(exif_words([Exif(), last, first])) == [
        "By their EXIF data, 2 of 3 images were taken from 2026-05-03 11:02 to 2026-05-03 11:40, "
        "at latitude 53.90 to 53.94 and longitude 27.56"
    ]
