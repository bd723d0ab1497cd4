"""Detectors that judge a reproduction and are not attacked in it (section S5.4).

They stand in tables, each of which holds detectors that learnt from the same images.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from skyproof.detectors.card import DetectorCard, read_card
from skyproof.detectors.reference_detectors import reference_folder
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import drop_empty_folder, finished_folder, is_leftover
from skyproof.layout import Layout
from skyproof.reproduction.preset import Preset
from skyproof.reproduction.world import GSD_M
from skyproof.results.precheck import PRECHECK_FILE
from skyproof.words import detector_name

_TABLE = "judges"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class Judge:
    """A detector that only judges.

    Attributes:
        folder: the detector folder.
        card: what is known of it.
    """

    folder: Path
    card: DetectorCard

    @classmethod
    def open(cls, folder: Path) -> Judge:
        """Reads what a detector folder says of itself.

        Raises:
            StoredFileError: it is none.
        """
        return cls(folder, read_card(folder))

    @property
    def name(self) -> str:
        """The detector's name."""
        return self.card.name

    @property
    def data(self) -> str:
        """The images that it learnt from, in words; all imported ones learnt elsewhere."""
        if self.card.brought is not None:
            return "elsewhere"
        return f"{self.card.trained_on or 'unknown images'}, {self.card.training.get('images')}"

    def is_same(self, other: Judge) -> bool:
        """Says whether two folders hold one detector at one threshold."""
        own, theirs = self.card, other.card
        return (own.weights_sha256, own.threshold) == (theirs.weights_sha256, theirs.threshold)

    def learnt_like(self, other: Judge) -> bool:
        """Says whether two learnt from the same images, as far as their cards tell."""
        digests = [each.card.training.get("data_sha256") for each in (self, other)]
        return digests[0] == digests[1] if all(digests) else self.data == other.data


def read_judges(texts: Sequence[str]) -> dict[str, list[Judge]]:
    """Reads `[TABLE=]FOLDER` arguments: by table, detectors that learnt from the same images.

    Raises:
        ConfigurationError: a table of another name than a folder can have, or detectors in it that
            learnt from different images, of one kind, or made for other images.
        StoredFileError: a folder is no detector folder.
    """
    tables: dict[str, list[Judge]] = {}
    for text in texts:
        table, equals, place = text.partition("=")
        # A path may have the sign, too.
        if not equals or "/" in table:
            table, place = _TABLE, text
        if not _NAME.fullmatch(table) or not place:
            raise ConfigurationError(
                "--held-out expects [TABLE=]FOLDER, the table's name of at most 40 letters, digits "
                f"or - and _, got {text[:200]!r}."
            )
        judge = Judge.open(Path(place))
        if not math.isclose(judge.card.gsd_m, GSD_M):
            raise ConfigurationError(
                f"{place} was made for {judge.card.gsd_m} m per pixel, and a reproduction has "
                f"images of {GSD_M} m; give a detector for those."
            )
        others = tables.setdefault(table, [])
        if any(judge.name == other.name for other in others):
            raise ConfigurationError(
                f"{place} is a second {judge.name} of the table {table}; give it a table of its "
                f"own, as OTHER={place}."
            )
        unlike = next((other for other in others if not judge.learnt_like(other)), None)
        if unlike is not None:
            raise ConfigurationError(
                f"{unlike.folder} and {place} learnt from different images ({unlike.data}; "
                f"{judge.data}), so they cannot stand in one table, {table}, with a mean over "
                f"both; give one a table of its own, as OTHER={place}."
            )
        others.append(judge)
    return tables


def stored_judges(layout: Layout) -> dict[str, tuple[str, ...]]:
    """Lists by table the detectors that lie in a run folder to judge it."""
    if not layout.judges.is_dir():
        return {}
    tables = sorted(
        path.name for path in layout.judges.iterdir() if path.is_dir() and not is_leftover(path)
    )
    return {
        table: tuple(
            path.parent.name
            for path in sorted(layout.judged(table).detectors.glob("*/detector.json"))
        )
        for table in tables
    }


def new_judges(
    layout: Layout, preset: Preset, asked: Mapping[str, Sequence[Judge]]
) -> dict[str, Sequence[Judge]]:
    """Says which tables a run folder does not hold yet.

    Raises:
        ConfigurationError: a detector is one that the run attacks.
        RunFolderError: a table of that name holds other detectors.
    """
    known = stored_judges(layout)
    attacked = [_attacked(layout, preset, name) for name in preset.detectors if asked]
    for table, judges in asked.items():
        for judge in judges:
            same = next((one for one in attacked if one and judge.is_same(one)), None)
            if same is not None:
                raise ConfigurationError(
                    f"{judge.folder} is the {detector_name(same.name)} that this run attacks, and "
                    "is judged as such; give detectors to --held-out that no attack learns on."
                )
        own = layout.judged(table)
        stored = [Judge.open(own.detector(name)) for name in known.get(table, ())]
        other = next((j for j in judges if not any(map(j.is_same, stored))), None)
        if stored and other is not None:
            raise RunFolderError(
                f"{layout.folder} has a table {table} of other judges "
                f"({', '.join(judge.name for judge in stored)}) than {other.folder}, which stay as "
                f"they are; give it another table, as OTHER={other.folder}."
            )
    return {table: judges for table, judges in asked.items() if table not in known}


def store_judges(layout: Layout, tables: Mapping[str, Sequence[Judge]]) -> None:
    """Copies detectors into a run folder, a table at a time, each whole or not at all.

    Raises:
        RunFolderError: the disk cannot take them.
    """
    from skyproof.detectors.loaded import copy_detector

    for table, judges in tables.items():
        with finished_folder(layout.judges / table) as folder:
            for judge in judges:
                copy_detector(judge.folder, Layout(folder).detector(judge.name), [PRECHECK_FILE])


def store_reference_detectors(layout: Layout, preset: Preset) -> None:
    """Copies the attacked detectors that come with skyproof, with their prechecks, into a run.

    Raises:
        RunFolderError: the disk cannot take them.
    """
    from skyproof.detectors.loaded import copy_detector

    for name in preset.reference:
        if not (layout.detector(name) / "detector.json").exists():
            drop_empty_folder(layout.detector(name))
            with finished_folder(layout.detector(name)) as folder:
                copy_detector(reference_folder(name), folder, [PRECHECK_FILE])


def _attacked(layout: Layout, preset: Preset, name: str) -> Judge | None:
    """A detector that the run attacks; None where it is not trained yet."""
    folder = reference_folder(name) if name in preset.reference else layout.detector(name)
    return Judge.open(folder) if (folder / "detector.json").exists() else None
