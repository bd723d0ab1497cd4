"""A scene as plain data: its ground, camera, sun and weather, and which vehicles stand where."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from skyproof.documents import read_lines
from skyproof.errors import StoredFileError
from skyproof.files import write_jsonl
from skyproof.ranges import Coordinate, Fraction, GroundResolution, ImageSide, Name, Radians, Seed
from skyproof.scenes.weather import CLEAR, Weather

MOST_PLACEMENTS = 1000
"""Vehicles in one scene."""

Tilt = Annotated[float, Meta(ge=0, le=1.5)]
"""Radians off the vertical; near the horizon a vehicle would reach endlessly far."""

SunElevation = Annotated[float, Meta(ge=0.01, le=math.pi / 2)]
"""Radians above the horizon; nearer to it a shadow would reach endlessly far."""

_Place = Annotated[float, Meta(ge=-1e5, le=1e5)]


@dataclass(frozen=True)
class BackgroundWindow:
    """A square window of a background tile.

    Attributes:
        tile: id of the tile in its background set; the cluster of the bootstrap.
        centre_x_px: the window's middle in tile pixels, from the tile's left edge, continuous.
        centre_y_px: the same from the tile's top edge.
        rotation_rad: the window's x axis is the tile's turned by this angle, counter-clockwise on
            screen.
    """

    tile: Name
    centre_x_px: Coordinate
    centre_y_px: Coordinate
    rotation_rad: Radians


@dataclass(frozen=True)
class Camera:
    """An aerial camera whose picture was rectified to the ground plane, as an orthophoto is.

    Ground points land on the pixel grid whatever the tilt; a point at height h leans away from the
    camera by h * tan(tilt). This is the limit of a high camera: parallel rays over one vehicle.

    Attributes:
        tilt_rad: angle off the vertical, 0 to 20 degrees (section S3.2.1).
        azimuth_rad: direction from the scene to the camera, in the ground plane, from x (east)
            towards y (north).
        gsd_m: metres per pixel.
        size_px: the image is size_px x size_px; world (0, 0) is its centre, east is right, north is
            up.
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
    """The sun's place in the sky.

    Attributes:
        azimuth_rad: direction from the scene to the sun, from x (east) towards y (north).
        elevation_rad: above the horizon.
    """

    azimuth_rad: Radians
    elevation_rad: SunElevation

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector from the scene to the sun."""
        return _direction(self.azimuth_rad, self.elevation_rad)


@dataclass(frozen=True)
class Placement:
    """One vehicle in a scene.

    Attributes:
        vehicle: its id in the fleet.
        x_m: its place, metres east of the image's middle.
        y_m: the same northwards.
        heading_rad: which way it points, from x towards y.
        shade: the part of the direct sun that the photograph's shadows take from it.
        covered: the part of its footprint that the photograph's crowns and roofs hide; 0 also for a
            vehicle that stands on top of them.
    """

    vehicle: Name
    x_m: _Place
    y_m: _Place
    heading_rad: Radians
    shade: Fraction = 0.0
    covered: Fraction = 0.0


@dataclass(frozen=True)
class Scene:
    """All that is needed to draw one image again, but for the fleet and the background set.

    Attributes:
        id: unique within its set; names its picture.
        seed: of everything drawn while rendering (sensor noise).
        weather: clear where not given.
    """

    id: Name
    background: BackgroundWindow
    camera: Camera
    sun: Sun
    placements: Annotated[tuple[Placement, ...], Meta(max_length=MOST_PLACEMENTS)]
    seed: Seed
    weather: Weather = CLEAR


def write_scenes(path: Path, scenes: Iterable[Scene]) -> None:
    """Writes a set of scenes, one JSON object a line."""
    write_jsonl(path, map(_row, scenes))


def read_scenes(path: Path) -> list[Scene]:
    """Reads what `write_scenes` wrote.

    Raises:
        StoredFileError: the file is missing, not JSON lines, of another form or out of range; two
            scenes share an id; or they differ in image size or resolution.
    """
    remedy = "copy the file again, or sample the scenes again"
    scenes: list[Scene] = read_lines(path, Scene, remedy)
    if not scenes:
        raise StoredFileError(f"{path} holds no scene; {remedy}.")
    ids: set[str] = set()
    for scene in scenes:
        if scene.id in ids:
            raise StoredFileError(f"{path} holds two scenes called {scene.id!r}; {remedy}.")
        ids.add(scene.id)
        own = (scene.camera.size_px, scene.camera.gsd_m)
        if own != (scenes[0].camera.size_px, scenes[0].camera.gsd_m):
            raise StoredFileError(
                f"{path} holds scenes of several image sizes or resolutions ({scene.id} differs "
                f"from {scenes[0].id}); {remedy}."
            )
    return scenes


def scenes_digest(scenes: Iterable[Scene]) -> str:
    """Computes the SHA-256 of scenes; it is the same of drawn ones and of the file they became."""
    return hashlib.sha256(msgspec.json.encode([_row(scene) for scene in scenes])).hexdigest()


def _row(scene: Scene) -> dict[str, Any]:
    row = dataclasses.asdict(scene)
    # Clear weather is not written, so that scenes of a clear day are one file in every version.
    if scene.weather == CLEAR:
        del row["weather"]
    for placement in row["placements"]:
        # Nor is what the ground does not say.
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
