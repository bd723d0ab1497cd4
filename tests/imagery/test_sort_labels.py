"""Labels divided into vehicles and ignore regions: classes, border, points, cutting, by hand."""

import pytest
import torch

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import (
    ImageLabels,
    Label,
    cut_to_image,
    require_classes,
    sort_labels,
)


def label_of(name, *corners, **options):
    return Label(name, tuple((float(x), float(y)) for x, y in corners), **options)


def upright(name, left, top, right, bottom, **options):
    return label_of(name, (left, top), (right, top), (right, bottom), (left, bottom), **options)


def sort(*labels, classes=("car",), size_px=(100, 50), border_px=0.0, point_box_px=8.0):
    truths, ignored = sort_labels(
        labels, classes=classes, size_px=size_px, border_px=border_px, point_box_px=point_box_px
    )
    return truths.tolist(), ignored.tolist()


def test_named_classes_are_vehicles_and_all_others_ignore_regions():
    truths, ignored = sort(
        upright("car", 10, 10, 20, 14),
        upright("truck", 30, 10, 50, 18),
        upright("car", 60, 10, 70, 14, ignore=True),
        upright("van", 80, 10, 90, 14),
        classes=("car", "van"),
    )
    assert truths == [[10, 10, 20, 14], [80, 10, 90, 14]]
    assert ignored == [[30, 10, 50, 18], [60, 10, 70, 14]]


def test_an_oriented_box_becomes_the_upright_one_around_it():
    label = label_of("car", (20, 10), (26, 18), (22, 21), (16, 13))
    assert label.bounds == (16, 10, 26, 21)
    assert sort(label) == ([[16, 10, 26, 21]], [])


def test_points_become_boxes():
    assert sort(label_of("car", (30, 20)))[0] == [[26, 16, 34, 24]]
    # At the edge the box is cut, its centre still counts.
    assert sort(label_of("car", (2, 20)))[0] == [[0, 16, 6, 24]]


def test_boxes_are_cut_at_the_edge_and_count_where_their_centre_is():
    inside, outside, gone = (
        upright("car", -4, 5, 10, 9),
        upright("car", 95, 5, 106, 9),
        upright("car", 101, 5, 110, 9),
    )
    assert sort(inside, outside, gone) == ([[0, 5, 10, 9]], [[95, 5, 100, 9]])


def test_border_band():
    # Centres 9, 10 and 10.5 px from the edge of a band of 10 px.
    truths, ignored = sort(
        upright("car", 5, 20, 13, 24),
        upright("car", 6, 26, 14, 30),
        upright("car", 6.5, 32, 14.5, 36),
        border_px=10.0,
    )
    assert truths == [[6, 26, 14, 30], [6.5, 32, 14.5, 36]]
    assert ignored[0] == [5, 20, 13, 24]
    covered = torch.zeros(50, 100, dtype=torch.bool)
    for left, top, right, bottom in torch.tensor(ignored[1:]).int().tolist():
        covered[top:bottom, left:right] = True
    expected = torch.ones(50, 100, dtype=torch.bool)
    expected[10:40, 10:90] = False
    assert torch.equal(covered, expected)


@pytest.mark.parametrize("x", [9.5, 90.5])
@pytest.mark.parametrize("y", [9.5, 25.0, 40.5])
def test_the_band_runs_along_every_side(x, y):
    near = upright("car", x - 2, y - 2, x + 2, y + 2)
    across = upright("car", 48, y - 2, 52, y + 2)
    truths, _ = sort(near, across, border_px=10.0)
    assert truths == ([[48, 23, 52, 27]] if y == 25 else [])


def test_a_band_wider_than_the_image_ignores_all_of_it():
    truths, ignored = sort(upright("car", 40, 20, 50, 24), border_px=60.0)
    assert truths == []
    assert all(
        0 <= left < right <= 100 and 0 <= top < bottom <= 50 for left, top, right, bottom in ignored
    )


def test_no_labels():
    truths, ignored = sort_labels(
        [], classes=["car"], size_px=(10, 10), border_px=0.0, point_box_px=1.0
    )
    assert truths.shape == ignored.shape == (0, 4)


@pytest.mark.parametrize(
    ("label", "message"),
    [
        (upright("car", 100, 10, 111, 14), "outside its image of 100 x 50 px"),
        (upright("car", -9, 10, 0, 14), "outside"),
        (upright("car", 10, 50, 20, 60), "outside"),
        (label_of("car", (99, 10), (104, 12), (103, 16), (98, 14)), "outside"),
        (label_of("car", (101, 10)), "outside"),
    ],
)
def test_labels_outside_their_image_are_refused(label, message):
    with pytest.raises(ImageryError, match=f"here has a box {message}"):
        cut_to_image(label, (100, 50), "here")


def test_upright_boxes_are_cut_at_the_edge_of_their_image():
    label = upright("car", -8, 45, 32, 61)
    assert cut_to_image(label, (100, 50), "here") == upright("car", 0, 45, 32, 50)
    for whole in (
        # Rounding, and an oriented box.
        upright("car", -0.5, 10, 9, 50.2),
        label_of("car", (97, 10), (102, 12), (101, 16), (96, 14)),
    ):
        assert cut_to_image(whole, (100, 50), "here") == whole


def test_an_unknown_class_is_answered_with_those_there_are():
    labels = ImageLabels(("car", "bus"), {}, {})
    require_classes(labels, ["bus"], "labels")
    with pytest.raises(
        ImageryError, match="labels has no class 'lorry'; choose from those that it names: car, bus"
    ):
        require_classes(labels, ["car", "lorry"], "labels")
    with pytest.raises(ImageryError, match="labels has no classes 'cars', 'lorry'; choose"):
        require_classes(labels, ["cars", "car", "lorry"], "labels")
