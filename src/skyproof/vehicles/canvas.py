"""The left half of a texture map while a body is painted, and where its texels lie."""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.vehicles.bodies import Body
from skyproof.vehicles.template import COLUMNS, TOPOLOGY_BELT, TOPOLOGY_SILL, column_u, row_v
from skyproof.vehicles.texels import is_floor
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part

Mask = Bool[Tensor, "512 256"]
Colour = Float[Tensor, " 3"] | tuple[float, float, float]


class TextureCanvas:
    """The left half of a map being painted; places are `[512, 256]` or `[512, 1]`, in metres."""

    def __init__(self, body: Body, paint: Tensor) -> None:
        rows, columns, column = _texel_weights()
        x, self.y, self.z = (rows @ body.half[..., axis].float() @ columns for axis in range(3))
        half_length = body.dimensions.length / 2
        self.body = body
        self.behind = half_length - x  # distance behind the nose
        self.ahead = x + half_length  # distance ahead of the tail
        self.column = column[None]  # `[1, 256]` column coordinate, 0 to 16
        self.upper = self.column > TOPOLOGY_BELT  # above the shoulder
        self.side = (self.column > TOPOLOGY_SILL) & ~self.upper  # the lower side
        self.floor = is_floor(self.column, self.z, body.dimensions.clearance)
        # `[512, 1]`: distance of the texel's cross-section behind the nose, shoulder and roof rail.
        self.station, self.belt, self.rail_z, self.rail_y = (
            (rows @ row.float())[:, None]
            for row in (body.station, body.belt_z, body.rail_z, body.rail_y)
        )
        self.colour: Float[Tensor, "3 512 256"] = paint.view(3, 1, 1).expand(3, *x.shape).clone()
        self.parts = torch.full(x.shape, int(Part.BODY), dtype=torch.uint8)

    def fill(self, where: Mask, colour: Colour, part: Part) -> None:
        self.colour = torch.where(where, torch.as_tensor(colour).view(3, 1, 1), self.colour)
        self.parts.masked_fill_(where, int(part))

    def shade(self, where: Mask, factor: float) -> None:
        self.colour = torch.where(where, self.colour * factor, self.colour)


@lru_cache(maxsize=1)
def _texel_weights() -> tuple[Tensor, Tensor, Tensor]:
    """Bilinear weights of rows `[512, 33]` and columns `[17, 256]`, and columns' coordinates."""
    centre = (torch.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE

    def weights(at: Tensor, knots: Tensor) -> Tensor:
        right = torch.searchsorted(knots, at).clamp(1, len(knots) - 1)
        share = (at - knots[right - 1]) / (knots[right] - knots[right - 1])
        out = torch.zeros(len(at), len(knots))
        out.scatter_(1, (right - 1)[:, None], (1 - share)[:, None])
        return out.scatter_(1, right[:, None], share[:, None])

    half = COLUMNS // 2
    rows = weights(centre, row_v(torch.float32))
    columns = weights(centre[: TEXTURE_SIZE // 2], column_u(torch.float32)[: half + 1])
    return rows, columns.T.contiguous(), columns @ torch.arange(half + 1.0)


def between(value: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    return (value > low) & (value < high)
