"""What a shape costs in practice: added volume and size, and surfaces that cross themselves."""

from dataclasses import dataclass

import torch

from skyproof.geometry.intersections import self_intersections
from skyproof.geometry.meshes import enclosed_volume_m3
from skyproof.vehicles.vehicle import VehicleBatch


@dataclass(frozen=True)
class ShapeMeasures:
    """One vehicle before and after a change of its shape; added values are after minus before.

    Attributes:
        intersections_before, intersections_after: pairs of crossing triangles, see
            `self_intersections`.
    """

    vehicle: str
    volume_m3: float
    added_volume_m3: float
    largest_displacement_m: float
    added_length_m: float
    added_width_m: float
    added_height_m: float
    intersections_before: int
    intersections_after: int


@torch.no_grad()
def measure_shape(before: VehicleBatch, after: VehicleBatch) -> tuple[ShapeMeasures, ...]:
    """Measures every vehicle of a batch as built and deformed, about 50 ms each."""
    if before.ids != after.ids:
        raise ValueError(
            f"expected the same vehicles before and after, got {before.ids} and {after.ids}"
        )
    faces = before.template.faces
    volume, volume_after = (
        enclosed_volume_m3(batch.vertices, faces).tolist() for batch in (before, after)
    )
    moved = (after.vertices - before.vertices).norm(dim=-1).amax(dim=1).tolist()
    size, size_after = (
        batch.vertices.amax(dim=1) - batch.vertices.amin(dim=1) for batch in (before, after)
    )
    added = (size_after - size).tolist()
    return tuple(
        ShapeMeasures(
            vehicle=vehicle,
            volume_m3=volume[row],
            added_volume_m3=volume_after[row] - volume[row],
            largest_displacement_m=moved[row],
            added_length_m=added[row][0],
            added_width_m=added[row][1],
            added_height_m=added[row][2],
            intersections_before=self_intersections(before.vertices[row], faces),
            intersections_after=self_intersections(after.vertices[row], faces),
        )
        for row, vehicle in enumerate(before.ids)
    )
