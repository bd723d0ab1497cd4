"""`python -m skyproof.generator learn`: a generator learnt from photographs, and its fleets."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Suppress

from skyproof.cli.vehicles import FleetCounts, draw_fleets
from skyproof.console import say, stage_bars
from skyproof.generator.settings import LearnSettings
from skyproof.ranges import Fraction, Seed, WholeNumber
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety


@dataclass(frozen=True, kw_only=True)
class LearnVehicles:
    """Learns a generator of vehicles from photographs, and draws fleets from it.

    Every vehicle whose place `skyproof clear` recorded is fitted through the renderer: body,
    heading, paint and texture. A stopped run resumes with the same command. A finished generator
    draws fleets without the photographs.

    Attributes:
        imagery: tiled folder of labelled imagery, and the same cleared of vehicles; such a pair for
            every camera or day.
        out: folder of the generator, with sheets of all fits and of samples.
        settings: method of the generator.
        fleets: folder to write: the fleets train, validation, attack and test.
        counts: number of vehicles per split (train, validation, attack, test).
        fleet_seed: seed of the fleets.
        patterned: share of the fleets train and validation with random patterns.
        shapes: share of the fleets train and validation with a random shape (R-S-O).
        first_number: number of the first vehicle; drawn and wrapped vehicles have lower ones, so
            that fleets can be mixed.
        device: auto, cpu or cuda; trains the network of gan.
    """

    imagery: Annotated[
        tuple[tuple[Path, Path], ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="TILES CLEARED [TILES CLEARED ...]"),
    ] = ()
    out: Path
    settings: LearnSettings = field(default_factory=LearnSettings)
    fleets: Path | None = None
    counts: Suppress[FleetCounts] = (128, 32, 32, 32)
    fleet_seed: Suppress[Seed] = 0
    patterned: Suppress[Fraction] = PaintVariety().patterned
    shapes: Suppress[Fraction] = 0.25
    first_number: Suppress[WholeNumber] = 5000
    device: str = "auto"

    def run(self) -> None:
        """Learns the generator, says what it learnt from, and draws the fleets."""
        from skyproof.files import refuse_existing

        if self.fleets is not None:
            refuse_existing(self.fleets)
        if self.imagery or self.fleets is None:
            self._learn()
        if self.fleets is not None:
            self._draw(self.fleets)

    def _learn(self) -> None:
        from skyproof.device import choose_device
        from skyproof.generator.learning import Imagery, learn_vehicles
        from skyproof.scenes.backgrounds import BackgroundSet

        names = {"fit": "fit vehicles", "learn": "learn from them"}
        imagery = [
            Imagery(BackgroundSet.open(tiles), BackgroundSet.open(cleared))
            for tiles, cleared in self.imagery
        ]
        place = choose_device(self.device)
        with stage_bars() as update:
            record = learn_vehicles(
                imagery,
                self.settings,
                self.out,
                device=place,
                progress=lambda stage, done, total: update(names[stage], done, total),
            )
        self._say_record(record)

    def _draw(self, fleets: Path) -> None:
        from skyproof.generator.fleet import sample_learnt_fleet
        from skyproof.generator.folder import load_generator
        from skyproof.vehicles.fleet import FleetSettings

        settings = FleetSettings(
            first_number=self.first_number,
            paints=replace(CATALOGUE_PAINTS, patterned=self.patterned),
            shapes=self.shapes,
        )
        sample = partial(sample_learnt_fleet, load_generator(self.out))
        draw_fleets(fleets, self.counts, settings, self.fleet_seed, sample)

    def _say_record(self, record: dict[str, Any]) -> None:
        types = ", ".join(f"{count} {name}" for name, count in record["body_types"].items())
        say(f"Learnt from {record['vehicles']} vehicles: {types}.")
        for why, count in record["left_out"].items():
            say(f"  left out: {count} because {why}")
        guessed = record["headings_from"].get("picture", 0)
        if guessed:
            say(f"Headings of {guessed} were estimated from their boxes and pictures.")
        # Headings of labels are modulo a half turn, too.
        if record["unsure_directions"]:
            say(
                f"Of {record['unsure_directions']} of those learnt from, nose and tail may be "
                "exchanged."
            )
        say(
            f"Generator: {self.out.resolve()} (look at samples.png, and at "
            "fits/00001.png, which has the worst fits)"
        )
        if self.fleets is None:
            say(f"Draw fleets: python -m skyproof.generator learn --out {self.out} --fleets fleets")
