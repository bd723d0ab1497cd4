"""Windows of large training images: where boxes go, what is hidden, what stays as it was."""

from __future__ import annotations

from dataclasses import replace

import torch
from detector_images import bar_images

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.batches import WINDOW_PX, training_batch, window
from skyproof.detectors.settings import TrainingSettings

PLAIN = TrainingSettings(batch_size=2, jitter=0.0)


def test_a_small_image_is_left_alone_and_nothing_is_drawn() -> None:
    generator = torch.Generator().manual_seed(0)
    state = generator.get_state()
    image, boxes, ignore = torch.rand(3, WINDOW_PX, 100), torch.rand(2, 4), torch.rand(1, 4)
    shown = window(image, boxes, ignore, generator=generator)
    assert all(one is other for one, other in zip(shown, (image, boxes, ignore), strict=True))
    assert torch.equal(state, generator.get_state())


def test_boxes_and_regions_follow_the_pixels() -> None:
    """Each vehicle and region has a value of its own; its box holds just these pixels."""
    height, width = 500, 900
    generator = torch.Generator().manual_seed(1)
    corners = torch.stack(
        [torch.randint(0, width - 40, (60,)), torch.randint(0, height - 40, (60,))], dim=1
    )
    boxes = torch.cat([corners, corners + torch.randint(8, 40, (60, 2))], dim=1).float()
    # Of overlapping ones the first is kept, so that no value hides another.
    kept: list[int] = []
    for index, box in enumerate(boxes):
        others = boxes[kept]
        apart = (
            (others[:, 0] >= box[2])
            | (others[:, 2] <= box[0])
            | (others[:, 1] >= box[3])
            | (others[:, 3] <= box[1])
        )
        if bool(apart.all()):
            kept.append(index)
    boxes = boxes[kept]
    vehicles, regions = boxes[::2], boxes[1::2]
    image = torch.zeros(3, height, width, dtype=torch.int64)
    for value, (left, top, right, bottom) in enumerate(
        torch.cat([vehicles, regions]).long().tolist(), 1
    ):
        image[:, top:bottom, left:right] = value
    starts, whole, hidden = set(), 0, 0
    for _ in range(60):
        shown, own, ignore = window(image, vehicles, regions, generator=generator)
        assert shown.shape == (3, WINDOW_PX, WINDOW_PX)
        for left, top, right, bottom in own.long().tolist():
            values = shown[0, top:bottom, left:right].unique()
            assert len(values) == 1
            # All of it is in the window.
            assert (
                (image[0] == values).sum()
                == (shown[0] == values).sum()
                == (bottom - top) * (right - left)
            )
        taken = torch.zeros(WINDOW_PX, WINDOW_PX, dtype=torch.bool)
        for left, top, right, bottom in torch.cat([own, ignore]).long().tolist():
            assert 0 <= left < right <= WINDOW_PX
            assert 0 <= top < bottom <= WINDOW_PX
            taken[top:bottom, left:right] = True
        # Nothing of a vehicle or a region is left that is neither.
        assert torch.equal(taken, shown[0] > 0)
        starts.add(int(shown.sum()))
        whole, hidden = whole + len(own), hidden + len(ignore)
    assert len(starts) > 50
    assert whole > 100
    assert hidden > 100


def test_every_second_window_holds_a_vehicle_of_a_wide_image() -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.zeros(3, 2000, 4000, dtype=torch.uint8)
    vehicle = torch.tensor(
        [[3950.0, 1980, 4001, 2000]]
    )  # at the corner, and labelled a little over the edge
    found = [
        len(window(image, vehicle, torch.zeros(0, 4), generator=generator)[1]) for _ in range(200)
    ]
    assert 70 < sum(found) < 130
    nothing = window(image, torch.zeros(0, 4), torch.zeros(0, 4), generator=generator)
    assert nothing[1].shape == (0, 4)


def test_a_batch_of_all_sizes_shows_windows_hides_cut_vehicles_and_repeats() -> None:
    wide = torch.full((3, 400, 700), 80, dtype=torch.uint8)
    # A row of vehicles, so close that every window of 384 px cuts one.
    row = torch.tensor([[left, 0.0, left + 30, 400.0] for left in range(0, 700, 31)])
    for left, _, right, _ in row.long().tolist():
        wide[:, :, left:right] = 250
    small = bar_images(1, seed=0)
    images = Dataset.of_images([wide, small.image(0)], [row, small.boxes[0]], gsd_m=0.125)
    batch, targets = training_batch(images, PLAIN, 5, 3)
    again, _ = training_batch(images, PLAIN, 5, 3)
    assert batch.shape == (2, 3, WINDOW_PX, WINDOW_PX)
    assert torch.equal(batch, again)
    assert not torch.equal(batch, training_batch(images, PLAIN, 5, 4)[0])
    for picture, boxes in zip(batch, targets, strict=True):
        if len(boxes):
            taught = torch.zeros(WINDOW_PX, WINDOW_PX, dtype=torch.bool)
            for left, top, right, bottom in boxes.long().tolist():
                taught[top:bottom, left:right] = True
            assert torch.equal(picture[0] > 0.9, taught)


def test_boxes_without_area_are_not_taught() -> None:
    images = bar_images(2, seed=3)
    out_of_sight = torch.tensor([[10.0, 10, 10, 20], [96, 0, 96, 0]])
    with_more = replace(images, boxes=[torch.cat([own, out_of_sight]) for own in images.boxes])
    for data in (images, with_more):
        batch, targets = training_batch(data, TrainingSettings(batch_size=2), 0, 0)
        if data is images:
            wanted = batch, targets
    assert torch.equal(batch, wanted[0])
    assert all(map(torch.equal, targets, wanted[1]))
