"""The three texture constraints and all their combinations (sections 3.3 and S4.2)."""

import itertools
import math

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import Part

PALETTE = (
    torch.tensor([[0, 0, 0], [60, 80, 40], [120, 110, 90], [200, 190, 170], [255, 0, 51]]) / 255
)
SETTINGS = [
    TextureConstraints(pixelised, colours, masked)
    for pixelised, colours, masked in itertools.product(
        (False, True), ("free", "learnt", "fixed"), (False, True)
    )
]


def drawn(seed):
    return torch.Generator().manual_seed(seed)


def texture(constraints=None, seed=0, **more):
    name = CamouflageName("texture", constraints or TextureConstraints())
    if constraints and constraints.colours == "fixed":
        more = {"palette": PALETTE, **more}
    return UniversalTexture(name, generator=drawn(seed), **more)


@pytest.fixture(scope="module")
def vehicles():
    fleet = sample_fleet(FleetSettings(count=3), generator=drawn(0))
    return fleet.batch(fleet.ids)


def learn(camouflage, vehicles, steps=6):
    """A few steps towards an arbitrary goal, as an attack takes them."""
    goal = torch.rand(3, 512, 512, generator=drawn(9))
    groups = [
        {"params": [value], "lr": 0.05 * camouflage.learning_rates.get(name, 1.0)}
        for name, value in camouflage.named_parameters()
    ]
    optimiser = torch.optim.Adam(groups)
    for step in range(1, steps + 1):
        camouflage.before_step_(step, steps)
        optimiser.zero_grad()
        (camouflage(vehicles).worn_texture() - goal).square().mean().backward()
        optimiser.step()
        camouflage.project_()
    return camouflage


def colours_of(path):
    with Image.open(path) as image:
        return {tuple(pixel) for pixel in np.array(image).reshape(-1, 3)}


@pytest.mark.parametrize("constraints", SETTINGS, ids=lambda each: each.name)
def test_every_setting_keeps_its_constraints_after_learning_and_in_its_png(
    tmp_path, vehicles, constraints
):
    camouflage = learn(texture(constraints), vehicles)
    camouflage.finalise()
    save_camouflage(tmp_path, camouflage)
    with Image.open(tmp_path / "texture.png") as image:
        pixels = np.array(image)
    found = {tuple(pixel) for pixel in pixels.reshape(-1, 3)}
    if constraints.colours == "free":
        assert len(found) > 900
    else:
        assert 2 <= len(found) <= 5
    if constraints.colours == "fixed":
        assert found <= {tuple(row) for row in (PALETTE * 255).round().int().tolist()}
    if constraints.pixelised:
        blocks = pixels.reshape(32, 16, 32, 16, 3)
        assert (blocks == blocks[:, :1, :, :1]).all()
    worn = camouflage(vehicles).worn_texture()
    if constraints.masked:
        painted = vehicles.parts == Part.BODY
        own = vehicles.texture.float() / 255
        elsewhere = (worn != own).any(dim=1) & ~painted
        assert not elsewhere.any()
        everywhere = camouflage.map().expand(3, 3, 512, 512).permute(0, 2, 3, 1)
        assert torch.equal(worn.permute(0, 2, 3, 1)[painted], everywhere[painted])
    else:
        assert worn.shape == (1, 3, 512, 512)
        assert torch.equal(worn[0], camouflage.map())
    # What is stored is what was learnt, and evaluation sees the same map.
    loaded = load_camouflage(tmp_path)
    assert loaded.constraints == constraints
    assert torch.equal(loaded.map(), camouflage.map())
    assert np.array_equal(
        (loaded.map().detach() * 255).round().byte().permute(1, 2, 0).numpy(), pixels
    )


@pytest.mark.parametrize("constraints", SETTINGS, ids=lambda each: each.name)
def test_every_setting_learns(vehicles, constraints):
    goal = torch.rand(3, 512, 512, generator=drawn(9))
    camouflage = texture(constraints)
    with torch.no_grad():
        before = float((camouflage(vehicles).worn_texture() - goal).square().mean())
    learn(camouflage, vehicles, steps=10)
    with torch.no_grad():
        after = float((camouflage(vehicles).worn_texture() - goal).square().mean())
    assert after < before


@pytest.mark.parametrize("constraints", SETTINGS, ids=lambda each: each.name)
def test_a_random_control_is_the_finished_start_of_its_attack(constraints):
    start, control = texture(constraints, seed=4), texture(constraints, seed=4)
    control.finalise()
    if constraints.colours == "free":
        assert (control.map() - start.map()).abs().max() <= 0.5 / 255 + 1e-6
    else:
        # Uniform draws: every colour is as likely.
        shares = (
            torch.bincount(control.cells.argmax(0).flatten(), minlength=5)
            / control.cells[0].numel()
        )
        assert (shares - 0.2).abs().max() < (0.04 if constraints.pixelised else 0.005)
        assert torch.equal(control.cells, start.cells)
    assert not torch.equal(control.cells, texture(constraints, seed=5).cells)


def test_the_mixture_is_a_softmax_of_logits_over_the_temperature():
    camouflage = texture(TextureConstraints(True, "fixed"))
    with torch.no_grad():
        camouflage.cells[:, 0, 0] = torch.tensor([0.0, 1.0, 0.0, 0.0, 2.0])
    camouflage.before_step_(1, 5)
    weights = [math.exp(value) for value in (0, 1, 0, 0, 2)]
    wanted = sum(
        weight / sum(weights) * colour for weight, colour in zip(weights, PALETTE, strict=True)
    )
    assert torch.allclose(camouflage.map()[:, 0, 0], wanted, atol=1e-6)
    camouflage.before_step_(3, 5)
    assert float(camouflage.temperature) == pytest.approx(math.sqrt(0.1))
    camouflage.before_step_(5, 5)
    assert float(camouflage.temperature) == pytest.approx(0.1)
    weights = [math.exp(value / 0.1) for value in (0, 1, 0, 0, 2)]
    wanted = sum(
        weight / sum(weights) * colour for weight, colour in zip(weights, PALETTE, strict=True)
    )
    assert torch.allclose(camouflage.map()[:, 15, 15], wanted, atol=1e-6)
    assert not torch.allclose(camouflage.map()[:, 16, 0], wanted, atol=1e-3)


def test_the_papers_mixture_is_two_softmaxes_of_probabilities():
    camouflage = texture(TextureConstraints(True, "fixed"), seed=3)
    uniform = camouflage.cells.detach().exp()
    camouflage.paper_form_(True)
    # It starts from uniform draws, divided by their sum.
    assert torch.allclose(camouflage.cells, uniform / uniform.sum(0))
    p = [0.1, 0.2, 0.05, 0.25, 0.4]
    with torch.no_grad():
        camouflage.cells[:, 0, 0] = torch.tensor(p)
    for _ in range(2):
        # s(r) = exp(ln(r) / 0.5) / sum, the square of each, divided by the sum of squares.
        p = [each**2 / sum(other**2 for other in p) for each in p]
    wanted = sum(weight * colour for weight, colour in zip(p, PALETTE, strict=True))
    camouflage.before_step_(5, 5)
    assert torch.allclose(camouflage.map()[:, 0, 0], wanted, atol=1e-6)
    shown = camouflage.map().detach()
    camouflage.paper_form_(False)
    assert torch.allclose(camouflage.map(), shown, atol=1e-6)
    camouflage.finalise()
    assert torch.equal(camouflage.map()[:, 0, 0], PALETTE[4])


def test_a_softmax_after_every_step_keeps_probabilities_and_forgets_them():
    camouflage = texture(TextureConstraints(True, "learnt"))
    camouflage.paper_form_(True)
    with torch.no_grad():
        camouflage.cells[:, 0, 0] = torch.tensor([0.96, 0.01, 0.01, 0.01, 0.01])
    wanted = torch.tensor([0.96, 0.01, 0.01, 0.01, 0.01])
    apart = [float((camouflage.cells.detach() - 0.2).abs().max())]
    for _ in range(6):
        camouflage.project_()
        wanted = wanted.exp() / wanted.exp().sum()
        assert torch.allclose(camouflage.cells[:, 0, 0], wanted, atol=1e-6)
        assert torch.allclose(camouflage.cells.sum(0), torch.ones(32, 32))
        assert camouflage.cells.min() > 0
        apart.append(float((camouflage.cells.detach() - 0.2).abs().max()))
    # Without any gradient the largest falls from 0.96 to one fifth.
    assert apart[0] == pytest.approx(0.76)
    assert apart[-1] < 1e-3
    assert apart == sorted(apart, reverse=True)


def test_annealing_leaves_little_to_the_last_rounding(vehicles):
    annealed = learn(texture(TextureConstraints(True, "learnt")), vehicles, steps=20)
    soft = annealed.map().detach()
    annealed.finalise()
    assert float((soft - annealed.map().detach()).abs().mean()) < 0.03


def test_fixed_colours_do_not_move_and_learnt_ones_do(vehicles):
    fixed, learnt = (
        texture(TextureConstraints(False, "fixed")),
        texture(TextureConstraints(False, "learnt")),
    )
    before = learnt.palette.detach().clone()
    learn(fixed, vehicles, 2)
    learn(learnt, vehicles, 2)
    assert torch.equal(fixed.palette, PALETTE)
    assert not torch.equal(learnt.palette.detach(), before)
    assert {name for name, _ in fixed.named_parameters()} == {"cells"}


@pytest.mark.parametrize(("blocks", "side"), [(8, 64), (512, 1), (1, 512)])
def test_blocks_cover_the_map_evenly(blocks, side):
    shown = texture(TextureConstraints(True), blocks=blocks).map().detach()
    assert torch.equal(
        shown[:, ::side, ::side].repeat_interleave(side, 1).repeat_interleave(side, 2), shown
    )


@pytest.mark.parametrize("blocks", [1024, 33, 0, -4])
def test_blocks_that_do_not_fit_the_map_are_refused(blocks):
    with pytest.raises(ConfigurationError, match=f"512 texels a side, got {blocks}"):
        texture(TextureConstraints(True), blocks=blocks)


def test_a_palette_of_one_colour_is_refused():
    with pytest.raises(ConfigurationError, match="at least 2 colours, got 1"):
        texture(TextureConstraints(colours="fixed"), palette=PALETTE[:1])
    with pytest.raises(ConfigurationError, match="at least 2 colours, got 1"):
        texture(TextureConstraints(colours="learnt"), colours=1)


def test_fixed_colours_need_a_palette():
    with pytest.raises(ConfigurationError, match="give them with --palette"):
        make_camouflage("T-Fc", generator=drawn(0))


@pytest.mark.parametrize("name", ["T-PixLc-0", "R-PixLc_search", "C-PixLc-par@0.2"])
def test_learnt_colours_begin_near_those_that_are_given(name):
    begun = [make_camouflage(name, generator=drawn(seed), palette=PALETTE) for seed in (0, 1)]
    palettes = [getattr(each, "texture", each).palette for each in begun]
    for palette in palettes:
        assert (palette - PALETTE).abs().max() < 0.25
        assert not torch.equal(palette, PALETTE)
    assert not torch.equal(*palettes)


@pytest.mark.parametrize("name", ["T-PixMa-0", "R-Pix_search", "C-Pix-par@0.2"])
def test_free_blocks_begin_among_those_that_are_given(name):
    begun = make_camouflage(name, generator=drawn(0), palette=PALETTE)
    cells = getattr(begun, "texture", begun).cells.flatten(1).T
    for cell in cells.unique(dim=0):
        assert (cell == PALETTE).all(1).any()
    assert len(cells.unique(dim=0)) == len(PALETTE)


@pytest.mark.parametrize("name", ["R-PixLc-0", "R-C-PixLc@0.2-0", "R-Pix-0", "T-U-0", "T-Ma-0"])
def test_random_draws_and_free_texels_know_no_palette(name):
    made = [make_camouflage(name, generator=drawn(0), palette=each) for each in (PALETTE, None)]
    first, second = (getattr(each, "texture", each).bytes() for each in made)
    assert torch.equal(first, second)


def test_a_mask_that_covers_nothing_is_refused(vehicles):
    bare = vehicles.row(0)
    bare.parts.fill_(Part.GLASS)
    with pytest.raises(ConfigurationError, match="covers nothing"):
        texture(TextureConstraints(masked=True))(bare)
