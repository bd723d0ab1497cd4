"""What tools/swapped_vehicles.py swaps, and what it leaves as it was."""

import pytest
import torch
from swapped_vehicles import SwappedVehicles

from skyproof.errors import ConfigurationError
from skyproof.generator.adversarial import AdversarialGenerator, Network
from skyproof.generator.fits import fitted_vehicles
from skyproof.generator.folder import save_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.prototypes import draw_prototypes
from skyproof.main import run
from skyproof.vehicles.bodies import BODY_RANGES
from skyproof.vehicles.fleet import Fleet
from tests.generator.made_fits import made_fits


def test_one_thing_is_swapped_and_names_stay(tmp_path):
    prototypes = draw_prototypes(list(BODY_RANGES), 2, 0)
    fitted = fitted_vehicles(made_fits(prototypes, 20), prototypes)
    save_generator(tmp_path / "town", LayeredGenerator.learn(fitted), {})
    SwappedVehicles(tmp_path / "town", tmp_path / "swapped", count=4).run()
    told = ["learn-vehicles", "--out", str(tmp_path / "town"), "--counts", "1", "1", "1", "4"]
    assert run([*told, "--fleets", str(tmp_path / "fleets")]) == 0
    learnt = Fleet.load(tmp_path / "fleets" / "test")
    for name, same_body, same_paint in (
        ("drawn_paint", True, False),
        ("drawn_body", False, False),
        ("no_map", True, False),
    ):
        swapped = Fleet.load(tmp_path / "swapped" / name)
        assert swapped.ids == learnt.ids
        assert torch.equal(swapped.vertices, learnt.vertices) is same_body
        assert torch.equal(swapped.textures, learnt.textures) is same_paint
    bare, drawn = (Fleet.load(tmp_path / "swapped" / name) for name in ("no_map", "drawn_paint"))
    # Without the map the colours of the paint are still the learnt ones.
    assert not torch.equal(bare.textures, drawn.textures)


def test_a_network_knows_no_paint_apart_from_the_body(tmp_path):
    network = Network(torch.zeros(1, 3, 33, 17), torch.ones(1, 3, 33, 17))
    save_generator(tmp_path / "town", AdversarialGenerator(network), {})
    with pytest.raises(ConfigurationError, match="generator gan; give a layered one"):
        SwappedVehicles(tmp_path / "town", tmp_path / "swapped").run()
    assert not (tmp_path / "swapped").exists()
