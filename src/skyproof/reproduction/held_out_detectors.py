"""Detectors that a reproduction scores and does not attack (section S5.4), in tables."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from skyproof.detectors.card import DetectorCard, read_card, reference_folder
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import drop_empty_folder, finished_folder
from skyproof.layout import Layout
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.preset import GSD_M, Preset
from skyproof.results.precheck import PRECHECK_FILE
from skyproof.words import detector_name

_TABLE = "judges"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class HeldOutDetector:
    """A held-out detector: its folder and its card."""

    folder: Path
    card: DetectorCard

    @classmethod
    def open(cls, folder: Path) -> "HeldOutDetector":
        """Reads a detector folder's card; raises StoredFileError for any other folder."""
        return cls(folder, read_card(folder))

    @property
    def data(self) -> str:
        """The training images in words; those of imported detectors are unknown."""
        if self.card.brought is not None:
            return "elsewhere"
        return f"{self.card.trained_on or 'unknown images'}, {self.card.training.get('images')}"

    def is_same(self, other: "HeldOutDetector") -> bool:
        """Says whether two folders hold one detector at one threshold."""
        own, theirs = self.card, other.card
        return (own.weights_sha256, own.threshold) == (theirs.weights_sha256, theirs.threshold)

    def is_trained_like(self, other: "HeldOutDetector") -> bool:
        """Says whether two have the same training images, as far as their cards tell."""
        digests = [each.card.training.get("data_sha256") for each in (self, other)]
        return digests[0] == digests[1] if all(digests) else self.data == other.data


def read_held_out(texts: Sequence[str]) -> dict[str, list[HeldOutDetector]]:
    """Reads `[TABLE=]FOLDER` arguments: by table, detectors of the same training images."""
    tables: dict[str, list[HeldOutDetector]] = {}
    for text in texts:
        table, equals, place = text.partition("=")
        # A path may contain the equals sign, too.
        if not equals or "/" in table:
            table, place = _TABLE, text
        if not _NAME.fullmatch(table) or not place:
            raise ConfigurationError(
                "--held-out expects [TABLE=]FOLDER, a table's name of at most 40 letters, digits, "
                f"- and _, got {text[:200]!r}."
            )
        detector = HeldOutDetector.open(Path(place))
        if not math.isclose(detector.card.gsd_m, GSD_M):
            raise ConfigurationError(
                f"{place} was made for {detector.card.gsd_m} m per pixel, and a reproduction has "
                f"images of {GSD_M} m; give a detector for those."
            )
        others = tables.setdefault(table, [])
        name = detector.card.name
        if any(name == other.card.name for other in others):
            raise ConfigurationError(
                f"{place} is a second {name} of the table {table}; give it a table of its own, as "
                f"OTHER={place}."
            )
        unlike = next((other for other in others if not detector.is_trained_like(other)), None)
        if unlike is not None:
            raise ConfigurationError(
                f"{unlike.folder} and {place} have different training images ({unlike.data}; "
                f"{detector.data}), so they cannot stand in one table, {table}, with a mean over "
                f"both; give one a table of its own, as OTHER={place}."
            )
        others.append(detector)
    return tables


def stored_tables(layout: PaperLayout) -> dict[str, tuple[str, ...]]:
    """Lists by table the held-out detectors that lie in a run folder."""
    tables: dict[str, tuple[str, ...]] = {}
    # Hidden folders are being copied, or are left from a killed run.
    for card in sorted(layout.held_out.glob("[!.]*/detectors/*/detector.json")):
        detector = card.parent
        table = detector.parents[1].name
        tables[table] = (*tables.get(table, ()), detector.name)
    return tables


def new_tables(
    layout: PaperLayout, preset: Preset, given: Mapping[str, Sequence[HeldOutDetector]]
) -> dict[str, Sequence[HeldOutDetector]]:
    """Says which tables a run folder does not hold yet; refuses detectors that the run attacks."""
    known = stored_tables(layout)
    folders = [
        reference_folder(name) if name in preset.reference else layout.detector(name)
        for name in preset.detectors
    ]
    # Detectors that are not trained yet cannot be among the given ones.
    trained = [folder for folder in folders if given and (folder / "detector.json").exists()]
    attacked = [*map(HeldOutDetector.open, trained)]
    for table, detectors in given.items():
        for detector in detectors:
            same = next((one for one in attacked if detector.is_same(one)), None)
            if same is not None:
                raise ConfigurationError(
                    f"{detector.folder} is the {detector_name(same.card.name)} that this run "
                    "attacks; give detectors to --held-out that no attack uses."
                )
        own = layout.table(table)
        stored = [HeldOutDetector.open(own.detector(name)) for name in known.get(table, ())]
        other = next((d for d in detectors if not any(map(d.is_same, stored))), None)
        if stored and other is not None:
            raise RunFolderError(
                f"{layout.folder} has a table {table} of other detectors "
                f"({', '.join(known[table])}) than {other.folder}, which stay as they are; give it "
                f"another table, as OTHER={other.folder}."
            )
    return {table: detectors for table, detectors in given.items() if table not in known}


def store_detectors(
    layout: PaperLayout, preset: Preset, tables: Mapping[str, Sequence[HeldOutDetector]]
) -> None:
    """Copies the detectors that a run does not train, a table at a time, whole or not at all."""
    from skyproof.detectors.loaded import copy_detector

    for name in preset.reference:
        if not (layout.detector(name) / "detector.json").exists():
            drop_empty_folder(layout.detector(name))
            with finished_folder(layout.detector(name)) as folder:
                copy_detector(reference_folder(name), folder, [PRECHECK_FILE])
    for table, detectors in tables.items():
        with finished_folder(layout.held_out / table) as folder:
            for each in detectors:
                copy_detector(each.folder, Layout(folder).detector(each.card.name), [PRECHECK_FILE])
