"""A sheet of wrapped vehicles beside the meshes they come from: for looking, not for measuring."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from skyproof.render.portrait import close_up
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, VehicleBatch
from skyproof.vehicles.wrapping.meshes import SourceMesh
from skyproof.vehicles.wrapping.views import parallel_view, view_axes

PART_COLOURS = {
    Part.BODY: (200, 200, 200),
    Part.GLASS: (60, 110, 200),
    Part.LIGHT: (250, 230, 60),
    Part.WHEEL: (40, 40, 40),
    Part.BUMPER: (230, 120, 40),
    Part.TRIM: (150, 60, 160),
    Part.UNDERSIDE: (110, 80, 60),
}
_VIEWS = (
    (-90.0, 90.0),
    (-90.0, 0.0),
    (40.0, 30.0),
)  # azimuth and elevation of the viewer in degrees
_WIDTH_PX, _HEIGHT_PX, _CAPTION_PX = 320, 200, 16
_GROUND = 0.45

Colours = Callable[[np.ndarray, np.ndarray], np.ndarray]


def turntable_row(mesh: SourceMesh, vehicles: VehicleBatch, caption: str) -> UInt8[Tensor, "3 H W"]:
    """Draws one vehicle and its mesh in the vehicle's axes from above, the side and aslant, and its
    maps.
    """
    texture = (vehicles.worn_texture()[0].permute(1, 2, 0).double() / 255).numpy()
    labels = np.array(list(PART_COLOURS.values()))[vehicles.parts[0].numpy()] / 255
    template = vehicles.template
    uvs = template.uvs[template.face_uvs].double().numpy()
    wrapped = vehicles.vertices[0][template.faces].double().numpy()

    def worn(face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        column, row = (
            (np.einsum("nk,nkc->nc", weights, uvs[face]) * TEXTURE_SIZE).astype(int).clip(0, 511).T
        )
        return texture[row, column]

    length = float(np.ptp(wrapped[..., 0]))
    rendered = close_up(
        vehicles,
        gsd_m=length * 1.15 / _WIDTH_PX,
        side_m=length * 1.15,
        tilt_rad=math.radians(20),
        heading_rad=0.0,
    )[0]
    above = (_WIDTH_PX - _HEIGHT_PX) // 2
    cells = [
        *_views(mesh.corners, lambda face, weights: mesh.look(face, weights)[0], length),
        *_views(wrapped, worn, length),
        rendered.permute(1, 2, 0).numpy()[above : above + _HEIGHT_PX] / 255,
        *(
            np.asarray(Image.fromarray(_bytes(image)).resize((_HEIGHT_PX, _HEIGHT_PX))) / 255
            for image in (texture, labels)
        ),
    ]
    row = Image.fromarray(_bytes(np.concatenate(cells, axis=1)))
    sheet = Image.new("RGB", (row.width, row.height + _CAPTION_PX), "white")
    sheet.paste(row, (0, _CAPTION_PX))
    ImageDraw.Draw(sheet).text((4, 2), caption, fill="black")
    return torch.from_numpy(np.array(sheet)).permute(2, 0, 1)


def turntable_sheet(rows: Sequence[UInt8[Tensor, "3 H W"]]) -> UInt8[Tensor, "3 H W"]:
    """Rows below one another."""
    return torch.cat(list(rows), dim=1)


def _views(
    corners: Float[np.ndarray, "F 3 3"], colours: Colours, length: float
) -> list[np.ndarray]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    light = 0.5 + 0.5 * np.abs(normal @ np.array([0.35, -0.5, 0.79]))
    middle = np.array([0.0, 0.0, (corners[..., 2].max()) / 2])
    pixel = length * 1.12 / _WIDTH_PX
    pictures = []
    for azimuth, elevation in _VIEWS:
        axes = view_axes(azimuth, elevation)
        corner = (axes @ middle)[:2] - pixel * np.array([_WIDTH_PX, _HEIGHT_PX]) / 2
        seen = parallel_view(corners @ axes.T, corner, pixel, (_HEIGHT_PX, _WIDTH_PX))
        hit = seen.face >= 0
        picture = np.full((*seen.face.shape, 3), _GROUND)
        picture[hit] = colours(seen.face[hit], seen.weights[hit]) * light[seen.face[hit], None]
        pictures.append(picture)
    return pictures


def _bytes(picture: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (picture.clip(0.0, 1.0) * 255).round().astype(np.uint8)
