"""A scene as plain data: ground, camera, sun, weather, and the vehicles and their places."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.documents import read_lines
from skyproof.errors import StoredFileError
from skyproof.files import value_digest, write_jsonl
from skyproof.ranges import Coordinate, Fraction, GroundResolution, ImageSide, Name, Radians, Seed
from skyproof.scenes.weather import CLEAR, Weather

MOST_PLACEMENTS = 1000
"""Largest number of vehicles in one scene."""

Tilt = Annotated[float, Meta(ge=0, le=1.5)]
"""Radians off the vertical; near the horizon the image of a vehicle grows without bound."""

SunElevation = Annotated[float, Meta(ge=0.01, le=math.pi / 2)]
"""Radians above the horizon; under a lower sun, shadows grow without bound."""

_Place = Annotated[float, Meta(ge=-1e5, le=1e5)]


@dataclass(frozen=True)
class BackgroundWindow:
    """A square window of a background tile, by its middle in tile pixels from the top-left corner.

    The rotation is the angle from the tile's x axis to the window's, counter-clockwise on screen.
    """

    tile: Name
    centre_x_px: Coordinate
    centre_y_px: Coordinate
    rotation_rad: Radians


@dataclass(frozen=True)
class Camera:
    """An aerial camera whose picture was rectified to the ground plane, as an orthophoto is.

    Ground points stay on the pixel grid at any tilt, and a point at height h leans away from the
    camera by h * tan(tilt): parallel rays. World (0, 0) is the image's centre, x is east and right,
    y north and up. The azimuth is the direction to the camera, from x to y. (Section S3.2.1)
    """

    tilt_rad: Tilt
    azimuth_rad: Radians
    gsd_m: GroundResolution
    size_px: ImageSide

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector from the scene to the camera."""
        return _direction(self.azimuth_rad, math.pi / 2 - self.tilt_rad)


@dataclass(frozen=True)
class Sun:
    """The sun's azimuth, from x (east) towards y (north), and its elevation above the horizon."""

    azimuth_rad: Radians
    elevation_rad: SunElevation

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector from the scene to the sun."""
        return _direction(self.azimuth_rad, self.elevation_rad)


@dataclass(frozen=True)
class Placement:
    """One vehicle in a scene, in metres east and north of the image's middle.

    Attributes:
        heading_rad: direction of its nose, from x towards y.
        shade: share of the direct sun that the photograph's shadows block.
        covered: share of its footprint under crowns and roofs; also 0 if it stands on top of them.
    """

    vehicle: Name
    x_m: _Place
    y_m: _Place
    heading_rad: Radians
    shade: Fraction = 0.0
    covered: Fraction = 0.0


@dataclass(frozen=True)
class Scene:
    """All data to render one image again, including its noise, except fleet and background set."""

    id: Name
    background: BackgroundWindow
    camera: Camera
    sun: Sun
    placements: Annotated[tuple[Placement, ...], Meta(max_length=MOST_PLACEMENTS)]
    seed: Seed
    weather: Weather = CLEAR


def write_scenes(path: Path, scenes: Iterable[Scene]) -> None:
    """Writes a set of scenes, one JSON object per line."""
    write_jsonl(path, map(_row, scenes))


def read_scenes(path: Path) -> list[Scene]:
    """Reads a file that `write_scenes` wrote; a missing or invalid one raises StoredFileError."""
    remedy = "copy the file again, or sample the scenes again"
    scenes: list[Scene] = read_lines(path, Scene, remedy)
    if not scenes:
        raise StoredFileError(f"{path} holds no scene; {remedy}.")
    ids: set[str] = set()
    first = scenes[0].camera
    for scene in scenes:
        if scene.id in ids:
            raise StoredFileError(f"{path} holds two scenes called {scene.id!r}; {remedy}.")
        ids.add(scene.id)
        if (scene.camera.size_px, scene.camera.gsd_m) != (first.size_px, first.gsd_m):
            raise StoredFileError(
                f"{path} holds scenes of several image sizes or resolutions ({scene.id} differs "
                f"from {scenes[0].id}); {remedy}."
            )
    return scenes


def scenes_digest(scenes: Iterable[Scene]) -> str:
    """Computes the SHA-256 of scenes, which is the same for drawn and for stored ones."""
    return value_digest([_row(scene) for scene in scenes])


def _row(scene: Scene) -> dict[str, Any]:
    row = dataclasses.asdict(scene)
    # Clear weather is not written, so that a file of clear scenes is the same in every version.
    if scene.weather == CLEAR:
        del row["weather"]
    for placement in row["placements"]:
        # Nor are shade and cover of 0, which is their value on ground that does not state them.
        for name in ("shade", "covered"):
            if not placement[name]:
                del placement[name]
    return row


def _direction(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    horizontal = math.cos(elevation_rad)
    return (
        horizontal * math.cos(azimuth_rad),
        horizontal * math.sin(azimuth_rad),
        math.sin(elevation_rad),
    )
