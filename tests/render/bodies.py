"""Small closed bodies on a template of their own, so that tests do not depend on the fleet."""

import dataclasses
import math
from collections.abc import Mapping

import torch

from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.scenes.sensor import PAPER_BLUR_SIGMA_PX, Sensor
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Template, VehicleBatch

PAPER_SENSOR = Sensor(PAPER_BLUR_SIGMA_PX)


def sphere_template(rings: int = 31, columns: int = 32) -> Template:
    """Builds rings between two poles, as the fleet's template has, with evenly spaced (u, v)."""
    count = rings * columns
    nose, tail = count, count + 1
    faces, face_uvs = [], []
    uvs = [(c / columns, (r + 1) / (rings + 1)) for r in range(rings) for c in range(columns + 1)]
    first_pole = len(uvs)
    uvs += [((c + 0.5) / columns, 0.0) for c in range(columns)] + [
        ((c + 0.5) / columns, 1.0) for c in range(columns)
    ]

    def vertex(ring: int, column: int) -> int:
        return ring * columns + column % columns

    def texel(ring: int, column: int) -> int:
        return ring * (columns + 1) + column

    for c in range(columns):
        faces.append((nose, vertex(0, c), vertex(0, c + 1)))
        face_uvs.append((first_pole + c, texel(0, c), texel(0, c + 1)))
        faces.append((tail, vertex(rings - 1, c + 1), vertex(rings - 1, c)))
        face_uvs.append((first_pole + columns + c, texel(rings - 1, c + 1), texel(rings - 1, c)))
        for r in range(rings - 1):
            a, b, d, e = (r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)
            for corners in ((a, d, e), (a, e, b)):
                faces.append(tuple(vertex(*corner) for corner in corners))
                face_uvs.append(tuple(texel(*corner) for corner in corners))
    mirror = list(range(count + 2))
    vertex_uvs = [
        (c / columns, (r + 1) / (rings + 1)) for r in range(rings) for c in range(columns)
    ]
    vertex_uvs += [(0.5, 0.0), (0.5, 1.0)]
    return Template(
        torch.tensor(faces),
        torch.tensor(face_uvs),
        torch.tensor(uvs),
        torch.tensor(mirror),
        torch.tensor(vertex_uvs),
    )


def rounded_box(
    length_m: float = 4.4,
    width_m: float = 1.8,
    height_m: float = 1.5,
    power: float = 0.5,
    rings: int = 31,
    columns: int = 32,
) -> torch.Tensor:
    """Returns a superellipsoid on the ground; power 1 is an ellipsoid, below 1 is boxier."""

    def bent(value: float) -> float:
        return math.copysign(abs(value) ** power, value)

    points = []
    for r in range(rings):
        polar = math.pi * (r + 1) / (rings + 1)
        for c in range(columns):
            around = 2 * math.pi * c / columns
            radius = bent(math.sin(polar))
            # As in the fleet's template: from the middle of the underside up the left side, so
            # faces look outward.
            points.append(
                (
                    bent(math.cos(polar)),
                    radius * bent(math.sin(around)),
                    -radius * bent(math.cos(around)),
                )
            )
    points += [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)]
    half = torch.tensor([length_m, width_m, height_m]) / 2
    return (torch.tensor(points) * half + torch.tensor([0.0, 0.0, height_m / 2]))[None]


def smooth_texture(seed: int, count: int = 1, size: int = TEXTURE_SIZE) -> torch.Tensor:
    """A colourful texture without fine detail, continuous across the seam."""
    coarse = torch.rand(count, 3, 8, 8, generator=torch.Generator().manual_seed(seed))
    wide = torch.nn.functional.pad(coarse, (2, 2, 0, 0), mode="circular")
    full = torch.nn.functional.interpolate(
        wide, size=(size, size * 12 // 8), mode="bicubic", align_corners=False
    )
    margin = size * 2 // 8
    return (full[..., margin : margin + size] * 0.7 + 0.1).clamp(0.05, 0.95)


def vehicles(count: int = 1, seed: int = 0) -> VehicleBatch:
    """Rounded boxes with colourful textures."""
    return VehicleBatch(
        sphere_template(),
        rounded_box().repeat(count, 1, 1),
        smooth_texture(seed, count),
        torch.zeros(count, TEXTURE_SIZE, TEXTURE_SIZE, dtype=torch.uint8),
        tuple(f"box-{index:04d}" for index in range(count)),
    )


def double(batch: VehicleBatch) -> VehicleBatch:
    """The same vehicles in float64, for gradient checks."""
    template = batch.template
    template = dataclasses.replace(
        template, uvs=template.uvs.double(), vertex_uvs=template.vertex_uvs.double()
    )
    return dataclasses.replace(
        batch, template=template, vertices=batch.vertices.double(), texture=batch.texture.double()
    )


class PlainGround:
    """A background source: one grey, or noise with a fixed seed."""

    def __init__(
        self,
        value: float | None = 0.4,
        sensors: Mapping[str, Sensor] | None = None,
        light: Light | None = None,
        cover: torch.Tensor | None = None,
    ) -> None:
        self.value, self.sensors = value, sensors or {}
        self.light = light or Light()
        self.cover = cover

    def sensor_of(self, window: BackgroundWindow) -> Sensor:
        """What took each tile; the paper's where nothing else is said."""
        return self.sensors.get(window.tile, PAPER_SENSOR)

    def light_of(self, window: BackgroundWindow) -> Light:
        """How it shows light."""
        return self.light

    def cover_of(self, window: BackgroundWindow, size_px: int) -> torch.Tensor | None:
        """What covers the ground; nothing where none is given."""
        return self.cover

    def window(self, window: BackgroundWindow, size_px: int) -> torch.Tensor:
        if self.value is None:
            return torch.rand(3, size_px, size_px, generator=torch.Generator().manual_seed(7))
        return torch.full((3, size_px, size_px), self.value)


def scene(
    *places: tuple[float, float, float],
    tilt_deg: float = 12.0,
    size_px: int = 96,
    sun_elevation_deg: float = 45.0,
    seed: int = 0,
    name: str = "s0",
) -> Scene:
    """One scene with a vehicle at every (x, y, heading in degrees)."""
    return Scene(
        name,
        BackgroundWindow("tile", 0.0, 0.0, 0.0),
        Camera(math.radians(tilt_deg), 0.7, 0.125, size_px),
        Sun(2.0, math.radians(sun_elevation_deg)),
        tuple(
            Placement("box-0000", float(x), float(y), math.radians(heading))
            for x, y, heading in places
        ),
        seed,
    )
