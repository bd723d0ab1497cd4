"""Draws learnt vehicles in drawn paint or on drawn bodies, to see what an answer is due to.

    python tools/swapped_vehicles.py --generator layered --out swapped

OUT gets three fleets of the vehicles that `skyproof learn-vehicles --out layered --counts 1 1 1 32`
puts into its fleet `test`, under the same names, so that scenes of that show them at their places:

- drawn_paint: their bodies, in paints that are drawn by the rules of `skyproof vehicles`;
- drawn_body: their paints and maps, on bodies of their types that are drawn by the rules;
- no_map: their bodies and the colours of their paints, without the map of what photographs show.

`skyproof render` and `skyproof score` then say what a camouflage hides from each.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from pathlib import Path

import torch
import tyro

from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder
from skyproof.generator.fleet import sample_learnt_fleet
from skyproof.generator.folder import load_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.sample import Sample
from skyproof.randomness import generator_of
from skyproof.vehicles.bodies import BodyDimensions, sample_dimensions
from skyproof.vehicles.fleet import FleetSettings
from skyproof.vehicles.painting import paint_vehicle
from skyproof.vehicles.surface import build_body

_BODY = len(fields(BodyDimensions))
# As `skyproof vehicles --counts 1 1 1 32` numbers and draws the fleet test.
_FIRST_NUMBER, _SEED = 5003, 0


@dataclass(frozen=True)
class SwappedVehicles:
    """Draws the three fleets.

    Attributes:
        generator: folder of `skyproof learn-vehicles --settings.method layered`.
        out: folder to write.
        count: vehicles in each fleet.
    """

    generator: Path
    out: Path
    count: int = 32

    def run(self) -> None:
        """Writes all of them, or nothing."""
        learnt = load_generator(self.generator)
        if not isinstance(learnt, LayeredGenerator):
            raise ConfigurationError(
                f"{self.generator} holds a generator {learnt.method}; give a layered one, whose "
                "bodies and paints are apart."
            )
        tensors = learnt.tensors()
        no_map = {name: torch.zeros_like(tensors[name]) for name in ("detail_mean", "components")}
        swapped = {
            "drawn_paint": InDrawnPaint.of(learnt.body_types, tensors),
            "drawn_body": OnDrawnBody.of(learnt.body_types, tensors),
            "no_map": LayeredGenerator.of(learnt.body_types, tensors | no_map),
        }
        settings = FleetSettings(self.count, first_number=_FIRST_NUMBER)
        with finished_folder(self.out) as folder:
            for name, vehicles in swapped.items():
                draws = generator_of(_SEED, "fleet", "test")
                fleet = sample_learnt_fleet(vehicles, settings, generator=draws)
                fleet.save(folder / name)


class InDrawnPaint(LayeredGenerator):
    """Learnt bodies, in paint and glass of the rules."""

    def decode(self, body_type: str, latent: torch.Tensor, seed: int) -> Sample:
        """See `LayeredGenerator.decode`."""
        body = build_body(BodyDimensions(*latent[:_BODY].double().tolist()))
        texture, parts = paint_vehicle(body, body_type, generator=generator_of(seed, "trim"))
        return Sample(body_type, body.vertices, texture, parts)


class OnDrawnBody(LayeredGenerator):
    """Bodies of the rules, in learnt paint and glass, with the learnt map."""

    def decode(self, body_type: str, latent: torch.Tensor, seed: int) -> Sample:
        """See `LayeredGenerator.decode`."""
        drawn = astuple(sample_dimensions(body_type, generator=generator_of(seed, "body")))
        return super().decode(body_type, torch.cat((torch.tensor(drawn), latent[_BODY:])), seed)


if __name__ == "__main__":
    tyro.cli(SwappedVehicles).run()
