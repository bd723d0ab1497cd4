"""The light of tiles that are cut from imagery: exposure of each flight, sun of a date and time."""

import math
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
import torch
from rasterio.crs import CRS
from rasterio.transform import Affine

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.ground.procedural import draw_ground
from skyproof.imagery.exif import Exif
from skyproof.imagery.flights import flights_of
from skyproof.imagery.photographs import sun_over
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.georeference import Georeference
from skyproof.imagery.tiles.grid import Cell
from skyproof.imagery.tiles.sources import Source
from skyproof.scenes.light import Light
from tests.imagery.made import all_tiles, noise, tile, write_image

# The middle of a UTM zone, so that grid north is true north; and far from it.
MIDDLE, EDGE = (500_000.0, 5_330_000.0), (760_000.0, 5_330_000.0)


def cell(place, crs=32632):
    return Cell("a", CRS.from_epsg(crs), *place, 64, 0.125, (0,), ("a", 0, 0))


def compass_deg(sun):
    """Clockwise from the cell's upper side."""
    return (90 - math.degrees(sun.azimuth_rad)) % 360


def test_the_sun_of_a_date_and_time_is_the_almanacs():
    # At 48.12 N, 9 E the sun crosses the meridian at 11:25:46 UTC on 2024-06-20 (equation of time
    # -1 min 46 s), 90 - 48.12 + 23.44 degrees high.
    noon = datetime(2024, 6, 20, 11, 25, 46, tzinfo=UTC)
    sun = sun_over(cell(MIDDLE), noon)
    assert math.degrees(sun.elevation_rad) == pytest.approx(65.32, abs=0.1)
    assert compass_deg(sun) == pytest.approx(180, abs=0.7)
    # In the morning it stands in the east; the zone of the clock makes no difference.
    morning = noon - timedelta(hours=4)
    assert 80 < compass_deg(sun_over(cell(MIDDLE), morning)) < 120
    summer_time = morning.astimezone(timezone(timedelta(hours=2)))
    again = sun_over(cell(MIDDLE), summer_time)
    assert again.azimuth_rad == sun_over(cell(MIDDLE), morning).azimuth_rad


def test_grid_north_is_told_from_true_north():
    # 3.49 degrees east of the zone's middle at 48.06 N, the grid is turned by 3.49 sin(48.06).
    sun = sun_over(cell(EDGE), datetime(2024, 6, 20, 11, 11, 48, tzinfo=UTC))
    longitude_from_middle_deg = 3.49
    turned = longitude_from_middle_deg * math.sin(math.radians(48.06))
    assert compass_deg(sun) == pytest.approx(180 - turned, abs=1.0)


def test_night_and_places_unknown_are_refused():
    with pytest.raises(ImageryError, match="the sun stood at"):
        sun_over(cell(MIDDLE), datetime(2024, 6, 20, 23, 0, tzinfo=UTC))
    nowhere = Cell("a", None, 0.0, 0.0, 64, 0.125, (0,), ("a", 0, 0))
    with pytest.raises(ImageryError, match="expects georeferenced images"):
        sun_over(nowhere, datetime(2024, 6, 20, 11, 0, tzinfo=UTC))
    with pytest.raises(ConfigurationError, match="expects a time with its zone"):
        SourceSettings(taken=datetime(2024, 6, 20, 11, 0))


@pytest.mark.parametrize(("crs", "hour"), [("EPSG:32632", 23), (None, 11)])
def test_a_time_that_cannot_be_is_refused_before_anything_is_cut(tmp_path, crs, hour):
    """At night, and without a place; by day, over a place, the tiles know their sun."""
    corner = Affine(0.125, 0, MIDDLE[0], 0, -0.125, MIDDLE[1])
    where = {"crs": crs, "transform": corner} if crs else {}
    image = write_image(tmp_path / "a.tif", noise(128, 128), **where)
    taken = datetime(2024, 6, 20, hour, tzinfo=UTC)
    cut = []

    def cut_it(taken):
        return tile(
            [image],
            tmp_path / "set",
            source_gsd_m=None if crs else 0.125,
            taken=taken,
            progress=lambda done, _: cut.append(done),
        )

    with pytest.raises(ImageryError, match=r"--source\.taken expects"):
        cut_it(taken)
    assert cut == []
    assert not list(tmp_path.glob("set/**/*.png"))
    backgrounds, _ = cut_it(taken.replace(hour=11) if crs else None)
    assert len(cut) == 4
    tiles = all_tiles(backgrounds)
    assert [one.light.sun is not None for one in tiles] == 4 * [crs is not None]


def test_each_flight_keeps_its_exposure(tmp_path):
    """One picture at half the other's exposure: its white is half as bright."""

    drawn = draw_ground(300, 0.125, generator=torch.Generator().manual_seed(4)).image.numpy()
    linear = (drawn / 255.0) ** 2.2
    names = ("north", "south", "south2")
    for number, exposure in enumerate((1.0, 0.5, 0.3)):
        shown = ((exposure * linear) ** (1 / 2.2) * 255).astype(np.uint8)
        corner = Affine(0.125, 0, 500_000 + 100 * number, 0, -0.125, 5_330_000)
        write_image(tmp_path / f"{names[number]}.tif", shown, crs="EPSG:32632", transform=corner)
    backgrounds, _ = tile([tmp_path / f"{name}.tif" for name in names], tmp_path / "set")
    whites = {one.source: one.light.white[1] for one in all_tiles(backgrounds)}
    assert whites["south.tif"] / whites["north.tif"] == pytest.approx(0.5, abs=0.08)
    assert whites["south.tif"] == whites["south2.tif"]
    assert {one.flight for one in all_tiles(backgrounds)} == {"north.tif", "south.tif"}


def test_a_flight_is_a_folder_a_system_a_series_of_names_and_a_time(tmp_path):
    (tmp_path / "other").mkdir()
    grid = CRS.from_epsg(32632)

    def source(name, taken=None, crs=None):
        georeference = Georeference(crs, Affine.identity(), (0.1, 0.1))
        exif = Exif(taken and datetime(2024, 6, 20, *taken))
        place = (Affine.identity(), georeference, (1, 2, 3), None, False, None, None, exif, ())
        return Source(tmp_path / name, 9, 9, *place)

    flights = flights_of(
        [
            source("DJI_5-01.jpg", (9, 50)),
            source("DJI_5-02.jpg", (11, 30)),
            source("DJI_5-03.jpg", (10, 40)),
            source("DJI_5-04.jpg"),
            source("DJI_5-05.jpg", (15, 0)),
            source("DJI_6-01.jpg", (9, 50)),
            source("DJI_5-06.jpg", crs=grid),
            source("other/DJI_5-07.jpg", (9, 50)),
        ]
    )
    first = "DJI_5-01.jpg"
    alone = ["DJI_5-05.jpg", "DJI_6-01.jpg", "DJI_5-06.jpg", "DJI_5-07.jpg"]
    assert flights == [first, first, first, first, *alone]


def test_photographs_of_the_night_are_noted(tmp_path):
    drawn = draw_ground(300, 0.125, generator=torch.Generator().manual_seed(4)).image.numpy()
    corner = Affine(0.125, 0, 500_000, 0, -0.125, 5_330_000)
    write_image(tmp_path / "a.tif", drawn // 8, crs="EPSG:32632", transform=corner)
    night, record = tile([tmp_path / "a.tif"], tmp_path / "night")
    assert noted(record, "night") == [
        "a.tif: so dark that it seems to be taken at night; vehicles will be drawn as in dim "
        "daylight, without lamps"
    ]
    assert np.mean(all_tiles(night)[0].light.white) == pytest.approx(0.3, abs=0.001)


def test_only_what_was_measured_is_noted(tmp_path):
    """The white of a plain source is nobody's measurement: of a dark one it would be the larger."""
    corners = [Affine(0.125, 0, place, 0, -0.125, 5_330_000) for place in (500_000, 500_100)]
    drawn = draw_ground(300, 0.125, generator=torch.Generator().manual_seed(4)).image.numpy()
    dark = (drawn * 0.6).astype(np.uint8)
    plain = np.full((3, 300, 300), 120, np.uint8)
    write_image(tmp_path / "dark.tif", dark, crs="EPSG:32632", transform=corners[0])
    write_image(tmp_path / "plain.tif", plain, crs="EPSG:32632", transform=corners[1])
    both, record = tile([tmp_path / "dark.tif", tmp_path / "plain.tif"], tmp_path / "both")
    lights = {one.source: one.light for one in all_tiles(both)}
    assert lights["plain.tif"] == Light()
    white = sum(lights["dark.tif"].white) / 3
    assert white < 0.9
    assert noted(record, "too plain") == [
        "plain.tif: too plain to measure its exposure; vehicles will be drawn as on a clear day, "
        "well exposed"
    ]
    (measured,) = noted(record, "exposure measured")
    assert f"shown as {white:.2f} to {white:.2f} of" in measured
    _, record = tile([tmp_path / "plain.tif"], tmp_path / "alone")
    assert [note.image for note in noted(record, "too plain")] == ["plain.tif"]
    assert noted(record, "exposure measured") == []


def noted(record, words):
    return [note for note in record.notes if words in note]
