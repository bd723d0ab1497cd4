"""The steps of an assessment, and the frozen suite that it consists of."""

from dataclasses import replace
from pathlib import Path

import pytest

from skyproof.assessment.asking import Asked, Frozen, Query
from skyproof.assessment.assessment import Given, assessment_plan
from skyproof.assessment.enough import Enough
from skyproof.assessment.suite import read_suite, suite_digest
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.attack import Attack
from skyproof.cli.clear import Clear
from skyproof.cli.import_detector import Import
from skyproof.cli.precheck import Precheck
from skyproof.cli.report import Report
from skyproof.cli.score import Score
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS
from skyproof.errors import ConfigurationError

RUN = Path("run")
ASKED = {"accept": 0.2, "reject": 0.3, "producer_risk": 0.05, "consumer_risk": 0.05}
SUITE = read_suite()


def given(folder, **changes):
    detector = folder / "mine"
    detector.mkdir()
    settings = {
        "name": "mine",
        "detector": detector,
        "gsd_m": 0.1,
        "imagery": (Path("photos"),),
        "imagery_gsd_m": 0.1,
        "labels": Path("labels.json"),
        "label_classes": ("car",),
        "vehicle_classes": (),
        "architecture": None,
        "requirement": {},
        "seed": 3,
    }
    return Given(**{**settings, **changes})


def plan(asked):
    return assessment_plan(asked, SUITE, RUN)


def ids(asked):
    return [step.id for step in plan(asked).steps]


def only(asked, kind):
    (command,) = [step.command for step in plan(asked).steps if isinstance(step.command, kind)]
    return command


WORLD = ["vehicles/fleets", "scenes/test", "render/test", "check/detectors"]
LEARNT = [f"attack/{name}" for name in SUITE.attacks]


def test_imagery_labels_and_a_detector_folder(tmp_path):
    asked = given(tmp_path)
    steps = ids(asked)
    assert steps[:3] == ["ground/tiles", "threshold/mine", "clear/clear"]
    assert steps[3:7] == WORLD
    assert steps[7 : 7 + len(LEARNT)] == LEARNT
    assert steps[-1] == "report/report"
    frozen, checked = (step.command for step in plan(asked).steps if type(step.command) is Precheck)
    # The threshold is frozen on other tiles than those on which the detector is checked.
    assert frozen.frames == ("your imagery=run/tiles/validation@0.1",)
    assert frozen.freeze == "labels"
    assert checked.frames == ("your imagery=run/tiles/test@0.1",)
    assert frozen.frame_classes == checked.frame_classes == ("vehicle",)
    assert only(asked, Clear).detector == RUN / "detectors/mine"


def test_a_checkpoint_is_imported_on_the_labelled_tiles(tmp_path):
    file = tmp_path / "best.pt"
    file.touch()
    asked = given(tmp_path, detector=file, vehicle_classes=("car",))
    assert ids(asked)[:3] == ["ground/tiles", "import/mine", "clear/clear"]
    brought = only(asked, Import)
    assert (brought.kind, brought.validation) == ("ultralytics", RUN / "tiles/validation")
    named = replace(asked, architecture="retinanet_resnet50_fpn")
    assert only(named, Import).kind == "torchvision"


def test_without_labels_a_folder_keeps_its_threshold_and_a_checkpoint_learns_it_on_renders(
    tmp_path,
):
    asked = given(tmp_path, labels=None, label_classes=())
    assert ids(asked)[:3] == ["ground/tiles", "detector/mine", "clear/clear"]
    assert not any(getattr(step.command, "frames", ()) for step in plan(asked).steps)
    file = tmp_path / "best.pt"
    file.touch()
    checkpoint = replace(asked, detector=file, vehicle_classes=("car",))
    steps = ids(checkpoint)
    world = ["ground/threshold-ground", "vehicles/threshold-fleets"]
    world += ["scenes/threshold-validation", "render/threshold-validation"]
    assert steps[1:7] == [*world, "import/mine", "clear/clear"]


def test_without_imagery_ground_is_drawn(tmp_path):
    asked = given(tmp_path, imagery=(), imagery_gsd_m=None, labels=None, label_classes=())
    assert ids(asked)[:2] == ["ground/ground", "detector/mine"]
    assert ids(asked)[2:6] == WORLD


def test_a_requirement_counts_the_ground_first_and_reaches_the_report(tmp_path):
    asked = given(tmp_path, requirement=ASKED)
    steps = ids(asked)
    assert steps.index("size/size") == steps.index("scenes/test") + 1
    assert only(asked, Enough).reject == 0.3
    report = only(asked, Report)
    assert {key: getattr(report, key) for key in ASKED} == ASKED


def test_every_attack_is_scored_beside_its_controls(tmp_path):
    scored = [
        folder.name
        for step in plan(given(tmp_path)).steps
        if isinstance(step.command, Score)
        for folder in step.command.camouflages
    ]
    assert len(scored) == len(set(scored))
    for text in SUITE.attacks:
        name = CamouflageName.parse(text)
        assert text in scored
        assert {str(control) for control in name.unlearnt} <= set(scored)
        draws = [str(name.control.with_repeat(draw)) for draw in range(SUITE.draws)]
        assert set(draws) <= set(scored)


class Box:
    name = "mine"

    def detect(self, images):
        raise AssertionError("asked")


def boxed(tmp_path, **changes):
    asked = given(tmp_path, detector=None, gsd_m=0.125, **changes)
    return assessment_plan(asked, SUITE, RUN, Box()).steps


def test_a_black_box_is_asked_and_its_attacks_are_learnt_on_others(tmp_path):
    steps = boxed(tmp_path)
    order = [step.id for step in steps]
    assert order[:3] == ["ground/tiles", "threshold/mine", "clear/clear"]
    for text in SUITE.attacks:
        learnt = order.index(f"attack/{CamouflageName.parse(text).with_variant('transfer')}")
        assert order.index("teacher/retinanet") < learnt < order.index(f"ask/{text}")
    by_id = {step.id: step.command for step in steps}
    shape = by_id["ask/C-PixFc-seq@0.2"]
    assert shape.start == RUN / "camouflages/C-PixFc-seq@0.2_transfer"
    # The shape is learnt on the texture that was asked for, not on what was carried over.
    taught = by_id["attack/C-PixFc-seq@0.2_transfer"]
    assert taught.folder == RUN / "detectors/mine"
    assert taught.command.texture == RUN / "camouflages/T-PixFc"
    assert taught.command.detectors[0] == RUN / "teachers/detectors/retinanet"
    # Whatever needs the detector asks it; nothing looks for its weights.
    for step in steps:
        inner = step.command.command if isinstance(step.command, Asked) else step.command
        asks = isinstance(step.command, Asked | Frozen | Query)
        assert asks == isinstance(inner, Attack | Precheck | Clear | Score | Frozen | Query)
    searches = [id for id in order if id.endswith("_search")]
    assert searches
    assert all(id.startswith("ask/") for id in searches)
    scored = [
        folder.name
        for step in steps
        if step.kind == "score"
        for folder in step.command.command.camouflages
    ]
    assert {"T-U_transfer", "T-U_asked1500", "T-U_asked3000", "R-U_search_asked1500"} < set(scored)


def test_a_black_box_of_another_resolution_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"see 0\.125 m per pixel, got 0\.1"):
        assessment_plan(given(tmp_path, detector=None), SUITE, RUN, Box())


def test_gradients_are_compared_with_answers_where_the_teachers_see_the_same(tmp_path):
    order = ids(given(tmp_path, gsd_m=0.125))
    for text in SUITE.compared:
        assert f"attack/{text}_transfer" in order
        assert f"ask/{text}_asked" in order
    assert sum(id.startswith("ask/") for id in order) == len(SUITE.compared)


def test_cycles_adds_steps_and_changes_none(tmp_path):
    asked = given(tmp_path)
    more = [step.id for step in plan(replace(asked, cycles=True)).steps]
    assert [step for step in more if step in ids(asked)] == ids(asked)
    assert sorted(set(more) - set(ids(asked))) == ["render/test-cycles", "score/test-cycles"]


@pytest.mark.parametrize(
    ("gsd_m", "image_px", "attack_px"), [(0.125, 192, 128), (0.3, 96, 96), (0.05, 480, 320)]
)
def test_images_cover_the_same_ground_at_every_resolution(gsd_m, image_px, attack_px):
    assert SUITE.sizes(gsd_m).image_px == image_px
    assert SUITE.attack_px(gsd_m) == attack_px


def test_version_three_is_frozen():
    """Another suite is another version: numbers of one cannot be compared with the other's."""
    assert SUITE.version == 3
    assert suite_digest() == "0ec7a27fea5956d8913d15b025a53318350ec8f75c937b7d57bf1dc1d7722ef7"


def test_what_each_attack_reached_is_stored_with_the_suite():
    assert set(SUITE.expected) == set(REFERENCE_DETECTORS)
    for of_attack in SUITE.expected.values():
        assert tuple(of_attack) == SUITE.attacks
        assert all(0 < one.low < one.easr < one.high < 1 for one in of_attack.values())
