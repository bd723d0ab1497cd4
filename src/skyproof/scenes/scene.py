"""A scene as plain data: its ground, camera, sun and weather, and which vehicles stand where."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import read_jsonl, write_jsonl
from skyproof.scenes.weather import CLEAR, Weather

__all__ = ["BackgroundWindow", "Camera", "Placement", "Scene", "Sun", "read_scenes", "write_scenes"]


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

    tile: str
    centre_x_px: float
    centre_y_px: float
    rotation_rad: float


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

    tilt_rad: float
    azimuth_rad: float
    gsd_m: float
    size_px: int

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

    azimuth_rad: float
    elevation_rad: float

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
    """

    vehicle: str
    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Scene:
    """All that is needed to draw one image again, but for the fleet and the background set.

    Attributes:
        id: unique within its set.
        seed: of everything drawn while rendering (sensor noise).
        weather: clear where not given.
    """

    id: str
    background: BackgroundWindow
    camera: Camera
    sun: Sun
    placements: tuple[Placement, ...]
    seed: int
    weather: Weather = CLEAR


def write_scenes(path: Path, scenes: Iterable[Scene]) -> None:
    """Writes a set of scenes, one JSON object a line."""
    write_jsonl(path, map(_row, scenes))


def read_scenes(path: Path) -> list[Scene]:
    """Reads what `write_scenes` wrote.

    Raises:
        StoredFileError: the file is missing, not JSON lines, or of another form.
    """
    try:
        scenes = [_scene(row) for row in read_jsonl(path)]
    except (KeyError, TypeError, ConfigurationError) as error:
        message = (
            f"{path} is not a scene file of this version ({error!r}); sample the scenes again."
        )
        raise StoredFileError(message) from error
    if not scenes:
        raise StoredFileError(f"{path} holds no scene; sample the scenes again.")
    return scenes


def _row(scene: Scene) -> dict[str, Any]:
    row = dataclasses.asdict(scene)
    # Clear weather is not written, so that scenes of a clear day are one file in every version.
    if scene.weather == CLEAR:
        del row["weather"]
    return row


def _scene(row: dict[str, Any]) -> Scene:
    return Scene(
        id=row["id"],
        background=BackgroundWindow(**row["background"]),
        camera=Camera(**row["camera"]),
        sun=Sun(**row["sun"]),
        placements=tuple(Placement(**placement) for placement in row["placements"]),
        seed=row["seed"],
        weather=Weather(**row.get("weather", {})),
    )


def _direction(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    horizontal = math.cos(elevation_rad)
    return (
        horizontal * math.cos(azimuth_rad),
        horizontal * math.sin(azimuth_rad),
        math.sin(elevation_rad),
    )
