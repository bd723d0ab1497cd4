"""The patterns of the precheck that no training draws from."""

import numpy as np
import pytest
import torch

from skyproof.camouflage.make import make_candidates
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.patterns import PATTERNS, draw_pattern
from skyproof.measure.precheck import precheck_changes

PALETTE = torch.tensor([[0, 0, 0], [60, 80, 40], [120, 110, 90], [200, 190, 170]]) / 255


def drawn(kind: str, seed: int) -> np.ndarray:
    return draw_pattern(kind, PALETTE, seed=seed, draw=0).bytes().permute(1, 2, 0).numpy()


@pytest.mark.parametrize("kind", PATTERNS)
def test_a_pattern_covers_the_map_in_the_colours_of_its_palette(kind: str) -> None:
    first, second = drawn(kind, 0), drawn(kind, 1)
    assert (first == drawn(kind, 0)).all()
    assert (first != second).any()
    known = {tuple(colour) for colour in (PALETTE * 255).round().byte().tolist()}
    for pattern in (first, second):
        colours, counts = np.unique(pattern.reshape(-1, 3), axis=0, return_counts=True)
        assert {tuple(colour) for colour in colours.tolist()} == known
        assert counts.max() < 0.75 * counts.sum()
        # Large enough to be seen: most texels have their neighbour's colour.
        assert (pattern[:, 1:] == pattern[:, :-1]).all(axis=2).mean() > 0.7


def test_steps_of_noise_are_equally_large_and_lie_in_order() -> None:
    grey = torch.arange(4).view(4, 1).expand(4, 3) / 4
    shares = []
    for seed in range(3):
        pattern = draw_pattern("noise", grey, seed=0, draw=seed)
        colours, counts = np.unique(pattern.bytes()[0].numpy(), return_counts=True)
        assert len(colours) == 4
        shares += (counts / counts.sum()).tolist()
    assert max(abs(share - 0.25) for share in shares) < 0.001


def test_stripes_repeat_along_one_direction_alone() -> None:
    stripes = drawn("stripes", 2).astype(float).mean(axis=2)
    down, right = np.gradient(stripes)
    edges = np.hypot(down, right) > 0
    # Doubled angles: both sides of a stripe count alike.
    doubled = 2 * np.arctan2(down, right)[edges]
    assert abs(np.exp(1j * doubled).mean()) > 0.5


def test_a_control_is_chosen_from_the_draws_of_the_precheck() -> None:
    name = CamouflageName.parse("R-U_pattern")
    candidates = make_candidates(name, 8, seed=3, palette=PALETTE)
    changes = precheck_changes(PALETTE, draws=2, seed=3)
    checked = [each.camouflage for each in changes if each.name in PATTERNS]
    assert {str(each.name) for each in candidates} == {str(each.name) for each in checked}
    maps = {str(each.name): each.bytes() for each in candidates}
    assert all((maps[str(each.name)] == each.bytes()).all() for each in checked)
