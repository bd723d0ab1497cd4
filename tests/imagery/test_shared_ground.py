"""Photographs of the same ground are recognised, and each piece of it becomes one tile."""

import itertools
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from skyproof.datasets.dataset import Dataset
from skyproof.imagery.exif import Exif
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import ImageLabels
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.imagery.tiles import planes, shared_ground
from skyproof.imagery.tiles.grid import lay_grids
from skyproof.imagery.tiles.planes import inspect_imagery
from skyproof.imagery.tiles.shared_ground import CoarseView, PhotographPair, find_pairs
from skyproof.imagery.tiles.sources import SourceReader
from skyproof.scenes.splits import SPLITS
from tests.imagery.flown import GSD_M, fly, overlap, photograph, store
from tests.imagery.made import all_tiles, noise, tile

GIVEN = SourceSettings(GSD_M)


def plane_of(source):
    return source.georeference.plane or source.path.name


def places(sources, size_px=99):
    """What laying grids says of the number of places."""
    notes = []
    lay_grids(sources, TilingSettings(GSD_M, size_px), notes)
    return notes[0]


def agreement(flown, sources):
    """Counts pairs: those that overlap by 30 %, those found of them, and wrong ones; and errors.

    Errors are metres on the ground between what one photograph's middle shows and what another's
    pixel shows that lies there in their plane.
    """
    true, found, wrong, errors_m = 0, 0, 0, []
    for i, j in itertools.combinations(range(len(flown)), 2):
        together = plane_of(sources[i]) == plane_of(sources[j])
        if flown[i].place != flown[j].place:
            wrong += together
            continue
        overlaps = overlap(flown[i], flown[j]) >= 0.3
        true += overlaps
        found += overlaps and together
        if together:
            middle = flown[i].side_px / 2
            here = sources[i].georeference.transform * (middle, middle)
            there = complex(*(~sources[j].georeference.transform * here))
            shown = flown[i].to_ground(middle + middle * 1j), flown[j].to_ground(there)
            errors_m.append(abs(shown[0] - shown[1]) * GSD_M)
    return true, found, wrong, errors_m


def test_turned_and_scaled_photographs_of_drawn_places_are_recognised(tmp_path):
    flown = fly(np.random.default_rng(5), places=3, each=3, side_px=400, ground_px=800, seed=5)
    paths, labels = store(flown, tmp_path)
    sources = inspect_imagery(paths, GIVEN, labels)
    true, found, wrong, errors_m = agreement(flown, sources)
    assert true == found > 5
    assert wrong == 0
    assert max(errors_m) < 1.0
    assert places(sources) == "9 images without georeference show at most 3 distinct places"


@pytest.mark.slow
def test_nearly_all_photographs_of_the_same_ground_are_recognised_and_no_others(tmp_path):
    """95 % found and 1 % wrong, over seeds that nothing was tuned on, with and without labels.

    Pixels are coarse, because drawing the ground takes most of the time. Photographs are compared
    at 0.5 m.
    """
    given = SourceSettings(2 * GSD_M)
    counts = {True: [], False: []}
    for seed in (21, 22, 23):
        rng = np.random.default_rng(seed)
        side = {"side_px": 320, "ground_px": 700, "gsd_m": given.gsd_m}
        flown = fly(rng, places=8, each=6, seed=seed, **side)
        folder = tmp_path / str(seed)
        folder.mkdir()
        paths, labels = store(flown, folder, quality=65)
        for labelled, every in counts.items():
            sources = inspect_imagery(paths, given, labels if labelled else None)
            every.append(agreement(flown, sources)[:3])
    for labelled, every in counts.items():
        true, found, wrong = np.sum(every, 0)
        print(f"labelled: {labelled}, true pairs: {true}, found: {found}, wrong: {wrong}")
        assert found >= 0.95 * true
        assert wrong <= 0.01 * true


def repeated(kind, number):
    """A picture of ground that repeats itself, at a heading and place of its own."""
    rng = np.random.default_rng(number)
    y, x = np.mgrid[:256, :256]
    heading = rng.uniform(0, np.pi)
    u = x * np.cos(heading) + y * np.sin(heading) + rng.uniform(100, 400)
    v = y * np.cos(heading) - x * np.sin(heading) + rng.uniform(400, 700)
    ground = np.full((256, 256), 0.4)
    if kind == "grass":
        for sigma in (1.0, 8.0):
            blotches = ndimage.gaussian_filter(rng.standard_normal((256, 256)), sigma)
            ground += 0.05 * blotches / blotches.std()
    elif kind == "roof":
        ground += 0.1 * ((u % 9 < 1.5) | ((v + 4 * (u // 9 % 2)) % 6 < 1.2))
    else:
        marks = (u % 10 < 1) & (v % 60 < 40)
        bay = (u // 10).astype(int) * 97 + (v // 20).astype(int) * 31
        colour = np.where(rng.random(4096) < 0.5, rng.uniform(-0.35, 0.5, 4096), 0)[bay % 4096]
        parked = (abs(u % 10 - 5.75) < 3.25) & (abs(v % 20 - 10) < 7) & (v % 60 < 40)
        ground += np.where(parked, colour, 0.25 * marks)
    ground = ndimage.gaussian_filter(ground, 0.7) + 0.01 * rng.standard_normal((256, 256))
    return np.clip(ground, 0, 1).astype(np.float32)


def view_of(grey):
    return CoarseView.of(grey, np.ones(grey.shape, bool), 0.25)


@pytest.mark.parametrize("kind", ["grass", "roof", "bays"])
def test_ground_that_repeats_itself_is_not_taken_for_the_same(kind):
    assert find_pairs([view_of(repeated(kind, number)) for number in range(6)]) == []


def test_an_overlap_that_fits_elsewhere_as_well_is_no_evidence():
    rng = np.random.default_rng(0)
    motif = ndimage.gaussian_filter(rng.random((32, 32)), 2, mode="wrap")
    motif = (motif - motif.min()) / np.ptp(motif)
    wallpaper = view_of(np.tile(motif, (8, 8)).astype(np.float32))
    assert not shared_ground._overlap_agrees(wallpaper, wallpaper, 1, 8.0)
    unique = ndimage.gaussian_filter(rng.random((256, 256)), 2)
    unique = view_of(((unique - unique.min()) / np.ptp(unique)).astype(np.float32))
    assert shared_ground._overlap_agrees(unique, unique, 1, 0)
    assert not shared_ground._overlap_agrees(unique, unique, 1, 8.0)


def coordinates(side_px):
    """Ground whose red and green tell its pixel's x and y, and whose blue has a random pattern."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:side_px, :side_px] * 255 / side_px
    blue = ndimage.gaussian_filter(rng.random((side_px, side_px)), 4)
    blue = 255 * (blue - blue.min()) / np.ptp(blue)
    return Image.fromarray(np.stack([x, y, blue], 2).round().astype(np.uint8))


def shown_at(pixels, x, y):
    """The pixel of the strip's ground that bytes `[3, H, W]` show around a place."""
    row, column = round(y), round(x)
    part = pixels[:2, max(0, row - 6) : row + 6, max(0, column - 6) : column + 6]
    return complex(*(part.float().mean((1, 2)) * STRIP_PX / 255).tolist())


STRIP_PX = 900
CARS = [complex(x, y) for x in range(120, 840, 90) for y in (330, 450, 570)]


@pytest.fixture
def strip(tmp_path):
    """Paths and labels of nine photographs of one strip; each overlaps the next, some are turned.

    Cars are labelled but cannot be seen.
    """
    ground = coordinates(STRIP_PX)
    cars = [([at + z for z in (-18 - 8j, 18 - 8j, 18 + 8j, -18 + 8j)], None) for at in CARS]
    flown = [
        photograph(ground, 0, 210 + 60 * i + 450j, np.exp(1j * turn), 360, cars)
        for i, turn in enumerate([0, 0.05, 0, 1.57, 0, 0.6, 3.14, 0, 0])
    ]
    folder = tmp_path / "strip"
    folder.mkdir()
    return store(flown, folder, quality=95)


def test_ground_that_several_photographs_show_becomes_one_tile(strip, tmp_path):
    backgrounds, record = tile(strip[0], tmp_path / "tiles", source_gsd_m=GSD_M, size_px=96)
    middles = [shown_at(backgrounds.pixels(one.id), 48, 48) for one in all_tiles(backgrounds)]
    # The photographs on their own would be 81 tiles, and 34 have the area of the strip.
    assert 15 <= len(middles) <= 34
    for one, other in itertools.combinations(middles, 2):
        assert max(abs((one - other).real), abs((one - other).imag)) > 96 - 6
    assert "9 images without georeference show at most 1 distinct place" in record.notes


def test_a_vehicle_that_several_photographs_show_counts_once_where_it_stands(strip, tmp_path):
    paths, labels = strip
    labels = labels, LabelSettings(Path("labels"))
    out = tmp_path / "tiles"
    tile(paths, out, labels=labels, source_gsd_m=GSD_M, size_px=96)
    stand = [
        shown_at(data.image(i), (left + right) / 2, (top + bottom) / 2)
        for data in (Dataset.open(out / split) for split in SPLITS)
        for i in range(len(data))
        for left, top, right, bottom in data.boxes[i].tolist()
    ]
    nearest = [min(CARS, key=lambda car: abs(car - each)) for each in stand]
    # A box at the border of its tile is cut, and so its middle moves.
    off = [abs(car - each) for car, each in zip(nearest, stand, strict=True)]
    assert np.median(off) < 4
    assert max(off) < 20
    assert len(nearest) == len({*nearest}) > 10


def test_a_grid_over_photographs_has_at_least_the_tiles_of_each(tmp_path):
    ground = coordinates(STRIP_PX)
    flown = [photograph(ground, 0, 400 + 30 * i + (400 + 20 * i) * 1j, 1, 400) for i in range(3)]
    paths, _ = store(flown, tmp_path, quality=95)
    backgrounds, _ = tile(paths, tmp_path / "tiles", source_gsd_m=GSD_M, size_px=200)
    assert len(all_tiles(backgrounds)) >= 4


def test_tiles_are_cut_from_labelled_photographs_where_there_are_any(tmp_path):
    ground = coordinates(STRIP_PX)
    paths, labels = store([photograph(ground, 0, 450 + 450j, 1, 400) for _ in range(3)], tmp_path)
    labels = ImageLabels(("car",), {"001": labels.images["001"]}, {})
    labels = labels, LabelSettings(Path("labels"))
    backgrounds, _ = tile(paths, tmp_path / "t", labels=labels, source_gsd_m=GSD_M, size_px=200)
    assert {one.source for one in all_tiles(backgrounds)} == {"001.jpg"}


def test_another_scale_than_that_of_the_same_ground_is_corrected_and_told(tmp_path):
    ground = coordinates(STRIP_PX)
    flown = [photograph(ground, 0, 450 + 450j, scale, 360) for scale in (1, 1, 1.3, 1)]
    paths, _ = store(flown, tmp_path, quality=95)
    sources = inspect_imagery(paths, GIVEN)
    assert sources[2].georeference.gsd_m == pytest.approx((1.3 * GSD_M,) * 2, rel=0.01)
    told = ["over 10 % larger or smaller" in " ".join(source.notes) for source in sources]
    assert told == [False, False, True, False]


def test_a_pair_that_contradicts_the_others_is_dropped():
    lie = [(1, 0), (1.1 * np.exp(0.3j), 40 + 5j), (0.9, 70 - 8j), (np.exp(-1j), 60 + 60j)]

    def pair(first, second, off_m=0.0):
        (turn, shift), (its_turn, its_shift) = lie[first], lie[second]
        relative = its_turn / turn, (its_shift - shift) / turn + off_m
        return PhotographPair(first, second, *relative, (10 + 10j, 50 + 40j))

    pairs = [pair(0, 1), pair(1, 2), pair(2, 3), pair(3, 0), pair(0, 2, off_m=30)]
    found, groups = planes._poses(5, pairs)
    assert groups == [[0, 1, 2, 3], [4]]
    turn, shift = found[0]
    for (its_turn, its_shift), expected in zip(found, lie, strict=False):
        assert its_turn / turn == pytest.approx(expected[0])
        assert (its_shift - shift) / turn == pytest.approx(expected[1])


def test_photographs_that_are_stored_turned_are_compared_upright(tmp_path):
    ground = coordinates(STRIP_PX).crop((0, 0, 400, 300))
    paths = []
    turns = [None, 0, 3, 1, 5, 4, 6, 2]
    for orientation, back in enumerate(turns, 1):
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = ground if back is None else ground.transpose(Image.Transpose(back))
        paths.append(tmp_path / f"{orientation}.jpg")
        stored.save(paths[-1], exif=exif, quality=95)
    sources = inspect_imagery(paths, GIVEN)
    assert places(sources) == "8 images without georeference show at most 1 distinct place"
    middles = [source.georeference.transform * (200, 150) for source in sources]
    assert np.ptp(middles, axis=0).max() < 0.2


def test_images_of_other_places_or_with_little_to_see_stay_alone(tmp_path):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (200, 200, 3)), np.full((200, 200, 3), 90)]
    pictures += [pictures[1], pictures[1][:3], rng.integers(0, 9, (1, 1, 3))]
    paths = [tmp_path / f"{number}.png" for number in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        Image.fromarray(picture.astype(np.uint8)).save(path)
    sources = inspect_imagery(paths, GIVEN)
    assert all(source.georeference.plane is None for source in sources)
    assert places(sources, 9) == "5 images without georeference show at most 5 distinct places"


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_photographs_are_averaged_to_a_coarse_scale(tmp_path, suffix):
    """A PNG is read at once, other formats by GDAL."""
    values = noise(300, 200)
    path = tmp_path / f"photo{suffix}"
    Image.fromarray(values.transpose(1, 2, 0)).save(path)
    (source,) = inspect_imagery([path], GIVEN)
    with SourceReader() as reader:
        grey, usable, pixel_m = planes._coarse_picture(source, reader, 2 * GSD_M, None)
    rows, columns = grey.shape
    assert (2 * rows, 2 * columns) == values.shape[1:]
    expected = values.reshape(3, rows, 2, columns, 2).mean((0, 2, 4)) / 255
    # Bytes are rounded.
    assert np.abs(grey - expected).max() < 0.003
    assert usable.all()
    assert pixel_m == 2 * GSD_M


def test_the_images_of_a_long_flight_are_compared_with_their_neighbours(tmp_path, monkeypatch):
    """Time must not grow with the square of their number, and the user hears of it."""
    monkeypatch.setattr(shared_ground, "MOST_NEIGHBOURS", 2)
    ground = coordinates(STRIP_PX)
    flown = [photograph(ground, 0, at + 450j, 1, 200) for at in (150, 250, 650, 750, 150)]
    paths, _ = store(flown, tmp_path, quality=95)
    sources = inspect_imagery(paths, GIVEN)
    planes_of = [source.georeference.plane for source in sources]
    assert planes_of == ["000", "000", "002", "002", None]
    assert all(one.notes[-1].startswith("compared with the 2 before and") for one in sources)


@pytest.mark.parametrize(("north_deg", "together"), [(53.001, True), (53.05, False)])
def test_cameras_that_stood_far_apart_saw_other_ground(tmp_path, monkeypatch, north_deg, together):
    ground = coordinates(STRIP_PX)
    sources = []
    for number, degrees in enumerate([53.0, north_deg]):
        one = photograph(ground, 0, 450 + 450j, 1, 360)
        path = tmp_path / f"{number}.png"
        one.image.save(path)
        (source,) = inspect_imagery([path], GIVEN)
        sources.append(replace(source, exif=Exif(place=(27.5, degrees))))
    monkeypatch.setattr(planes, "inspect_sources", lambda *_: sources)
    planes_of = {plane_of(source) for source in inspect_imagery([], GIVEN)}
    assert len(planes_of) == (1 if together else 2)


@pytest.mark.data
@pytest.mark.skipif("SKYPROOF_DATA" not in os.environ, reason="SKYPROOF_DATA names no imagery")
def test_the_40_frames_of_munich_show_two_places():
    folder = Path(os.environ["SKYPROOF_DATA"]) / "kit_ais_munich"
    sources = inspect_imagery([folder], SourceSettings(0.116), read_labels(folder))
    assert places(sources) == "40 images without georeference show at most 2 distinct places"
    groups = {(one.path.stem.startswith("MOS"), plane_of(one)) for one in sources}
    assert len(groups) == 2


@pytest.mark.data
@pytest.mark.skipif("SKYPROOF_DATA" not in os.environ, reason="SKYPROOF_DATA names no imagery")
def test_the_drone_images_of_minsk_show_two_places():
    folder = Path(os.environ["SKYPROOF_DATA"]) / "minsk_drone"
    sources = inspect_imagery([folder], SourceSettings(0.055))
    assert places(sources) == "32 images without georeference show at most 2 distinct places"


@pytest.mark.data
@pytest.mark.skipif("SKYPROOF_DATA" not in os.environ, reason="SKYPROOF_DATA names no imagery")
def test_crops_of_drone_images_in_another_light_are_recognised(tmp_path):
    """Only their fine details correlate."""
    paths = []
    for name in ("DJI_0013-0036", "DJI_0013-0023"):
        with Image.open(Path(os.environ["SKYPROOF_DATA"]) / f"minsk_drone/{name}.jpg") as whole:
            paths.append(tmp_path / f"{name}.png")
            whole.crop((680, 520, 1240, 1080)).save(paths[-1])
    sources = inspect_imagery(paths, SourceSettings(0.055))
    assert places(sources) == "2 images without georeference show at most 1 distinct place"
