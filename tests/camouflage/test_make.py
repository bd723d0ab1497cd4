"""What is made from a name, and combinations of texture and shape."""

import pytest
import torch

from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.make import Combination, make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import Part

PALETTE = (
    torch.tensor([[0, 0, 0], [60, 80, 40], [120, 110, 90], [200, 190, 170], [255, 0, 51]]) / 255
)


def drawn(seed=0):
    return torch.Generator().manual_seed(seed)


def make(name, seed=0, texture=None, palette=PALETTE, **settings):
    return make_camouflage(
        name,
        generator=drawn(seed),
        palette=palette,
        texture=texture,
        settings=CamouflageSettings(**settings),
    )


@pytest.fixture(scope="module")
def vehicles():
    fleet = sample_fleet(FleetSettings(count=2), generator=drawn())
    return fleet.batch(fleet.ids)


def test_fixed_colours_need_a_palette_and_a_sequence_its_texture():
    with pytest.raises(ConfigurationError, match="--palette"):
        make_camouflage("T-Fc", generator=drawn())
    for given in (None, make("T-Pix"), make("S-O@0.2")):
        with pytest.raises(ConfigurationError, match="--texture"):
            make("C-Fc-seq@0.2", texture=given)
    with pytest.raises(ConfigurationError, match="turn_steps expects a whole number from 1"):
        make("C-Fc-par@0.2", turn_steps=0)


def test_a_name_as_text_and_as_value_make_the_same():
    one = make("T-PixLc-1", palette=None, blocks=8, colours=3)
    other = make(CamouflageName.parse("T-PixLc-1"), palette=None, blocks=8, colours=3)
    assert (str(one.name), one.blocks, tuple(one.palette.shape)) == ("T-PixLc-1", 8, (3, 3))
    assert torch.equal(one.cells, other.cells)
    with pytest.raises(ConfigurationError, match="mine names no camouflage"):
        make(CamouflageName.read("mine"))


def test_random_controls_are_finished_and_follow_their_seed():
    both = make("R-C-PixFc@0.2-0", seed=1)
    assert isinstance(both, Combination)
    assert both.texture.finished
    assert torch.equal(both.shape.map(), both.shape.map().flip(1))
    assert float(both.shape.map().detach().std()) == pytest.approx(12**-0.5, abs=0.02)
    again, other = make("R-C-PixFc@0.2-0", seed=1), make("R-C-PixFc@0.2-0", seed=2)
    assert all(
        torch.equal(a, b)
        for a, b in zip(both.state_dict().values(), again.state_dict().values(), strict=True)
    )
    assert not torch.equal(both.texture.cells, other.texture.cells)
    assert not torch.equal(both.shape.reach, other.shape.reach)


@pytest.mark.parametrize("masked", [False, True])
def test_a_combination_wears_both(vehicles, masked):
    name = f"C-PixFc{'Ma' if masked else ''}-par@0.3"
    both = make(name)
    with torch.no_grad():
        both.shape.reach.fill_(0.9)
    worn = both(vehicles)
    assert torch.equal(worn.vertices, both.shape(vehicles).vertices)
    assert torch.equal(worn.worn_texture(), both.texture(vehicles).worn_texture())
    assert not torch.equal(worn.vertices, vehicles.vertices)
    if masked:
        # The part map lies on the UV map, which a displacement does not touch.
        glass = vehicles.parts == Part.GLASS
        shown = (worn.worn_texture() * 255).round().byte().permute(0, 2, 3, 1)
        assert torch.equal(shown[glass], vehicles.texture.permute(0, 2, 3, 1)[glass])


def test_a_sequence_learns_the_shape_alone(vehicles):
    texture = make("T-Fc")
    texture.finalise()
    both = make("C-Fc-seq@0.3", texture=texture)
    assert [name for name, value in both.named_parameters() if value.requires_grad] == [
        "shape.reach"
    ]
    worn = both(vehicles)
    (worn.vertices.sum() + worn.worn_texture().sum()).backward()
    assert both.texture.cells.grad is None
    assert both.shape.reach.grad.abs().sum() > 0
    before = both.texture.bytes()
    both.before_step_(1, 5)
    both.project_()
    both.finalise()
    assert torch.equal(both.texture.bytes(), before)


def test_a_parallel_attack_takes_turns():
    both = make("C-Fc-par@0.3", turn_steps=3)
    turns = []
    for step in range(1, 11):
        both.before_step_(step, 10)
        learnt = {
            name.partition(".")[0] for name, value in both.named_parameters() if value.requires_grad
        }
        assert len(learnt) == 1
        turns.append(learnt.pop())
    assert turns == ["texture"] * 3 + ["shape"] * 3 + ["texture"] * 3 + ["shape"]
    # A softmax of the paper's form on the turn of the shape would make the texture forget.
    both.paper_form_(True)
    both.before_step_(4, 10)
    before = both.texture.cells.detach().clone()
    both.project_()
    assert torch.equal(both.texture.cells, before)
    both.before_step_(7, 10)
    both.project_()
    assert not torch.equal(both.texture.cells, before)
    assert both.learning_rates["texture.cells"] == both.texture.learning_rates["cells"]


@pytest.mark.parametrize(
    "name", ["C-PixFcMa-par@0.3", "C-Lc-par@0.1", "S-O@0.4", "R-S-O@0.4", "R-C-U@1"]
)
def test_shapes_and_combinations_are_stored_with_pictures(tmp_path, vehicles, name):
    made = make(name)
    if isinstance(made, Combination):
        with torch.no_grad():
            made.shape.reach.copy_(torch.rand(64, 64, generator=drawn(3)))
    made.finalise()
    save_camouflage(tmp_path, made, {"seed": 1})
    loaded = load_camouflage(tmp_path)
    assert type(loaded) is type(made)
    assert str(loaded.name) == name
    assert torch.equal(loaded(vehicles).vertices, made(vehicles).vertices)
    assert torch.equal(loaded(vehicles).worn_texture(), made(vehicles).worn_texture())
    pictures = {path.name for path in tmp_path.glob("*.png")}
    wanted = {"displacement.png"} | ({"texture.png"} if isinstance(made, Combination) else set())
    assert pictures == wanted
    assert isinstance(loaded, DisplacementMap | Combination | UniversalTexture)
