"""Is there enough ground to decide what is asked of a detector? Told before anything is learnt."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.errors import ConfigurationError, ImageryError
from skyproof.files import write_json
from skyproof.ranges import Fraction, Risk
from skyproof.words import percent


@dataclass(frozen=True)
class Enough:
    """Stops a run that could never accept its detector, before anything is learnt.

    Attributes:
        scenes: the test scenes, whose tiles are counted.
        reject: the share lost from which on a detector is refused.
        consumer_risk: chance at most that one which loses that is accepted.
        out: JSON file that keeps both numbers.
    """

    scenes: Path
    reject: Fraction
    consumer_risk: Risk
    out: Path

    def run(self) -> None:
        """Counts the tiles that the scenes stand on.

        Raises:
            ImageryError: they are too few, whatever the detector does on them.
        """
        from skyproof.results.statistics.acceptance import fewest_tiles
        from skyproof.results.statistics.planning import tiles_to_show
        from skyproof.scenes.scene import read_scenes

        scenes = read_scenes(self.scenes)
        tiles = len({scene.background.tile for scene in scenes})
        needed = fewest_tiles(self.reject, self.consumer_risk)
        if tiles < needed:
            raise ImageryError(
                f"The {len(scenes)} scenes of {self.scenes} stand on {tiles} test tiles, and on "
                f"fewer than {needed} no detector can be accepted at {percent(self.reject)} with "
                "these risks, not even one that loses nothing; give imagery with about "
                f"{tiles_to_show(needed, len(scenes)):,} test tiles that have drivable ground, or "
                "leave out --accept and --reject."
            )
        say(f"Test tiles: {tiles}; no verdict is possible on fewer than {needed}.")
        write_json(self.out, {"test_tiles": tiles, "fewest": needed})


def refuse_what_scenes_cannot_show(reject: float, consumer_risk: float, scenes: int) -> None:
    """Refuses a requirement that takes more tiles than there are test scenes.

    Raises:
        ConfigurationError: no imagery could be enough.
    """
    from skyproof.results.statistics.acceptance import fewest_tiles

    needed = fewest_tiles(reject, consumer_risk)
    if needed >= scenes:
        raise ConfigurationError(
            f"To accept a detector at --reject {reject:g} with --consumer-risk {consumer_risk:g} "
            f"takes {needed} test tiles at least, and the suite has {scenes} scenes, which do not "
            "all stand on tiles of their own; ask for a larger share or a larger risk."
        )
