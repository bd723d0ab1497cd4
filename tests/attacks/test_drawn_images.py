"""Images that are rendered while a detector is trained on them."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from skyproof.attacks.world import World
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.batches import training_batch, training_batches
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import build_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import train
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from tests.rendered_world import RenderedWorld, make_world

SETTINGS = TrainingSettings(steps=5, batch_size=4, learning_rate=1e-3, checkpoint_every=2)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RenderedWorld:
    return make_world(tmp_path_factory.mktemp("world"))


def world_of(rendered: RenderedWorld, split: Split = "train", empty_share: float = 0.3) -> World:
    scenes = SceneSettings(size_px=96, vehicles_maximum=1)
    world = World(rendered.renderer(), rendered.ground, rendered.fleets["train"], scenes, split)
    return world.for_training(empty_share)


def photographs(rendered: RenderedWorld, split: str) -> Dataset:
    return rendered.images(split, rendered.scenes(split, 6, 1, 2))


def run(
    rendered: RenderedWorld, folder: Path, training: Dataset | None = None, **more: Any
) -> tuple[TrainableDetector, DetectorCard]:
    generator = torch.Generator().manual_seed(0)
    detector = build_detector("retinanet", "slim", generator=generator)
    given = {"drawn": world_of(rendered)} | more
    validation = photographs(rendered, "validation")
    card = train(detector, training, validation, SETTINGS, folder, generator=generator, **given)
    return detector, card


def test_images_show_vehicles_of_the_split_where_their_boxes_say(rendered: RenderedWorld) -> None:
    world = world_of(rendered, empty_share=0.5)
    images, boxes = world.images(40, generator=torch.Generator().manual_seed(1), device=CPU)
    assert images.shape == (40, 3, 96, 96)
    assert 0 <= images.min() < images.max() <= 1
    # A 12 m wide image has room for one vehicle, half of the images have none.
    counts = [len(each) for each in boxes]
    assert 10 <= counts.count(0) <= 30
    assert max(counts) == 1
    # Without vehicles the same scenes differ inside the boxes, and hardly elsewhere.
    scenes = world.draw(40, generator=torch.Generator().manual_seed(1))
    tiles = {tile.id for tile in rendered.ground.tiles("train")}
    assert {scene.background.tile for scene in scenes} <= tiles
    shares = []
    for image, own, scene in zip(images, boxes, scenes, strict=True):
        bare = replace(scene, placements=())
        (ground,) = world.frames(None, [bare]).image
        changed = (image - ground).abs().mean(0) > 0.1
        if not len(own):
            assert not changed.any()
            continue
        left, top, right, bottom = own[0].clamp(0, 96).int().tolist()
        shares.append(float(changed[top:bottom, left:right].float().mean()))
    # Crowns and roofs hide some of them, and dark ones differ little from asphalt.
    assert sorted(shares)[len(shares) // 2] > 0.4


def test_vehicles_marked_so_wear_patterns(rendered: RenderedWorld) -> None:
    shown = []
    for marks in ({}, {"coat": "patterned"}):
        world = world_of(rendered, empty_share=0.0)
        sources = dict.fromkeys(world.fleet.ids, marks)
        world = replace(world, fleet=replace(world.fleet, sources=sources))
        generator = torch.Generator().manual_seed(3)
        images, boxes = world.images(2, generator=generator, device=CPU)
        assert sum(map(len, boxes)) > 1
        shown.append(images)
    assert float((shown[0] - shown[1]).abs().max()) > 0.1


def test_half_of_the_images_are_drawn_beside_others(rendered: RenderedWorld) -> None:
    world, others = world_of(rendered), photographs(rendered, "train")
    settings = replace(SETTINGS, batch_size=5)
    shown, drawn = training_batches(others, world, settings, 3, CPU, 2)
    assert [len(images) for images, _ in (shown, drawn)] == [3, 2]
    alone, boxes = training_batch(others, replace(settings, batch_size=3), 3, 2)
    assert torch.equal(shown[0], alone)
    assert all(map(torch.equal, shown[1], boxes))
    # The same step shows the same, another step another image.
    (again,) = training_batches(None, world, replace(settings, batch_size=2), 3, CPU, 2)
    assert torch.equal(again[0], drawn[0])
    (other,) = training_batches(None, world, replace(settings, batch_size=2), 3, CPU, 4)
    assert not torch.equal(other[0], drawn[0])
    # A single image is one of the others.
    (only,) = training_batches(others, world, replace(settings, batch_size=1), 3, CPU, 2)
    assert len(only[0]) == 1


@pytest.mark.parametrize("beside", [False, True])
def test_a_stopped_training_goes_on_exactly(
    rendered: RenderedWorld, tmp_path: Path, beside: bool
) -> None:
    others = photographs(rendered, "train") if beside else None
    whole, card = run(rendered, tmp_path / "whole", others)

    def kill(row: dict[str, Any]) -> None:
        if row["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(rendered, tmp_path / "killed", others, on_step=kill)
    resumed, _ = run(rendered, tmp_path / "killed", others)
    assert resumed.weights_sha256 == whole.weights_sha256
    assert card.training["images"] == (6 if beside else 0)
    assert card.image_size_px == (96, 96)
    with pytest.raises(RunFolderError, match="another seed, start or images"):
        run(rendered, tmp_path / "killed", others, drawn=world_of(rendered, "attack"))
    with pytest.raises(RunFolderError, match="another seed, start or images"):
        run(rendered, tmp_path / "killed", photographs(rendered, "train"), drawn=None)


def test_without_vehicles_or_of_another_resolution_nothing_is_trained(
    rendered: RenderedWorld, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match="at least one vehicle"):
        run(rendered, tmp_path, drawn=None)
    coarse = replace(photographs(rendered, "train"), gsd_m=0.2)
    with pytest.raises(ConfigurationError, match=r"0\.2 m per pixel, validation images 0\.125"):
        run(rendered, tmp_path, coarse)
    ground = copy.copy(rendered.ground)
    ground.gsd_m = 0.2
    coarse_world = replace(world_of(rendered), backgrounds=ground)
    with pytest.raises(ConfigurationError, match=r"0\.2 m per pixel, validation images 0\.125"):
        run(rendered, tmp_path, drawn=coarse_world)
