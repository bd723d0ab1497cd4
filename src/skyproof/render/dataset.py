"""Scenes drawn to disk: the same scenes with and without camouflage are matched pairs (PAPER 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from skyproof.files import finished_folder
from skyproof.render.frames import Renderer
from skyproof.scenes.coco import Annotation, CocoWriter
from skyproof.scenes.scene import Scene, write_scenes
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["placed_vehicles", "render_dataset"]


def placed_vehicles(fleet: Fleet, scenes: Sequence[Scene]) -> VehicleBatch:
    """One row per placement, scene by scene, as renderers expect."""
    return fleet.batch([placement.vehicle for scene in scenes for placement in scene.placements])


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
    gsd_m, source = scenes[0].camera.gsd_m, {"renderer": renderer.name, "rendering": renderer.record()}
    with finished_folder(folder) as partial, CocoWriter(partial, gsd_m=gsd_m, source=source) as writer:
        write_scenes(partial / "scenes.jsonl", scenes)
        for start in range(0, len(scenes), batch_size):
            batch = scenes[start : start + batch_size]
            vehicles = placed_vehicles(fleet, batch).to(device)
            frames = renderer(batch, camouflage(vehicles) if camouflage else vehicles, masks=True)
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
                        )
                    )
                writer.add(images[index], scene.id, annotations)
            if progress:
                progress(start + len(batch), len(scenes))
