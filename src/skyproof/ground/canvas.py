"""The canvas of the procedural ground: reflectance and height, then lit and photographed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.scenes.directions import direction_values, with_room

Array = NDArray[np.floating[Any]]
Colour = tuple[int, int, int]
Place = tuple[float, float]

MARGIN_M = 6.0
"""Drawn beyond the picture on every side, so that things outside cast their shadows into it."""
IN_THE_WAY_M = 0.3
"""What stands higher than this, no vehicle stands on."""
HIDES_FROM_M = 2.0
"""What reaches higher than this hides a vehicle that stands beneath it: crowns, roofs, sheds."""


def reflectance(colour: Colour) -> Array:
    """Linear reflectance of an sRGB colour given in bytes, by the usual power of 2.2."""
    return ((np.asarray(colour, np.float32) / 255.0) ** 2.2).astype(np.float32)


@dataclass(frozen=True)
class Patch:
    """The part of the canvas that one shape touches.

    Attributes:
        rows, columns: slices into the canvas.
        u, v: metres along and across the shape, from its centre, `[h, w]`.
        inside: metres inside the outline, negative outside, `[h, w]`.
        coverage: part of each pixel covered, 0 to 1, `[h, w]`.
    """

    rows: slice
    columns: slice
    u: Array
    v: Array
    inside: Array
    coverage: Array

    @property
    def empty(self) -> bool:
        """True where the shape lies wholly outside the canvas."""
        return self.u.size == 0


class Canvas:
    """Reflectance `[n, n, 3]` and height `[n, n]` m over a square, with axes for straight streets.

    Places are metres along these axes: origin at the centre, u along the street, v to its left.
    One sun lights all.
    """

    def __init__(
        self, size_px: int, gsd_m: float, rng: np.random.Generator, *, axes_rad: float
    ) -> None:
        self.gsd_m = gsd_m
        self.rng = rng
        self.size_px = size_px
        self.margin_px = math.ceil(MARGIN_M / gsd_m)
        self.pixels = size_px + 2 * self.margin_px
        self.reach_m = self.pixels * gsd_m * 0.7072
        self.axes_rad = axes_rad
        self.reflectance = np.zeros((self.pixels, self.pixels, 3), np.float32)
        self.height = np.zeros((self.pixels, self.pixels), np.float32)
        self.directions = np.zeros((self.pixels, self.pixels), np.uint8)
        self.sun_azimuth_rad = float(rng.uniform(0, 2 * math.pi))
        self.sun_elevation_rad = float(rng.uniform(math.radians(28), math.radians(62)))
        self._fields = self._draw_fields()

    def _draw_fields(self) -> dict[str, Array]:
        """Periodic noise of unit variance, by feature size; one transform, filtered three ways."""
        n = self.pixels
        frequency = (
            np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) / self.gsd_m
        )  # cycles per metre
        spectrum = np.fft.rfft2(self.rng.standard_normal((n, n)))
        filters = {
            "grain": 1 / (1 + (frequency / 3.0) ** 2),
            "clump": (frequency**2) * np.exp(-((frequency / 0.75) ** 2)),
            "mottle": 1 / (0.12 + frequency) ** 1.6,
            "patch": 1 / (0.025 + frequency) ** 2.4 * np.exp(-((frequency / 0.5) ** 2)),
        }
        fields = {}
        for name, gain in filters.items():
            gain[0, 0] = 0
            field = np.fft.irfft2(spectrum * gain, s=(n, n)).astype(np.float32)
            fields[name] = field / field.std()
        return fields

    def noise(self, name: str, patch: Patch | None = None) -> Array:
        """Returns unit noise under `patch`, or everywhere.

        It is the stored field at a random shift, so that repeats do not line up.
        """
        shift = self.rng.integers(0, self.pixels, 2)
        field = self._fields[name]
        if patch is None:
            return np.roll(field, tuple(int(s) for s in shift), (0, 1))
        rows = (np.arange(patch.rows.start, patch.rows.stop) + shift[0]) % self.pixels
        columns = (np.arange(patch.columns.start, patch.columns.stop) + shift[1]) % self.pixels
        return field[rows[:, None], columns[None]]

    def to_pixels(self, u_m: float, v_m: float) -> tuple[float, float]:
        """Column and row of a place."""
        cosine = math.cos(self.axes_rad)
        sine = math.sin(self.axes_rad)
        x, y = cosine * u_m - sine * v_m, sine * u_m + cosine * v_m
        return self.pixels / 2 + x / self.gsd_m, self.pixels / 2 - y / self.gsd_m

    def _local(
        self, u_m: float, v_m: float, angle_rad: float, radius_m: float
    ) -> tuple[slice, slice, Array, Array]:
        column, row = self.to_pixels(u_m, v_m)
        reach = radius_m / self.gsd_m + 2
        rows = slice(
            *(int(np.clip(edge, 0, self.pixels)) for edge in (row - reach, row + reach + 1))
        )
        columns = slice(
            *(int(np.clip(edge, 0, self.pixels)) for edge in (column - reach, column + reach + 1))
        )
        x = ((np.arange(columns.start, columns.stop) + 0.5 - column) * self.gsd_m).astype(
            np.float32
        )[None]
        y = (-(np.arange(rows.start, rows.stop) + 0.5 - row) * self.gsd_m).astype(np.float32)[
            :, None
        ]
        turn = self.axes_rad + angle_rad
        cosine = math.cos(turn)
        sine = math.sin(turn)
        return rows, columns, cosine * x + sine * y, -sine * x + cosine * y

    def _patch(self, rows: slice, columns: slice, u: Array, v: Array, inside: Array) -> Patch:
        coverage = np.clip(0.5 + inside / self.gsd_m, 0, 1).astype(np.float32)
        return Patch(rows, columns, u, v, inside.astype(np.float32), coverage)

    def rectangle(
        self,
        place: tuple[float, float],
        size_m: tuple[float, float],
        angle_rad: float = 0.0,
        corner_m: float = 0.0,
    ) -> Patch:
        """Returns a rectangle about a place, its corners rounded by `corner_m`.

        Its length is along u, its width along v.
        """
        half_u, half_v = size_m[0] / 2 - corner_m, size_m[1] / 2 - corner_m
        radius_m = min(math.hypot(*size_m) / 2, 2 * self.reach_m + math.hypot(*place))
        rows, columns, u, v = self._local(*place, angle_rad, radius_m)
        du = np.abs(u) - half_u
        dv = np.abs(v) - half_v
        if corner_m == 0:
            return self._patch(rows, columns, u, v, -np.maximum(du, dv))
        outside = np.hypot(np.maximum(du, 0), np.maximum(dv, 0)) + np.minimum(np.maximum(du, dv), 0)
        return self._patch(rows, columns, u, v, corner_m - outside)

    def disc(
        self,
        place: tuple[float, float],
        radius_m: float,
        raggedness: float = 0.0,
        stretch: float = 1.0,
    ) -> Patch:
        """Returns a disc whose outline wanders by a part `raggedness` of its radius."""
        angle = float(self.rng.uniform(0, math.pi))
        rows, columns, u, v = self._local(
            *place, angle, radius_m * (1 + 2 * raggedness) * max(1.0, stretch)
        )
        inside = radius_m - np.hypot(u / stretch, v)
        patch = self._patch(rows, columns, u, v, inside)
        if raggedness and not patch.empty:
            wander = 0.6 * self.noise("mottle", patch) + 0.6 * self.noise("clump", patch)
            inside = inside + radius_m * raggedness * np.clip(wander, -2, 2)
            patch = self._patch(rows, columns, u, v, inside)
        return patch

    def everywhere(self, angle_rad: float = 0.0, wander_m: float = 0.0) -> Patch:
        """Returns the whole canvas along its axes; with `wander_m` v meanders, as a track does."""
        rows, columns, u, v = self._local(0.0, 0.0, angle_rad, 3 * self.reach_m)
        if wander_m:
            period = float(self.rng.uniform(40, 90))
            v = v + np.float32(wander_m) * np.sin(
                2 * math.pi * u / period + self.rng.uniform(0, 6)
            ).astype(np.float32)
        return Patch(rows, columns, u, v, np.full_like(u, 1e3), np.ones_like(u))

    def band(
        self, base: Patch, centre_v_m: float, width_m: float, roughness_m: float = 0.0
    ) -> Patch:
        """Returns a strip of `base` along u about `centre_v_m`, for roads and long markings."""
        inside = width_m / 2 - np.abs(base.v - centre_v_m)
        if roughness_m:
            inside = inside + roughness_m * self.noise("mottle", base)
        return self._patch(base.rows, base.columns, base.u, base.v - centre_v_m, inside)

    def paint(self, patch: Patch, colour: Array, strength: float | Array = 1.0) -> None:
        """Lays reflectance (`[3]` or `[h, w, 3]`) over the patch."""
        if patch.empty:
            return
        weight = (patch.coverage * strength)[..., None]
        region = self.reflectance[patch.rows, patch.columns]
        region += weight * (colour - region)

    def shade(self, patch: Patch, factor: float | Array) -> None:
        """Multiplies the reflectance under the patch (stains, wear, wet)."""
        if not patch.empty:
            region = self.reflectance[patch.rows, patch.columns]
            region *= (1 + patch.coverage * (np.asarray(factor, np.float32) - 1))[..., None]

    def mute(self, kept: float) -> None:
        """Draws all reflectance towards grey, keeping a part of its chroma: dust, drought, soot."""
        grey = self.reflectance.mean(2, keepdims=True)
        self.reflectance = grey + np.float32(kept) * (self.reflectance - grey)

    def raise_to(self, patch: Patch, height_m: float | Array) -> None:
        """Raises the height to `height_m` above the ground, where what stands there is lower."""
        if not patch.empty:
            region = self.height[patch.rows, patch.columns]
            np.maximum(
                region, np.where(patch.coverage > 0.5, height_m, 0), out=region, casting="same_kind"
            )

    def allow(
        self, patch: Patch, where: NDArray[np.bool_] | bool = True, turn_rad: float = 0.0
    ) -> None:
        """Says where the middle of a vehicle may be, under the patch.

        It heads along the patch's u, which may bend, turned by `turn_rad` to the left.
        """
        if min(patch.v.shape) < 2:
            return
        down, right = np.gradient(patch.v)
        heading_rad = np.arctan2(-right, -down) + turn_rad
        region = self.directions[patch.rows, patch.columns]
        allowed = (patch.coverage > 0.5) & where
        region[allowed] = direction_values(heading_rad)[allowed]

    def forbid(self, patch: Patch) -> None:
        """Says that no vehicle stands under the patch."""
        if not patch.empty:
            self.directions[patch.rows, patch.columns][patch.coverage > 0] = 0

    def drivable(self) -> NDArray[np.uint8]:
        """Gives the picture's map of drivable ground, `[size, size]`: what is allowed and free."""
        cut = slice(self.margin_px, self.margin_px + self.size_px)
        shown = np.zeros_like(self.directions)
        shown[cut, cut] = self.directions[cut, cut]
        free = self.height < IN_THE_WAY_M
        return np.ascontiguousarray(with_room(shown, free, self.gsd_m)[cut, cut])

    def cover(self, blur_px: float) -> NDArray[np.uint8]:
        """Gives the picture's map of what hides the ground, `[size, size]`, as blurred as it is."""
        cut = slice(self.margin_px, self.margin_px + self.size_px)
        high = (self.height >= HIDES_FROM_M).astype(np.float32)
        blurred = ndimage.gaussian_filter(high, blur_px)[cut, cut]
        return np.ascontiguousarray(np.round(255 * blurred).astype(np.uint8))

    def base_height(self, place: tuple[float, float]) -> float:
        """Height of whatever stands at a place, for things put on roofs."""
        column, row = self.to_pixels(*place)
        limit = self.pixels - 1
        return float(self.height[int(np.clip(row, 0, limit)), int(np.clip(column, 0, limit))])


def pick(canvas: Canvas, colours: tuple[Colour, ...], spread: float = 0.12) -> Array:
    """One of the colours as reflectance, a little off, because no two roofs are alike."""
    colour = reflectance(colours[int(canvas.rng.integers(len(colours)))])
    return (
        colour * np.exp(canvas.rng.normal(0, spread) + canvas.rng.normal(0, spread / 3, 3))
    ).astype(np.float32)


def textured(canvas: Canvas, patch: Patch, colour: Array, grain: float, mottle: float) -> Array:
    """A colour varied by fine grain and by stains of about a metre, `[h, w, 3]`."""
    factor = 1 + grain * canvas.noise("grain", patch) + mottle * canvas.noise("mottle", patch)
    return np.clip(factor, 0.2, 2.5)[..., None] * colour


def beside(place: Place, angle_rad: float, u_m: float, v_m: float) -> Place:
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    return place[0] + cosine * u_m - sine * v_m, place[1] + sine * u_m + cosine * v_m
