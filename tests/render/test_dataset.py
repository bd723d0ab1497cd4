"""Matched pairs and datasets on disk (section S5.1)."""

import dataclasses
import json
import threading

import numpy as np
import pytest
import torch

from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.datasets.dataset import Dataset
from skyproof.errors import RunFolderError
from skyproof.render.dataset import ground_corners, placed_vehicles, render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.scene import Placement, read_scenes
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from tests.render.bodies import PAPER_SENSOR, PlainGround, scene


@pytest.fixture(scope="module")
def fleet():
    return sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))


def some_scenes(fleet):
    """Four scenes, one of them empty, one with a vehicle across the border."""
    places = [
        [(0.3, -0.2, 20.0)],
        [(-2.5, 2.0, 100.0), (2.5, -2.0, 250.0)],
        [],
        [(5.7, 0.5, 10.0), (-2.0, 0.0, 190.0)],
    ]
    scenes = []
    for number, vehicles in enumerate(places):
        made = scene(*vehicles, seed=number, name=f"scene-{number}", tilt_deg=5.0 * number)
        named = tuple(
            Placement(fleet.ids[index % 2], each.x_m, each.y_m, each.heading_rad)
            for index, each in enumerate(made.placements)
        )
        scenes.append(type(made)(made.id, made.background, made.camera, made.sun, named, made.seed))
    return scenes


def random_colours(seed=0):
    return UniversalTexture(
        CamouflageName.parse("R-U-0"), generator=torch.Generator().manual_seed(seed)
    )


def write(folder, fleet, **changed):
    settings = {"camouflage": None, "batch_size": 3, **changed}
    render_dataset(folder, some_scenes(fleet), fleet, TorchRenderer(PlainGround(None)), **settings)


def files(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def _any_mask(frames, count):
    masks = torch.zeros(count, *frames.masks.shape[1:], dtype=torch.bool)
    for index, mask in zip(frames.scene_index.tolist(), frames.masks, strict=True):
        masks[index] |= mask
    return masks


@torch.no_grad()
def test_a_camouflage_changes_pixels_of_the_vehicle_and_no_labels(fleet):
    scenes = some_scenes(fleet)
    renderer, vehicles = TorchRenderer(PlainGround(None)), placed_vehicles(fleet, scenes)
    original = renderer(scenes, vehicles, masks=True)
    camouflaged = renderer(scenes, random_colours()(vehicles), masks=True)
    for label in ("scene_index", "boxes", "centres", "visible_px", "visible_fraction", "masks"):
        assert torch.equal(getattr(original, label), getattr(camouflaged, label)), label
    differs = (original.image != camouflaged.image).any(1)
    masks = _any_mask(original, len(scenes))
    # What lies just outside the image is blurred into it: its mask is taken from a larger image.
    wider = [
        dataclasses.replace(each, camera=dataclasses.replace(each.camera, size_px=96 + 64))
        for each in scenes
    ]
    whole = _any_mask(renderer(wider, vehicles, masks=True), len(scenes))
    assert torch.equal(whole[:, 32:128, 32:128], masks)
    side = 2 * (PAPER_SENSOR.blur_radius_px + 1) + 1
    near = (
        torch.nn.functional.max_pool2d(whole[:, None].float(), side, stride=1, padding=side // 2)[
            :, 0
        ]
        > 0
    )
    near = near[:, 32:128, 32:128]
    assert not (differs & ~near).any()
    # I_bg + G(I_fg - I_bg) keeps the ground's fine detail; its blackest pixels are clipped in both
    # images.
    assert differs[masks].float().mean() > 0.97
    change = (original.image - camouflaged.image).abs().amax(1)
    assert change[masks].median() > 0.05
    assert not differs[2].any(), "the scene without vehicles"


def test_a_dataset_reads_back_with_the_boxes_and_pixels_that_were_drawn(tmp_path, fleet):
    calls = []
    write(tmp_path / "set", fleet, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(3, 4), (4, 4)]
    scenes = some_scenes(fleet)
    assert read_scenes(tmp_path / "set" / "scenes.jsonl") == scenes
    frames = TorchRenderer(PlainGround(None))(scenes, placed_vehicles(fleet, scenes), masks=True)
    stored = Dataset.open(tmp_path / "set")
    assert list(stored.ids) == [each.id for each in scenes]
    assert stored.gsd_m == 0.125
    for index in range(len(scenes)):
        boxes = frames.boxes[frames.scene_index == index]
        torch.testing.assert_close(stored.boxes[index], boxes, atol=1e-4, rtol=0)
        drawn = (frames.image[index] * 255).round()
        # Batches of another size may round the last bit of a float otherwise.
        assert (stored.image(index).float() - drawn).abs().max() <= 1
    document = json.loads((tmp_path / "set" / "annotations.json").read_text())
    assert (document["info"]["renderer"], document["info"]["rendering"]) == (
        "torch",
        TorchRenderer(PlainGround(None)).record(scenes),
    )
    rows = document["annotations"]
    assert [row["placement_index"] for row in rows] == [0, 0, 1, 0, 1]
    assert [row["vehicle"] for row in rows] == [
        place.vehicle for each in scenes for place in each.placements
    ]
    assert [row["area"] for row in rows] == frames.masks.flatten(1).sum(1).tolist()
    assert rows[3]["visible_fraction"] == pytest.approx(float(frames.visible_fraction[3]), abs=1e-6)
    assert 0 < rows[3]["visible_fraction"] < 1


def test_the_same_scenes_give_the_same_bytes(tmp_path, fleet):
    write(tmp_path / "one", fleet)
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    write(tmp_path / "two", fleet)
    one = files(tmp_path / "one")
    assert one == files(tmp_path / "two")
    assert sorted(one) == sorted(
        ["annotations.json", "scenes.jsonl", *(f"images/scene-{n}.png" for n in range(4))]
    )


def test_several_threads_write_the_same_bytes_and_give_their_setting_back(
    tmp_path, fleet, monkeypatch
):
    write(tmp_path / "alone", fleet, batch_size=1)
    drawing = []
    draw = TorchRenderer.__call__
    # Nobody gets past it alone: of the four batches two are always drawn at once.
    meeting = threading.Barrier(2)

    def noted(renderer, *arguments, **options):
        meeting.wait(60)
        drawing.append((threading.current_thread().name, torch.get_num_threads()))
        return draw(renderer, *arguments, **options)

    monkeypatch.setattr(TorchRenderer, "__call__", noted)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        write(tmp_path / "together", fleet, batch_size=1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert files(tmp_path / "together") == files(tmp_path / "alone")
    assert len({name for name, _ in drawing}) == 2
    assert {threads for _, threads in drawing} == {1}


def test_matched_pairs_on_disk_share_annotations_and_scenes(tmp_path, fleet):
    write(tmp_path / "original", fleet)
    write(tmp_path / "camouflaged", fleet, camouflage=random_colours())
    original, camouflaged = files(tmp_path / "original"), files(tmp_path / "camouflaged")
    same = {name for name in original if original[name] == camouflaged[name]}
    assert same == {"scenes.jsonl", "images/scene-2.png"}
    labels = [json.loads(each["annotations.json"]) for each in (original, camouflaged)]
    assert labels[1]["info"].pop("camouflage")
    assert labels[0] == labels[1]
    # Judges that learnt from either learnt from different images.
    write(tmp_path / "again", fleet, camouflage=random_colours())
    write(tmp_path / "other", fleet, camouflage=random_colours(1))
    original, camouflaged, again, other = (
        Dataset.open(tmp_path / name).digest
        for name in ("original", "camouflaged", "again", "other")
    )
    assert again == camouflaged
    assert len({original, camouflaged, other}) == 3


def test_an_existing_folder_is_refused_and_left_alone(tmp_path, fleet):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "mine.txt").write_text("keep")
    with pytest.raises(RunFolderError, match="set"):
        write(tmp_path / "set", fleet)
    assert files(tmp_path / "set") == {"mine.txt": b"keep"}


def test_a_kill_in_the_middle_leaves_no_finished_folder_and_a_second_run_does(tmp_path, fleet):
    def kill(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "set", fleet, progress=kill)
    assert not (tmp_path / "set").exists()
    write(tmp_path / "set", fleet)
    write(tmp_path / "other", fleet)
    assert files(tmp_path / "set") == files(tmp_path / "other")
    assert {path.name for path in tmp_path.iterdir()} == {"set", "other"}


def test_the_ground_a_vehicle_stands_on(tmp_path, fleet):
    write(tmp_path / "set", fleet)
    rows = json.loads((tmp_path / "set" / "annotations.json").read_text())["annotations"]
    placements = [place for each in some_scenes(fleet) for place in each.placements]
    for row, placement in zip(rows, placements, strict=True):
        length, width, _ = fleet.sizes_m[placement.vehicle]
        forward = np.array([np.cos(placement.heading_rad), -np.sin(placement.heading_rad)])
        left = np.array([-np.sin(placement.heading_rad), -np.cos(placement.heading_rad)])
        # 96 px of 12.5 cm; rows run down, the world's y up. Bodies are centred to within some
        # centimetres.
        middle = np.array([48 + placement.x_m / 0.125, 48 - placement.y_m / 0.125])
        signs = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
        expected = [middle + (a * forward * length + b * left * width) / 0.25 for a, b in signs]
        np.testing.assert_allclose(row["corners_px"], expected, atol=0.5)


def test_no_vehicle_stands_nowhere(fleet):
    empty = some_scenes(fleet)[2]
    assert ground_corners([empty], placed_vehicles(fleet, [empty])).shape == (0, 4, 2)
