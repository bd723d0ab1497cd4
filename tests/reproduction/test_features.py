"""Features at vehicles and at ground: where they are looked at, and how they are stored."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from torchvision import ops

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections, Detector, TrainableDetector
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.reproduction import gather_features as module
from skyproof.reproduction.gather_features import gather_features
from skyproof.reproduction.stored import Features, read_features, write_features
from skyproof.scenes.scene import write_scenes

VEHICLES = [(20.0, 30.0, 56.0, 46.0), (100.0, 90.0, 116.0, 126.0)]
UNSEEN = (0.0, 0.0, 0.0, 0.0)


class Looking(TrainableDetector):
    """Finds the first vehicle, and its features are a box's place and mean brightness."""

    def __init__(self, name="looking"):
        super().__init__()
        self.name = name
        self.looked = []

    def detect(self, images):
        return [Detections(torch.tensor(VEHICLES[:1]), torch.ones(1)) for _ in images]

    def features(self, images, boxes):
        self.looked += [own.clone() for own in boxes]
        return [
            torch.cat([own, image.mean().expand(len(own), 1)], dim=1)
            for image, own in zip(images, boxes, strict=True)
        ]


class BlackBox(Detector):
    name = "black_box"

    def detect(self, images):
        return [Detections(torch.tensor(VEHICLES[:1]), torch.ones(1)) for _ in images]


def judging(detector):
    detector.set_card(DetectorCard(detector.name, threshold=0.5, gsd_m=0.125))
    return detector


@pytest.fixture(autouse=True)
def own_features(monkeypatch):
    def own(detector, images, boxes):
        return detector.features(images, boxes)

    monkeypatch.setattr(module, "box_features", own)


@pytest.fixture
def make_dataset(tmp_path, make_scene):
    def make(name, brightness, size_px=192):
        """One image per value of `brightness`, with two vehicles in sight and one that is not."""
        scenes = [make_scene(f"s{i}", f"tile-{i // 2}", 3) for i in range(len(brightness))]
        with CocoWriter(tmp_path / name, gsd_m=0.125) as writer:
            for scene, value in zip(scenes, brightness, strict=True):
                image = torch.full((3, size_px, size_px), value, dtype=torch.uint8)
                mask = torch.ones(size_px, size_px, dtype=torch.bool)
                vehicles = [
                    Annotation(box, (32.0, 32.0), 1.0, mask, "pick-up-0000", place)
                    for place, box in enumerate([VEHICLES[0], UNSEEN, VEHICLES[1]])
                ]
                writer.add(image, scene.id, vehicles)
        write_scenes(tmp_path / name / "scenes.jsonl", scenes)
        return tmp_path / name

    return make


def test_vehicles_in_sight_and_ground_beside_them(make_dataset):
    original = Dataset.open(make_dataset("test", [51] * 20))
    hidden = Dataset.open(make_dataset("test-T-U-0", [102] * 20))
    judge = Looking()
    found = gather_features([judging(judge)], original, {"T-U-0": hidden}, seed=5)
    assert [each.shown for each in found] == ["ground", "original", "T-U-0"]
    ground, before, after = found
    assert before.scenes[:3] == ["s0", "s0", "s1"]
    assert before.backgrounds[3:5] == ["tile-0", "tile-1"]
    # The second vehicle is out of sight.
    assert before.placements == [0, 2] * 20
    assert np.allclose(before.vectors[0], [*VEHICLES[0], 0.2])
    assert np.allclose(after.vectors[:, 4], 0.4)
    assert np.array_equal(after.vectors[:, :4], before.vectors[:, :4])
    # Ground: boxes of the same sizes, in the image, a metre (8 px) from every vehicle.
    places = torch.from_numpy(ground.vectors[:, :4])
    assert ground.placements == before.placements
    sides = places[:, 2:] - places[:, :2]
    assert torch.allclose(sides[0::2], torch.tensor([36.0, 16.0]).double(), atol=1e-4)
    assert torch.allclose(sides[1::2], torch.tensor([16.0, 36.0]).double(), atol=1e-4)
    assert places.min() >= 0
    assert places.max() <= 192
    near = torch.tensor(VEHICLES).double() + torch.tensor([-8.0, -8, 8, 8]).double()
    assert float(ops.box_iou(places, near).max()) == 0
    assert len(np.unique(ground.vectors[:, 0])) == 40
    # The seed alone decides where, not who looks nor how many images there are.
    fewer = Dataset.open(make_dataset("fewer", [51] * 3))
    again = gather_features([judging(BlackBox()), judging(Looking())], fewer, {}, seed=5)
    assert np.array_equal(again[0].vectors, ground.vectors[:6])
    other = gather_features([judging(Looking())], fewer, {}, seed=6)
    assert not np.array_equal(other[0].vectors[:, :4], again[0].vectors[:, :4])


def test_a_full_image_has_no_ground(make_dataset):
    small = Dataset.open(make_dataset("test", [51, 51], size_px=128))
    ground, before = gather_features([judging(Looking())], small, {}, seed=0)
    assert len(before.vectors) == 4
    small.boxes[0][0] = torch.tensor([0.0, 0.0, 128.0, 128.0])
    crowded, _ = gather_features([judging(Looking())], small, {}, seed=0)
    assert set(crowded.scenes) == {"s1"}
    assert set(ground.scenes) == {"s0", "s1"}


def test_of_many_scenes_the_first(make_dataset, monkeypatch):
    monkeypatch.setattr(module, "MOST_SCENES", 3)
    original = Dataset.open(make_dataset("test", [51] * 5))
    ground, before = gather_features([judging(Looking())], original, {}, seed=0)
    assert set(before.scenes) == set(ground.scenes) == {"s0", "s1", "s2"}


def test_images_too_large_to_be_seen_whole_are_refused(make_dataset, monkeypatch):
    monkeypatch.setattr(module, "LARGEST_WHOLE_PX", 100)
    original = Dataset.open(make_dataset("test", [51]))
    with pytest.raises(ConfigurationError, match="up to 100 px a side, these have 192"):
        gather_features([judging(Looking())], original, {}, seed=0)


def stored(vectors, detector="a"):
    count = len(vectors)
    tiles = [f"t{row}" for row in range(count)]
    return Features(
        detector, "T-U", [f"s{row}" for row in range(count)], tiles, [0] * count, vectors
    )


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "features.parquet"
    first = stored(np.arange(6.0).reshape(2, 3))
    second = stored(np.full((1, 5), 0.25), "b")
    write_features(path, [first, second])
    for read, made in zip(read_features(path), [first, second], strict=True):
        assert np.array_equal(read.vectors, made.vectors)
        assert (read.detector, read.scenes, read.backgrounds, read.placements) == (
            *(made.detector, made.scenes, made.backgrounds, made.placements),
        )


@pytest.mark.parametrize(
    ("vectors", "said"),
    [
        ([np.array([[1.0, np.nan]])], "no finite numbers"),
        ([np.array([[np.inf, 1.0]])], "no finite numbers"),
        ([np.ones((1, 2)), np.ones((1, 3))], "different lengths of a"),
        ([np.ones((1, 0))], "or empty ones"),
    ],
)
def test_damage_is_one_sentence(tmp_path, vectors, said):
    path = tmp_path / "features.parquet"
    write_features(path, [stored(each) for each in vectors])
    with pytest.raises(StoredFileError, match=said):
        read_features(path)


def test_other_tables_are_no_features(tmp_path):
    path = tmp_path / "features.parquet"
    write_features(path, [stored(np.ones((2, 3)))])
    table = pq.read_table(path)
    pq.write_table(table.drop_columns(["scene"]), path)
    with pytest.raises(StoredFileError, match="other columns"):
        read_features(path)
    path.write_bytes(b"PAR1 and nothing more")
    with pytest.raises(StoredFileError, match="not a readable Parquet"):
        read_features(path)
