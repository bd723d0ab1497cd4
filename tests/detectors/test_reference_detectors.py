"""The detectors that come with skyproof: what they weigh, and that they see."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import skyproof as sp
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import (
    REFERENCE_FOLDER,
    SHIPPED_DETECTORS,
    reference_folder,
)
from skyproof.detectors.detector import Detections
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import match_images
from skyproof.detectors.validation import validate
from skyproof.errors import ConfigurationError
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles
from skyproof.results.precheck import read_precheck
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

SCENES, SIDE_PX = 24, 128
LARGEST_BYTES = 5_000_000


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A few scenes of ground and vehicles that no detector learnt from."""
    folder = tmp_path_factory.mktemp("ground")
    ground = write_procedural_backgrounds(folder / "ground", {"test": 6}, 260, seed=77)
    generator = torch.Generator().manual_seed(77)
    fleet = sample_fleet(FleetSettings(12), generator=generator)
    settings = SceneSettings(size_px=SIDE_PX, vehicles_maximum=3)
    scenes = sample_scenes(settings, ground, "test", fleet.sizes_m, SCENES, generator=generator)
    with torch.no_grad():
        frames = sp.TorchRenderer(ground)(scenes, placed_vehicles(fleet, scenes))
    pixels = (frames.image * 255).round().byte()
    boxes = [frames.boxes[frames.scene_index == index] for index in range(SCENES)]
    return Dataset.of_images(list(pixels), boxes, gsd_m=0.125)


def recall_and_precision(found: list[Detections], images: Dataset, threshold: float):
    table = match_images(found, images, criterion="centre_1m")
    hits, alarms = table.counts_at(threshold)
    return hits / table.vehicles, hits / max(hits + alarms, 1)


@pytest.mark.parametrize("name", SHIPPED_DETECTORS)
def test_they_find_vehicles_at_their_frozen_threshold(name: str, images: Dataset) -> None:
    judge = load_detector(name)
    found = detect_all(judge, images)
    recall, precision = recall_and_precision(found, images, judge.threshold)
    assert recall > 0.7
    assert precision > 0.7
    # The threshold is one that fits: hardly any other is better.
    assert validate(judge, images)["f1"] < 2 / (1 / recall + 1 / precision) + 0.1


@pytest.mark.parametrize("name", SHIPPED_DETECTORS)
def test_halves_are_stored_and_single_precision_is_computed_with(name: str) -> None:
    path = REFERENCE_FOLDER / name / "weights.safetensors"
    assert path.stat().st_size <= LARGEST_BYTES
    stored = load_file(path)
    assert {tensor.dtype for tensor in stored.values()} == {torch.float16, torch.int64}
    loaded = load_detector(name)
    assert {parameter.dtype for parameter in loaded.parameters()} == {torch.float32}
    for key, tensor in loaded.state_dict().items():
        assert torch.equal(tensor, stored[key].to(tensor.dtype)), key
    card = loaded.card
    assert (card.name, card.size, card.gsd_m) == (name.removesuffix("_hardened"), "slim", 0.125)
    assert card.parameters == sum(each.numel() for each in loaded.parameters())
    assert card.doubts == []


def test_their_check_is_of_these_very_weights() -> None:
    for name in SHIPPED_DETECTORS:
        record, card = read_precheck(REFERENCE_FOLDER / name), load_detector(name).card
        assert (record.weights_sha256, record.threshold) == (card.weights_sha256, card.threshold)
        assert record.measured_on.sources == ("procedural",)
        assert {rate.kind for rate in record.rates} >= {"paint_body", "blur", "control", "sun"}


def test_how_they_were_made_is_told_beside_them() -> None:
    page = (REFERENCE_FOLDER / "README.md").read_text(encoding="utf-8")
    assert "Apache-2.0" in page
    assert "skyproof reproduce --preset reference" in page
    for name in SHIPPED_DETECTORS:
        assert f"{load_detector(name).threshold:.3f}" in page
    assert {path.name for path in REFERENCE_FOLDER.iterdir()} == {"README.md", *SHIPPED_DETECTORS}


@pytest.mark.parametrize("name", ["yolov5", "../retinanet", ""])
def test_no_other_comes_trained(name: str) -> None:
    with pytest.raises(ConfigurationError, match="does not come trained"):
        reference_folder(name)


def test_halves_are_widened_wherever_a_detector_lies(tmp_path: Path) -> None:
    """A folder of the user's may hold halves, too; its digest is that of what is computed with."""
    from skyproof.detectors.loaded import save_detector
    from skyproof.storage import weights_digest, write_tensors

    judge = load_detector("retinanet")
    save_detector(tmp_path, judge, judge.card)
    assert load_file(tmp_path / "weights.safetensors").keys() == judge.state_dict().keys()
    single = (tmp_path / "weights.safetensors").stat().st_size
    halves = {
        name: tensor.half() if tensor.is_floating_point() else tensor
        for name, tensor in judge.state_dict().items()
    }
    write_tensors(tmp_path / "weights.safetensors", halves)
    assert (tmp_path / "weights.safetensors").stat().st_size < 0.6 * single
    assert weights_digest(load_detector(tmp_path)) == weights_digest(judge)
