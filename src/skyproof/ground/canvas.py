"""The canvas of the procedural ground: reflectance and height, then lit and photographed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.scenes.directions import direction_values, with_room

Array = NDArray[np.floating[Any]]
Colour = tuple[int, ...]
Place = tuple[float, float]
Option = TypeVar("Option")

MARGIN_M = 6.0
"""Width of the band drawn around the picture, so that things outside cast shadows into it."""
IN_THE_WAY_M = 0.3
"""No vehicle stands on anything higher than this."""
HIDES_FROM_M = 2.0
"""Crowns, roofs and sheds higher than this hide a vehicle beneath them."""


def reflectance(colour: Colour) -> Array:
    """Returns the linear reflectance of an sRGB colour of bytes, by the usual power of 2.2."""
    return ((np.asarray(colour, np.float32) / 255.0) ** 2.2).astype(np.float32)


def palette(colours: str) -> tuple[Colour, ...]:
    """Returns sRGB colours that are written as "rrggbb rrggbb ..."."""
    return tuple(tuple(bytes.fromhex(colour)) for colour in colours.split())


@dataclass(frozen=True)
class Patch:
    """The part of the canvas that one shape touches, `[h, w]`.

    `u` and `v` are metres along and across the shape, from its centre. `inside` is the distance in
    metres from the outline, negative outside it. `coverage` is the covered share of each pixel.
    """

    rows: slice
    columns: slice
    u: Array
    v: Array
    inside: Array
    coverage: Array

    @property
    def empty(self) -> bool:
        """Whether the shape lies wholly outside the canvas."""
        return self.u.size == 0


class Canvas:
    """Reflectance `[n, n, 3]` and height `[n, n]` m over a square, with axes for straight streets.

    Places are metres along these axes: origin at the centre, u along the street, v to its left.
    """

    def __init__(
        self, size_px: int, gsd_m: float, rng: np.random.Generator, *, axes_rad: float
    ) -> None:
        self.gsd_m = gsd_m
        self.rng = rng
        self.size_px = size_px
        self.margin_px = math.ceil(MARGIN_M / gsd_m)
        self.pixels = size_px + 2 * self.margin_px
        self.picture = np.s_[self.margin_px : -self.margin_px, self.margin_px : -self.margin_px]
        self.reach_m = self.pixels * gsd_m * 0.7072
        self.axes_rad = axes_rad
        self.reflectance = np.zeros((self.pixels, self.pixels, 3), np.float32)
        self.height = np.zeros((self.pixels, self.pixels), np.float32)
        self.directions = np.zeros((self.pixels, self.pixels), np.uint8)
        self.sun_azimuth_rad = rng.uniform(0, 2 * math.pi)
        self.sun_elevation_rad = rng.uniform(math.radians(28), math.radians(62))
        self._fields = self._draw_fields()

    def _draw_fields(self) -> dict[str, Array]:
        """Returns periodic noise of unit variance by feature size: one transform, four filters."""
        n = self.pixels
        # In cycles per metre.
        frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) / self.gsd_m
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
        """Returns unit noise under `patch`, or everywhere, at a random shift of its field."""
        shift = self.rng.integers(0, self.pixels, 2)
        field = self._fields[name]
        if patch is None:
            return np.roll(field, shift, (0, 1))
        rows = (np.arange(patch.rows.start, patch.rows.stop) + shift[0]) % self.pixels
        columns = (np.arange(patch.columns.start, patch.columns.stop) + shift[1]) % self.pixels
        return field[rows[:, None], columns[None]]

    def to_pixels(self, u_m: float, v_m: float) -> tuple[float, float]:
        """Returns the column and row of a place."""
        x, y = beside((0.0, 0.0), self.axes_rad, u_m, v_m)
        return self.pixels / 2 + x / self.gsd_m, self.pixels / 2 - y / self.gsd_m

    def _local(
        self, place: Place, angle_rad: float, radius_m: float
    ) -> tuple[slice, slice, Array, Array]:
        column, row = self.to_pixels(*place)
        reach = radius_m / self.gsd_m + 2
        rows, columns = (
            slice(*np.clip([at - reach, at + reach + 1], 0, self.pixels).astype(int).tolist())
            for at in (row, column)
        )
        right_m = (np.arange(columns.start, columns.stop) + 0.5 - column) * self.gsd_m
        up_m = -(np.arange(rows.start, rows.stop) + 0.5 - row) * self.gsd_m
        x, y = right_m.astype(np.float32)[None], up_m.astype(np.float32)[:, None]
        turn_rad = self.axes_rad + angle_rad
        cosine = math.cos(turn_rad)
        sine = math.sin(turn_rad)
        return rows, columns, cosine * x + sine * y, -sine * x + cosine * y

    def _patch(self, rows: slice, columns: slice, u: Array, v: Array, inside: Array) -> Patch:
        coverage = np.clip(0.5 + inside / self.gsd_m, 0, 1).astype(np.float32)
        return Patch(rows, columns, u, v, inside.astype(np.float32), coverage)

    def rectangle(
        self, place: Place, size_m: Place, angle_rad: float = 0.0, corner_m: float = 0.0
    ) -> Patch:
        """Returns a rectangle about a place, with rounded corners; its length is along u."""
        half_u, half_v = size_m[0] / 2 - corner_m, size_m[1] / 2 - corner_m
        radius_m = min(math.hypot(*size_m) / 2, 2 * self.reach_m + math.hypot(*place))
        rows, columns, u, v = self._local(place, angle_rad, radius_m)
        du = np.abs(u) - half_u
        dv = np.abs(v) - half_v
        if corner_m == 0:
            return self._patch(rows, columns, u, v, -np.maximum(du, dv))
        outside = np.hypot(np.maximum(du, 0), np.maximum(dv, 0)) + np.minimum(np.maximum(du, dv), 0)
        return self._patch(rows, columns, u, v, corner_m - outside)

    def disc(
        self, place: Place, radius_m: float, raggedness: float = 0.0, stretch: float = 1.0
    ) -> Patch:
        """Returns a disc whose outline wanders by a share `raggedness` of its radius."""
        angle_rad = self.rng.uniform(0, math.pi)
        reach_m = radius_m * (1 + 2 * raggedness) * max(1.0, stretch)
        rows, columns, u, v = self._local(place, angle_rad, reach_m)
        inside = radius_m - np.hypot(u / stretch, v)
        patch = self._patch(rows, columns, u, v, inside)
        if raggedness and not patch.empty:
            wander = 0.6 * self.noise("mottle", patch) + 0.6 * self.noise("clump", patch)
            inside = inside + radius_m * raggedness * np.clip(wander, -2, 2)
            patch = self._patch(rows, columns, u, v, inside)
        return patch

    def everywhere(self, angle_rad: float = 0.0, wander_m: float = 0.0) -> Patch:
        """Returns the whole canvas along its axes; with `wander_m` v meanders, as a track does."""
        rows, columns, u, v = self._local((0.0, 0.0), angle_rad, 3 * self.reach_m)
        if wander_m:
            period_m = self.rng.uniform(40, 90)
            wave = np.sin(2 * math.pi * u / period_m + self.rng.uniform(0, 6))
            v = v + np.float32(wander_m) * wave.astype(np.float32)
        return Patch(rows, columns, u, v, np.full_like(u, 1e3), np.ones_like(u))

    def band(
        self, base: Patch, centre_v_m: float, width_m: float, roughness_m: float = 0.0
    ) -> Patch:
        """Returns a strip of `base` along u about `centre_v_m`, for roads and long markings."""
        inside = width_m / 2 - np.abs(base.v - centre_v_m)
        if roughness_m:
            inside = inside + roughness_m * self.noise("mottle", base)
        return self._patch(base.rows, base.columns, base.u, base.v - centre_v_m, inside)

    def varied(
        self, patch: Patch, colour: Array, low: float = 0.2, high: float = 2.5, /, **weights: float
    ) -> Array:
        """Varies a colour by noise of the named kinds, by a factor from `low` to `high`."""
        factor: float | Array = 1
        for name, weight in weights.items():
            factor = factor + weight * self.noise(name, patch)
        return np.clip(factor, low, high)[..., None] * colour

    def either(self, *options: Option) -> Option:
        """Draws one of the options."""
        return options[self.rng.choice(len(options))]

    def pick(self, colours: Sequence[Colour], spread: float = 0.12) -> Array:
        """Draws one of the colours as reflectance, a little off: no two roofs are alike."""
        colour = reflectance(self.either(*colours))
        change = self.rng.normal(0, spread) + self.rng.normal(0, spread / 3, 3)
        return (colour * np.exp(change)).astype(np.float32)

    def paint(self, patch: Patch, colour: Array, strength: float | Array = 1.0) -> None:
        """Lays reflectance (`[3]` or `[h, w, 3]`) over the patch."""
        region = self.reflectance[patch.rows, patch.columns]
        region += (patch.coverage * strength)[..., None] * (colour - region)

    def shade(self, patch: Patch, factor: float | Array) -> None:
        """Multiplies the reflectance under the patch (stains, wear, wet)."""
        region = self.reflectance[patch.rows, patch.columns]
        region *= (1 + patch.coverage * (np.asarray(factor, np.float32) - 1))[..., None]

    def mute(self, kept: float) -> None:
        """Moves all reflectance towards grey, keeping a part of its chroma: dust, drought, soot."""
        grey = self.reflectance.mean(2, keepdims=True)
        self.reflectance = grey + np.float32(kept) * (self.reflectance - grey)

    def raise_to(self, patch: Patch, height_m: float | Array) -> None:
        """Raises the canvas under the patch to `height_m` above the ground, where it is lower."""
        region = self.height[patch.rows, patch.columns]
        height_m = np.where(patch.coverage > 0.5, height_m, -np.inf)
        np.maximum(region, height_m, out=region, casting="same_kind")

    def allow(
        self, patch: Patch, where: NDArray[np.bool_] | bool = True, turn_rad: float = 0.0
    ) -> None:
        """Allows middles of vehicles that head along the patch's u, turned left by `turn_rad`."""
        if min(patch.v.shape) < 2:
            return
        down, right = np.gradient(patch.v)
        heading_rad = np.arctan2(-right, -down) + turn_rad
        region = self.directions[patch.rows, patch.columns]
        allowed = (patch.coverage > 0.5) & where
        region[allowed] = direction_values(heading_rad)[allowed]

    def forbid(self, patch: Patch) -> None:
        """Forbids vehicles under the patch."""
        self.directions[patch.rows, patch.columns][patch.coverage > 0] = 0

    def drivable(self) -> NDArray[np.uint8]:
        """Returns the picture's map of drivable ground, `[size, size]`: allowed and free."""
        shown = np.zeros_like(self.directions)
        shown[self.picture] = self.directions[self.picture]
        free = self.height < IN_THE_WAY_M
        return np.ascontiguousarray(with_room(shown, free, self.gsd_m)[self.picture])

    def cover(self, blur_px: float) -> NDArray[np.uint8]:
        """Returns the picture's map of crowns and roofs, `[size, size]`, blurred as it is."""
        high = (self.height >= HIDES_FROM_M).astype(np.float32)
        blurred = ndimage.gaussian_filter(high, blur_px)[self.picture]
        return np.ascontiguousarray(np.round(255 * blurred).astype(np.uint8))

    def base_height(self, place: Place) -> float:
        """Returns the height of the canvas at a place, for things put on roofs."""
        column, row = self.to_pixels(*place)
        limit = self.pixels - 1
        return float(self.height[int(np.clip(row, 0, limit)), int(np.clip(column, 0, limit))])


def beside(place: Place, angle_rad: float, u_m: float, v_m: float) -> Place:
    """Returns the place u_m along and v_m across from another, in axes turned by an angle."""
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    return place[0] + cosine * u_m - sine * v_m, place[1] + sine * u_m + cosine * v_m
