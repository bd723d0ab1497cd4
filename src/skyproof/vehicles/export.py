"""Hands a vehicle to other programs: GLB with its texture."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from skyproof.files import write_bytes
from skyproof.vehicles.vehicle import VehicleBatch

_VIEW_RAD = (0.7, -0.45, 0.0)
"""Where the camera of a view stands: turned about the vehicle, then raised."""

_FIELD_DEG = (36.0, 28.0)


def export_glb(vehicles: VehicleBatch, index: int, path: Path) -> None:
    """Writes one vehicle as binary glTF 2.0, its texture inside, whole or not at all.

    glTF has y up and looks along +z: its (x, y, z) is our (y, z, x), so the vehicle's nose points
    along glTF's +z, its left side along +x, and it stands on y = 0, in metres. glTF's texture
    origin is the top-left corner of the image, as ours is (row 0 at v = 0); trimesh counts v from
    the bottom and turns it round in the file, so it is given 1 - v.

    Args:
        vehicles: the batch it is taken from.
        index: its place in the batch.
        path: a name ending in .glb.

    Raises:
        RunFolderError: the file cannot be written.
    """
    _write(_mesh(vehicles, index, _texture(vehicles, index)), path)


def export_view(vehicles: VehicleBatch, index: int, path: Path) -> None:
    """Writes one vehicle to be looked at in a page: as `export_glb`, but small, and with a camera.

    The texture has half the side and is a JPEG. The camera stands at the vehicle's left front.
    """
    small = io.BytesIO()
    _texture(vehicles, index).reduce(2).save(small, "JPEG", quality=85)
    # trimesh stores what was read from JPEG as JPEG.
    mesh = _mesh(vehicles, index, Image.open(small))
    scene = trimesh.Scene(mesh)
    turned = trimesh.transformations.euler_matrix(*_VIEW_RAD, axes="ryxz")
    scene.camera.fov = _FIELD_DEG
    scene.camera_transform = scene.camera.look_at(mesh.bounding_box.vertices, rotation=turned)
    _write(scene, path)


def _texture(vehicles: VehicleBatch, index: int) -> Image.Image:
    texture = vehicles.row(index).worn_texture()[0].detach().cpu()
    pixels = texture if texture.dtype == torch.uint8 else (texture.clamp(0, 1) * 255).round().byte()
    return Image.fromarray(pixels.permute(1, 2, 0).numpy())


def _mesh(vehicles: VehicleBatch, index: int, image: Image.Image) -> trimesh.Trimesh:
    template = vehicles.template
    faces = template.faces.cpu().numpy()
    face_uvs = template.face_uvs.cpu().numpy()
    # glTF has one index for position and UV: a vertex for each pair that occurs.
    pairs, corners = np.unique(
        np.stack([faces, face_uvs], -1).reshape(-1, 2), axis=0, return_inverse=True
    )
    vertices = vehicles.vertices[index].detach().cpu().double().numpy()[:, [1, 2, 0]]
    uvs = template.uvs.detach().cpu().double().numpy()[pairs[:, 1]]
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.5, name=vehicles.ids[index]
    )
    visual = trimesh.visual.TextureVisuals(
        uv=np.stack([uvs[:, 0], 1 - uvs[:, 1]], -1), material=material
    )
    return trimesh.Trimesh(
        vertices[pairs[:, 0]], corners.reshape(-1, 3), visual=visual, process=False
    )


def _write(shown: trimesh.Trimesh | trimesh.Scene, path: Path) -> None:
    data = shown.export(file_type="glb")
    assert isinstance(data, bytes)
    write_bytes(Path(path), data)
