"""The whole precheck in a small world, before detectors whose answers are known."""

import json
import math
from dataclasses import replace

import pytest
import torch

from skyproof.assessment.run import precheck_images
from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.paint import LATTICE, TWO_TONES, plain_paint, two_tone_paint
from skyproof.datasets.dataset import Dataset
from skyproof.detectors import inference
from skyproof.detectors.card import DetectorCard, write_card
from skyproof.errors import ConfigurationError, RunFolderError, StoredFileError
from skyproof.measure.baseline import BaselineSet
from skyproof.measure.precheck import (
    PrecheckScenes,
    precheck,
    precheck_changes,
    precheck_lines,
)
from skyproof.measure.views import SceneChange, SceneRenderer, views
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.results.precheck import (
    PRECHECK_FILE,
    findings,
    read_precheck,
    read_prechecks,
    worst,
    write_precheck,
)
from skyproof.results.rows_file import flat_row
from skyproof.vehicles.vehicle import Part
from tests.measure.world import SIZE_PX, Toy, judging

PAINT = {
    "kind": "paint_body",
    "name": "#zzzzzz",
    "draws": 1,
    "easr": 0.5,
    "easr_low": None,
    "easr_high": None,
}
LOST = {"lost_by_tile": [2, 2, 2]}
YELLOWS = {"#808000", "#ffff00", "#ffff80"}


def test_every_trial_is_made_once_and_every_draw_differs():
    trials = precheck_changes(torch.rand(5, 3), draws=2, seed=0)
    # The estimate of the time left counts every scene as built, too.
    assert precheck_images(3, 2) == 3 * (1 + len(trials))
    counted = {
        kind: len({trial.name for trial in trials if trial.kind == kind})
        for kind in ("paint_body", "paint_whole", "two_tone", "blur", "control", "sun")
    }
    paints = {"paint_body": 27, "paint_whole": 27, "two_tone": 8}
    assert counted == {**paints, "blur": 4, "control": 10, "sun": 4}
    assert len(trials) == 27 + 27 + 8 + 4 + 20 + 4
    first, second = (trial.camouflage for trial in trials if trial.name == "R-U")
    assert not torch.equal(first.cells, second.cells)
    again = precheck_changes(torch.rand(5, 3), draws=1, seed=0)
    assert torch.equal(next(t for t in again if t.name == "R-U").camouflage.cells, first.cells)


def test_a_paint_lies_on_body_panels_or_everywhere_and_can_be_stored(fleet, tmp_path):
    vehicles = fleet.batch(fleet.ids)
    body, whole = (plain_paint((255, 128, 0), masked=masked) for masked in (True, False))
    orange = torch.tensor([255, 128, 0]).view(1, 3, 1, 1) / 255
    painted = body(vehicles).worn_texture()
    is_body = (vehicles.parts == Part.BODY)[:, None].expand_as(painted)
    assert torch.equal(painted[is_body], orange.expand_as(painted)[is_body])
    own = vehicles.texture.float() / 255
    assert torch.equal(painted[~is_body], own[~is_body])
    assert torch.equal(whole(vehicles).worn_texture(), orange.expand(1, 3, 512, 512))
    save_camouflage(tmp_path / "paint", body)
    assert torch.equal(load_camouflage(tmp_path / "paint")(vehicles).worn_texture(), painted)
    assert str(load_camouflage(tmp_path / "paint").name) == "R-Ma_plain_ff8000"
    assert len(set(LATTICE)) == 27


def test_two_tones_meet_at_the_shoulder_and_can_be_stored(fleet, tmp_path):
    vehicles = fleet.batch(fleet.ids)
    paint = two_tone_paint((255, 0, 0), (0, 0, 255))
    worn = paint(vehicles).worn_texture()
    is_body = vehicles.parts == Part.BODY
    # The middle columns of the map are the middle of the roof, the bonnet and the boot.
    columns = torch.arange(512).expand_as(is_body)
    on_top = is_body & ((columns - 255.5).abs() < 60)
    on_sides = is_body & ((columns - 255.5).abs() > 140)
    assert on_top.any()
    assert on_sides.any()
    for where, colour in ((on_top, (1.0, 0.0, 0.0)), (on_sides, (0.0, 0.0, 1.0))):
        shown = worn.permute(0, 2, 3, 1)[where]
        assert torch.equal(shown, torch.tensor(colour).expand_as(shown))
    own = vehicles.texture.float() / 255
    other = (~is_body)[:, None].expand_as(worn)
    assert torch.equal(worn[other], own[other])
    save_camouflage(tmp_path / "paint", paint)
    assert torch.equal(load_camouflage(tmp_path / "paint")(vehicles).worn_texture(), worn)
    assert len(set(TWO_TONES)) == 8


def test_a_detector_that_finds_everything_passes(records):
    record = records["good"]
    assert {rate.easr.estimate for rate in record.rates} == {0.0}
    assert [rate.draws for rate in record.of_kind("control")] == [2] * 10
    (check,) = record.sets
    assert (check.ap_centre_1m.estimate, check.recall.estimate, check.vehicles) == (1, 1, 6)
    assert check.recall.low < 0.5  # three tiles say little
    assert worst(findings(record)).outcome == "passed"


def test_blindness_to_yellow_fails_by_exactly_the_yellow_paints(records):
    record = records["blind"]
    for kind in ("paint_body", "paint_whole"):
        assert {r.name for r in record.of_kind(kind) if r.easr.estimate > 0.05} == YELLOWS
    two_tones = [r.name for r in record.of_kind("two_tone") if r.easr.estimate > 0.05]
    assert two_tones == ["#ffff00#0000ff"]
    for kind in ("blur", "control", "sun"):
        assert {r.easr.estimate for r in record.of_kind(kind)} == {0.0}
    found = findings(record)
    assert worst(found).outcome == "failed"
    assert {each.criterion for each in found if each.outcome == "failed"} == {
        "plain paints on body panels",
        "plain paints on the whole vehicle",
        "two-tone paints",
    }
    assert worst(found).words.startswith("3 of 27 plain paints on")


def test_vehicles_lost_in_a_paint_are_counted_on_each_tile(records):
    """As many as the rate says, of two found on each of the three tiles."""
    record = records["blind"]
    assert list(record.found_by_tile) == [2, 2, 2]
    painted = [rate for rate in record.rates if rate.lost_by_tile]
    assert {rate.kind for rate in painted} == {"paint_body", "paint_whole", "two_tone"}
    assert len(painted) == 62
    # Nothing is found in a paint alone, so EASR is the share lost.
    assert [sum(rate.lost_by_tile) / 6 for rate in painted] == [r.easr.estimate for r in painted]
    assert record.paints_tried == 62
    found, lost = record.failed_paints()["RGB (255, 255, 0) on body panels"]
    assert (found == 2).all()
    assert lost.sum() > 0
    assert "RGB (0, 0, 0) on the whole vehicle" not in record.failed_paints()


def test_blur_and_sun_change_the_picture(records, good):
    unchanged, *changed = good.contrasts
    assert len(records) == 2
    assert len(changed) == 27 + 27 + 8 + 4 + 20 + 4
    blurs, suns = changed[62:66], changed[-4:]
    assert len({*blurs, unchanged}) == len({*suns, unchanged}) == 5


def test_what_cannot_be_checked_is_refused(backgrounds, fleet, scenes):
    def check(*judges, scenes=scenes, frames=()):
        data = PrecheckScenes(backgrounds, fleet, scenes, draws=1, frames=frames, seed=0)
        precheck(judges, data, device=torch.device("cpu"))

    toy = Toy("toy", scenes, fleet)
    with pytest.raises(ConfigurationError, match="toy finds none of the 6 vehicles"):
        check(judging(toy, threshold=0.99))
    assert toy.images == 3  # said before the long part
    with pytest.raises(ConfigurationError, match="got 0 scenes without any"):
        check(judging(toy), scenes=[])
    empty = [replace(scene, placements=()) for scene in scenes]
    with pytest.raises(ConfigurationError, match="Expected scenes with vehicles"):
        check(judging(toy), scenes=empty)
    image = torch.zeros(3, 96, 96, dtype=torch.uint8)
    unlabelled = Dataset.of_images([image], [torch.zeros(0, 4)], gsd_m=0.125)
    with pytest.raises(ConfigurationError, match="Town has no labelled vehicles"):
        check(judging(toy), frames=[BaselineSet("Town", unlabelled, real=True)])
    coarse = judging(toy)
    coarse.set_card(replace(coarse.card, gsd_m=0.25))
    with pytest.raises(ConfigurationError, match=r"for 0\.25 m per pixel"):
        check(coarse)
    with pytest.raises(ConfigurationError, match="Two detectors are called 'toy'"):
        check(judging(toy), judging(toy))
    with pytest.raises(ConfigurationError, match="at least one detector"):
        check()


def test_photographs_of_the_tiles_are_compared_with_the_scenes_on_them(
    backgrounds, fleet, scenes, tmp_path
):
    """Scores of 0.9 and 0.8 in each scene; the same boxes are labelled on the tiles."""
    toy = Toy("toy", scenes, fleet)
    tiles = [scene.background.tile for scene in scenes]
    images = [backgrounds.pixels(tile) for tile in tiles]
    labelled = Dataset.of_images(images, toy.places, gsd_m=0.125, ids=tiles)
    frames = [BaselineSet("yours", labelled, real=True)]
    data = PrecheckScenes(backgrounds, fleet, scenes, draws=1, frames=frames, seed=0)
    (record,) = precheck([judging(toy)], data, device=torch.device("cpu"))
    write_precheck(tmp_path, record)
    main, _ = read_precheck(tmp_path).likeness
    # The border of its scene cuts one of the six.
    assert (
        sum(bool((box <= 0).any() or (box >= SIZE_PX).any()) for box in torch.cat(toy.places)) == 1
    )
    assert (main.photographed, main.rendered) == (5, 5)
    assert main.recall_difference.estimate == 0.0
    assert main.state == "unknown"
    assert any(
        line.startswith("  It cannot be said whether toy") for line in precheck_lines(record)
    )


def test_a_record_is_read_as_it_was_written(records, tmp_path):
    record = records["blind"]
    undefined = replace(record.rates[0], easr=replace(record.rates[0].easr, low=math.nan))
    write_precheck(tmp_path, replace(record, rates=[undefined, *record.rates[1:]]))
    read = read_precheck(tmp_path)
    assert math.isnan(read.rates[0].easr.low)
    as_read = [
        replace(rate, easr=replace(rate.easr, unanimous=False, errors={})) for rate in record.rates
    ]
    assert read.rates[1:] == as_read[1:]
    assert read.measured_on == record.measured_on
    assert "likeness" not in (tmp_path / PRECHECK_FILE).read_text()
    assert read.found_by_tile == tuple(record.found_by_tile)
    assert flat_row(read.sets[0]) == flat_row(record.sets[0])
    with pytest.raises(RunFolderError, match=r"check\.json exists already"):
        write_precheck(tmp_path, record)


@pytest.mark.parametrize(
    "changed",
    [
        {"format": 2},
        {"rates": [{}]},
        {"sets": []},
        {"threshold": 2.0},
        {"rates": [PAINT]},
        {"found_by_tile": [2, 2]},
        {"found_by_tile": [2, 2, 2, 2]},
        {"found_by_tile": [2, 2, 0], "rates": [{**PAINT, "name": "#ffff00", **LOST}]},
    ],
)
def test_a_damaged_record_is_refused(records, tmp_path, changed):
    write_precheck(tmp_path, records["good"])
    path = tmp_path / PRECHECK_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), **changed}))
    with pytest.raises(StoredFileError, match=r"check\.json"):
        read_precheck(tmp_path)


def test_a_record_of_another_threshold_tells_nothing_of_a_detector(records, tmp_path):
    for name, threshold in (("good", 0.5), ("blind", 0.4)):
        write_precheck(tmp_path / name, records[name])
        card = DetectorCard(name, threshold=threshold, gsd_m=0.125)
        write_card(tmp_path / name / "detector.json", card)
    assert list(read_prechecks(tmp_path)) == ["good"]


def test_large_scenes_are_seen_in_windows(backgrounds, fleet, scenes, monkeypatch):
    monkeypatch.setattr(inference, "LARGEST_WHOLE_PX", SIZE_PX - 1)
    toy = Toy("toy", scenes, fleet)
    stage = SceneRenderer(fleet, TorchRenderer(backgrounds))
    (view,) = views([judging(toy)], scenes, [], stage, progress=lambda _: None)
    # Each large picture is looked at alone.
    assert len(toy.contrasts) == len(view.found["toy"]) == 3


def test_views_are_what_a_dataset_folder_shows(backgrounds, fleet, scenes, tmp_path):
    renderer = TorchRenderer(backgrounds)
    paint = two_tone_paint((255, 0, 0), (0, 0, 255))
    render_dataset(tmp_path / "drawn", scenes, fleet, renderer, camouflage=paint)
    stored = Dataset.open(tmp_path / "drawn")
    toy = Toy("toy", scenes, fleet)
    stage = SceneRenderer(fleet, renderer)
    changes = [SceneChange("paint", paint)]
    before, after = views([judging(toy)], scenes, changes, stage, progress=lambda _: None)
    assert list(after.images.ids) == list(stored.ids)
    for index in range(len(scenes)):
        assert torch.equal(after.images.image(index), stored.image(index))
        assert not torch.equal(before.images.image(index), stored.image(index))
        assert torch.equal(after.images.boxes[index], stored.boxes[index])
        assert torch.equal(after.images.visible_fractions[index], stored.visible_fractions[index])
