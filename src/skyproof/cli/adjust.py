"""`skyproof adjust`: a person's corrections of a background set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from skyproof.cli.console import say
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.scenes.sensor import BlurChoice, Noise, chosen_blur_px


@dataclass(frozen=True)
class Adjust:
    """Takes rejected tiles out of a background set; says how sharp vehicles are drawn on it.

    Datasets rendered before keep their blur and noise; `skyproof score` refuses to mix them with
    later ones.

    Attributes:
        folder: background set, as `skyproof ground` or `skyproof clear` wrote it.
        drop: ids of the tiles to take out, as on the sheets of `skyproof clear`, with their
            annotations; their pictures stay on disk.
        measure_sensor: measure blur and noise of the imagery anew, but for what is given.
        blur_sigma_px: standard deviation of the Gaussian blur in pixels, or "paper" for the paper's
            2.4.
        noise: standard deviation of the noise, in sRGB units from 0 to 1.
    """

    folder: Positional[Path]
    drop: tuple[str, ...] = ()
    measure_sensor: bool = False
    blur_sigma_px: BlurChoice | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        if not (self.drop or self.measure_sensor or self._given()):
            raise ConfigurationError(
                "Nothing to adjust was named; give --drop with tiles, --measure-sensor, "
                "--blur-sigma-px or --noise."
            )

    def run(self) -> None:
        """Rewrites the set's index, and without dropped tiles its annotations."""
        from skyproof.scenes.backgrounds import BackgroundSet

        # What is no background set is said before anything is written.
        BackgroundSet.open(self.folder)
        with alone(self.folder):
            if self.drop:
                self._drop_tiles()
            if self.measure_sensor or self._given():
                self._set_sensor()

    def _given(self) -> dict[str, float]:
        values = {} if self.noise is None else {"noise": self.noise}
        if self.blur_sigma_px is not None:
            values["blur_sigma_px"] = chosen_blur_px(self.blur_sigma_px)
        return values

    def _drop_tiles(self) -> None:
        from skyproof.imagery.clearing.dropping import drop_tiles

        emptied = drop_tiles(self.folder, self.drop)
        say(f"Dropped {len(set(self.drop))} tiles from {self.folder.resolve()}")
        for split in emptied:
            say(
                f"No tile of the split {split} is left; give more imagery before using this folder "
                "for it."
            )

    def _set_sensor(self) -> None:
        from skyproof.imagery.sharpness import sensor_of_tiles
        from skyproof.scenes.background_index import change_sensors, read_index
        from skyproof.scenes.backgrounds import BackgroundSet

        backgrounds = BackgroundSet.open(self.folder)
        given = self._given()
        if not self.measure_sensor:
            change_sensors(self.folder, lambda its: replace(its, **given))
        else:
            measured = sensor_of_tiles(backgrounds, read_index(self.folder).tiles)
            change_sensors(self.folder, lambda _: replace(measured, **given))
        backgrounds = BackgroundSet.open(self.folder)
        tiles = backgrounds.all_tiles()
        sensors = [tile.sensor or backgrounds.sensor for tile in tiles]
        blur = _span([sensor.blur_sigma_px for sensor in sensors])
        noise = _span([sensor.noise for sensor in sensors])
        say(f"Blur {blur} px, noise {noise}: {self.folder.resolve()}")


def _span(values: Sequence[float]) -> str:
    """Says one number, or from which to which they go."""
    low = min(values)
    high = max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
