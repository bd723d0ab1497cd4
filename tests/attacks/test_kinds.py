"""Every kind of attack: it learns, resumes, counts what rounding cost, has the right gradient."""

import dataclasses
import json

import pytest
import torch

from skyproof.attacks.attack import attack
from skyproof.attacks.making import sign_test
from skyproof.attacks.objective import target_scores
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.detectors.detector import Candidates, TrainableDetector
from skyproof.errors import ConfigurationError
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles
from skyproof.render.frames import Frames
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

PALETTE = (
    torch.tensor([[10, 10, 10], [60, 80, 40], [120, 110, 90], [200, 190, 170], [250, 20, 51]]) / 255
)
# Blocks, colours and mask: every pair of choices is in one of these.
TEXTURES = ["T-U", "T-PixLc", "T-PixFcMa", "T-LcMa", "T-Fc", "T-PixMa"]
KINDS = [
    *TEXTURES,
    "S-O@0.4",
    "S-O@1.0",
    "C-Fc-seq@0.2",
    "C-PixFcMa-seq@0.2",
    "C-PixFc-par@0.2",
    "C-Lc-par@0.3",
]
FEW = AttackSettings(
    steps=6, batch_size=2, balance_batches=2, preview_every=9, checkpoint_every=2, learning_rate=0.1
)


class BrightnessDetector(TrainableDetector):
    """Fires where 8 x 8 pixels are brighter than usual: paint it dark or flatten it."""

    name, size = "brightness", "slim"

    def __init__(self):
        super().__init__()
        self.register_buffer("kernel", torch.full((1, 3, 8, 8), 1 / 192))

    def answers(self, images):
        return torch.sigmoid(
            12 * (torch.nn.functional.conv2d(images, self.kernel, stride=4) - 0.45)
        )

    def loss(self, images, targets):
        return self.answers(images).flatten(1).mean(1)

    def candidates(self, images):
        answers = self.answers(images)
        rows, columns = torch.meshgrid(
            *(torch.arange(n) * 4.0 for n in answers.shape[2:]), indexing="ij"
        )
        boxes = (
            torch.stack((columns, rows, columns + 8, rows + 8), dim=-1)
            .view(1, -1, 4)
            .expand(len(images), -1, -1)
        )
        scores = answers.flatten(1)
        return Candidates(boxes, scores)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    backgrounds = write_procedural_backgrounds(
        tmp_path_factory.mktemp("ground"), {"attack": 2}, 140, seed=0
    )
    fleet = sample_fleet(FleetSettings(count=3), generator=torch.Generator().manual_seed(0))
    scenes = SceneSettings(size_px=96, vehicles_maximum=1)
    return World(TorchRenderer(backgrounds), backgrounds, fleet, scenes)


def start(name, seed=0, turn_steps=2):
    parsed = CamouflageName.parse(name)
    texture = None
    if parsed.order == "seq":
        texture = start(f"T-{parsed.constraints.name}", seed)
        texture.finalise()
    return make_camouflage(
        name,
        generator=torch.Generator().manual_seed(seed),
        palette=PALETTE,
        texture=texture,
        settings=CamouflageSettings(turn_steps=turn_steps),
    )


def record(folder):
    return json.loads((folder / "camouflage.json").read_text())["record"]


@torch.no_grad()
def mean_loss(camouflage, world):
    scenes = world.draw(12, generator=torch.Generator().manual_seed(12345))
    images = world.renderer(scenes, camouflage(placed_vehicles(world.fleet, scenes))).image
    return float(BrightnessDetector().loss(images, []).mean())


@pytest.mark.parametrize(
    "name", ["T-PixLc", "T-PixFcMa", "S-O@1.0", "C-PixFcMa-seq@0.2", "C-Lc-par@0.3"]
)
def test_every_part_hides_vehicles_better_than_at_its_start(tmp_path, world, name):
    settings = dataclasses.replace(FEW, steps=8, batch_size=3)
    before = start(name)
    before.finalise()
    learnt = attack(start(name), [BrightnessDetector()], world, settings, tmp_path)
    assert mean_loss(learnt, world) < mean_loss(before, world)


@pytest.mark.parametrize("name", KINDS)
def test_one_step_along_the_gradient_lowers_the_score_on_the_target(world, name):
    camouflage = start(name)
    state = {key: value.clone() for key, value in camouflage.state_dict().items()}
    settings = dataclasses.replace(FEW, batch_size=6, balance_batches=3)
    found = sign_test(camouflage, [BrightnessDetector()], world, settings)["brightness"]
    assert found["scenes"] == 18
    assert found["mean_change"] < 0
    # A shape step lifts few edges at first; where a bright spot stays on top no score changes.
    if name.startswith("T-"):
        assert found["p"] < 0.001, found
    assert all(torch.equal(value, state[key]) for key, value in camouflage.state_dict().items())


def test_the_sign_test_notices_a_reversed_gradient(world):
    class Reversed(BrightnessDetector):
        def loss(self, images, targets):
            return 1.0 - super().loss(images, targets)

    found = sign_test(start("T-Pix"), [Reversed()], world, FEW)["brightness"]
    assert found["mean_change"] > 0
    assert found["p"] > 0.5


def test_the_score_on_the_target_is_the_best_within_a_metre(world):
    class Fixed(TrainableDetector):
        name, size = "fixed", "slim"

        def candidates(self, images):
            boxes = torch.tensor(
                [[[40.0, 40, 60, 60], [47, 40, 67, 60], [60, 40, 80, 60], [40, 40, 60, 60]]]
            )
            return Candidates(boxes, torch.tensor([[0.3, 0.5, 0.9, 0.0]]))

    one = torch.zeros(1)
    box, centre = torch.tensor([[40.0, 40, 60, 60]]), torch.tensor([[50.0, 50]])
    frames = Frames(torch.zeros(1, 3, 96, 96), one.long(), box, centre, one, one)
    # 7 px of 12.5 cm are within 1 m, 20 px are not; the last row is padding.
    assert target_scores(Fixed(), frames, 0.125).tolist() == [0.5]
    assert target_scores(Fixed(), frames, 0.2).tolist() == pytest.approx([0.3])
    # The lenient rule also takes a centre in the box, which here is larger than a metre.
    assert target_scores(Fixed(), frames, 0.2, "centre_in_box").tolist() == pytest.approx([0.5])
    wide = dataclasses.replace(frames, boxes=box + torch.tensor([-20.0, -20, 20, 20]))
    assert target_scores(Fixed(), wide, 0.125, "centre_in_box").tolist() == pytest.approx([0.9])


@pytest.mark.parametrize(
    "name", ["T-PixLcMa", "S-O@0.4", "C-PixFc-par@0.2", "C-PixFc-seq@0.2", "R-PixLc_search"]
)
def test_a_killed_attack_goes_on_to_the_same_bits(tmp_path, world, name):
    whole = attack(start(name), [BrightnessDetector()], world, FEW, tmp_path / "whole")

    def kill(row):
        if row["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attack(start(name), [BrightnessDetector()], world, FEW, tmp_path / "killed", on_step=kill)
    resumed = attack(start(name), [BrightnessDetector()], world, FEW, tmp_path / "killed")
    for one, other in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(one, other)
    assert record(tmp_path / "whole") == record(tmp_path / "killed")


def test_snapshots_show_an_attack_growing(tmp_path, world):
    settings = dataclasses.replace(FEW, steps=12, batch_size=4, keep_at=(1, 4))
    learnt = attack(start("T-PixFc"), [BrightnessDetector()], world, settings, tmp_path)
    kept = {path.name: load_camouflage(path) for path in (tmp_path / "snapshots").iterdir()}
    assert set(kept) == {"T-PixFc_step1", "T-PixFc_step4"}
    assert all(str(camouflage.name) == name for name, camouflage in kept.items())
    losses = [mean_loss(kept[name], world) for name in ("T-PixFc_step1", "T-PixFc_step4")] + [
        mean_loss(learnt, world)
    ]
    assert losses[0] > losses[1] > losses[2]
    assert len(torch.unique(kept["T-PixFc_step1"].bytes().flatten(1), dim=1)[0]) <= 5
    # The record has the losses before and after the last rounding.
    gap = record(tmp_path)["discretisation"]
    assert gap["before"]["brightness"] != gap["after"]["brightness"]
    with torch.no_grad():
        batches = [world.frames(learnt, world.step_scenes(4, 0, -batch)).image for batch in (0, 1)]
    measured = float(BrightnessDetector().loss(torch.cat(batches), []).mean())
    assert gap["after"]["brightness"] == pytest.approx(measured, rel=1e-4)


def test_a_repeat_keeps_its_number_at_the_end_of_a_snapshots_name(tmp_path, world):
    settings = dataclasses.replace(FEW, steps=1, keep_at=(1,))
    attack(start("S-O@0.4-2"), [BrightnessDetector()], world, settings, tmp_path)
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["S-O@0.4_step1-2"]


def test_a_finished_camouflage_has_nothing_to_learn(tmp_path, world):
    finished = start("T-Pix").requires_grad_(False)
    with pytest.raises(ConfigurationError, match="nothing to optimise"):
        attack(finished, [BrightnessDetector()], world, FEW, tmp_path)
