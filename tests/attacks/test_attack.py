"""The attack with stand-in detectors: it learns, resumes exactly, refuses what cannot work."""

import dataclasses
import itertools
import json
import math

import pytest
import torch
from torch import nn

from skyproof.attacks.attack import add_gradients, attack
from skyproof.attacks.objective import (
    OBJECTIVES,
    balanced_weights,
    empty_truth_losses,
    frozen,
    objective,
    objective_and_gradient,
)
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.errors import ConfigurationError, NotFiniteError, RunFolderError, StoredFileError
from skyproof.files import alone
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.settings import SceneSettings
from skyproof.storage import read_tensors, weights_digest
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

SCENES = SceneSettings(size_px=96, vehicles_maximum=1)
FEW = AttackSettings(
    steps=7, batch_size=2, balance_batches=2, preview_every=4, checkpoint_every=3, learning_rate=0.1
)


class StandIn(TrainableDetector):
    """Two convolutions; every answer above none raises the loss."""

    size = "slim"

    def __init__(self, name="one", seed=0, scale=1.0):
        super().__init__()
        self.name, self.scale = name, scale
        self.first, self.norm = nn.Conv2d(3, 6, 5, stride=2), nn.BatchNorm2d(6)
        self.second = nn.Conv2d(6, 1, 3)
        draw = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for weight in self.parameters():
                weight.copy_(torch.randn(weight.shape, generator=draw) * 0.3)

    def loss(self, images, targets):
        assert all(len(target) == 0 for target in targets)
        answers = self.second(torch.relu(self.norm(self.first(images)))).flatten(1)
        return self.scale * nn.functional.softplus(8 * answers).mean(1)


class Restless(StandIn):
    """A detector that counts its calls in a buffer."""

    def __init__(self):
        super().__init__("restless")
        self.register_buffer("calls", torch.zeros(1))

    def loss(self, images, targets):
        self.calls += 1
        return super().loss(images, targets)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    backgrounds = write_procedural_backgrounds(
        tmp_path_factory.mktemp("ground"), {"attack": 2}, 140, seed=0
    )
    fleet = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))
    return World(TorchRenderer(backgrounds), backgrounds, fleet, SCENES)


def start(seed=0):
    return make_camouflage("T-U", generator=torch.Generator().manual_seed(seed))


def rows(folder):
    return [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]


def without_seconds(folder):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows(folder)]


@torch.no_grad()
def mean_loss(camouflage, detectors, world):
    """On scenes that no attack in this file draws."""
    scenes = world.draw(8, generator=torch.Generator().manual_seed(12345))
    images = world.renderer(scenes, camouflage(placed_vehicles(world.fleet, scenes))).image
    return {
        name: float(loss.mean()) for name, loss in empty_truth_losses(detectors, images).items()
    }


def test_what_is_given_and_not_learnt_makes_another_attack(tmp_path, world):
    def fixed(level):
        palette = torch.tensor([[0.2, 0.2, 0.2], [level, level, level]])
        draw = torch.Generator().manual_seed(0)
        return make_camouflage("T-Fc", generator=draw, palette=palette)

    few = dataclasses.replace(FEW, steps=1)
    attack(fixed(0.8), [StandIn()], world, few, tmp_path)
    attack(fixed(0.8), [StandIn()], world, few, tmp_path)
    with pytest.raises(RunFolderError, match="other settings"):
        attack(fixed(0.4), [StandIn()], world, few, tmp_path)
    fleet = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(7))
    elsewhere = dataclasses.replace(world, fleet=fleet)
    with pytest.raises(RunFolderError, match="other settings"):
        attack(fixed(0.8), [StandIn()], elsewhere, few, tmp_path)


def test_an_attack_lowers_the_loss_of_every_detector_on_unseen_scenes(tmp_path, world):
    detectors = [StandIn("one", 0).eval(), StandIn("two", 1, scale=300.0).eval()]
    before = [weights_digest(detector) for detector in detectors]
    camouflage, seen = start(), []
    untouched = mean_loss(camouflage, detectors, world)
    settings = AttackSettings(
        steps=15, batch_size=4, learning_rate=0.1, balance_batches=2, preview_every=10
    )
    result = attack(camouflage, detectors, world, settings, tmp_path, on_step=seen.append)
    attacked = mean_loss(result, detectors, world)
    # Vehicles are a twentieth of the image. Other random maps hardly move the loss.
    control = mean_loss(start(seed=1), detectors, world)
    for name in untouched:
        assert abs(control[name] - untouched[name]) < 0.005 * untouched[name], (untouched, control)
        assert attacked[name] < 0.97 * untouched[name], (untouched, attacked)
    assert [weights_digest(detector) for detector in detectors] == before
    assert all(not detector.training for detector in detectors)

    table = rows(tmp_path)
    assert table == seen
    assert [row["step"] for row in table] == list(range(1, 16))
    # The weights bring both losses to 1 on vehicles without camouflage, though one is 300 times the
    # other (section 3.2).
    weights, first = table[0]["weights"], table[0]["losses"]
    for name in ("one", "two"):
        assert weights[name] * first[name] == pytest.approx(1.0, abs=0.35)
    for row in table:
        # The mean of logarithms is at most the logarithm of the mean.
        at_most = sum(math.log(weights[name] * row["losses"][name] + 0.03) for name in weights)
        assert at_most - 0.5 < row["loss"] <= at_most

    stored = load_camouflage(tmp_path)
    assert torch.equal(stored.cells, result.cells)
    assert torch.equal((stored.cells * 255).round() / 255, stored.cells)
    assert {path.name for path in tmp_path.iterdir()} == {
        "steps.jsonl",
        "previews",
        "texture.png",
        "camouflage.json",
        "camouflage.safetensors",
    }
    assert {path.name for path in (tmp_path / "previews").iterdir()} == {
        "000001.png",
        "000010.png",
        "000015.png",
    }


def test_a_killed_attack_goes_on_to_the_same_bits(tmp_path, world):
    whole = attack(start(), [StandIn()], world, FEW, tmp_path / "whole")

    def kill(row):
        if row["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attack(start(), [StandIn()], world, FEW, tmp_path / "killed", on_step=kill)
    assert not (tmp_path / "killed" / "camouflage.json").exists()
    # A kill between two files leaves rows of steps that the checkpoint does not know.
    with (tmp_path / "killed" / "steps.jsonl").open("a") as file:
        file.write(json.dumps({"step": 4}) + "\n")
    done = []
    resumed = attack(
        start(seed=9), [StandIn()], world, FEW, tmp_path / "killed", on_step=done.append
    )
    # The last checkpoint was after step 3; the parameters come from there, not from the caller.
    assert [row["step"] for row in done] == [4, 5, 6, 7]
    assert torch.equal(whole.cells, resumed.cells)
    assert without_seconds(tmp_path / "whole") == without_seconds(tmp_path / "killed")
    assert [row["step"] for row in rows(tmp_path / "killed")] == [1, 2, 3, 4, 5, 6, 7]

    # Both folders are finished now; a third call neither computes nor writes.
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "killed").rglob("*")}
    again = attack(start(seed=5), [StandIn()], world, FEW, tmp_path / "killed", on_step=kill)
    assert torch.equal(again.cells, whole.cells)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "killed").rglob("*")} == written
    with pytest.raises(RunFolderError, match="other settings"):
        attack(start(), [StandIn()], world, dataclasses.replace(FEW, seed=1), tmp_path / "killed")
    with pytest.raises(RunFolderError, match="other settings"):
        attack(start(), [StandIn("other")], world, FEW, tmp_path / "killed")

    (tmp_path / "killed" / "camouflage.safetensors").write_bytes(b"damaged")
    with pytest.raises(StoredFileError, match=r"camouflage\.safetensors"):
        attack(start(), [StandIn()], world, FEW, tmp_path / "killed")


def test_a_checkpoint_of_another_attack_or_a_damaged_one_is_refused(tmp_path, world, monkeypatch):
    def kill(row):
        if row["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attack(start(), [StandIn()], world, FEW, tmp_path, on_step=kill)
    other = dataclasses.replace(FEW, learning_rate=0.2)
    with pytest.raises(RunFolderError, match="other settings"):
        attack(start(), [StandIn()], world, other, tmp_path)
    # The same name with other weights is another detector.
    with pytest.raises(RunFolderError, match="other detectors"):
        attack(start(), [StandIn(seed=1)], world, FEW, tmp_path)
    # An attack that an earlier version began, which minimised something else.
    monkeypatch.setitem(OBJECTIVES, "skyproof", "the losses")
    with pytest.raises(RunFolderError, match="other settings"):
        attack(start(), [StandIn()], world, FEW, tmp_path)
    monkeypatch.undo()
    (tmp_path / "checkpoint.safetensors").write_bytes(b"damaged")
    with pytest.raises(StoredFileError, match=r"checkpoint\.safetensors"):
        attack(start(), [StandIn()], world, FEW, tmp_path)


def test_an_attack_does_not_depend_on_the_global_generator(tmp_path, world):
    short = dataclasses.replace(FEW, steps=2, balance_batches=1)
    torch.manual_seed(0)
    one = attack(start(), [StandIn()], world, short, tmp_path / "one")
    detector = StandIn()
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    two = attack(start(), [detector], world, short, tmp_path / "two")
    assert torch.equal(one.cells, two.cells)
    assert torch.equal(torch.random.get_rng_state(), before)
    other = attack(
        start(), [StandIn()], world, dataclasses.replace(short, seed=1), tmp_path / "three"
    )
    assert not torch.equal(one.cells, other.cells)


def test_colours_stay_within_bounds_at_every_step(tmp_path, world):
    camouflage, extremes = start(), []

    def look(row):
        extremes.append(
            (float(camouflage.cells.detach().min()), float(camouflage.cells.detach().max()))
        )

    fast = dataclasses.replace(FEW, steps=2, learning_rate=0.8, balance_batches=1)
    attack(camouflage, [StandIn()], world, fast, tmp_path, on_step=look)
    assert all(low >= 0 and high <= 1 for low, high in extremes)
    assert extremes[-1] == (0.0, 1.0)


def test_weights_bring_mean_first_losses_to_one():
    assert balanced_weights({"a": [2.0, 4.0], "b": [0.001]}) == pytest.approx(
        {"a": 1 / 3, "b": 1000.0}
    )


def test_losses_are_per_image_and_per_detector():
    images = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    losses = empty_truth_losses([StandIn("one").eval(), StandIn("two", 1).eval()], images)
    assert {name: tuple(value.shape) for name, value in losses.items()} == {
        "one": (3,),
        "two": (3,),
    }
    assert not torch.equal(losses["one"], losses["two"])


def test_the_objective_weighs_images_up_in_which_a_detector_is_nearly_fooled():
    class Sums(StandIn):
        """Its loss is an image's sum, so that every pixel changes it alike."""

        def loss(self, images, targets):
            return images.sum(dim=(1, 2, 3))

    images = torch.stack([torch.full((3, 8, 8), level) for level in (0.5, 0.005)])
    detectors = [Sums("one"), Sums("two", 1)]
    weights = {"one": 1 / 96, "two": 0.5 / 96}
    found, gradient = objective_and_gradient(detectors, weights, images)
    assert found.losses == pytest.approx({"one": 48.48, "two": 48.48})
    # Weight times loss: 1 and 0.01 before one detector, 0.5 and 0.005 before the other.
    terms = [math.log(share + 0.03) for share in (1, 0.01, 0.5, 0.005)]
    assert found.loss == pytest.approx(sum(terms) / 2, rel=1e-5)
    slopes = [
        sum(0.5 * weight / (weight * 192 * level + 0.03) for weight in weights.values())
        for level in (0.5, 0.005)
    ]
    assert gradient[:, 0, 0, 0].tolist() == pytest.approx(slopes, rel=1e-5)
    assert gradient[1, 0, 0, 0] > 20 * gradient[0, 0, 0, 0]
    asked = objective(detectors, weights, images)
    assert asked.loss == pytest.approx(found.loss)
    assert asked.losses == pytest.approx(found.losses)


@pytest.mark.parametrize("batch_size", [1, 4, 5])
def test_the_gradient_of_the_halves_is_that_of_the_batch(world, batch_size):
    camouflage, detectors = start(), [StandIn("one").eval(), StandIn("two", 1).eval()]
    weights = {"one": 1.5, "two": 0.7}
    scenes = world.step_scenes(batch_size, 0, 1)
    found = []
    threads = torch.get_num_threads()
    for count in (1, 2):
        torch.set_num_threads(count)
        try:
            with frozen(detectors):
                now, shown = add_gradients(camouflage, detectors, weights, world, scenes)
        finally:
            torch.set_num_threads(threads)
        found.append((now, camouflage.cells.grad))
        camouflage.cells.grad = None
    assert found[0][0] == found[1][0]
    assert torch.equal(found[0][1], found[1][1])
    images = world.frames(camouflage, scenes).image
    torch.testing.assert_close(torch.cat([frames.image for frames in shown]), images.detach())
    whole, gradient = objective_and_gradient(detectors, weights, images)
    images.backward(gradient)
    assert found[0][0].loss == pytest.approx(whole.loss, rel=1e-5)
    assert found[0][0].losses == pytest.approx(whole.losses, rel=1e-5)
    difference = (camouflage.cells.grad - found[0][1]).norm()
    assert difference < 1e-5 * camouflage.cells.grad.norm()


def test_a_detector_whose_loss_falls_below_zero_is_refused(tmp_path, world):
    class Likelihood(StandIn):
        def loss(self, images, targets):
            return super().loss(images, targets) - 10

    with pytest.raises(ConfigurationError, match=r"one is -.*never below"):
        attack(start(), [Likelihood("one")], world, FEW, tmp_path)
    assert not (tmp_path / "steps.jsonl").exists()


def test_frozen_puts_detectors_into_evaluation_without_weight_gradients():
    detector = StandIn().train()
    with frozen([detector]):
        assert not detector.training
        assert not any(weight.requires_grad for weight in detector.parameters())
        detector.loss(torch.rand(2, 3, 48, 48), [torch.zeros(0, 4)] * 2)


def test_frozen_notices_a_changed_buffer_or_weight():
    detector = StandIn()
    with pytest.raises(RuntimeError, match="one changed"), frozen([detector]):
        detector.norm.running_mean += 1e-3
    with pytest.raises(RuntimeError, match="one changed"), frozen([detector]):
        detector.first.weight[0, 0, 0, 0] += 1e-6


def test_an_attack_on_a_detector_that_changes_is_no_result(tmp_path, world):
    short = dataclasses.replace(FEW, steps=1, balance_batches=1)
    with pytest.raises(RuntimeError, match="restless"):
        attack(start(), [Restless()], world, short, tmp_path)
    assert not (tmp_path / "camouflage.json").exists()


def test_a_renderer_without_gradients_is_refused(world):
    renderer = TorchRenderer(world.backgrounds)
    renderer.differentiable = False
    with pytest.raises(ConfigurationError, match="differentiable"):
        dataclasses.replace(world, renderer=renderer)


@pytest.mark.parametrize(("minimum", "maximum"), [(2, 2), (1, 2), (0, 1)])
def test_an_attack_has_exactly_one_vehicle_per_image(world, minimum, maximum):
    scenes = SceneSettings(size_px=96, vehicles_minimum=minimum, vehicles_maximum=maximum)
    with pytest.raises(ConfigurationError, match="one vehicle"):
        dataclasses.replace(world, scenes=scenes).step_scenes(1, 0, 1)


@pytest.mark.parametrize(
    "changed",
    [
        {"steps": 0},
        {"batch_size": 0},
        {"balance_batches": 0},
        {"preview_every": 0},
        {"checkpoint_every": 0},
        {"learning_rate": 0.0},
        {"learning_rate": float("inf")},
        {"learning_rate": 1e300},
        {"steps": 10**9},
        {"keep_at": (0,)},
        {"keep_at": (401,)},
        {"seed": 2**63},
        {"method": "literal"},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_settings_that_cannot_work_are_refused(changed):
    with pytest.raises(ConfigurationError):
        AttackSettings(**changed)


@pytest.mark.parametrize(
    ("steps", "batch_size", "of_search"),
    [(200, 4, (100, 8)), (100, 32, (100, 32)), (3, 2, (1, 6)), (5, 4, (2, 8))],
)
def test_a_search_has_the_same_images_in_larger_batches(steps, batch_size, of_search):
    settings = AttackSettings(steps=steps, batch_size=batch_size, keep_at=(1,), seed=5)
    searched = settings.of_search()
    assert (searched.steps, searched.batch_size) == of_search
    assert (searched.keep_at, searched.seed) == ((), 5)


@pytest.mark.parametrize("seed", [-1, -(2**63), 2**63 - 1])
def test_any_seed_of_64_bits_works(tmp_path, world, seed):
    settings = dataclasses.replace(FEW, steps=1, seed=seed)
    made = attack(start(), [StandIn()], world, settings, tmp_path)
    assert made.cells.isfinite().all()


class Breaking(StandIn):
    """A detector whose loss, or its gradient alone, is no number from some call on."""

    def __init__(self, first_bad, what="loss"):
        super().__init__("breaking")
        self.calls, self.first_bad, self.what = itertools.count(1), first_bad, what

    def loss(self, images, targets):
        call = next(self.calls)
        loss = super().loss(images, targets)
        if call < self.first_bad:
            return loss
        if self.what == "loss":
            return loss * float("nan")
        if loss.requires_grad:
            loss.register_hook(lambda gradient: gradient * float("nan"))
        return loss


@pytest.mark.parametrize(
    ("first_bad", "what", "said"),
    [
        (1, "loss", "loss of the detector breaking is nan"),
        # Two calls balance the losses, and each step takes two, one for each half of its batch.
        (11, "loss", "is nan at step 5; attack again in another folder"),
        (13, "gradient", "What step 6 left .* begin again in another folder"),
    ],
)
def test_what_is_not_finite_stops_an_attack_and_is_not_stored(
    tmp_path, world, first_bad, what, said
):
    with pytest.raises(NotFiniteError, match=said):
        attack(start(), [Breaking(first_bad, what)], world, FEW, tmp_path)
    assert not (tmp_path / "camouflage.json").exists()
    if first_bad > 1:
        tensors, record = read_tensors(tmp_path / "checkpoint.safetensors", "")
        assert record["step"] == 3
        assert all(value.isfinite().all() for value in tensors.values())


def test_two_attacks_do_not_share_a_folder(tmp_path, world):
    def work():
        raise AssertionError("worked beside somebody else")

    with alone(tmp_path), pytest.raises(RunFolderError, match="being written by another process"):
        attack(start(), [StandIn()], world, FEW, tmp_path, record=work)
    assert not list(tmp_path.iterdir())
