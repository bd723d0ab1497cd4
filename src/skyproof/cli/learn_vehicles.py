"""`skyproof learn-vehicles`: a generator of vehicles, from photographs of them."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from skyproof.cli.console import progress_bar, say
from skyproof.generator.settings import LearnSettings


@dataclass(frozen=True)
class LearnVehicles:
    """Learns vehicles from photographs, so that fleets can be drawn that look like those there.

    Every vehicle whose place `skyproof clear` kept is fitted through the renderer: body, heading,
    paint and texture, in the photograph's own light. A run that was stopped goes on where it was.
    Fleets are drawn by skyproof vehicles --generator.

    Attributes:
        imagery: tiled folder with the vehicles, as `skyproof ground` writes it from labelled
            imagery, and the same without them, as `skyproof clear` writes it; such a pair for
            every camera or day.
        out: folder to write: the generator, sheets of all fits and of samples.
        settings: how they are fitted, and by which method one learns from them.
        device: auto, cpu or cuda; where the network of "gan" is trained. All else works on the CPU.
    """

    imagery: Annotated[
        tuple[tuple[Path, Path], ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="TILES CLEARED [TILES CLEARED ...]"),
    ]
    out: Path
    settings: LearnSettings = field(default_factory=LearnSettings)
    device: str = "auto"

    def run(self) -> None:
        """Learns the generator, and says what it learnt from."""
        from skyproof.cli.device import choose_device
        from skyproof.generator.learning import Imagery, learn_vehicles
        from skyproof.scenes.backgrounds import BackgroundSet

        names = {"fit": "fit vehicles", "learn": "learn from them"}
        with ExitStack() as bars:
            updates: dict[str, Any] = {}

            def progress(stage: str, done: int, total: int) -> None:
                if stage not in updates:
                    bars.close()
                    updates[stage] = bars.enter_context(progress_bar(names[stage]))
                updates[stage](done, total)

            imagery = [
                Imagery(BackgroundSet.open(tiles), BackgroundSet.open(cleared))
                for tiles, cleared in self.imagery
            ]
            record = learn_vehicles(
                imagery,
                self.settings,
                self.out,
                device=choose_device(self.device),
                progress=progress,
            )
        self._say_record(record)

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
            f"Generator: {self.out.resolve()} (look at samples.png, between.png and turntable.png, "
            "and at fits/00001.png, which has the worst fits); draw fleets with skyproof vehicles "
            f"--generator {self.out} --out fleets"
        )
