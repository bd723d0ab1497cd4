"""Background sets: windows, their rotation, sampling, determinism, damage."""

import json
import math
from dataclasses import replace

import pytest
import torch

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.scene import BackgroundWindow


def _set(folder, image, split="train"):
    tile = BackgroundTile("one", "tiles/one.png", split, image.shape[2], image.shape[1], "made")
    save_tile(folder, tile, image)
    write_index(folder, 0.125, [tile])
    return BackgroundSet.open(folder)


@pytest.fixture
def noise():
    return torch.randint(
        256, (3, 60, 80), dtype=torch.uint8, generator=torch.Generator().manual_seed(3)
    )


def test_whole_pixel_window_is_an_exact_copy(tmp_path, noise):
    backgrounds = _set(tmp_path, noise)
    even = backgrounds.window(BackgroundWindow("one", 30.0, 25.0, 0.0), 20)
    assert torch.equal(even, noise[:, 15:35, 20:40].float() / 255)
    odd = backgrounds.window(BackgroundWindow("one", 30.5, 25.5, 0.0), 21)
    assert torch.equal(odd, noise[:, 15:36, 20:41].float() / 255)


def test_half_pixel_shift_averages_neighbours(tmp_path, noise):
    window = _set(tmp_path, noise).window(BackgroundWindow("one", 30.5, 25.0, 0.0), 20)
    expected = (noise[:, 15:35, 20:40].float() + noise[:, 15:35, 21:41].float()) / 2 / 255
    torch.testing.assert_close(window, expected, atol=2e-5, rtol=0)


def test_quarter_turn_is_counter_clockwise(tmp_path):
    # A red mark right of the middle of the tile and a green one above it. The window's x axis
    # points up the screen after a quarter turn, so that green lies to its right and red below.
    image = torch.zeros(3, 40, 40, dtype=torch.uint8)
    image[0, 20, 26] = 255
    image[1, 13, 20] = 255
    window = _set(tmp_path, image).window(BackgroundWindow("one", 20.5, 20.5, math.pi / 2), 21)
    # Offsets from the middle pixel (10, 10): red at (+6, 0) turns to (0, +6), green at (0, -7) to
    # (+7, 0).
    assert window[0].argmax() == (10 + 6) * 21 + 10
    assert window[1].argmax() == 10 * 21 + 10 + 7
    assert float(window.max()) == pytest.approx(1, abs=1e-4)


def test_small_turn_moves_a_mark_the_right_way(tmp_path):
    image = torch.zeros(3, 80, 80, dtype=torch.uint8)
    image[:, 39:42, 59:62] = 255
    turn = 0.3
    window = _set(tmp_path, image).window(BackgroundWindow("one", 40.5, 40.5, turn), 51)
    weights = window[0] / window[0].sum()
    steps = torch.arange(51) + 0.5 - 25.5
    # The camera turned left, so the mark at distance 20 turns right: below the x axis.
    assert float((weights.sum(0) * steps).sum()) == pytest.approx(20 * math.cos(turn), abs=0.05)
    assert float((weights.sum(1) * steps).sum()) == pytest.approx(20 * math.sin(turn), abs=0.05)


def test_sampled_windows_are_inside_and_use_all_of_the_tile(tmp_path, noise):
    backgrounds = _set(tmp_path, noise, "attack")
    generator = torch.Generator().manual_seed(0)
    xs, turns = [], []
    for _ in range(300):
        window = backgrounds.sample_window("attack", 40, generator=generator)
        for dx, dy in ((-20, -20), (20, -20), (20, 20), (-20, 20)):
            x = (
                window.centre_x_px
                + math.cos(window.rotation_rad) * dx
                + math.sin(window.rotation_rad) * dy
            )
            y = (
                window.centre_y_px
                - math.sin(window.rotation_rad) * dx
                + math.cos(window.rotation_rad) * dy
            )
            assert -1e-9 <= x <= 80 + 1e-9
            assert -1e-9 <= y <= 60 + 1e-9
        backgrounds.window(window, 40)
        xs.append(window.centre_x_px)
        turns.append(window.rotation_rad)
    assert min(xs) < 30
    assert max(xs) > 50
    assert max(turns) > 6
    assert min(turns) < 0.3


@pytest.mark.parametrize("size_px", [43, 50, 58])
def test_windows_with_little_room_turn_as_far_as_they_fit(tmp_path, noise, size_px):
    backgrounds = _set(tmp_path, noise)
    generator, turns = torch.Generator().manual_seed(0), []
    for _ in range(400):
        window = backgrounds.sample_window("train", size_px, generator=generator)
        cosine, sine = abs(math.cos(window.rotation_rad)), abs(math.sin(window.rotation_rad))
        reach = size_px / 2 * (cosine + sine)
        for middle, side in ((window.centre_x_px, 80), (window.centre_y_px, 60)):
            assert reach - 1e-6 <= middle <= side - reach + 1e-6
        backgrounds.window(window, size_px)
        turns.append(window.rotation_rad / (math.pi / 2))
    # Every angle that fits is drawn, around each of the four sides: a search in small steps.
    fits = [
        angle
        for angle in torch.linspace(0, math.pi / 4, 2000).tolist()
        if size_px * (math.cos(angle) + math.sin(angle)) <= 60
    ]
    for quarter in range(4):
        off = [turn - quarter for turn in (*turns, *(each - 4 for each in turns))]
        near = [each * math.pi / 2 for each in off if abs(each) < 0.5]
        assert len(near) > 60
        assert max(near) == pytest.approx(fits[-1], rel=0.1)
        assert min(near) == pytest.approx(-fits[-1], rel=0.1)


def test_windows_without_room_to_turn_are_quarter_turns_of_exact_pixels(tmp_path, noise):
    backgrounds, size_px = _set(tmp_path, noise), 60
    generator, turns, corners = torch.Generator().manual_seed(0), set(), set()
    for _ in range(120):
        window = backgrounds.sample_window("train", size_px, generator=generator)
        quarters = window.rotation_rad / (math.pi / 2)
        assert quarters in (0, 1, 2, 3)
        left, top = window.centre_x_px - size_px / 2, window.centre_y_px - size_px / 2
        assert (left, top) == (int(left), int(top))
        own = noise[:, int(top) : int(top) + size_px, int(left) : int(left) + size_px]
        # Turned back to the left, the window is the tile's own pixels.
        got = backgrounds.window(window, size_px)
        assert torch.equal(torch.rot90(got, int(quarters), (1, 2)), own.float() / 255)
        turns.add(quarters)
        corners.add((left, top))
    assert len(turns) == 4
    assert {top for _, top in corners} == {0}
    assert max(left for left, _ in corners) == 80 - size_px


def test_an_exact_quarter_turn_agrees_with_interpolation(tmp_path, noise):
    backgrounds = _set(tmp_path, noise)
    for quarters in range(4):
        exact = backgrounds.window(BackgroundWindow("one", 40.0, 30.0, quarters * math.pi / 2), 40)
        near = backgrounds.window(
            BackgroundWindow("one", 40.0, 30.0, quarters * math.pi / 2 + 1e-9), 40
        )
        torch.testing.assert_close(exact, near, atol=1e-4, rtol=0)


def test_no_room_and_no_such_split_raise(tmp_path, noise):
    backgrounds = _set(tmp_path, noise)
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(ConfigurationError, match="at least 61 px"):
        backgrounds.sample_window("train", 61, generator=generator)
    with pytest.raises(ConfigurationError, match="no test tile"):
        backgrounds.sample_window("test", 10, generator=generator)


def test_window_outside_or_of_another_set_raises(tmp_path, noise):
    backgrounds = _set(tmp_path, noise)
    with pytest.raises(StoredFileError, match="reaches out"):
        backgrounds.window(BackgroundWindow("one", 5.0, 30.0, 0.0), 20)
    with pytest.raises(StoredFileError, match="no tile 'two'"):
        backgrounds.window(BackgroundWindow("two", 30.0, 30.0, 0.0), 20)


@pytest.mark.parametrize(
    "damage",
    [
        lambda index: index.pop("gsd_m"),
        lambda index: index.update(format_version=99),
        lambda index: index.update(tiles=[]),
        lambda index: index["tiles"][0].pop("split"),
        lambda index: index["tiles"][0].update(split="holiday"),
        lambda index: index["tiles"][0].update(file="/etc/passwd"),
        lambda index: index["tiles"][0].update(file="tiles/../../holiday.png"),
        lambda index: index["tiles"][0].update(id="../holiday"),
        lambda index: index["tiles"][0].update(width_px=10**9),
        lambda index: index["tiles"].append(index["tiles"][0]),
        lambda index: index.update(gsd_m=1e300),
        lambda index: index.update(sensor={"blur_sigma_px": 1e300}),
        lambda index: index["tiles"][0].update(drivable="../holiday.png"),
        lambda index: index["tiles"][0].update(drivable="tiles/one.png"),
        lambda index: index["tiles"][0].update(drivable="tiles/one.jpg"),
        lambda index: index["tiles"][0].update(removed=[{"x_px": 3.0}]),
        lambda index: index["tiles"][0].update(removed=[{"x_px": 3, "y_px": 4, "length_m": 0}]),
        lambda index: index["tiles"][0].update(
            removed=[{"x_px": 3, "y_px": 4, "heading_from": "holiday"}]
        ),
    ],
)
def test_damaged_index_raises(tmp_path, noise, damage):
    _set(tmp_path, noise)
    path = tmp_path / "index.json"
    index = json.loads(path.read_text())
    damage(index)
    path.write_text(json.dumps(index))
    with pytest.raises(StoredFileError, match=r"index\.json"):
        BackgroundSet.open(tmp_path)


def test_a_vehicle_removed_outside_its_tile_is_one_sentence(tmp_path, noise):
    _set(tmp_path, noise)
    path = tmp_path / "index.json"
    index = json.loads(path.read_text())
    for x, y in ((80.5, 30.0), (40.0, -0.5)):
        index["tiles"][0]["removed"] = [{"x_px": x, "y_px": y}]
        path.write_text(json.dumps(index))
        said = rf"removed at \({x:g}, {y:g}\) px, outside the tile one of 80 x 60 px; copy"
        with pytest.raises(StoredFileError, match=said):
            BackgroundSet.open(tmp_path)


def test_removed_vehicles_and_maps_are_read_back_and_old_sets_have_none(tmp_path, noise):
    before = _set(tmp_path, noise).tile("one")
    assert (before.removed, before.drivable) == ((), None)
    stood = (RemovedVehicle(3.25, 60.0, 0.5, "label", 4.5, 1.8), RemovedVehicle(80.0, 0.0))
    values = torch.arange(60 * 80).reshape(60, 80).remainder(181).to(torch.uint8)
    file = save_map(tmp_path, "drivable", "one", values.numpy())
    write_index(tmp_path, 0.125, [replace(before, removed=stood, drivable=file)])
    now = BackgroundSet.open(tmp_path)
    assert now.tile("one").removed == stood
    assert torch.equal(now.directions("one"), values)
    assert torch.equal(now.pixels("one"), noise), "pixels and directions are kept apart"
    # As a set of before names neither.
    index = json.loads((tmp_path / "index.json").read_text())
    for name in ("removed", "drivable"):
        del index["tiles"][0][name]
    (tmp_path / "index.json").write_text(json.dumps(index))
    assert BackgroundSet.open(tmp_path).tile("one") == before
    assert BackgroundSet.open(tmp_path).directions("one") is None


def test_a_tile_that_a_link_leads_out_to_is_refused(tmp_path, noise):
    folder = tmp_path / "set"
    _set(folder, noise)
    (folder / "tiles" / "one.png").rename(tmp_path / "holiday.png")
    (folder / "tiles" / "one.png").symlink_to(tmp_path / "holiday.png")
    with pytest.raises(StoredFileError, match=r"tiles/one\.png, which leads out of its folder"):
        BackgroundSet.open(folder)


def test_any_seed_of_64_bits_draws_ground(tmp_path):
    for number, seed in enumerate((-1, -(2**63), 2**63 - 1)):
        write_procedural_backgrounds(tmp_path / str(number), {"train": 1}, 64, seed=seed)
    pictures = {file.read_bytes() for file in tmp_path.glob("*/tiles/train-00000.png")}
    assert len(pictures) == 3


def test_missing_index_and_damaged_tile_raise(tmp_path, noise):
    with pytest.raises(StoredFileError, match=r"index\.json is missing"):
        BackgroundSet.open(tmp_path / "nowhere")
    backgrounds = _set(tmp_path, noise)
    file = tmp_path / "tiles" / "one.png"
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(StoredFileError, match=r"one\.png"):
        backgrounds.pixels("one")


def test_same_seed_same_bytes_whatever_the_counts(tmp_path):
    before = torch.random.get_rng_state()
    first = write_procedural_backgrounds(tmp_path / "a", {"train": 2, "test": 1}, 128, seed=5)
    write_procedural_backgrounds(tmp_path / "b", {"test": 2}, 128, seed=5)
    write_procedural_backgrounds(tmp_path / "c", {"test": 1}, 128, seed=6)
    name = "tiles/test-00000.png"
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / name).read_bytes() != (tmp_path / "c" / name).read_bytes()
    assert (tmp_path / "b" / "tiles/test-00001.png").read_bytes() != (
        tmp_path / "b" / name
    ).read_bytes()
    assert len(first.tiles("train")) == 2
    light = first.tiles("test")[0].light
    assert light is not None
    assert light.sun is not None
    assert light.sun.elevation_rad > 0
    assert torch.equal(before, torch.random.get_rng_state())


def test_drawn_tiles_know_where_vehicles_may_stand(tmp_path):
    backgrounds = write_procedural_backgrounds(tmp_path, {"train": 8}, 160, seed=3)
    tiles = backgrounds.tiles("train")
    kinds = {tile.kind: tile for tile in tiles}
    assert {"park", "street"} <= set(kinds)
    assert kinds["park"].drivable is None
    files = {path.name for path in (tmp_path / "drivable").iterdir()}
    assert files == {f"{tile.id}.png" for tile in tiles if tile.drivable is not None}
    assert len(files) >= 5
    assert backgrounds.directions(kinds["street"].id).shape == (160, 160)


def test_progress_and_unknown_split(tmp_path):
    calls = []
    write_procedural_backgrounds(
        tmp_path, {"train": 2}, 64, seed=0, progress=lambda *call: calls.append(call)
    )
    assert calls == [(1, 2), (2, 2)]
    with pytest.raises(ConfigurationError, match="holiday"):
        write_procedural_backgrounds(tmp_path, {"holiday": 1}, 64, seed=0)
