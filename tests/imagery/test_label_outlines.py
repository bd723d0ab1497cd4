"""Outlines and masks in labels: COCO without boxes, polygons of YOLO."""

import numpy as np
import pytest
import torch
from faster_coco_eval import mask as coco_masks
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skyproof.datasets.coco import encode_rle
from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import read_labels
from tests.imagery.made import written

CAR = {"id": 1, "name": "car"}
BOX = ((20.0, 10.0), (60.0, 10.0), (60.0, 40.0), (20.0, 40.0))


def outlined(segmentation, size_px=(200, 100), **more):
    """A COCO document with one object, which has no box."""
    width, height = size_px
    image = {"id": 3, "file_name": "one.png", "width": width, "height": height}
    row = {"id": 5, "image_id": 3, "category_id": 1, "segmentation": segmentation} | more
    return {"categories": [CAR], "images": [image], "annotations": [row]}


def refused(error, where):
    assert where in str(error)


def label_of(path, document):
    (label,) = read_labels(written(path, document)).images["one"]
    return label


def test_an_empty_box_counts_as_missing(tmp_path):
    document = outlined([[20, 10, 60, 20, 40, 40]], bbox=[])
    assert label_of(tmp_path / "x.json", document).corners == BOX


@pytest.mark.parametrize(
    ("segmentation", "corners"),
    [
        ([[20, 10, 60, 10, 60, 40, 20, 40]], BOX),
        ([[40, 0, 60, 20, 40, 40, 20, 20]], ((40, 0), (60, 20), (40, 40), (20, 20))),
        ([[20, 10, 60, 20, 40, 40]], BOX),
        ([[20, 10, 25, 10, 25, 12], [50, 30, 60, 30, 60, 40, 50, 40]], BOX),
    ],
)
def test_outlines(tmp_path, segmentation, corners):
    label = label_of(tmp_path / "x.json", outlined(segmentation))
    assert label.corners == corners
    assert not label.ignore


def test_a_box_comes_before_an_outline(tmp_path):
    for outline in ([[0, 0, 1, 0, 1, 1]], [], "", None, {"counts": 7}):
        document = outlined(outline, bbox=[20, 10, 40, 30])
        assert label_of(tmp_path / "x.json", document).corners == BOX


def test_the_mask_of_a_crowd_is_an_ignore_region(tmp_path):
    pixels = torch.zeros(100, 200, dtype=torch.bool)
    pixels[10:40, 20:60] = True
    label = label_of(tmp_path / "x.json", outlined(encode_rle(pixels), iscrowd=1))
    assert label.corners == BOX
    assert label.ignore


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        (None, "annotation 5 has neither a bbox nor a segmentation"),
        ([], "annotation 5 has a segmentation that is not"),
        ([[1, 2, 3, 4]], "annotation 5 has a segmentation that is not lists of x1, y1"),
        ([[1, 2, 3, 4, 5, 6, 7]], "annotation 5 has a segmentation that is not"),
        ([[1, 2, 3, 4, 5, "6"]], r"annotation 5, segmentation\[0\]\[5\]: expected a number"),
        ([[1, 2, 3, 2, 5, 2]], r"1 of 1 boxes .* \(first: annotation 5\)"),
        ([[300, 2, 310, 2, 310, 9]], "annotation 5 has a box outside its image"),
        ("words", "annotation 5, segmentation: expected"),
        ({"size": [100, 200]}, "segmentation: the field counts is missing"),
        ({"size": [100, 200], "counts": [5, 5]}, "run lengths do not fill 200 x 100 px"),
        ({"size": [100, 200], "counts": [20000]}, "1 of 1 boxes .* have no width or height"),
        ({"size": [100, 200], "counts": [-5, 20005]}, r"counts\[0\]: expected a whole number >= 0"),
        (
            {"size": [200, 100], "counts": [5, 19995]},
            "has a mask of 100 x 200 px but its image 200",
        ),
        ({"size": [100, 200], "counts": "o"}, "run lengths cannot be decoded"),
        ({"size": [100, 200], "counts": "o" * 14}, "run lengths cannot be decoded"),
        ({"size": [100, 200], "counts": "5 5"}, "run lengths cannot be decoded"),
        ({"size": [100, 200], "counts": "O"}, "run lengths cannot be decoded"),
    ],
)
def test_bad_outlines(tmp_path, segmentation, message):
    with pytest.raises(ImageryError, match=message):
        label_of(tmp_path / "x.json", outlined(segmentation))


_SIDES = st.integers(1, 40)


@settings(max_examples=200, deadline=None)
@given(st.tuples(_SIDES, _SIDES).flatmap(lambda shape: arrays(bool, shape)), st.booleans())
def test_masks_have_the_boxes_of_another_reader(tmp_path_factory, pixels, compressed):
    path = tmp_path_factory.getbasetemp() / "mask.json"
    theirs = coco_masks.encode(np.asfortranarray(pixels.astype(np.uint8)))
    size_px = pixels.shape[::-1]
    runs = encode_rle(torch.from_numpy(pixels))
    if compressed:
        runs = {"size": [*pixels.shape], "counts": theirs["counts"].decode()}
    if not pixels.any():
        with pytest.raises(ImageryError, match="have no width or height"):
            label_of(path, outlined(runs, size_px))
        return
    left, top, right, bottom = label_of(path, outlined(runs, size_px)).bounds
    rows, columns = pixels.any(1).nonzero()[0], pixels.any(0).nonzero()[0]
    assert (left, top, right, bottom) == (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    assert [left, top, right - left, bottom - top] == coco_masks.toBbox(theirs).tolist()


_LETTERS = st.text(st.characters(min_codepoint=40, max_codepoint=120), max_size=30)
_COUNTS = st.one_of(_LETTERS, st.lists(st.integers(-3, 9), max_size=9))


@settings(max_examples=300, deadline=None)
@given(counts=_COUNTS)
def test_any_run_lengths_are_read_or_refused_with_a_sentence(tmp_path_factory, counts):
    path = tmp_path_factory.getbasetemp() / "counts.json"
    document = outlined({"size": [4, 4], "counts": counts}, (4, 4))
    try:
        left, top, right, bottom = label_of(path, document).bounds
    except ImageryError as error:
        refused(error, "annotation 5")
    else:
        assert 0 <= left < right <= 4
        assert 0 <= top < bottom <= 4
