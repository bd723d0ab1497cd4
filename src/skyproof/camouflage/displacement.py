"""One universal displacement map that pushes every vehicle's surface outward: S-O and R-S-O."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from skyproof.camouflage.camouflage import Camouflage, random_part
from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.vehicles.vehicle import Part, Template, VehicleBatch

DISPLACEMENT_SIZE = 64

_START = 0.5  # half-way out, as sigmoid(0) is (section S4.3: "initialised with zeros")


class DisplacementMap(Camouflage):
    """Moves every vertex away from the middle of its vehicle, further where the map is bright.

    Vertex i moves by PM * W * D_i * R_i / |R_i|: D_i in [0, 1] is the symmetric map at the vertex'
    UV, R_i the vector from the mean of the vertices, W the vehicle's width (section S4.3).

    Differences from the paper: its sigmoid of D_i * R_i, a vector, would push every vertex towards
    one corner. D itself is clipped to [0, 1], because values at the flat ends of a sigmoid hardly
    move, and starts half-way. By the method "paper" D is the sigmoid of a map that starts with
    zeros, taken before the map is read; vertices move along R_i all the same. Wheels and underside
    stay, and no vertex is pushed below the ground, so that a deformed vehicle can roll.

    Vertices slide along their rays from the middle, so a body that is visible from there never
    crosses itself. A pickup's bed is not, and does (see `measure_shape`). A generator draws D and
    its mirror image for a random control.

    Attributes:
        reach: `[64, 64]` D before symmetry; rows from nose to tail, columns as in `Template.uvs`.
    """

    def __init__(
        self,
        name: CamouflageName,
        *,
        generator: torch.Generator | None = None,
        frozen_parts: bool = True,
    ) -> None:
        super().__init__()
        if name.magnitude is None:
            raise ConfigurationError(
                f"A shape expects a name with a magnitude, such as S-O@0.4, got {name}."
            )
        self.name = name
        self.magnitude = name.magnitude
        self.frozen_parts = frozen_parts
        self._in_paper_form = False
        start = torch.full((DISPLACEMENT_SIZE, DISPLACEMENT_SIZE), _START)
        if generator is not None:
            half = torch.rand(DISPLACEMENT_SIZE, DISPLACEMENT_SIZE // 2, generator=generator)
            start = torch.cat((half, half.flip(1)), dim=1)
        self.reach = nn.Parameter(start)

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """Deforms the vehicles; at PM = 0 they are returned as they are, without a gradient."""
        if self.magnitude == 0.0:
            return vehicles
        vertices = vehicles.vertices
        template = vehicles.template
        radius = vertices - vertices.mean(dim=1, keepdim=True)
        direction = torch.nn.functional.normalize(radius, dim=-1)
        width = vertices[..., 1].amax(dim=1) - vertices[..., 1].amin(dim=1)
        sampled = sample_map(self.map(), template.vertex_uvs.to(self.reach.dtype))
        # Mirrored vertices read the map at places that are mirrored up to rounding only.
        sampled = (sampled + sampled[template.mirror]) / 2
        distance = self.magnitude * width[:, None] * sampled.to(vertices.dtype)
        if self.frozen_parts:
            distance = distance.masked_fill(_frozen(vehicles), 0.0)
        distance = torch.minimum(distance, _way_to_ground(vertices, direction))
        return replace(vehicles, vertices=vertices + distance[..., None] * direction)

    def map(self) -> Float[Tensor, "64 64"]:
        """Returns the symmetric map: the fraction of PM * W by which each place moves."""
        both = (self.reach + self.reach.flip(1)) / 2
        return both.sigmoid() if self._in_paper_form else both

    @torch.no_grad()
    def paper_form_(self, on: bool) -> None:
        """Turns `reach` into the argument of the sigmoid, or back into D."""
        if on != self._in_paper_form:
            self.reach.copy_(torch.logit(self.reach, eps=1e-6) if on else self.map())
            self._in_paper_form = on

    @torch.no_grad()
    def project_(self) -> None:
        if not self._in_paper_form:
            self.reach.clamp_(0.0, 1.0)

    @torch.no_grad()
    def vary_(self, generator: torch.Generator) -> None:
        """Sets a rectangle and its mirror image to another displacement, drawn at random."""
        rows, columns = random_part(DISPLACEMENT_SIZE, generator=generator)
        value = float(torch.rand((), generator=generator))
        self.reach[rows, columns] = value
        mirrored = slice(DISPLACEMENT_SIZE - columns.stop, DISPLACEMENT_SIZE - columns.start)
        self.reach[rows, mirrored] = value

    @torch.no_grad()
    def finalise(self) -> None:
        """Stores the symmetric map that is applied."""
        self.paper_form_(False)
        self.project_()
        self.reach.copy_(self.map())


def even_shape(name: CamouflageName) -> DisplacementMap:
    """The plain-paint control of a shape: every vertex out as far as the name allows."""
    shape = DisplacementMap(name)
    with torch.no_grad():
        shape.reach.fill_(1.0)
    shape.finalise()
    return shape.requires_grad_(False)


def sample_map(values: Float[Tensor, "64 64"], uvs: Float[Tensor, "V 2"]) -> Float[Tensor, " V"]:
    """Reads a map bilinearly between texel centres (i + 0.5) / 64, circular in u (section S4.3)."""
    column = uvs[:, 0] * DISPLACEMENT_SIZE - 0.5
    row = (uvs[:, 1] * DISPLACEMENT_SIZE - 0.5).clamp(0.0, DISPLACEMENT_SIZE - 1.0)
    left = column.floor()
    top = row.floor()
    across = column - left
    down = row - top
    columns = torch.stack((left, left + 1), dim=-1).long() % DISPLACEMENT_SIZE
    rows = torch.stack((top, top + 1), dim=-1).long().clamp(max=DISPLACEMENT_SIZE - 1)
    upper, lower = values[rows[:, :, None], columns[:, None, :]].unbind(1)
    between = upper + down[:, None] * (lower - upper)
    return between[:, 0] + across * (between[:, 1] - between[:, 0])


def _frozen(vehicles: VehicleBatch) -> Bool[Tensor, "N V"]:
    """Vertices on or at the edge of wheel or underside, always with their mirror images."""
    template: Template = vehicles.template
    size = vehicles.parts.shape[-1]
    column, row = (template.vertex_uvs * size).long().clamp(max=size - 1).unbind(1)
    parts = vehicles.parts[:, row, column]
    frozen = (parts == Part.WHEEL) | (parts == Part.UNDERSIDE)
    # A vertex between two texels reads one of them, its mirror image the other.
    return frozen | frozen[:, template.mirror]


def _way_to_ground(
    vertices: Float[Tensor, "N V 3"], direction: Float[Tensor, "N V 3"]
) -> Float[Tensor, "N V"]:
    """How far each vertex may go along its direction before z = 0; infinite unless it goes down."""
    height = vertices[..., 2].clamp(min=0.0)
    fall = -direction[..., 2]
    return torch.where(fall > 0, height / fall.clamp(min=1e-9), torch.inf)
