"""Detection over whole sets: batches of one size, and large images looked at in windows."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from PIL import Image

from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import PictureInMemory, Window
from skyproof.detectors.detector import Candidates, Detections, Detector, TrainableDetector
from skyproof.detectors.inference import LARGEST_WHOLE_PX, covering_windows, detect_all
from skyproof.detectors.ultralytics_detectors import upright
from skyproof.imagery.frames import FramePicture


class Spots(Detector):
    """Finds every bright spot of 8 px that it sees whole, and of one cut by the edge the rest."""

    name = "spots"

    def __init__(self) -> None:
        self.shapes: list[tuple[int, ...]] = []

    def detect(self, images: torch.Tensor) -> list[Detections]:
        self.shapes.append(tuple(images.shape))
        return [self._spots(image[0] > 0.5) for image in images]

    def _spots(self, bright: torch.Tensor) -> Detections:
        above = torch.nn.functional.pad(bright, (1, 0, 1, 0))
        corners = torch.nonzero(bright & ~above[:-1, 1:] & ~above[1:, :-1])
        boxes = []
        for top, left in corners.tolist():
            height = int(bright[top : top + 8, left].sum())
            width = int(bright[top, left : left + 8].sum())
            boxes.append([left, top, left + width, top + height])
        found = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
        scores = 0.5 + 0.01 * (found[:, 0] % 7)
        order = scores.argsort(descending=True)[:100]
        return Detections(found[order], scores[order])


def spotted(
    width: int, height: int, pitch: int, shift: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture with a spot every `pitch` pixels, and their boxes."""
    image = torch.zeros(3, height, width, dtype=torch.uint8)
    boxes = []
    for top in range(shift, height - 8, pitch):
        for left in range(shift, width - 8, pitch):
            image[:, top : top + 8, left : left + 8] = 255
            boxes.append([left, top, left + 8, top + 8])
    return image, torch.tensor(boxes, dtype=torch.float32)


def by_place(boxes: torch.Tensor) -> list[list[float]]:
    return sorted(boxes.tolist())


@pytest.mark.parametrize("size", [(1600, 1300), (1025, 800), (384, 2900)])
@pytest.mark.parametrize("shift", [0, 5, 19])
def test_each_spot_of_a_large_image_is_found_once(size: tuple[int, int], shift: int) -> None:
    image, boxes = spotted(*size, 41, shift)
    (found,) = detect_all(Spots(), Dataset.of_images([image], [boxes], gsd_m=0.125))
    assert by_place(found.boxes) == by_place(boxes)
    # More than the most that this detector returns of one image.
    assert len(boxes) > 400
    assert bool((found.scores[:-1] >= found.scores[1:]).all())


def test_an_image_that_is_not_large_is_seen_whole() -> None:
    image, boxes = spotted(LARGEST_WHOLE_PX, LARGEST_WHOLE_PX, 200)
    detector = Spots()
    (found,) = detect_all(detector, Dataset.of_images([image], [boxes], gsd_m=0.125))
    assert detector.shapes == [(1, 3, LARGEST_WHOLE_PX, LARGEST_WHOLE_PX)]
    assert by_place(found.boxes) == by_place(boxes)


def test_neighbours_of_one_size_share_a_batch_and_keep_their_order() -> None:
    sizes = [(100, 120)] * 18 + [(120, 100)] + [(1100, 100)] + [(100, 120)] * 2
    pairs = [spotted(*size, 40, shift) for shift, size in enumerate(sizes)]
    images, boxes = map(list, zip(*pairs, strict=True))
    detector = Spots()
    found = detect_all(detector, Dataset.of_images(images, boxes, gsd_m=0.125))
    assert detector.shapes[:3] == [(16, 3, 120, 100), (2, 3, 120, 100), (1, 3, 100, 120)]
    assert detector.shapes[3][1:] == (3, 100, 352)
    assert detector.shapes[4] == (2, 3, 120, 100)
    for of_image, truth in zip(found, boxes, strict=True):
        assert by_place(of_image.boxes) == by_place(truth)


@pytest.mark.parametrize(
    ("side", "width"), [(300, 300), (384, 384), (385, 256), (460, 288), (1025, 352), (5000, 384)]
)
def test_windows_cover_every_pixel_and_overlap(side: int, width: int) -> None:
    windows = covering_windows((side, 100))
    assert {(top, height) for _, top, _, height in windows} == {(0, 100)}
    starts = [window.left for window in windows]
    assert {window.width for window in windows} == {width}
    assert (starts[0], starts[-1] + width) == (0, side)
    assert all(first + width - second >= 96 for first, second in itertools.pairwise(starts))


def test_windows_are_those_that_the_detector_was_made_for() -> None:
    image, boxes = spotted(1400, 1100, 130)
    detector = Spots()
    detector.window_px = 640
    (found,) = detect_all(detector, Dataset.of_images([image], [boxes], gsd_m=0.125))
    # Two of 640 px would overlap by less than a quarter.
    assert {shape[2:] for shape in detector.shapes} == {(640, 576)}
    # Larger windows are shown one by one.
    assert {shape[0] for shape in detector.shapes} <= {1, 2}
    assert by_place(found.boxes) == by_place(boxes)


def test_a_larger_image_may_hold_more_vehicles_than_a_window() -> None:
    class Everywhere(TrainableDetector):
        def candidates(self, images: torch.Tensor) -> Candidates:
            corners = torch.cartesian_prod(torch.arange(0, 380, 16), torch.arange(0, 380, 16))
            boxes = torch.cat([corners, corners + 12], dim=1).float()[None]
            return Candidates(boxes, torch.full((1, len(corners)), 0.5))

    for side_px, count in ((384, 100), (768, 400)):
        (found,) = Everywhere().detect(torch.zeros(1, 3, side_px, side_px))
        assert len(found.boxes) == count


@pytest.mark.parametrize("scale", [0.25, 2.0, 4.0, 0.928, 3.7])
def test_windows_of_a_frame_are_parts_of_the_whole_resampled_frame(
    tmp_path: Path, scale: float
) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(256, (430, 500, 3), dtype=torch.uint8, generator=generator)
    Image.fromarray(pixels.numpy()).save(tmp_path / "frame.png")
    size = (round(500 * scale), round(430 * scale))
    frame = FramePicture(tmp_path / "frame.png", (500, 430), size)
    windows = [*covering_windows(size), Window(size[0] - 30, size[1] - 20, 30, 20)]
    expected = PictureInMemory(frame.read()).windows(windows)
    for part, whole in zip(frame.windows(windows), expected, strict=True):
        difference = (part.int() - whole.int()).abs()
        if scale in (0.25, 2.0, 4.0):
            assert not difference.any()
        # Otherwise Pillow rounds the corners of the box to 24 bits, and then each of two passes.
        assert difference.max() <= 2
        assert (difference > 0).float().mean() < 0.02


class Row(TrainableDetector):
    """Finds a row of vehicles parked side by side at 45 degrees, as upright boxes around them."""

    name = "row"

    def __init__(self, length_m: float, width_m: float, pitch_m: float) -> None:
        super().__init__()
        angles = torch.full((5, 1), torch.pi / 4)
        steps = 10 + pitch_m * torch.arange(5.0)[:, None] * torch.tensor([[0.5**0.5, -(0.5**0.5)]])
        middles = steps + torch.tensor([[0.0, 15.0]])
        sides = torch.tensor([[length_m, width_m]]).expand(5, 2)
        self.boxes = upright(torch.cat([middles, sides], dim=1), angles)[None] / 0.125

    def candidates(self, images: torch.Tensor) -> Candidates:
        scores = torch.linspace(0.9, 0.5, 5)[None]
        return Candidates(self.boxes, scores)


@pytest.mark.parametrize(("length_m", "width_m", "pitch_m"), [(4.6, 1.9, 2.2), (12.0, 2.55, 3.2)])
def test_suppression_of_upright_boxes_keeps_a_row_at_45_degrees(
    length_m: float, width_m: float, pitch_m: float
) -> None:
    (found,) = Row(length_m, width_m, pitch_m).detect(torch.zeros(1, 3, 320, 320))
    assert len(found.scores) == 5
