"""The steps of a demo: on detectors that come trained, and on those that it trains."""

from pathlib import Path

import pytest

from skyproof.assessment.demo import Demo, DemoSizes, demo_plan
from skyproof.cli.attack import Attack
from skyproof.cli.ground import Ground
from skyproof.cli.precheck import Precheck
from skyproof.cli.reference import Reference
from skyproof.cli.score import Score
from skyproof.cli.vehicles import Vehicles
from skyproof.layout import Layout

RUN = Path("run")
WORLD = ["ground/ground", "vehicles/fleets"]
CHOSEN = [
    *("R-U_plain", "R-U_best", "R-U_search"),
    *("R-Ma_plain", "R-PixFcMa_best", "R-PixFcMa_search"),
]
JUDGED = [
    *("attack/T-U", "attack/T-PixFcMa"),
    *(f"choose/{name}" for name in CHOSEN),
    *("control/random", "score/test", "report/report"),
]


def commands(demo, kind):
    return [s.command for s in demo_plan(demo, Layout(RUN)).steps if isinstance(s.command, kind)]


def steps(**given):
    return [step.id for step in demo_plan(Demo(out=RUN, **given), Layout(RUN)).steps]


def test_without_training_only_the_test_images_are_drawn():
    took = ["reference/retinanet", "reference/faster_rcnn"]
    assert steps() == [*took, *WORLD, "scenes/test", "render/test", *JUDGED]
    demo = Demo(out=RUN)
    assert commands(demo, Ground)[0].tiles == (1, 1, 24, 40)
    assert commands(demo, Vehicles)[0].counts == (1, 1, 32, 32)
    copied = commands(demo, Reference)
    assert [command.detectors for command in copied] == [("retinanet",), ("faster_rcnn",)]
    assert {(command.out, command.check) for command in copied} == {(RUN / "detectors", True)}


def test_controls_are_chosen_where_there_are_any():
    demo = Demo(out=RUN)
    searched = next(c for c in commands(demo, Attack) if c.names == ("R-PixFcMa_search",))
    assert searched.settings == next(
        command.settings for command in commands(demo, Attack) if command.names == ("T-PixFcMa",)
    )
    best = [c.draws for c in commands(demo, Attack) if c.names[0].endswith("_best")]
    assert best == [32, 32]
    (score,) = commands(demo, Score)
    scored = [folder.name for folder in score.camouflages]
    assert scored[:8] == ["T-U", "T-PixFcMa", *CHOSEN]
    (_, path_traced) = commands(Demo(out=RUN, cycles=True), Score)
    assert [folder.name for folder in path_traced.camouflages] == ["T-U", "T-PixFcMa", *CHOSEN]
    none = Demo(out=RUN, sizes=DemoSizes(random_draws=0))
    assert [c.names for c in commands(none, Attack)] == [("T-U",), ("T-PixFcMa",)]


def test_with_training_everything_is_made():
    names = ("retinanet", "faster_rcnn", "yolov5")
    splits = ("train", "validation", "test")
    assert steps(train=True) == [
        *WORLD,
        *(f"scenes/{split}" for split in splits),
        *(f"render/{split}" for split in splits),
        *(f"train/{name}" for name in names),
        "check/detectors",
        *JUDGED,
    ]
    demo = Demo(out=RUN, train=True)
    assert commands(demo, Ground)[0].tiles == (64, 12, 24, 40)
    assert commands(demo, Precheck)[0].scenes_count == 12


@pytest.mark.parametrize(
    "own",
    [{"imagery": (Path("a.tif"),)}, {"frames": ("kit/MOS*@0.116",)}],
    ids=["ground", "frames"],
)
def test_what_was_found_on_procedural_ground_is_left_out_where_there_is_other(own):
    demo = Demo(out=RUN, **own)
    assert "check/detectors" in steps(**own)
    assert not any(command.check for command in commands(demo, Reference))
    (check,) = commands(demo, Precheck)
    assert check.frames == demo.frames
    assert check.scenes_count == 12
    # Who wants no check keeps what was found before.
    without = Demo(out=RUN, sizes=DemoSizes(check_scenes=0), **own)
    assert not commands(without, Precheck)
    assert all(command.check for command in commands(without, Reference))


def test_a_check_that_is_asked_for_is_made():
    demo = Demo(out=RUN, sizes=DemoSizes(check_scenes=5))
    assert commands(demo, Precheck)[0].scenes_count == 5
    assert not any(command.check for command in commands(demo, Reference))


@pytest.mark.parametrize(("image_px", "attack_px"), [(160, 128), (100, 100)])
def test_reference_detectors_are_attacked_in_small_images(image_px, attack_px):
    sizes = DemoSizes(image_px=image_px)
    learnt = [
        command.image_px
        for command in commands(Demo(out=RUN, sizes=sizes), Attack)
        if command.detectors
    ]
    assert learnt == [attack_px] * 8
    trained = commands(Demo(out=RUN, sizes=sizes, train=True), Attack)
    assert trained[0].image_px == image_px
