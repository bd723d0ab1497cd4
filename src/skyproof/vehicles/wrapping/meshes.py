"""Holds a textured mesh as triangles with UVs and materials, whatever file it came from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import map_coordinates

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear

GREY = (0.6, 0.6, 0.6)
_PICTURES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".webp", ".gif")
_DARK_CABIN = 0.08  # what is seen through a transparent window


@dataclass(frozen=True)
class Material:
    """The look of some triangles; colours are sRGB in [0, 1], row 0 of the picture is on top.

    A `plain` colour is a stand-in if the file gives none. The `tint` multiplies the picture's
    light.
    """

    name: str
    colour: tuple[float, float, float] = GREY
    picture: UInt8[np.ndarray, "H W C"] | None = None
    opacity: float = 1.0
    plain: bool = False
    tint: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class SourceMesh:
    """The triangles of all objects of a file.

    Attributes:
        corners: in the file's axes and unit until it is oriented.
        uvs: v from the bottom of the picture, which repeats outside [0, 1].
        colours: sRGB at the corners; NaN if a texture or a material gives the colour.
        up: upward axis of the format.
        notes: repairs and assumptions while reading, one sentence each.
    """

    corners: Float[np.ndarray, "F 3 3"]
    uvs: Float[np.ndarray, "F 3 2"]
    colours: Float[np.ndarray, "F 3 3"]
    material: Int[np.ndarray, " F"]
    materials: tuple[Material, ...]
    up: str | None = None
    notes: tuple[str, ...] = ()

    def look(
        self,
        face: Int[np.ndarray, " N"],
        weights: Float[np.ndarray, "N 3"],
        mask: UInt8[np.ndarray, "H W"] | None = None,
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Returns sRGB in [0, 1] of points on triangles, and their pictures' opacity in [0, 1].

        A mask is read instead of the pictures' alpha, by the same UVs.
        """
        uv = np.einsum("nk,nkc->nc", weights, self.uvs[face])
        colours = np.einsum("nk,nkc->nc", weights, self.colours[face])
        alpha = np.ones(len(face))
        for index, material in enumerate(self.materials):
            covered = self.material[face] == index
            colours[covered & np.isnan(colours[:, 0])] = material.colour
            if material.picture is not None and covered.any():
                texels = _sample(material.picture, uv[covered]) / 255
                colours[covered] = _tinted(texels[:, :3], material.tint)
                alpha[covered] = texels[:, 3] if texels.shape[1] == 4 else 1.0
            if material.opacity < 1:
                cabin = (1 - material.opacity) * _DARK_CABIN
                colours[covered] = material.opacity * colours[covered] + cabin
        if mask is not None:
            alpha = _sample(mask[..., None], uv)[:, 0] / 255
        return colours, alpha


def _sample(
    picture: UInt8[np.ndarray, "H W C"], uv: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "N C"]:
    """Samples bilinearly between texel centres; the picture repeats."""
    height, width = picture.shape[:2]
    # Beyond 64 bits, map_coordinates would read outside the picture.
    places = np.mod((1 - uv[:, 1]) * height - 0.5, height), np.mod(uv[:, 0] * width - 0.5, width)
    channels = np.moveaxis(picture, 2, 0)
    read = [map_coordinates(each, places, float, order=1, mode="grid-wrap") for each in channels]
    return np.stack(read, axis=-1)


def _tinted(
    srgb: Float[np.ndarray, "N 3"], tint: tuple[float, float, float] | None
) -> Float[np.ndarray, "N 3"]:
    """Multiplies colours by a tint, in linear light."""
    if tint is None or min(tint) > 1 - 1e-6:
        return srgb
    factor = srgb_to_linear(torch.tensor(tint, dtype=torch.float64))
    return linear_to_srgb(srgb_to_linear(torch.from_numpy(srgb)) * factor).numpy()


def find_texture(mesh: Path, name: str) -> Path | None:
    """Finds the picture that a mesh file names, or one of that name in a neighbouring folder.

    It looks at the given path, then for `model://<model>/...` among the textures of a model beside
    this one with its mesh in `<model>/meshes`, then by file name without regard to case in the
    mesh's folder, its `textures` and `materials/textures`, and those one folder up. Any other path
    counts as a file name. Links out of these folders are ignored.
    """
    name = name.strip().replace("\\", "/").removeprefix("file://")
    own, above = mesh.parent, mesh.parent.parent
    below = ("textures", "materials/textures")
    picture = is_picture(name)
    if name.startswith("model://"):
        model, _, inner = name.removeprefix("model://").partition("/")
        models = mesh.absolute().parent.parent.parent
        candidate, allowed = models / model / inner, [own]
        if picture and mesh.absolute().parent.name == "meshes" and model not in ("", ".", ".."):
            allowed += [models / model / folder for folder in below]
    else:
        candidate, allowed = own / name, [own]
    if picture:
        allowed += [above / folder for folder in below]
    if _is_file_in(candidate, allowed):
        return candidate
    wanted = name.rpartition("/")[2].lower()
    for folder in (own, above) if picture else (own,):
        for place in (folder, *(folder / name for name in below)):
            for path in sorted(place.iterdir()) if place.is_dir() else []:
                if path.name.lower() == wanted and _is_file_in(path, [place]):
                    return path
    return None


def _is_file_in(path: Path, folders: list[Path]) -> bool:
    try:
        whole = path.resolve()
        return whole.is_file() and any(whole.is_relative_to(folder.resolve()) for folder in folders)
    except (OSError, ValueError, RuntimeError):
        # A name that no file can have, or links in a circle.
        return False


def is_picture(name: str) -> bool:
    """Says whether a file's name is that of a picture."""
    return Path(name).suffix.lower() in _PICTURES
