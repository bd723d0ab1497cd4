"""A step of an assessment: is there enough ground to decide what is asked?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.errors import ImageryError
from skyproof.files import write_json
from skyproof.ranges import Fraction, Risk
from skyproof.words import percent

__all__ = ["Enough"]


@dataclass(frozen=True)
class Enough:
    """Stops a run that could never accept its detector, before anything is learnt.

    Attributes:
        backgrounds: background set whose test tiles are counted.
        reject: the share lost from which on a detector is refused.
        consumer_risk: chance at most that one which loses that is accepted.
        out: JSON file that keeps both numbers.
    """

    backgrounds: Path
    reject: Fraction
    consumer_risk: Risk
    out: Path

    def run(self) -> None:
        """Counts the test tiles.

        Raises:
            ImageryError: they are too few, whatever the detector does on them.
        """
        from skyproof.results.statistics.acceptance import fewest_tiles
        from skyproof.scenes.backgrounds import BackgroundSet

        tiles = len(BackgroundSet.open(self.backgrounds).tiles("test"))
        needed = fewest_tiles(self.reject, self.consumer_risk)
        if tiles < needed:
            raise ImageryError(
                f"{self.backgrounds} has {tiles} test tiles, and on fewer than {needed} no "
                f"detector can be accepted at {percent(self.reject)} with these risks, not even "
                f"one that loses nothing; give {needed / tiles:.1f} times as much imagery at "
                "least, or leave out --accept and --reject."
            )
        say(f"Test tiles: {tiles}; no verdict is possible on fewer than {needed}.")
        write_json(self.out, {"test_tiles": tiles, "fewest": needed})
