"""Scenes drawn to disk; with and without camouflage they are matched pairs (section S5.1)."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import write_yolo
from skyproof.datasets.pictures import made_ahead
from skyproof.files import finished_folder
from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.render.frames import Frames, Renderer
from skyproof.scenes.scene import Scene, write_scenes
from skyproof.storage import tensors_digest
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.vehicle import VehicleBatch

AT_A_TIME = 4
"""Most batches that networks process at a time, to bound the memory of their activations."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def placed_vehicles(fleet: Fleet, scenes: Sequence[Scene]) -> VehicleBatch:
    """Returns one row per placement, scene by scene, as renderers expect."""
    return fleet.batch([placement.vehicle for scene in scenes for placement in scene.placements])


@torch.no_grad()
def ground_corners(scenes: Sequence[Scene], vehicles: VehicleBatch) -> Float[Tensor, "N 4 2"]:
    """Returns the corners of the rectangle around each vehicle's plan, on the ground, in its image.

    They are pixels (x, y) of front left, front right, rear right and rear left, not cut at borders.
    """
    # On the CPU, so that a dataset has the same labels wherever it was drawn.
    plan = vehicles.vertices[..., :2].cpu()
    rear, right = plan.amin(1).unbind(-1)
    front, left = plan.amax(1).unbind(-1)
    outline = ((front, left), (front, right), (rear, right), (rear, left))
    local = torch.stack([torch.stack((x, y, torch.zeros_like(x)), -1) for x, y in outline], dim=1)
    placements = [placement for scene in scenes for placement in scene.placements]
    heading = plan.new_tensor([each.heading_rad for each in placements])
    place = plan.new_tensor([[each.x_m, each.y_m, 0.0] for each in placements]).view(-1, 1, 3)
    corners = rotate_about_vertical(local, heading) + place
    upright = plan.new_tensor([[0.0, 0.0, 1.0]]).expand(len(corners), 3)
    camera = scenes[0].camera
    return project(corners, upright, camera.gsd_m, camera.size_px)[0]


@torch.no_grad()
def render_dataset(
    folder: Path,
    scenes: Sequence[Scene],
    fleet: Fleet,
    renderer: Renderer,
    *,
    camouflage: Callable[[VehicleBatch], VehicleBatch] | None = None,
    yolo: bool = False,
    batch_size: int = 8,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda *_: None,
) -> None:
    """Writes `images/*.png`, `annotations.json` (COCO) and `scenes.jsonl`; whole or not at all.

    Args:
        scenes: all of one image size, with vehicles of the fleet.
        camouflage: change of the vehicles, recorded if it is a module.
        yolo: write the labels as YOLO text as well.
        progress: called with (images done, images in all).

    Raises:
        RunFolderError: the folder exists, or the disk cannot take it.
    """
    source = {"renderer": renderer.name, "rendering": renderer.record(scenes)}
    if isinstance(camouflage, nn.Module):
        worn = f"{getattr(camouflage, 'name', '')} {tensors_digest(camouflage.state_dict())}"
        source["camouflage"] = hashlib.sha256(worn.encode()).hexdigest()

    @torch.no_grad()
    def draw(batch: Sequence[Scene]) -> tuple[Frames, Float[Tensor, "N 4 2"]]:
        vehicles = placed_vehicles(fleet, batch).to(device)
        if camouflage:
            vehicles = camouflage(vehicles)
        return renderer(batch, vehicles, masks=True), ground_corners(batch, vehicles)

    batches = [scenes[start : start + batch_size] for start in range(0, len(scenes), batch_size)]
    several = renderer.concurrent and torch.device(device).type == "cpu"
    with finished_folder(folder) as partial:
        with (
            CocoWriter(partial, gsd_m=scenes[0].camera.gsd_m, source=source) as writer,
            in_threads(draw, batches, torch.get_num_threads() if several else 1) as drawn,
        ):
            write_scenes(partial / "scenes.jsonl", scenes)
            done = 0
            for batch, (frames, corners) in zip(batches, drawn, strict=True):
                _write(writer, batch, frames, corners)
                done += len(batch)
                progress(done, len(scenes))
        if yolo:
            write_yolo(partial)


@contextmanager
def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], count: int
) -> Iterator[Iterator[Result]]:
    """Yields the results of work in order, from threads that work ahead.

    Two threads hardly speed up one batch of small operations, but run two batches at full speed.
    Fewer threads than cores divide the cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    start = partial(torch.set_num_threads, max(1, threads // count))
    try:
        with closing(made_ahead(work, items, count, start)) as results:
            yield results
    finally:
        torch.set_num_threads(threads)


@torch.no_grad()
def _write(
    writer: CocoWriter, scenes: Sequence[Scene], frames: Frames, corners: Float[Tensor, "N 4 2"]
) -> None:
    images = (frames.image * 255).round().byte().cpu()
    masks = iter(() if frames.masks is None else frames.masks.cpu())
    numbers = (frames.boxes, frames.centres, frames.visible_fraction, corners)
    rows = zip(*(values.tolist() for values in numbers), strict=True)
    for image, scene in zip(images, scenes, strict=True):
        annotations = []
        for place, placement in enumerate(scene.placements):
            box, centre, visible, outline = next(rows)
            annotations.append(
                Annotation(
                    box_xyxy=tuple(box),
                    centre_px=tuple(centre),
                    visible_fraction=visible,
                    mask=next(masks, None),
                    vehicle=placement.vehicle,
                    placement_index=place,
                    corners_px=tuple(map(tuple, outline)),
                )
            )
        writer.add(image, scene.id, annotations)
