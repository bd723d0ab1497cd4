"""Draws learnt vehicles in drawn paint or on drawn bodies, to see what an answer is due to.

    python tools/swapped_vehicles.py --generator layered --out swapped

OUT gets three fleets of the vehicles that `skyproof vehicles --generator layered --counts 1 1 1 32`
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
from skyproof.generator.fleet import fleet_of
from skyproof.generator.folder import load_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.sample import Sample
from skyproof.randomness import generator_of
from skyproof.vehicles.bodies import BodyDimensions, sample_dimensions
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
        fleets: dict[str, list[Sample]] = {"drawn_paint": [], "drawn_body": [], "no_map": []}
        generator = generator_of(_SEED, "fleet", "test")
        for _ in range(self.count):
            body_type, latent = learnt.sample_latent(generator)
            seed = int(torch.randint(2**31, (), generator=generator))
            fleets["drawn_paint"].append(in_drawn_paint(body_type, latent, seed))
            fleets["drawn_body"].append(on_drawn_body(learnt, body_type, latent, seed))
            fleets["no_map"].append(without_map(learnt, body_type, latent, seed))
        with finished_folder(self.out) as folder:
            for name, samples in fleets.items():
                fleet_of(samples, learnt.method, _FIRST_NUMBER).save(folder / name)


def in_drawn_paint(body_type: str, latent: torch.Tensor, seed: int) -> Sample:
    """Draws a learnt body in paint and glass of the rules."""
    body = build_body(BodyDimensions(*latent[:_BODY].double().tolist()))
    texture, parts = paint_vehicle(body, body_type, generator=generator_of(seed, "trim"))
    return Sample(body_type, body.vertices, texture, parts)


def on_drawn_body(
    learnt: LayeredGenerator, body_type: str, latent: torch.Tensor, seed: int
) -> Sample:
    """Draws a body of the rules in learnt paint and glass, with the learnt map."""
    drawn = astuple(sample_dimensions(body_type, generator=generator_of(seed, "body")))
    return learnt.decode(body_type, torch.cat((torch.tensor(drawn), latent[_BODY:])), seed)


def without_map(
    learnt: LayeredGenerator, body_type: str, latent: torch.Tensor, seed: int
) -> Sample:
    """Draws a learnt body in learnt paint and glass, as clean as drawn ones."""
    tensors = learnt.tensors()
    bare = {name: torch.zeros_like(tensors[name]) for name in ("detail_mean", "components")}
    return LayeredGenerator.of(learnt.body_types, tensors | bare).decode(body_type, latent, seed)


if __name__ == "__main__":
    tyro.cli(SwappedVehicles).run()
