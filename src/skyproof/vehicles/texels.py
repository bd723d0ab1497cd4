"""Measures how large texels are on a vehicle, and finds which are roof, bonnet or sides."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.vehicles.template import (
    COLUMNS,
    RINGS,
    TOPOLOGY_BELT,
    TOPOLOGY_RAIL,
    TOPOLOGY_SILL,
    column_u,
)
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, VehicleBatch

_ROWS = TEXTURE_SIZE // (RINGS + 1)  # texels between two rings; whole, because rings are even in v


def texel_metric(
    vehicles: VehicleBatch,
) -> tuple[Float[Tensor, "N 512 512"], Float[Tensor, "N 512 512"], Float[Tensor, "N 512 512"]]:
    """Measures length across, length along and area of every texel, at the present vertices.

    For lengths each template cell is a bilinear patch. The area of its two triangles is divided
    evenly, so that texels add up to the mesh's area. A pole's cells are quads with one side shrunk
    to the pole. Results are in metres and square metres, on the CPU.
    """
    vertices = vehicles.vertices.detach().double().cpu()
    grid = vertex_grid(vertices)
    to_texels = _column_shares()

    # Edges of the rings, interpolated from one ring to the next at each row's middle.
    across = grid.diff(dim=2)
    down = ((torch.arange(_ROWS, dtype=torch.float64) + 0.5) / _ROWS)[:, None, None]
    edges = torch.lerp(across[:, :-1, None], across[:, 1:, None], down).flatten(1, 2).norm(dim=-1)
    length_u = edges.float() @ to_texels.float()

    column, right = _place_in_cells()
    along = grid.diff(dim=1)
    left_side, right_side = along[:, :, column], along[:, :, column + 1]
    spans = torch.lerp(left_side, right_side, right[:, None]).norm(dim=-1) / _ROWS
    length_v = spans.float().repeat_interleave(_ROWS, dim=1)

    share_of_row = torch.full((RINGS + 1, _ROWS), 1 / _ROWS, dtype=torch.float64)
    share_of_row[0] = (2 * torch.arange(_ROWS) + 1) / _ROWS**2
    share_of_row[-1] = share_of_row[0].flip(0)
    cells = _cell_areas(vertices, vehicles)
    rows = (cells[:, :, None] * share_of_row[None, :, :, None]).flatten(1, 2)
    return length_u, length_v, rows.float() @ to_texels.float()


def texel_regions(vehicles: VehicleBatch) -> dict[str, Bool[Tensor, "N 512 512"]]:
    """Masks roof, bonnet, sides (between sill and shoulder), glass and underside, on the CPU.

    Bonnet and roof are painted texels inside the roof rail, before and behind the first glass of
    the middle column.
    """
    parts = vehicles.parts.cpu()
    body, glass = parts == Part.BODY, parts == Part.GLASS
    column, _ = _place_in_cells()
    half_column = torch.minimum(column, COLUMNS - 1 - column)
    first_glass = glass[:, :, TEXTURE_SIZE // 2].int().argmax(1)
    behind = torch.arange(TEXTURE_SIZE)[None] >= first_glass[:, None]
    rail_height = _centre_height(vehicles)
    high = rail_height > 0.9 * rail_height.amax(1, keepdim=True)
    top = body & (half_column >= TOPOLOGY_RAIL)
    return {
        "roof": top & (behind & high)[:, :, None],
        "bonnet": top & ~behind[:, :, None],
        "sides": body & (half_column >= TOPOLOGY_SILL) & (half_column < TOPOLOGY_BELT),
        "glass": glass,
        "underside": parts == Part.UNDERSIDE,
    }


def is_floor(
    column: Tensor, height_m: Float[Tensor, "512 W"], clearance_m: float
) -> Bool[Tensor, "512 W"]:
    """Returns the underside's texels, except where its columns run up the end faces."""
    ring = torch.arange(TEXTURE_SIZE)[:, None] / TEXTURE_SIZE * (RINGS + 1)
    end_face = (ring < 3) | (ring > RINGS - 2)
    return (column <= TOPOLOGY_SILL) & ~(end_face & (height_m > clearance_m + 0.12))


def _place_in_cells() -> tuple[Int[Tensor, " 512"], Float[Tensor, " 512"]]:
    """Returns the template column that holds the centre of each texel column, and where in it."""
    u = column_u()
    centre = (torch.arange(TEXTURE_SIZE, dtype=torch.float64) + 0.5) / TEXTURE_SIZE
    column = (torch.searchsorted(u, centre) - 1).clamp(0, COLUMNS - 1)
    return column, (centre - u[column]) / (u[column + 1] - u[column])


def vertex_grid(vertices: Float[Tensor, "N V 3"]) -> Float[Tensor, "N 33 33 3"]:
    """Returns nose pole, rings and tail pole, the first column repeated after the last."""
    rings = vertices[:, : RINGS * COLUMNS].unflatten(1, (RINGS, COLUMNS))
    nose, tail = (vertices[:, pole, None, None].expand(-1, 1, COLUMNS, 3) for pole in (-2, -1))
    grid = torch.cat([nose, rings, tail], dim=1)
    return torch.cat([grid, grid[:, :, :1]], dim=2)


def _cell_areas(
    vertices: Float[Tensor, "N V 3"], vehicles: VehicleBatch
) -> Float[Tensor, "N 32 32"]:
    """Returns each cell's area, from its two triangles (one at the poles) of `make_template`."""
    a, b, c = vertices[:, vehicles.template.faces.cpu()].unbind(2)
    triangles = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    quads = triangles[:, COLUMNS:-COLUMNS].unflatten(1, (RINGS - 1, COLUMNS, 2)).sum(-1)
    return torch.cat([triangles[:, None, :COLUMNS], quads, triangles[:, None, -COLUMNS:]], dim=1)


def _column_shares() -> Float[Tensor, "32 512"]:
    """Returns which share of each cell column lies in each texel column, which may straddle two."""
    edges = column_u() * TEXTURE_SIZE
    left = torch.arange(TEXTURE_SIZE, dtype=torch.float64)
    overlap = torch.minimum(edges[1:, None], left + 1) - torch.maximum(edges[:-1, None], left)
    return overlap.clamp(min=0.0) / edges.diff()[:, None]


def _centre_height(vehicles: VehicleBatch) -> Float[Tensor, "N 512"]:
    """Returns the height of the middle of the roof line at each row of the map."""
    half = COLUMNS // 2
    heights = vehicles.vertices[:, half : RINGS * COLUMNS : COLUMNS, 2].cpu()
    line = torch.cat([heights[:, :1], heights, heights[:, -1:]], dim=1)
    return torch.nn.functional.interpolate(
        line[:, None], size=TEXTURE_SIZE, mode="linear", align_corners=True
    )[:, 0]
