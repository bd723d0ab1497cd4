"""The paper's method: its objective, its weights, and what it leaves, beside skyproof's own."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from skyproof.attacks.attack import attack
from skyproof.attacks.making import Maker
from skyproof.attacks.objective import empty_truth_losses, objective, objective_and_gradient
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.errors import RunFolderError
from tests.attacks.test_kinds import FEW, PALETTE, BrightnessDetector, record, start, world

__all__ = ["world"]

PAPER = dataclasses.replace(FEW, method="paper", steps=3, keep_at=(1,))


class Sums(BrightnessDetector):
    """Its loss is the sum of an image, times a factor."""

    def __init__(self, name, factor):
        super().__init__()
        self.name, self.factor = name, factor

    def loss(self, images, targets):
        return self.factor * images.sum(dim=(1, 2, 3))


class Scaled(BrightnessDetector):
    name = "scaled"

    def loss(self, images, targets):
        return 300 * super().loss(images, targets).square()


def test_the_objective_is_the_weighted_sum_of_mean_losses_and_its_gradient_is_even():
    images = torch.stack([torch.full((3, 8, 8), level) for level in (0.5, 0.005)])
    detectors = [Sums("one", 1.0), Sums("two", 4.0)]
    weights = {"one": 0.25, "two": 0.5}
    found, gradient = objective_and_gradient(detectors, weights, images, 0.5, "paper")
    # The mean sum of an image is 192 * (0.5 + 0.005) / 2 = 48.48; the images are half a batch.
    assert found.loss == pytest.approx(0.5 * (0.25 + 0.5 * 4) * 48.48)
    # Every pixel of both images counts alike, however sure a detector is.
    assert torch.allclose(gradient, torch.full_like(gradient, 0.5 * (0.25 + 0.5 * 4) / 2))
    asked = objective(detectors, weights, images, "paper")
    assert asked.loss == pytest.approx((0.25 + 0.5 * 4) * 48.48)


def test_the_first_terms_are_equal_on_vehicles_in_the_camouflage_as_it_starts(tmp_path, world):
    detectors = [BrightnessDetector(), Scaled()]
    begun = start("T-PixFc")
    begun.paper_form_(True)
    scenes = [
        scene
        for batch in range(PAPER.balance_batches)
        for scene in world.step_scenes(PAPER.batch_size, PAPER.seed, -batch)
    ]
    with torch.no_grad():
        worn = empty_truth_losses(detectors, world.frames(begun, scenes).image)
        bare = empty_truth_losses(detectors, world.frames(None, scenes).image)
    for method, losses in (("paper", worn), ("skyproof", bare)):
        settings = dataclasses.replace(PAPER, method=method, steps=1)
        attack(start("T-PixFc"), detectors, world, settings, tmp_path / method)
        weights = record(tmp_path / method)["weights"]
        for name, each in losses.items():
            assert weights[name] * float(each.mean()) == pytest.approx(1.0, rel=1e-4), method
    other = record(tmp_path / "paper")["weights"]
    assert other["scaled"] != pytest.approx(weights["scaled"], rel=0.01)


@pytest.mark.parametrize("name", ["T-Lc", "T-PixMa", "S-O@0.4", "C-Fc-seq@0.2", "C-PixFc-par@0.2"])
def test_both_methods_leave_the_same_form(tmp_path, world, name):
    for method in ("paper", "skyproof"):
        settings = dataclasses.replace(PAPER, method=method)
        folder = tmp_path / method
        made = attack(start(name), [BrightnessDetector()], world, settings, folder)
        loaded = load_camouflage(folder)
        vehicles = world.fleet.batch(world.fleet.ids)
        assert torch.equal(loaded(vehicles).vertices, made(vehicles).vertices)
        assert torch.equal(loaded(vehicles).worn_texture(), made(vehicles).worn_texture())
        shape = getattr(loaded, "shape", loaded)
        if hasattr(shape, "reach"):
            assert 0 <= shape.reach.min() <= shape.reach.max() <= 1
            assert torch.equal(shape.reach, shape.map())
        stored = record(folder)["attack"]
        assert stored["settings"]["method"] == method
        assert ("log" in stored["objective"]) == (method == "skyproof")
    ours, theirs = (load_camouflage(tmp_path / each) for each in ("skyproof", "paper"))
    assert {key: value.shape for key, value in ours.state_dict().items()} == {
        key: value.shape for key, value in theirs.state_dict().items()
    }


def test_a_copy_after_the_last_step_is_the_finished_camouflage(tmp_path, world):
    settings = dataclasses.replace(PAPER, keep_at=(3,))
    done = attack(start("C-PixFc-par@0.2"), [BrightnessDetector()], world, settings, tmp_path)
    copied = load_camouflage(tmp_path / "snapshots" / "C-PixFc-par@0.2_step3")
    assert torch.equal(copied.texture.map(), done.texture.map())
    assert torch.equal(copied.shape.map(), done.shape.map())
    assert (copied.shape.map() != 0.5).any()


def test_an_attack_is_not_continued_by_another_method(tmp_path, world):
    def kill(row):
        if row["step"] == 2:
            raise KeyboardInterrupt

    whole = attack(start("C-PixFc-par@0.2"), [BrightnessDetector()], world, PAPER, tmp_path / "a")
    other = dataclasses.replace(PAPER, method="skyproof")
    killed = ([BrightnessDetector()], world)
    with pytest.raises(KeyboardInterrupt):
        attack(start("C-PixFc-par@0.2"), *killed, PAPER, tmp_path / "b", on_step=kill)
    for folder in (tmp_path / "a", tmp_path / "b"):
        with pytest.raises(RunFolderError, match=r"other settings.*move it away"):
            attack(start("C-PixFc-par@0.2"), *killed, other, folder)
    resumed = attack(start("C-PixFc-par@0.2"), *killed, PAPER, tmp_path / "b")
    for key, value in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[key], value), key


def test_optimised_colours_start_anywhere_and_fixed_ones_are_given(tmp_path, world):
    named = {name: CamouflageName.parse(name) for name in ("T-Fc", "T-PixLc", "T-Pix", "T-U")}
    takes = {
        method: [AttackSettings(method=method).takes_palette(name) for name in named.values()]
        for method in ("skyproof", "paper")
    }
    assert takes == {"skyproof": [True, True, True, False], "paper": [True, False, False, False]}
    settings = dataclasses.replace(PAPER, steps=1, keep_at=(), learning_rate=1e-6)
    maker = Maker([BrightnessDetector()], world, settings, torch.device("cpu"), PALETTE)
    maker.make(named["T-PixLc"], tmp_path / "T-PixLc", draws=2, texture=None)
    palette = load_camouflage(tmp_path / "T-PixLc").palette
    # None of the palette's colours is as saturated as some of these.
    assert (palette - PALETTE).abs().max() > 0.3


def test_a_search_has_the_objective_of_its_attack(tmp_path, world):
    settings = dataclasses.replace(PAPER, keep_at=())
    found = attack(start("R-PixFc_search"), [BrightnessDetector()], world, settings, tmp_path)
    assert bool(found.finished)
    rows = [json.loads(line) for line in Path(tmp_path, "steps.jsonl").read_text().splitlines()]
    for row in rows:
        assert row["loss"] == pytest.approx(
            row["weights"]["brightness"] * row["losses"]["brightness"], rel=1e-5
        )
