"""Measures how near rendered fleets come to photographed vehicles.

    python tools/learnt_vehicles.py --real RUN/tiles --cleared RUN/cleared \\
        --rendered RUN/drawn RUN/learnt --out RUN/fleets.json

Whether learnt vehicles are copies of those that were learnt from, tools/learnt_copies.py says.

RUN/tiles is labelled imagery that no fleet was learnt from, RUN/cleared the same without its
vehicles, and RUN/drawn and RUN/learnt datasets that `skyproof render` drew on that, with vehicles
in the places of others (as for tools/realism.py, which says how well a network tells them from the
photographs).

Of every window the features of RetinaNet as it comes with skyproof are taken at the vehicle. In
them, over all windows:

- density and coverage of the photographed by the rendered ones, with five neighbours (Naeem et al.,
  "Reliable fidelity and diversity metrics for generative models", 2020), beside those of one half
  of the photographed ones by the other half;
- the Vendi score, as how many different vehicles they count (Friedman and Dieng, 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from realism_pairs import Pairs, read_pairs
from scipy.spatial.distance import cdist

from skyproof.detectors.common import SMALLEST_IMAGE_PX
from skyproof.detectors.features import FeatureDetector
from skyproof.detectors.reference_detectors import reference_detector
from skyproof.files import new_file, write_json

Array = NDArray[np.float64]

_NEIGHBOURS = 5
_BATCH = 64


@dataclass(frozen=True)
class LearntVehicles:
    """Measures fleets against photographs.

    Attributes:
        real: the labelled tiled folder.
        cleared: the same without vehicles.
        rendered: datasets rendered on it, one for each fleet.
        out: JSON file to write.
    """

    real: Path
    cleared: Path
    rendered: tuple[Path, ...]
    out: Path

    def run(self) -> dict[str, Any]:
        """Measures, prints, writes, and returns what the file holds."""
        with new_file(self.out):
            sets = {
                str(folder): read_pairs([self.real], [folder], self.cleared)
                for folder in self.rendered
            }
            features = {name: (_features(of, 0), _features(of, 1)) for name, of in sets.items()}
            record: dict[str, Any] = {}
            for name, (real, rendered) in features.items():
                record[name] = measured(real, rendered)
                print(name, record[name], flush=True)
            write_json(self.out, record)
        return record


def measured(real: Array, rendered: Array) -> dict[str, Any]:
    """Returns all figures of one fleet."""
    density, coverage = density_and_coverage(real, rendered)
    order = np.random.default_rng(0).permutation(len(real))
    first, second = (real[part] for part in np.array_split(order, 2))
    real_density, real_coverage = density_and_coverage(first, second)
    return {
        "windows": len(real),
        "density": round(density, 3),
        "coverage": round(coverage, 3),
        "real_density": round(real_density, 3),
        "real_coverage": round(real_coverage, 3),
        "vendi": round(vendi_score(rendered), 2),
        "real_vendi": round(vendi_score(real), 2),
    }


def density_and_coverage(real: Array, made: Array) -> tuple[float, float]:
    """Measures how real made ones are, and how much of the real ones they stand for.

    Density is how many real ones' neighbourhoods a made one lies in, in parts of the number of
    neighbours; coverage is the share of real ones in whose neighbourhood a made one lies.

    Args:
        real, made: `[N, C]` and `[M, C]` features.
    """
    among = cdist(real, real)
    np.fill_diagonal(among, np.inf)
    radius = np.sort(among, axis=1)[:, _NEIGHBOURS - 1]
    within = cdist(real, made) < radius[:, None]
    return float(within.sum(0).mean()) / _NEIGHBOURS, float(within.any(1).mean())


def vendi_score(features: Array) -> float:
    """Counts how many different ones there are: exp of the entropy of a kernel's eigenvalues.

    The kernel is the cosine between features.

    Args:
        features: `[N, C]`.
    """
    rows = features / np.linalg.norm(features, axis=1, keepdims=True)
    # The eigenvalues of rows @ rows.T / N, of which rows.T @ rows / N has all but zeros.
    values = np.linalg.eigvalsh(rows.T @ rows / len(rows)).clip(1e-12)
    values = values / values.sum()
    return float(np.exp(-(values * np.log(values)).sum()))


def _features(pairs: Pairs, side: int) -> Array:
    """Returns the detector's features at the vehicles of one side of all pairs."""
    boxes = torch.cat([_box(mask) for mask in pairs.vehicle])
    return features_at(pairs.pixels[:, side], boxes)


@torch.no_grad()
def features_at(
    pictures: UInt8[torch.Tensor, "N 3 H W"], boxes: Float[torch.Tensor, "N 4"]
) -> Array:
    """Returns the features of RetinaNet, as it comes with skyproof, in a box of each picture."""
    detector = reference_detector("retinanet").detector
    assert isinstance(detector, FeatureDetector)
    found = []
    for start in range(0, len(pictures), _BATCH):
        images = pictures[start : start + _BATCH].float() / 255
        # Windows are smaller than what a detector takes: they go on as they end.
        before = max(0, SMALLEST_IMAGE_PX - images.shape[-1]) // 2
        after = max(0, SMALLEST_IMAGE_PX - images.shape[-1] - before)
        images = F.pad(images, (before, after, before, after), mode="replicate")
        found += detector.features(images, list(boxes[start : start + _BATCH, None] + before))
    return torch.cat(found).double().numpy()


def _box(mask: torch.Tensor) -> torch.Tensor:
    rows, columns = torch.nonzero(mask, as_tuple=True)
    low_y, high_y = int(rows.min()), int(rows.max()) + 1
    low_x, high_x = int(columns.min()), int(columns.max()) + 1
    return torch.tensor([[low_x, low_y, high_x, high_y]], dtype=torch.float32)


if __name__ == "__main__":
    tyro.cli(LearntVehicles).run()
