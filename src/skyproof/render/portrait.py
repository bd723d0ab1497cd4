"""Close-ups of vehicles, also beside the meshes they come from: for looking, not for measuring."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import Fleet
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
# Azimuth and elevation of the viewer in degrees.
_VIEWS = ((-90.0, 90.0), (-90.0, 0.0), (40.0, 30.0))
_WIDTH_PX, _HEIGHT_PX, _CAPTION_PX = 320, 200, 16
_GROUND = 0.45
_PORTRAIT_SIDE_M = 6.0
_PORTRAIT_GSD_M = 0.02
_SHADOW_M = 0.4
_SUN = Sun(azimuth_rad=math.radians(140), elevation_rad=math.radians(48))


class _Asphalt:
    """Even grey ground, without a sensor's blur or noise."""

    def window(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "3 H W"]:
        return torch.full((3, size_px, size_px), 0.46)

    def sensor_of(self, window: BackgroundWindow) -> Sensor:
        return Sensor(blur_sigma_px=0.0, noise=0.0)

    def light_of(self, window: BackgroundWindow) -> Light:
        return Light()

    def cover_of(self, window: BackgroundWindow, size_px: int) -> None:
        return None


@torch.no_grad()
def close_up(
    vehicles: VehicleBatch,
    *,
    gsd_m: float = 0.015,
    side_m: float = 6.4,
    tilt_rad: float = 0.0,
    heading_rad: float = 0.0,
) -> UInt8[Tensor, "N 3 H W"]:
    """Renders every vehicle alone on grey ground, without blur, in the renderer's own light."""
    camera = Camera(tilt_rad, math.radians(-100), gsd_m, round(side_m / gsd_m))
    window = BackgroundWindow("plain", 0.0, 0.0, 0.0)
    renderer = TorchRenderer(_Asphalt(), RenderSettings(supersampling=3, blur_sigma_px=0.0))
    pictures = []
    for index, name in enumerate(vehicles.ids):
        scene = Scene(name, window, camera, _SUN, (Placement(name, 0.0, 0.0, heading_rad),), seed=0)
        pictures.append((renderer([scene], vehicles.row(index)).image[0] * 255).round().byte())
    return torch.stack(pictures)


def portrait(
    fleet: Fleet, camouflage: Callable[[VehicleBatch], VehicleBatch]
) -> UInt8[Tensor, "3 H W"]:
    """Draws a sheet of one column per body type, as built and camouflaged, from above and aslant.

    It shows the first vehicle of at most four body types on one square of ground: 6 m a side, or
    more for longer bodies.
    """
    first: dict[str, str] = {}
    for name in fleet.ids:
        first.setdefault(name.rpartition("-")[0], name)
    vehicles = fleet.batch([first[body] for body in sorted(first)][:4])
    camouflaged = camouflage(vehicles)
    reach_m = float(camouflaged.vertices[..., :2].norm(dim=-1).max())
    side_m = max(_PORTRAIT_SIDE_M, 2 * reach_m + _SHADOW_M)
    rows = []
    for tilt_rad in (0.0, math.radians(40)):
        for worn in (vehicles, camouflaged):
            pictures = close_up(
                worn,
                tilt_rad=tilt_rad,
                heading_rad=math.radians(12),
                gsd_m=_PORTRAIT_GSD_M,
                side_m=side_m,
            )
            rows.append(torch.cat(list(pictures), dim=2))
    return torch.cat(rows, dim=1)


def turntable_row(
    mesh: SourceMesh, vehicles: VehicleBatch, caption: str
) -> UInt8[np.ndarray, "H W 3"]:
    """Draws one vehicle and its mesh from above, the side and aslant, and its maps."""
    texture = (vehicles.worn_texture()[0].permute(1, 2, 0).double() / 255).numpy()
    labels = np.array(list(PART_COLOURS.values()))[vehicles.parts[0].numpy()] / 255
    template = vehicles.template
    uvs = template.uvs[template.face_uvs].double().numpy()
    wrapped = vehicles.vertices[0][template.faces].double().numpy()

    def worn(face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        place = np.einsum("nk,nkc->nc", weights, uvs[face]) * TEXTURE_SIZE
        column, row = place.astype(int).clip(0, TEXTURE_SIZE - 1).T
        return texture[row, column]

    length = float(np.ptp(wrapped[..., 0]))
    side_m = length * 1.15
    rendered = close_up(
        vehicles, gsd_m=side_m / _WIDTH_PX, side_m=side_m, tilt_rad=math.radians(20)
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
    return captioned(_bytes(np.concatenate(cells, axis=1)), caption)


def captioned(row: UInt8[np.ndarray, "_ _ 3"], caption: str) -> UInt8[np.ndarray, "_ _ 3"]:
    """Writes a caption above a picture."""
    picture = Image.new("RGB", (row.shape[1], row.shape[0] + _CAPTION_PX), "white")
    picture.paste(Image.fromarray(row), (0, _CAPTION_PX))
    ImageDraw.Draw(picture).text((4, 2), caption, fill="black")
    return np.array(picture)


def _views(
    corners: Float[np.ndarray, "F 3 3"],
    colours: Callable[[np.ndarray, np.ndarray], np.ndarray],
    length: float,
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
