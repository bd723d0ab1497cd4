"""The drawn tiles and vehicles of a test."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Num

from skyproof.results.statistics.intervals import REPLICATES, resample, resampled


@dataclass(frozen=True)
class Sample:
    """The N cells of a test, each one vehicle of the fleet on one tile.

    A vehicle stands on many tiles, and a tile shows many vehicles, so neither is nested in the
    other. All results share one sample, which pairs their differences.

    Attributes:
        tile, vehicle: number of each cell's tile and vehicle, from 0 without gaps.
        weights: resampled tiles, from `resample`.
    """

    tile: Int[np.ndarray, " N"]
    vehicle: Int[np.ndarray, " N"]
    weights: Int[np.ndarray, "R C"]

    @classmethod
    def draw(
        cls,
        cells: Sequence[tuple[str, str]],
        *,
        generator: np.random.Generator,
        replicates: int = REPLICATES,
    ) -> "Sample":
        """Makes the sample of cells (tile, vehicle), and resamples its tiles."""
        tiles = np.array([tile for tile, _ in cells], dtype=object)
        vehicles = np.array([vehicle for _, vehicle in cells], dtype=object)
        names, tile = np.unique(tiles, return_inverse=True)
        _, vehicle = np.unique(vehicles, return_inverse=True)
        weights = resample(len(names), generator=generator, replicates=replicates)
        return cls(tile.reshape(-1), vehicle.reshape(-1), weights)

    def by_tile(self, counts: Num[np.ndarray, "S N K"]) -> Num[np.ndarray, "S C K"]:
        """Sums counts per tile."""
        return _summed(counts, *self._tile_order)

    def by_vehicle(self, counts: Num[np.ndarray, "S N K"]) -> Num[np.ndarray, "S V K"]:
        """Sums counts per vehicle of the fleet."""
        return _summed(counts, *self._vehicle_order)

    def replicates(self, counts: Num[np.ndarray, "S N 3"]) -> Float[np.ndarray, "R S 3"]:
        """Sums counts over the resampled tiles of every replicate; vehicles stay as they are."""
        return resampled(self.by_tile(counts), self.weights)

    @cached_property
    def _tile_order(self) -> tuple[np.ndarray, np.ndarray]:
        return _order(self.tile)

    @cached_property
    def _vehicle_order(self) -> tuple[np.ndarray, np.ndarray]:
        return _order(self.vehicle)


def _order(number: Int[np.ndarray, " N"]) -> tuple[np.ndarray, np.ndarray]:
    """Gives the cells group by group, and where each group starts."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(int(number.max()) + 1 if len(number) else 0))
    return order, starts


def _summed(
    counts: Num[np.ndarray, "S N K"], order: np.ndarray, starts: np.ndarray
) -> Num[np.ndarray, "S G K"]:
    if not len(starts):
        return counts
    return np.add.reduceat(counts[:, order], starts, axis=1)
