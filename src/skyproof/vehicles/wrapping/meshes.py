"""Holds a textured mesh as triangles with UVs and materials, whatever file it came from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, UnidentifiedImageError

from skyproof.errors import ConfigurationError

__all__ = ["GREY", "Material", "SourceMesh", "find_texture", "open_texture", "picture_bytes"]

GREY = (0.6, 0.6, 0.6)
_DARK_CABIN = 0.08  # what is seen through a transparent window


@dataclass(frozen=True)
class Material:
    """How some triangles look.

    Attributes:
        name: of the material and of the object it was found on.
        colour: sRGB in [0, 1], used where there is neither a texture nor vertex colours.
        picture: `[H, W, 3 or 4]` bytes, row 0 on top; or none.
        opacity: 1 for solid.
        plain: the file says nothing about its colour: `colour` is a stand-in.
    """

    name: str
    colour: tuple[float, float, float] = GREY
    picture: UInt8[np.ndarray, "H W C"] | None = None
    opacity: float = 1.0
    plain: bool = False


@dataclass(frozen=True)
class SourceMesh:
    """Triangles of all objects of a file together.

    Attributes:
        corners: `[F, 3, 3]`, in the file's axes and unit until it is oriented.
        uvs: `[F, 3, 2]`, v from the bottom of the picture; may lie outside [0, 1], then the picture
            repeats.
        colours: `[F, 3, 3]` sRGB at the corners; NaN where a texture or a material says it.
        material: `[F]` index into `materials`.
        materials: what the triangles are made of.
        up: axis that the format says is up, or none.
        unit_m: metres per unit that the file says, or none.
        notes: what was repaired or assumed while reading, one sentence each.
    """

    corners: Float[np.ndarray, "F 3 3"]
    uvs: Float[np.ndarray, "F 3 2"]
    colours: Float[np.ndarray, "F 3 3"]
    material: Int[np.ndarray, " F"]
    materials: tuple[Material, ...]
    up: str | None = None
    unit_m: float | None = None
    notes: tuple[str, ...] = ()

    def look(
        self,
        face: Int[np.ndarray, " N"],
        weights: Float[np.ndarray, "N 3"],
        mask: UInt8[np.ndarray, "H W"] | None = None,
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Returns colour and opacity of points on triangles.

        Args:
            face: which triangle.
            weights: where on it, barycentric.
            mask: read in place of the pictures' own alpha, by the same UVs.

        Returns:
            sRGB in [0, 1], and opacity in [0, 1] of the picture (not of the material).
        """
        uv = np.einsum("nk,nkc->nc", weights, self.uvs[face])
        colours = np.einsum("nk,nkc->nc", weights, self.colours[face])
        alpha = np.ones(len(face))
        for index, material in enumerate(self.materials):
            covered = self.material[face] == index
            missing = covered & np.isnan(colours[:, 0])
            colours[missing] = material.colour
            if material.picture is not None and covered.any():
                texels = _sample(material.picture, uv[covered]) / 255
                colours[covered], alpha[covered] = (
                    texels[:, :3],
                    texels[:, 3] if texels.shape[1] == 4 else 1.0,
                )
            if material.opacity < 1:
                colours[covered] = (
                    material.opacity * colours[covered] + (1 - material.opacity) * _DARK_CABIN
                )
        if mask is not None:
            alpha = _sample(mask[..., None], uv)[:, 0] / 255
        return colours, alpha


def _sample(
    picture: UInt8[np.ndarray, "H W C"], uv: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "N C"]:
    """Samples bilinearly between texel centres; the picture repeats."""
    height, width = picture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left = np.floor(x).astype(np.int64)
    top = np.floor(y).astype(np.int64)
    right, down = (x - left)[:, None], (y - top)[:, None]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper = picture[rows[0], columns[0]] * (1 - right) + picture[rows[0], columns[1]] * right
    lower = picture[rows[1], columns[0]] * (1 - right) + picture[rows[1], columns[1]] * right
    return upper * (1 - down) + lower * down


def find_texture(mesh: Path, name: str) -> Path | None:
    """Finds the picture that a mesh file names, or one of that name in a neighbouring folder.

    Looked for in this order: at the path given; as `model://<model>/...` beside this model's
    folder; then by file name, without regard to case, in the mesh's folder, its `textures` and
    `materials/textures`, and those one folder up.
    """
    name = name.strip().replace("\\", "/").removeprefix("file://")
    if name.startswith("model://"):
        name = name.removeprefix("model://")
        candidate = mesh.parents[2] / name if len(mesh.parents) > 2 else mesh.parent / name
    else:
        candidate = mesh.parent / name
    if candidate.is_file():
        return candidate
    for folder in (mesh.parent, mesh.parent.parent):
        for place in (folder, folder / "textures", folder / "materials" / "textures"):
            for path in sorted(place.iterdir()) if place.is_dir() else []:
                if path.name.lower() == Path(name).name.lower() and path.is_file():
                    return path
    return None


def open_texture(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """Opens a picture as bytes, `[H, W, 3]` or with alpha `[H, W, 4]`.

    Raises:
        ConfigurationError: it cannot be read.
    """
    try:
        with Image.open(path) as image:
            return picture_bytes(image)
    except (OSError, UnidentifiedImageError) as error:
        raise ConfigurationError(
            f"{path} cannot be read as a picture; give a PNG or JPEG."
        ) from error


def picture_bytes(image: Image.Image) -> UInt8[np.ndarray, "H W C"]:
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
