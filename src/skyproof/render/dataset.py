"""Scenes drawn to disk: the same scenes with and without camouflage are matched pairs (section S5.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.files import finished_folder
from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.render.frames import Renderer
from skyproof.scenes.scene import Scene, write_scenes
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["ground_corners", "placed_vehicles", "render_dataset"]


def placed_vehicles(fleet: Fleet, scenes: Sequence[Scene]) -> VehicleBatch:
    """One row per placement, scene by scene, as renderers expect."""
    return fleet.batch([placement.vehicle for scene in scenes for placement in scene.placements])


@torch.no_grad()
def ground_corners(scenes: Sequence[Scene], vehicles: VehicleBatch) -> Float[Tensor, "N 4 2"]:
    """Where the rectangle around each vehicle's plan lies in its image, on the ground, whatever the camera's tilt.

    Args:
        scenes: all of one image size and ground sampling distance.
        vehicles: one row per placement, scene by scene.

    Returns:
        `[N, 4, 2]` pixel (x, y) of front left, front right, rear right and rear left; not cut at the image border.
    """
    placements = [placement for scene in scenes for placement in scene.placements]
    # On the CPU, so that a dataset has the same labels wherever it was drawn.
    plan = vehicles.vertices[..., :2].cpu()
    (rear, right), (front, left) = plan.amin(1).unbind(-1), plan.amax(1).unbind(-1)
    xs, ys = torch.stack((front, front, rear, rear), 1), torch.stack((left, right, right, left), 1)
    local = torch.stack((xs, ys, torch.zeros_like(xs)), -1)
    heading = plan.new_tensor([placement.heading_rad for placement in placements])
    place = plan.new_tensor([[placement.x_m, placement.y_m, 0.0] for placement in placements]).view(
        -1, 1, 3
    )
    upright = plan.new_tensor([[0.0, 0.0, 1.0]]).expand(len(placements), 3)
    camera = scenes[0].camera
    return project(
        rotate_about_vertical(local, heading) + place, upright, camera.gsd_m, camera.size_px
    )[0]


@torch.no_grad()
def render_dataset(
    folder: Path,
    scenes: Sequence[Scene],
    fleet: Fleet,
    renderer: Renderer,
    *,
    camouflage: Callable[[VehicleBatch], VehicleBatch] | None = None,
    batch_size: int = 8,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Writes `images/*.png`, `annotations.json` (COCO) and `scenes.jsonl`; whole or not at all.

    Args:
        folder: must not exist yet.
        scenes: all of one image size.
        fleet: holds every vehicle the scenes name.
        renderer: differentiable or not.
        camouflage: changes the vehicles before they are drawn; None leaves them as they are.
        progress: called with (images done, images in all).

    Raises:
        RunFolderError: the folder exists, or the disk cannot take it.
    """
    gsd_m, source = (
        scenes[0].camera.gsd_m,
        {"renderer": renderer.name, "rendering": renderer.record()},
    )
    with (
        finished_folder(folder) as partial,
        CocoWriter(partial, gsd_m=gsd_m, source=source) as writer,
    ):
        write_scenes(partial / "scenes.jsonl", scenes)
        for start in range(0, len(scenes), batch_size):
            batch = scenes[start : start + batch_size]
            vehicles = placed_vehicles(fleet, batch).to(device)
            worn = camouflage(vehicles) if camouflage else vehicles
            frames = renderer(batch, worn, masks=True)
            corners = ground_corners(batch, worn).tolist()
            images = (frames.image * 255).round().byte().cpu()
            for index, scene in enumerate(batch):
                rows = torch.nonzero(frames.scene_index == index)[:, 0].tolist()
                annotations = []
                for place, row in enumerate(rows):
                    left, top, right, bottom = frames.boxes[row].tolist()
                    x, y = frames.centres[row].tolist()
                    annotations.append(
                        Annotation(
                            box_xyxy=(left, top, right, bottom),
                            centre_px=(x, y),
                            visible_fraction=float(frames.visible_fraction[row]),
                            mask=None if frames.masks is None else frames.masks[row].cpu(),
                            vehicle=scene.placements[place].vehicle,
                            placement_index=place,
                            corners_px=tuple((x, y) for x, y in corners[row]),
                        )
                    )
                writer.add(images[index], scene.id, annotations)
            if progress:
                progress(start + len(batch), len(scenes))
