"""`skyproof reference`: the detectors that come with it, copied to where a run wants them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS
from skyproof.errors import ConfigurationError


@dataclass(frozen=True)
class Reference:
    """Copies the detectors that come with skyproof into a folder, ready to be attacked.

    They learnt from procedural ground and vehicles alone. Each becomes a detector folder like any
    other, with what the check found of it when it was made, which is shown.

    Attributes:
        out: folder in which every detector gets its own, by its name.
        detectors: retinanet, faster_rcnn, or both; no other comes trained.
        check: copy what the check found, too; --no-check leaves it out, so that `skyproof precheck`
            can tell what it finds on your ground.
    """

    out: Path
    detectors: tuple[str, ...] = REFERENCE_DETECTORS
    check: bool = True

    def run(self) -> None:
        """Copies the detectors, and prints what was found of them and where they lie."""
        from skyproof.cli.precheck_words import lines
        from skyproof.detectors.loaded import copy_detector
        from skyproof.detectors.reference_detectors import reference_detector, reference_folder
        from skyproof.files import drop_empty_folder, finished_folder, refuse_existing
        from skyproof.results.precheck import PRECHECK_FILE, read_precheck

        names = tuple(dict.fromkeys(self.detectors))
        if not names:
            raise ConfigurationError(
                f"--detectors expects {' or '.join(REFERENCE_DETECTORS)}, got none."
            )
        # What is damaged or in the way shows before anything is written.
        found: list[list[str]] = []
        for name in names:
            card = reference_detector(name).card
            found.append(lines(read_precheck(reference_folder(name)), card.doubts))
            drop_empty_folder(self.out / name)
            refuse_existing(self.out / name)
        for name, told in zip(names, found, strict=True):
            with finished_folder(self.out / name) as folder:
                copy_detector(reference_folder(name), folder, [PRECHECK_FILE] if self.check else ())
            for line in told if self.check else ():
                say(line)
            say(f"Detector: {(self.out / name).resolve()}")
