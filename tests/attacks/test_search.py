"""Controls that are chosen unlearnt: plain paints, the best of many draws, random search."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import BATCHES, HeldOut, Hidden
from skyproof.attacks.making import choose
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage, random_part
from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.make import make_candidates
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.paint import plain_paint
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.card import DetectorCard
from skyproof.errors import ConfigurationError
from tests.attacks.test_kinds import FEW, PALETTE, BrightnessDetector, mean_loss, start, world

__all__ = ["world"]

SEARCHED = [
    "R-PixLcMa_search",
    pytest.param("R-C-PixFc@0.3_search", marks=pytest.mark.slow),
]


class Counting(BrightnessDetector):
    """Counts the images that it is asked about."""

    def __init__(self) -> None:
        super().__init__()
        self.images = 0

    def loss(self, images: Tensor, targets: list[Tensor]) -> Tensor:
        self.images += len(images)
        return super().loss(images, targets)


def loaded(threshold: float, name: str = "brightness") -> BrightnessDetector:
    detector = BrightnessDetector()
    detector.set_card(DetectorCard(name, threshold=threshold, gsd_m=0.125))
    return detector


@pytest.mark.parametrize("name", SEARCHED)
def test_a_search_finds_something_better_than_its_start(
    tmp_path: Path, world: World, name: str
) -> None:
    settings = replace(FEW, steps=40, batch_size=8, checkpoint_every=50)
    before = mean_loss(start(name), world)
    found = attack(start(name), [BrightnessDetector()], world, settings, tmp_path)
    assert mean_loss(found, world) < before
    assert str(load_camouflage(tmp_path).name) == name


def test_a_search_keeps_its_constraints(tmp_path: Path, world: World) -> None:
    settings = replace(FEW, steps=30, batch_size=4, checkpoint_every=50)
    found = attack(start("R-PixFc_search"), [BrightnessDetector()], world, settings, tmp_path)
    assert isinstance(found, UniversalTexture)
    colours = found.bytes().flatten(1).T.unique(dim=0)
    allowed = {tuple(colour) for colour in (PALETTE * 255).round().int().tolist()}
    assert {tuple(colour) for colour in colours.tolist()} <= allowed
    blocks = found.bytes().view(3, 32, 16, 32, 16)
    assert (blocks == blocks[:, :, :1, :, :1]).all()


def test_a_search_sees_as_many_images_as_the_attack_that_it_controls(
    tmp_path: Path, world: World
) -> None:
    asked = []
    for name in ("T-PixFc", "R-PixFc_search"):
        detector = Counting()
        attack(start(name), [detector], world, replace(FEW, batch_size=4), tmp_path / name)
        asked.append(detector.images)
    assert asked[0] == asked[1]


def test_the_paint_that_hides_most_is_chosen(world: World) -> None:
    # The detector fires where it is bright.
    paints = [plain_paint((level,) * 3, masked=False) for level in (255, 0, 128)]
    shown = []
    held_out = HeldOut([loaded(0.6)], world, FEW.seed, 8)
    chosen, record = choose(paints, held_out, progress=lambda number, _: shown.append(number))
    assert chosen is paints[1]
    assert record["hidden"][1] > max(record["hidden"][0], record["hidden"][2])
    assert len(record["hidden"]) == 3
    assert shown == [0, 1, 2]
    assert (record["scenes"], record["final_scenes"]) == (16, 64)
    assert record["finalists"] == {str(paints[1].name): held_out.measure(paints[1]).hidden}


def test_all_scenes_decide_between_the_finalists(world: World) -> None:
    class Told(HeldOut):
        """Has the answers ready: on few scenes, and on all of them."""

        few = (0.1, 0.5, 0.4, 0.2, 0.3)
        all = (1.0, 0.2, 0.3, 1.0, 1.0)

        def measure(self, camouflage: Camouflage, batches: int = BATCHES) -> Hidden:
            number = next(n for n, paint in enumerate(paints) if paint is camouflage)
            return Hidden((self.all if batches == BATCHES else self.few)[number], 0.0)

    paints = [plain_paint((level,) * 3, masked=False) for level in (0, 64, 128, 192, 255)]
    chosen, record = choose(
        paints, Told([loaded(0.6)], world, FEW.seed, 8), progress=lambda *_: None
    )
    assert chosen is paints[2]
    assert record["finalists"] == {str(paints[1].name): 0.2, str(paints[2].name): 0.3}


def test_candidates_are_the_paints_under_the_mask_or_the_draws_themselves() -> None:
    paints = make_candidates(CamouflageName.parse("R-Ma_plain"), 5, seed=0)
    assert len(paints) == 27
    assert all(paint.name.constraints.masked for paint in paints)
    draws = make_candidates(CamouflageName.parse("R-PixLc_best"), 3, seed=7)
    assert [str(draw.name) for draw in draws] == ["R-PixLc-0", "R-PixLc-1", "R-PixLc-2"]
    first, second = (draw.bytes() for draw in draws[:2])
    assert not torch.equal(first, second)


def test_a_chosen_paint_is_stored_under_its_own_name(tmp_path: Path) -> None:
    (paint, *_) = make_candidates(CamouflageName.parse("R-U_plain"), 2, seed=0)
    paint.name = CamouflageName.parse("R-U_plain")
    save_camouflage(tmp_path, paint)
    assert str(load_camouflage(tmp_path).name) == "R-U_plain"


def test_a_plain_paint_has_no_other_constraint() -> None:
    with pytest.raises(ConfigurationError, match=r"which only U \(all over\) and Ma"):
        make_candidates(CamouflageName.parse("R-PixFc_plain"), 5, seed=0)


def test_a_detector_that_finds_nothing_has_nothing_to_hide_from(world: World) -> None:
    with pytest.raises(ConfigurationError, match="brightness finds no vehicle"):
        HeldOut([loaded(1.0)], world, FEW.seed, 8).measure(plain_paint((0, 0, 0), masked=False))


def test_parts_of_a_map_are_of_all_sizes_and_everywhere() -> None:
    generator = torch.Generator().manual_seed(0)
    parts = [random_part(64, generator=generator) for _ in range(2000)]
    lengths = torch.tensor([rows.stop - rows.start for rows, _ in parts])
    assert lengths.min() == 2
    assert lengths.max() == 64
    # Half of a map's octaves lie below 64 / 2 ** 2.5.
    assert 0.45 < float((lengths < 11.3).float().mean()) < 0.55
    covered = torch.zeros(64)
    for rows, _ in parts:
        covered[rows] += 1
    assert covered.min() > 30
