"""Makes the template mesh: 31 rings of 32 points and two poles, with one UV map."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.vehicles.vehicle import Template

RINGS = 31
COLUMNS = 32

# Columns, counted from the middle of the underside up the left side to the middle of the roof (16).
TOPOLOGY_SILL = 2  # lower outer edge: sill, bottom of the tyre
TOPOLOGY_BELT = 7  # shoulder: below it the side, above it the windows
TOPOLOGY_RAIL = 11  # roof rail: below it the windows, above it the roof

# Texels of a 512 map between two columns, for underside, lower side, window height and half roof.
# They divide 256 texels so that a texel on a saloon's painted parts is about 1 cm long; the
# underside gets the rest.
_TEXELS = (2 * [19.0], 5 * [18.8], 4 * [16.0], 5 * [12.0])


def column_u(dtype: torch.dtype = torch.float64) -> Float[Tensor, " 33"]:
    """u of the 33 UV columns; 0 and 1 are the seam in the middle of the underside."""
    widths = torch.tensor([width for group in _TEXELS for width in group], dtype=torch.float64)
    half = torch.cat([widths.new_zeros(1), widths.cumsum(0)]) / (2 * widths.sum())
    return torch.cat([half, 1.0 - half[:-1].flip(0)]).to(dtype)


def row_v(dtype: torch.dtype = torch.float64) -> Float[Tensor, " 33"]:
    """v of nose pole, 31 rings and tail pole: even, 16 texels of a 512 map in each interval."""
    return torch.linspace(0.0, 1.0, RINGS + 2, dtype=torch.float64).to(dtype)


def make_template() -> Template:
    """Makes the closed mesh all vehicles share: 994 vertices, 1984 triangles, 1087 UV points.

    Vertex `32 ring + column` for rings from nose to tail; 992 is the nose pole, 993 the tail pole.
    Column 0 runs along the middle of the underside, 8 up the left side, 16 along the middle of the
    roof, then down the right side. With row 0 on top the UV map shows the vehicle from above, nose
    up, its sides folded out.

    The reflection y -> -y takes column k to (32 - k) mod 32 and is **u -> 1 - u** with v unchanged:
    texel i goes to 511 - i. The seam lies in the middle of the underside. Each pole has 32 UV
    points, one per triangle, centred over the triangle's ring edge.

    Differences from the paper: the underside is split between both edges of the map, which keeps
    painted parts whole and the mirror an exact flip.
    """
    ring_vertex = torch.arange(RINGS * COLUMNS).view(RINGS, COLUMNS)
    vertex = torch.cat([ring_vertex, ring_vertex[:, :1]], dim=1)
    uv = torch.arange(RINGS * (COLUMNS + 1)).view(RINGS, COLUMNS + 1)
    nose, tail = RINGS * COLUMNS, RINGS * COLUMNS + 1
    nose_uv = uv.numel() + torch.arange(COLUMNS)
    tail_uv = nose_uv + COLUMNS

    faces = torch.cat([_fan(vertex[0], nose), _quads(vertex), _fan(vertex[-1], tail).flip(1)])
    face_uvs = torch.cat([_fan(uv[0], nose_uv), _quads(uv), _fan(uv[-1], tail_uv).flip(1)])

    u = column_u(torch.float32)
    v = row_v(torch.float32)
    grid = torch.stack(torch.meshgrid(u, v[1:-1], indexing="xy"), dim=-1)
    middle = (u[1:] + u[:-1]) / 2
    poles = [torch.stack([middle, torch.full_like(middle, end)], dim=1) for end in (0.0, 1.0)]
    ends = torch.tensor([[0.5, 0.0], [0.5, 1.0]])
    mirrored = ring_vertex[:, (COLUMNS - torch.arange(COLUMNS)) % COLUMNS].reshape(-1)
    return Template(
        faces=faces,
        face_uvs=face_uvs,
        uvs=torch.cat([grid.reshape(-1, 2), *poles]),
        mirror=torch.cat([mirrored, torch.tensor([nose, tail])]),
        vertex_uvs=torch.cat([grid[:, :-1].reshape(-1, 2), ends]),
    )


def _fan(ring: Int[Tensor, " 33"], pole: int | Int[Tensor, " 32"]) -> Int[Tensor, "32 3"]:
    """Returns triangles from a pole to each edge of a ring, wound for the nose pole."""
    apex = torch.as_tensor(pole).expand(COLUMNS)
    return torch.stack([apex, ring[:-1], ring[1:]], dim=1)


def _quads(grid: Int[Tensor, "31 33"]) -> Int[Tensor, "N 3"]:
    """Two triangles per grid cell, the diagonal mirrored on the right half."""
    upper_left, upper_right = grid[:-1, :-1], grid[:-1, 1:]
    lower_left, lower_right = grid[1:, :-1], grid[1:, 1:]
    falling = [(upper_left, lower_left, lower_right), (upper_left, lower_right, upper_right)]
    rising = [(upper_left, lower_left, upper_right), (upper_right, lower_left, lower_right)]
    half = COLUMNS // 2
    left, right = (
        torch.stack([torch.stack(corners, -1) for corners in pair], dim=2)
        for pair in (falling, rising)
    )
    return torch.cat([left[:, :half], right[:, half:]], dim=1).reshape(-1, 3)
