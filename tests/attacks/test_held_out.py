"""Scenes that no step sees: what hides there, and whether an attack has converged."""

import threading

import pytest
import torch

from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import BATCHES, HeldOut, Hidden, at_a_time
from skyproof.camouflage.folder import read_record
from skyproof.camouflage.paint import plain_paint
from skyproof.detectors.answers import BlackBoxDetector
from tests.attacks.test_kinds import FEW, BrightnessDetector, start, world
from tests.attacks.test_search import loaded

__all__ = ["world"]


class Told(HeldOut):
    """Gives these answers, one after the other, and remembers what it was shown."""

    def __init__(self, world, *hidden):
        super().__init__([loaded(0.6)], world, FEW.seed, 8)
        self.answers = list(hidden)
        self.shown = []

    def measure(self, camouflage, batches=BATCHES):
        self.shown.append((bool(camouflage.finished), camouflage.cells.detach().clone()))
        return Hidden(self.answers.pop(0), 0.0)


def learn(folder, world, held_out, *, name="T-PixFc", **more):
    attack(start(name), [BrightnessDetector()], world, FEW, folder, held_out=held_out, **more)
    return read_record(folder).get("convergence")


def test_dark_paint_hides_from_what_fires_where_it_is_bright(world):
    held_out = HeldOut([loaded(0.6)], world, FEW.seed, 8)
    black, white = (held_out.measure(plain_paint((level,) * 3, masked=False)) for level in (0, 255))
    assert black > white
    assert black.hidden > 0.5 > white.hidden
    assert held_out.scenes() == 64


def test_of_scenes_in_which_a_detector_found_nothing_before_nothing_is_hidden(world):
    held_out = HeldOut([loaded(0.6)], world, FEW.seed, 8)
    # It finds the vehicles of later batches alone.
    held_out.__dict__["_found"] = {"brightness": torch.arange(64) >= 16}
    assert held_out.measure(plain_paint((0, 0, 0), masked=False), 2).hidden == 0


def test_a_batch_is_as_large_as_asked_for_and_not_that_of_the_steps(world):
    held_out = HeldOut([loaded(0.6)], world, FEW.seed, 3)
    assert held_out.scenes() == 24
    assert held_out.scenes(2) == 6
    assert len(held_out._scores(None, BATCHES)["brightness"]) == 24


def test_of_several_detectors_it_is_the_mean(world):
    paint = plain_paint((100, 100, 100), masked=False)
    one, two = (HeldOut([loaded(t)], world, FEW.seed, 3).measure(paint).hidden for t in (0.3, 0.7))
    both = HeldOut([loaded(0.3), loaded(0.7, "dim")], world, FEW.seed, 3)
    assert one != two
    assert both.measure(paint).hidden == pytest.approx((one + two) / 2)


@pytest.mark.parametrize(("later", "converged"), [(0.42, True), (0.43, False), (0.2, True)])
def test_twice_the_steps_say_whether_an_attack_has_converged(tmp_path, world, later, converged):
    held_out = Told(world, 0.4, later)
    assert learn(tmp_path, world, held_out) == {
        "steps": [FEW.steps // 2, FEW.steps],
        "hidden": [0.4, later],
        "scenes": 64,
        "converged": converged,
    }
    # What is judged is finished, both times, and half-way it is another one.
    (half_way, early), (end, late) = held_out.shown
    assert half_way
    assert end
    assert not torch.equal(early, late)


def test_judging_half_way_changes_nothing_of_the_attack(tmp_path, world):
    learn(tmp_path / "judged", world, HeldOut([loaded(0.6)], world, FEW.seed, 1))
    assert learn(tmp_path / "alone", world, None) is None
    judged, alone = (
        (tmp_path / name / "camouflage.safetensors").read_bytes() for name in ("judged", "alone")
    )
    assert judged == alone


def test_what_was_hidden_half_way_outlives_a_kill(tmp_path, world):
    def kill(row):
        if row["step"] == FEW.steps - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path, world, Told(world, 0.4), on_step=kill)
    found = learn(tmp_path, world, Told(world, 0.5))
    assert found["hidden"] == [0.4, 0.5]


def test_of_a_random_search_nothing_is_asked(tmp_path, world):
    assert learn(tmp_path, world, Told(world), name="R-PixFc_search") is None


def test_networks_see_two_batches_at_a_time_and_the_scores_keep_their_order(
    monkeypatch, world, two_threads
):
    held_out = HeldOut([loaded(0.6)], world, FEW.seed, 2)
    alone = [held_out._scores(None, 2)["brightness"], held_out._scores(None, 8)["brightness"]]
    assert torch.equal(alone[0], alone[1][:4])
    both = threading.Barrier(2, timeout=20)
    candidates = BrightnessDetector.candidates

    def met(detector, images):
        both.wait()
        return candidates(detector, images)

    monkeypatch.setattr(BrightnessDetector, "candidates", met)
    assert torch.equal(held_out._scores(None, 8)["brightness"], alone[1])


def test_a_black_box_is_asked_by_the_callers_thread_alone(two_threads):
    asked = at_a_time(
        lambda number: (number, threading.current_thread() is threading.main_thread()),
        range(3),
        [BlackBoxDetector(lambda images: [])],
    )
    assert asked == [(0, True), (1, True), (2, True)]
