"""A small textured car whose outline is known by hand, and files of it in several formats."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

LENGTH_M, WIDTH_M, HEIGHT_M = 4.4, 1.8, 1.5
SILL_M, BELT_M = 0.25, 0.9
WHEEL_X_M, WHEEL_M = (1.35, -1.35), 0.32
# Quarters seen from above: front left, front right, rear left, rear right.
PAINTS = {
    "front left": (200, 30, 30),
    "front right": (220, 200, 40),
    "rear left": (40, 160, 60),
    "rear right": (90, 90, 220),
}
GLASS = (0.10, 0.12, 0.16)


def picture() -> Image.Image:
    """Left half of the picture is the rear, its upper half (v above 0.5) the left side."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    for name, colour in PAINTS.items():
        rows = slice(0, 32) if "left" in name else slice(32, 64)
        columns = slice(32, 64) if "front" in name else slice(0, 32)
        pixels[rows, columns] = colour
    return Image.fromarray(pixels)


def _box(
    low: list[float], high: list[float], top_inset: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    """A box whose top is drawn in at the rear, the front and the sides, split up for its UVs."""
    mesh = trimesh.creation.box(bounds=[low, high])
    top = mesh.vertices[:, 2] > (low[2] + high[2]) / 2
    rear, front, side = top_inset
    vertices = mesh.vertices.copy()
    vertices[top & (vertices[:, 0] < 0.0 if low[0] < 0 < high[0] else top), 0] += rear
    vertices[top & (mesh.vertices[:, 0] > (low[0] + high[0]) / 2), 0] -= front
    vertices[top, 1] -= np.sign(vertices[top, 1]) * side
    return trimesh.Trimesh(vertices, mesh.faces, process=False).subdivide().subdivide()


def parts() -> dict[str, trimesh.Trimesh]:
    """Body, cabin, roof and wheels: metres, nose along +x, z up, standing on z = 0."""
    body = _box([-LENGTH_M / 2, -WIDTH_M / 2, SILL_M], [LENGTH_M / 2, WIDTH_M / 2, BELT_M])
    cabin = _box([-1.9, -0.8, BELT_M - 0.01], [0.9, 0.8, HEIGHT_M - 0.02], (0.3, 0.7, 0.12))
    roof = _box([-1.6, -0.68, HEIGHT_M - 0.02], [0.2, 0.68, HEIGHT_M])
    wheels = []
    for x in WHEEL_X_M:
        for y in (-WIDTH_M / 2 + 0.11, WIDTH_M / 2 - 0.11):
            wheel = trimesh.creation.cylinder(WHEEL_M, 0.2, sections=24)
            wheel.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
            wheel.apply_translation([x, y, WHEEL_M])
            wheels.append(wheel)
    return {"body": body, "roof": roof, "cabin": cabin, "wheels": trimesh.util.concatenate(wheels)}


def car(
    turn: np.ndarray | None = None, unit: float = 1.0, *, inverted: bool = False
) -> trimesh.Scene:
    """The car as a scene of four objects; turned by a 3 x 3 matrix, in units of `unit` metres."""
    scene = trimesh.Scene()
    image = picture()
    for name, mesh in parts().items():
        vertices = np.asarray(mesh.vertices)
        uv = np.stack(
            [vertices[:, 0] / LENGTH_M + 0.5, vertices[:, 1] / WIDTH_M + 0.5], axis=1
        ).clip(0.01, 0.99)
        if name in ("body", "roof"):
            material = SimpleMaterial(image=image, name=f"paint_{name}")
        elif name == "cabin":
            material = SimpleMaterial(
                diffuse=[*(round(255 * c) for c in GLASS), 255], name="window_glass"
            )
        else:
            material = SimpleMaterial(diffuse=[20, 20, 20, 255], name="tyres")
        placed = vertices @ (np.eye(3) if turn is None else turn).T / unit
        faces = mesh.faces[:, ::-1] if inverted else mesh.faces
        visual = TextureVisuals(uv=uv, material=material)
        scene.add_geometry(
            trimesh.Trimesh(placed, faces, visual=visual, process=False),
            geom_name=name,
            node_name=name,
        )
    return scene


def write_obj(folder: Path, scene: trimesh.Scene | None = None) -> Path:
    """OBJ with MTL and PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "car.obj"
    (car() if scene is None else scene).export(path)
    return path
