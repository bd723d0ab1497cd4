"""Labels the parts of a wrapped mesh: by names, else by place and by paint mask or colour."""

import re

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import binary_dilation, binary_erosion, label, uniform_filter

from skyproof.geometry.colour import srgb_to_cielab
from skyproof.vehicles.template import COLUMNS, TOPOLOGY_BELT, column_u
from skyproof.vehicles.texels import is_floor
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part
from skyproof.vehicles.wrapping.baking import Texels
from skyproof.vehicles.wrapping.meshes import SourceMesh
from skyproof.vehicles.wrapping.surface import Wrapping

# Colours for a mesh that has none.
PLAIN_COLOURS = {
    Part.BODY: (0.66, 0.67, 0.69),
    Part.GLASS: (0.115, 0.14, 0.165),
    Part.LIGHT: (0.80, 0.82, 0.84),
    Part.WHEEL: (0.075, 0.075, 0.075),
    Part.BUMPER: (0.13, 0.13, 0.135),
    Part.TRIM: (0.06, 0.06, 0.065),
    Part.UNDERSIDE: (0.07, 0.07, 0.07),
}

_NAMES = (
    (Part.WHEEL, r"wheel(?!.?arch)|tyre|tire(?!d)|\brims?\b"),
    (Part.GLASS, r"glass|window|windscreen|windshield"),
    (Part.LIGHT, r"light|lamp|indicator|blinker"),
    (Part.BUMPER, r"bumper"),
    (Part.UNDERSIDE, r"underside|underbody|undercarriage|chassis|axle"),
    (Part.TRIM, r"trim|chrome|grill|mirror|interior|plastic|rubber|plate"),
)
_DARK, _GREY = 0.30, 0.10
_END_M = 0.6
# Of windows that are not dark, in CIELAB: least difference from the paint, largest chroma and
# lightness.
_OTHER_COLOUR, _GREYISH, _PALE = 15.0, 22.0, 75.0
# Of a pane: the smallest area; the least share at window height of the area that it belongs to; and
# if less lies there, the largest share of its outline along which that area may continue elsewhere.
_LEAST_TEXELS, _WITHIN, _GOES_ON = 150, 0.8, 1 / 3
_MODE_PX = 7

_Mask = Bool[np.ndarray, "512 512"]


def name_part(name: str) -> Part | None:
    """Returns the part that a material's or object's name tells; None (mostly paint) if none."""
    words = name.lower().replace("_", " ")
    return next((part for part, pattern in _NAMES if re.search(pattern, words)), None)


def label_parts(
    mesh: SourceMesh, texels: Texels, wrapping: Wrapping, plain: _Mask, *, masked: bool
) -> tuple[UInt8[np.ndarray, "512 512"], dict[str, float], list[str]]:
    """Labels every texel.

    1. A material or object named wheel, glass, light, bumper, trim or chassis is that; a material
    less than half opaque is glass. 2. Columns of the floor are underside. 3. Round areas on the
    ground at the sides are wheels, unless a name says wheel. 4. The rest is paint, except below
    half in the paint mask or, without one, if dark and grey. What is not paint is glass at window
    height unless level, light if bright or red within 60 cm of an end (with a mask only), bumper if
    low at an end, and trim otherwise. 5. Without a mask, a greyish area of another colour than the
    paint at window height is glass, too.

    `plain` texels have no colour in the file. `masked` says whether their alpha is a paint mask.
    The second result is the share of texels that each rule decided.
    """
    said = [Part.GLASS if m.opacity < 0.5 else name_part(m.name) for m in mesh.materials]
    named = np.array([-1 if part is None else part for part in said])[mesh.material[texels.face]]
    x, y, z = np.moveaxis(texels.points, -1, 0)
    decided = named >= 0

    notes: list[str] = []
    dark = (texels.colour.max(-1) < _DARK) & (np.ptp(texels.colour, axis=-1) < _GREY)
    paint = texels.alpha >= 0.5 if masked else plain | ~dark
    open_ = ~decided
    if not masked and open_.any() and paint[open_].mean() < 0.4:
        notes.append(
            "most of the surface is dark: colour does not tell glass from paint, which is left as "
            "paint"
        )
        paint = np.ones_like(paint)
    # What is not paint, by its place.
    height = float(z.max())
    window_z = min(wrapping.belt_m - 0.05, (0.57 if height < 2.5 else 0.5) * height)
    ends = np.minimum(x - x.min(), x.max() - x)
    bright = texels.colour.max(-1) > 0.55
    red = texels.colour[..., 0] - texels.colour[..., 1:].max(-1) > 0.2
    other = np.full(z.shape, int(Part.TRIM), np.int64)
    at_end = ends < _END_M
    other[at_end & (z < 0.33 * height + 0.12)] = Part.BUMPER
    # Walls of a load bed face inwards.
    outwards = texels.normals[..., 1] * np.sign(y) > -0.3
    at_windows = (z > window_z) & (texels.normals[..., 2] < 0.975) & outwards
    other[at_windows] = Part.GLASS
    clearance_m = float(np.median(wrapping.hull.low))
    floor = is_floor(torch.from_numpy(_column()), torch.from_numpy(z), clearance_m).numpy()
    if masked:
        other[at_end & (z < window_z + 0.15) & (bright | red) & ~plain] = Part.LIGHT
    else:
        paint &= ~_panes(texels.colour, open_ & ~plain, paint & ~floor, at_windows)
    parts = np.where(paint, int(Part.BODY), other)

    # Wheels and underside by place; names overrule colour.
    discs = _wheels(wrapping, x, y, z)
    if not (named == int(Part.WHEEL)).any():
        parts[discs] = Part.WHEEL
    parts = np.where(decided, named, parts)
    floor &= ~((named == int(Part.WHEEL)) & (_column() > 0.8)[None])
    parts[floor] = Part.UNDERSIDE
    # Takes the most frequent label around each texel, which removes specks.
    around = [
        uniform_filter((parts == part).astype(np.float32), _MODE_PX, mode="wrap") for part in Part
    ]
    deciding = {
        "name": decided,
        "place": ~decided & floor,
        "paint mask" if masked else "colour": ~decided & ~floor,
    }
    shares = {rule: round(float(where.mean()), 3) for rule, where in deciding.items()}
    return np.argmax(around, axis=0).astype(np.uint8), shares, notes


def _panes(
    colour: Float[np.ndarray, "512 512 3"], open_: _Mask, paint: _Mask, at_windows: _Mask
) -> _Mask:
    """Finds windows of any grey: areas at window height that are no part of a stripe or of dirt."""
    if not (open_ & paint).any():
        return np.zeros_like(open_)
    lab = srgb_to_cielab(torch.from_numpy(colour)).numpy()
    other = np.linalg.norm(lab - np.median(lab[open_ & paint], axis=0), axis=-1) > _OTHER_COLOUR
    greyish = (np.hypot(lab[..., 1], lab[..., 2]) < _GREYISH) & (lab[..., 0] < _PALE)
    like_panes = open_ & other & greyish
    # Repeated side by side, because the map is circular in u.
    every, within = (np.tile(each, 2) for each in (like_panes, like_panes & at_windows))
    area_of, _ = label(within)
    whole_of, _ = label(every)

    def per_area(mask: Bool[np.ndarray, "512 1024"]) -> Int[np.ndarray, " A"]:
        return np.bincount(area_of[mask & within], minlength=int(area_of.max()) + 1)

    # Areas of which much lies elsewhere, and which continue there along much of their outline.
    inside = np.bincount(whole_of[within], minlength=int(whole_of.max()) + 1)
    spread = (inside < _WITHIN * np.bincount(whole_of.ravel()))[whole_of]
    outline = per_area(~binary_erosion(within))
    goes_on = per_area(binary_dilation(every & ~within)) > _GOES_ON * outline
    panes = (per_area(within) >= _LEAST_TEXELS)[area_of] & ~(spread & goes_on[area_of]) & within
    left, right = np.split(panes, 2, axis=1)
    return left | right


def _column() -> Float[np.ndarray, " 512"]:
    """Returns each texel's column coordinate, 0 in the floor's middle to 16 in the roof's."""
    centre = (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE
    column = np.interp(centre, column_u().numpy(), np.arange(COLUMNS + 1))
    return np.minimum(column, COLUMNS - column)


def _wheels(wrapping: Wrapping, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> _Mask:
    """Finds discs on the sides where the lower edge comes down to the ground."""
    hull = wrapping.hull
    at = hull.start[0] + (np.arange(len(hull.low)) + 0.5) * hull.cell
    wheels = np.zeros_like(x, bool)
    grounded = np.flatnonzero(hull.low < 0.15)
    if not len(grounded):
        return wheels
    half = np.abs(y).max()
    side = (np.abs(y) > 0.55 * half) & (_column() <= TOPOLOGY_BELT)[None]
    for run in np.split(grounded, np.flatnonzero(np.diff(grounded) > 1) + 1):
        reach = (at[run[-1]] - at[run[0]]) / 2
        # A circle on the ground that is `2 reach` wide at a height of 0.15 m.
        radius = float(np.clip((reach**2 + 0.15**2) / (2 * 0.15), 0.25, 0.6))
        middle = (at[run[0]] + at[run[-1]]) / 2
        wheels |= side & (np.hypot(x - middle, z - radius) < 1.03 * radius)
    return wheels
