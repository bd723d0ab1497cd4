"""Crops of single bodies, asked for as the renderer asks for them."""

import dataclasses

import numpy as np
import torch

from skyproof.cycles.jobs import Job, crop_jobs, crop_windows
from skyproof.cycles.settings import CyclesSettings
from skyproof.render.placed import place
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Template, VehicleBatch
from tests.render.bodies import rounded_box, sphere_template


def body(
    length_m: float,
    width_m: float,
    height_m: float,
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5),
) -> VehicleBatch:
    """A box with nearly sharp edges in one colour."""
    return VehicleBatch(
        sphere_template(),
        rounded_box(length_m, width_m, height_m, power=0.1),
        torch.tensor(colour)[None, :, None, None].expand(1, 3, TEXTURE_SIZE, TEXTURE_SIZE).clone(),
        torch.zeros(1, TEXTURE_SIZE, TEXTURE_SIZE, dtype=torch.uint8),
        ("box-0000",),
    )


def white_sheet(side_m: float, height_m: float) -> VehicleBatch:
    """A level square, open at its rim, that faces up."""
    half = side_m / 2
    corners = torch.tensor([[[-half, -half], [half, -half], [half, half], [-half, half]]])
    uvs = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    template = Template(faces, faces, uvs, torch.arange(4), uvs)
    vertices = torch.cat((corners, torch.full((1, 4, 1), height_m)), dim=-1)
    return dataclasses.replace(body(1, 1, 1, (1.0, 1.0, 1.0)), template=template, vertices=vertices)


def matt(job: Job) -> Job:
    """The same with a matt surface: nothing is mirrored."""
    table = np.zeros_like(job.arrays["materials"])
    table[:, 0] = 1.0
    return dataclasses.replace(job, arrays={**job.arrays, "materials": table})


def one_job(
    scene: Scene,
    vehicles: VehicleBatch,
    *,
    ground: float | torch.Tensor = 0.2,
    settings: CyclesSettings | None = None,
    margin_m: float = 1.0,
) -> Job:
    """The crop of a scene's only vehicle; `ground` in linear light."""
    placed = place([scene], vehicles)
    size = placed.size_px
    light = torch.as_tensor(ground, dtype=torch.float32).expand(1, 3, size, size).clone()
    windows = crop_windows(placed, round(margin_m / placed.gsd_m), [0])
    (job,) = crop_jobs(
        [scene],
        vehicles,
        placed,
        light,
        windows,
        settings or CyclesSettings(),
        [Light()],
    )
    return job


def world_places(job: Job) -> tuple[np.ndarray, np.ndarray]:
    """x (east) and y (north) in metres of the crop's pixel centres on the ground."""
    left, top, width, height = job.window_px
    half, gsd_m = job.numbers["size_px"] / 2, job.numbers["gsd_m"]
    x, y = (
        (np.arange(left, left + width) + 0.5 - half) * gsd_m,
        (half - np.arange(top, top + height) - 0.5) * gsd_m,
    )
    return np.broadcast_to(x, (height, width)), np.broadcast_to(y[:, None], (height, width))
