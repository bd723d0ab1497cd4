"""Close-ups of vehicles on plain ground: for looking, not for measuring."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch

_PORTRAIT_SIDE_M = 6.0
_SHADOW_M = 0.4
_SUN = Sun(azimuth_rad=math.radians(140), elevation_rad=math.radians(48))


class _Asphalt:
    """Even grey ground, and no sensor to see it by."""

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
    """Every vehicle alone on grey ground, sharp, in the renderer's own light."""
    size_px = round(side_m / gsd_m)
    camera = Camera(tilt_rad, math.radians(-100), gsd_m, size_px)
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
    chosen = [first[body] for body in sorted(first)][:4]
    vehicles = fleet.batch(chosen)
    camouflaged = camouflage(vehicles)
    reach_m = float(camouflaged.vertices[..., :2].norm(dim=-1).max())
    side_m = max(_PORTRAIT_SIDE_M, 2 * reach_m + _SHADOW_M)
    rows = []
    for tilt_rad in (0.0, math.radians(40)):
        for worn in (vehicles, camouflaged):
            pictures = close_up(
                worn, tilt_rad=tilt_rad, heading_rad=math.radians(12), gsd_m=0.02, side_m=side_m
            )
            rows.append(torch.cat(list(pictures), dim=2))
    return torch.cat(rows, dim=1)
