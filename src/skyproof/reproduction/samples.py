"""Scenes of a split, and sheets of sample images: camouflages, and the sensor's steps."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.cli.render import draw_scenes as draw_scenes
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch

SAMPLES = 6
"""Scenes of a sheet."""

_CROP_PX = 48

_STEPS = {
    "one sample a pixel": RenderSettings(
        supersampling=1, shadow_supersampling=1, blur_sigma_px=0.0
    ),
    "anti-aliasing": RenderSettings(blur_sigma_px=0.0),
    "anti-aliasing and blur": RenderSettings(),
}


@torch.no_grad()
def sample_strips(
    scenes: Sequence[Scene],
    fleet: Fleet,
    backgrounds: BackgroundSet,
    camouflages: Mapping[str, Callable[[VehicleBatch], VehicleBatch]],
) -> Iterator[tuple[str, UInt8[Tensor, "3 H W"]]]:
    """Draws the same scenes as bare ground, with vehicles as built, and with each camouflage.

    Yields:
        what is shown, and the scenes side by side.
    """
    side_px = scenes[0].camera.size_px
    yield "ground", _strip([backgrounds.window(scene.background, side_px) for scene in scenes])
    vehicles = placed_vehicles(fleet, scenes)
    renderer = TorchRenderer(backgrounds)
    yield "as built", _strip(list(renderer(scenes, vehicles).image))
    for name, camouflage in camouflages.items():
        yield name, _strip(list(renderer(scenes, camouflage(vehicles)).image))


@torch.no_grad()
def sensor_strips(
    scenes: Sequence[Scene], fleet: Fleet, backgrounds: BackgroundSet
) -> Iterator[tuple[str, UInt8[Tensor, "3 H W"]]]:
    """Draws one vehicle of each scene with the renderer's steps towards a photograph (S2.1, S2.2).

    Yields:
        the steps taken, and crops of 48 pixels a side, side by side.
    """
    vehicles = placed_vehicles(fleet, scenes)
    for label, settings in _STEPS.items():
        frames = TorchRenderer(backgrounds, settings)(scenes, vehicles)
        crops = []
        for index, image in enumerate(frames.image):
            box = frames.boxes[frames.scene_index == index][0]
            across, down = ((box[:2] + box[2:]) / 2).tolist()
            left, top = (
                round(min(max(middle - _CROP_PX / 2, 0), image.shape[-1] - _CROP_PX))
                for middle in (across, down)
            )
            crops.append(image[:, top : top + _CROP_PX, left : left + _CROP_PX])
        yield label, _strip(crops)


def _strip(images: Sequence[Float[Tensor, "3 H W"]]) -> UInt8[Tensor, "3 H sheet"]:
    return (torch.cat([image.cpu() for image in images], dim=2) * 255).round().byte()
