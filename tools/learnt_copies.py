"""Asks whether a generator's vehicles are copies of those that it learnt from.

    python tools/learnt_copies.py --generators layered gan --unseen other-place --out copies.json

Each generator is a folder of `skyproof learn-vehicles`, with the fits that it learnt from. So is
the unseen one, of which only the fits are used: vehicles of photographs that no generator knows.

All vehicles are rendered alike, fits as well as made ones: alone, from above, at 12.5 cm per pixel.
Two are compared by their pictures (root mean square of the CIELAB difference over all pixels) and
by the features of RetinaNet as it comes with skyproof. For every vehicle the nearest of those that
were learnt from is looked for. A generator copies where its vehicles lie nearer to those than
unseen vehicles do, which is the three-sample test of Meehan, Chaudhuri and Dasgupta ("A
non-parametric test to detect data-copying in generative models", 2020). Here it says how often a
made vehicle is the nearer one of the two: 0.5 where it is as near as an unseen one, 1 where all are
copies. The interval is a bootstrap over the photographs that the unseen vehicles stand in, crossed
with the made vehicles.

So that one sees what the figure can tell, it is given for sets whose answer is known, too: the
learnt ones themselves, the same in a slightly other colour, and vehicles drawn by the rules of
`skyproof vehicles`, which were not learnt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from learnt_vehicles import features_at
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from skyproof.errors import StoredFileError
from skyproof.files import new_file, write_json
from skyproof.generator.fits import LARGEST_MISFIT, Fit, Fits, fitted_texture, fitted_vehicles
from skyproof.generator.fleet import fleet_of, sample_learnt_fleet
from skyproof.generator.folder import load_generator
from skyproof.generator.prototypes import draw_prototypes
from skyproof.generator.sample import Sample
from skyproof.geometry.colour import srgb_to_cielab
from skyproof.loop import CHECKPOINT
from skyproof.render.portrait import close_up
from skyproof.storage import read_tensors
from skyproof.vehicles.bodies import BODY_RANGES
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

Array = NDArray[np.float64]

_DRAWS = 2000
_GSD_M, _SIDE_M = 0.125, 6.4
# By how much sRGB of learnt vehicles is moved at random, for a set of known answer.
_OTHER_COLOUR = 0.02


@dataclass(frozen=True)
class Rows:
    """Vehicles as they are compared, a row each.

    Attributes:
        delta_e: colours of a picture; their distance is the root mean square over its pixels.
        features: of a detector.
    """

    delta_e: Array
    features: Array


@dataclass(frozen=True)
class LearntCopies:
    """Compares made vehicles with those that were learnt from.

    Attributes:
        generators: folders of `skyproof learn-vehicles`.
        unseen: such a folder of photographs that none of the generators learnt from.
        out: JSON file to write.
        count: vehicles made by each.
        seed: of what is made and of the bootstrap.
    """

    generators: tuple[Path, ...]
    unseen: Path
    out: Path
    count: int = 400
    seed: int = 0

    def run(self) -> dict[str, Any]:
        """Compares, prints, writes, and returns what the file holds."""
        with new_file(self.out):
            generator = torch.Generator().manual_seed(self.seed)
            unseen, fits = stored_vehicles(self.unseen)
            # A fit is named by its tile and by its number in that.
            photographs = [fit.id.rpartition("-")[0] for fit in fits]
            far = rows_of(unseen)
            drawn = rows_of(sample_fleet(FleetSettings(self.count), generator=generator))
            record: dict[str, Any] = {}
            for folder in self.generators:
                vehicles = load_generator(folder)
                fitted, _ = stored_vehicles(folder)
                learnt = rows_of(fitted)
                settings = FleetSettings(self.count)
                made = {
                    "made": rows_of(sample_learnt_fleet(vehicles, settings, generator=generator)),
                    "learnt": learnt,
                    "other_colour": rows_of(_in_other_colours(fitted, generator)),
                    "drawn": drawn,
                }
                record[folder.name] = copies(learnt, far, photographs, made, self.seed)
                print(folder.name, record[folder.name], flush=True)
            write_json(self.out, record)
        return record


def stored_vehicles(folder: Path) -> tuple[Fleet, list[Fit]]:
    """Makes a fleet of the good fits of a folder of `skyproof learn-vehicles`.

    Raises:
        StoredFileError: there are none.
    """
    path = folder / "fits" / CHECKPOINT
    if not path.is_file():
        raise StoredFileError(f"{path} is missing; give a folder of skyproof learn-vehicles.")
    tensors, content = read_tensors(path, "learn the vehicles again")
    identity = content["identity"]
    settings = identity["settings"]
    prototypes = draw_prototypes(list(BODY_RANGES), settings["fit"]["bodies"], settings["seed"])
    fits = Fits(identity["vehicles"])
    fits.load_state_dict({name.partition("/")[2]: values for name, values in tensors.items()})
    kept = [fit for fit in map(fits.fit, range(len(fits))) if fit.misfit <= LARGEST_MISFIT]
    bodies = [prototypes[fit.prototype] for fit in kept]
    textures = [
        (fitted_texture(fit, body) * 255).round().to(torch.uint8)
        for fit, body in zip(kept, bodies, strict=True)
    ]
    vertices = fitted_vehicles(kept, prototypes).vertices
    samples = [
        Sample(body.body_type, surface, texture, body.parts)
        for body, surface, texture in zip(bodies, vertices, textures, strict=True)
    ]
    return fleet_of(samples, "fit"), kept


def rows_of(fleet: Fleet) -> Rows:
    """Renders vehicles, and gives what they are compared by."""
    vehicles = fleet.batch(fleet.ids)
    pictures = close_up(vehicles, gsd_m=_GSD_M, side_m=_SIDE_M)
    lab = srgb_to_cielab(pictures.permute(0, 2, 3, 1).float() / 255).flatten(1)
    half_px = vehicles.vertices.amax(1)[:, :2] / _GSD_M
    centre_px = pictures.shape[-1] / 2
    boxes = torch.cat((centre_px - half_px, centre_px + half_px), 1)
    return Rows(
        (lab / (lab.shape[1] / 3) ** 0.5).double().numpy(),
        features_at(pictures, boxes),
    )


def copies(
    learnt: Rows, unseen: Rows, photographs: Sequence[str], made: dict[str, Rows], seed: int
) -> dict[str, Any]:
    """Says of each set how near it is to the learnt ones, beside the unseen ones.

    Args:
        learnt, unseen: vehicles that were learnt from, and such as were not.
        photographs: of the unseen ones, the photograph of each.
        made: the sets.
        seed: of the bootstrap.
    """
    generator = np.random.default_rng(seed)
    record: dict[str, Any] = {"learnt": len(learnt.delta_e), "unseen": len(unseen.delta_e)}
    for space in ("delta_e", "features"):
        known = getattr(learnt, space)
        far = cdist(getattr(unseen, space), known).min(1)
        record[space] = {"unseen": {"median": round(float(np.median(far)), 3)}}
        for name, rows in made.items():
            near = cdist(getattr(rows, space), known).min(1)
            value, low, high = _nearer(near, far, photographs, generator)
            record[space][name] = {
                "median": round(float(np.median(near)), 3),
                "nearer": round(value, 3),
                "nearer_low": round(low, 3),
                "nearer_high": round(high, 3),
            }
    return record


def nearer_share(near: Array, far: Array) -> float:
    """Gives how often one of `near` is smaller than one of `far`; ties count as half."""
    order = np.sort(far)
    larger = len(far) - np.searchsorted(order, near, side="right")
    not_smaller = len(far) - np.searchsorted(order, near, side="left")
    return float((larger + not_smaller).mean() / (2 * len(far)))


def _nearer(
    near: Array, far: Array, photographs: Sequence[str], generator: np.random.Generator
) -> tuple[float, float, float]:
    """Gives the share, and its 95 % interval over photographs crossed with made vehicles."""
    names, groups = np.unique(np.array(photographs), return_inverse=True)
    members = [far[groups == group] for group in range(len(names))]
    draws = []
    for _ in range(_DRAWS):
        chosen = generator.integers(len(names), size=len(names))
        again = near[generator.integers(len(near), size=len(near))]
        draws.append(nearer_share(again, np.concatenate([members[index] for index in chosen])))
    low, high = np.quantile(draws, [0.025, 0.975])
    return nearer_share(near, far), float(low), float(high)


def _in_other_colours(fleet: Fleet, generator: torch.Generator) -> Fleet:
    """Moves the colour of each vehicle as a whole."""
    shift = 255 * _OTHER_COLOUR * torch.randn(len(fleet), 3, 1, 1, generator=generator)
    samples = [
        Sample(
            name.rpartition("-")[0],
            fleet.vertices[index],
            (fleet.textures[index] + shift[index]).clamp(0, 255).round().to(torch.uint8),
            fleet.parts[index],
        )
        for index, name in enumerate(fleet.ids)
    ]
    return fleet_of(samples, "fit")


if __name__ == "__main__":
    tyro.cli(LearntCopies).run()
