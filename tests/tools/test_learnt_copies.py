"""What tools/learnt_copies.py says of vehicles of which one knows whether they are copies."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from learnt_copies import LearntCopies, nearer_share, stored_vehicles

from skyproof.errors import StoredFileError
from skyproof.generator.fits import Fits, fitted_vehicles
from skyproof.generator.folder import save_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.prototypes import draw_prototypes
from skyproof.loop import Loop
from skyproof.vehicles.bodies import BODY_RANGES
from tests.generator.made_fits import made_fits

BODIES = 2


@pytest.fixture(scope="module")
def prototypes():
    return draw_prototypes(list(BODY_RANGES), BODIES, 0)


def learnt_folder(folder, fits, prototypes):
    """Writes what `skyproof learn-vehicles` leaves of these fits."""
    held = Fits([fit.id for fit in fits])
    identity = {
        "settings": {"seed": 0, "fit": {"bodies": BODIES}},
        "vehicles": [fit.id for fit in fits],
    }
    loop = Loop(folder / "fits", identity, len(fits), 100, {"fits": held}, "other fits", "do it")
    for step in loop:
        held.add(fits[step - 1])
    fitted = fitted_vehicles(fits, prototypes)
    save_generator(folder, LayeredGenerator.learn(fitted), {})
    return fitted


def test_the_share_counts_pairs_and_half_of_the_ties():
    near, far = np.array([1.0, 2.0, 5.0]), np.array([2.0, 3.0])
    pairs = [(a < b) + 0.5 * (a == b) for a in near for b in far]
    assert nearer_share(near, far) == pytest.approx(np.mean(pairs))


def test_copies_are_told_from_vehicles_that_nobody_learnt(tmp_path, prototypes):
    generator = torch.Generator().manual_seed(0)
    fits = [
        replace(fit, paint=torch.rand(3, generator=generator)) for fit in made_fits(prototypes, 80)
    ]
    learnt_folder(tmp_path / "town", fits[:40], prototypes)
    learnt_folder(tmp_path / "elsewhere", fits[40:], prototypes)
    tool = LearntCopies((tmp_path / "town",), tmp_path / "elsewhere", tmp_path / "said.json", 30)
    record = tool.run()
    assert json.loads((tmp_path / "said.json").read_text()) == record
    for space in ("delta_e", "features"):
        found = record["town"][space]
        assert found["learnt"]["median"] == pytest.approx(0, abs=1e-4)
        assert found["learnt"]["nearer_low"] > 0.99
        # Another tint of the same vehicle is still a copy.
        assert 0 < found["other_colour"]["median"] < found["unseen"]["median"]
        assert found["other_colour"]["nearer_low"] > 0.9
        # What lies between two learnt ones is nearer to them than what nobody learnt.
        assert found["made"]["nearer"] > found["drawn"]["nearer"]
        assert found["drawn"]["nearer_low"] < 0.6


def test_fits_come_back_as_they_were_stored(tmp_path, prototypes):
    fits = made_fits(prototypes, 12)
    fitted = learnt_folder(tmp_path, fits, prototypes)
    fleet, kept = stored_vehicles(tmp_path)
    assert [fit.id for fit in kept] == [fit.id for fit in fits]
    assert fleet.vertices.equal(fitted.vertices)
    assert fleet.ids[0].rpartition("-")[0] == fitted.body_types[0]
    with pytest.raises(StoredFileError, match="skyproof learn-vehicles"):
        stored_vehicles(tmp_path / "nowhere")
