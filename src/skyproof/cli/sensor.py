"""`skyproof imagery sensor`: how blurred and noisy vehicles are to be drawn on a background set."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from skyproof.cli.console import say
from skyproof.imagery.sharpness import measure_sensor
from skyproof.scenes.backgrounds import BackgroundSet, write_sensor
from skyproof.scenes.sensor import Sensor

__all__ = ["SetSensor"]


@dataclass(frozen=True)
class SetSensor:
    """Says how sharp imagery is, so that vehicles are drawn alike (PAPER 12); measured where no value is given.

    Datasets rendered before keep their blur; evaluation refuses to mix them with later ones.

    Attributes:
        folder: background set, as `imagery tile`, `imagery clear` or `world` wrote it.
        blur_sigma_px: standard deviation of the Gaussian blur; 2.4 is the paper's.
        noise: standard deviation of the noise, sRGB units in [0, 1].
    """

    folder: Positional[Path]
    blur_sigma_px: float | None = None
    noise: float | None = None

    def run(self) -> None:
        """Measures what is not given, and writes both into the set's index."""
        backgrounds = BackgroundSet.open(self.folder)
        given = {
            name: value
            for name, value in (("blur_sigma_px", self.blur_sigma_px), ("noise", self.noise))
            if value is not None
        }
        measured = Sensor()
        if len(given) < 2:
            measured = measure_sensor(
                backgrounds.pixels(tile.id) for tile in backgrounds.tiles("train")
            )
        sensor = replace(measured, **given)
        write_sensor(self.folder, sensor)
        say(f"Blur {sensor.blur_sigma_px:g} px, noise {sensor.noise:g}: {self.folder.resolve()}")
