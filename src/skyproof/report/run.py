"""A run folder, read: what must be there is checked, what may be there is taken when it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyproof.camouflage.names import is_control, matched_control
from skyproof.errors import StoredFileError
from skyproof.files import read_json, read_jsonl
from skyproof.results.pairs.outcomes import Outcome, read_outcomes

__all__ = ["Headline", "Run", "is_real", "read_run"]

_ROW_KEYS = {
    "camouflage",
    "renderer",
    "detector",
    "vehicles",
    "easr",
    "easr_low",
    "easr_high",
    "net_easr",
    "net_easr_low",
    "net_easr_high",
    "asr",
    "er",
    "ap_original",
    "ap_adversarial",
    "apd",
    "match",
}
MAIN_MATCH = "centre_1m"
# `clean.json` calls the rendered test images so, whoever drew them.
_RENDERED = "rendered test"
_RENDERED_BY_CYCLES = "Blender Cycles test"


@dataclass(frozen=True)
class Headline:
    """One camouflage under one renderer: the row to quote, the rows by detector and those of its random control."""

    camouflage: str
    renderer: str
    row: Mapping[str, Any]
    by_detector: Sequence[Mapping[str, Any]]
    control: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Run:
    """What a run folder holds.

    Attributes:
        folder: the run folder.
        config, environment: as written; environment is empty where missing.
        rows: of `results.json`, then of `evaluation-cycles/results.json` where there is one.
        timings, clean: rows, empty where missing; those on Cycles images are called "Blender Cycles test".
        detectors, camouflages: by name, the JSON beside the weights or texture; empty where missing.
        outcomes: of both evaluations; None where missing.
    """

    folder: Path
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    rows: Sequence[Mapping[str, Any]]
    timings: Sequence[Mapping[str, Any]]
    clean: Sequence[Mapping[str, Any]]
    detectors: Mapping[str, Mapping[str, Any]]
    camouflages: Mapping[str, Mapping[str, Any]]
    outcomes: Sequence[Outcome] | None

    @property
    def synthetic_only(self) -> bool:
        """Whether the ground is procedural, so that no pixel comes from a real camera."""
        return self.config.get("imagery") == "procedural"

    @property
    def ground_known(self) -> bool:
        """Whether it is recorded what the ground is; an evaluation made in Python does not say."""
        return "imagery" in self.config

    @property
    def checked_on_real(self) -> bool:
        """Whether the detectors were also checked on images that no renderer drew."""
        return any(map(is_real, self.clean))

    def evaluation(self, renderer: str) -> tuple[Path, str]:
        """The folder that judged a renderer's images, and the name of its dataset without camouflage."""
        cycles = self.folder / "evaluation-cycles"
        if renderer == "cycles" and cycles.exists():
            return cycles, "test-cycles"
        return self.folder / "evaluation", "test"

    def steps(self, kind: str, name: str) -> list[Mapping[str, Any]]:
        """The log of a training ("detectors") or an attack ("camouflages"); empty where missing."""
        path = self.folder / kind / name / "steps.jsonl"
        rows = _optional(path, _rows, [])
        if not all(
            "step" in row and (row.get("kind") == "validation" or row.keys() & {"loss", "losses"})
            for row in rows
        ):
            raise _other_form(path)
        return rows

    def headlines(self) -> list[Headline]:
        """One entry per learnt or given camouflage and renderer, at the main match criterion."""
        rows = [row for row in self.rows if row["match"] == MAIN_MATCH]
        found = []
        for name, renderer in dict.fromkeys((row["camouflage"], row["renderer"]) for row in rows):
            own = [row for row in rows if (row["camouflage"], row["renderer"]) == (name, renderer)]
            if is_control(name):
                continue
            control_name = matched_control(name)
            control = {
                row["detector"]: row
                for row in rows
                if (row["camouflage"], row["renderer"]) == (control_name, renderer)
            }
            mean = [row for row in own if row["detector"] == "mean"]
            single = [row for row in own if row["detector"] != "mean"]
            found.append(Headline(name, renderer, (mean or single)[0], single + mean, control))
        return found


def is_real(row: Mapping[str, Any]) -> bool:
    """Whether a row of `clean.json` is on images that a camera took; those of before it was said go by name."""
    return bool(row.get("real", row.get("dataset") not in (_RENDERED, _RENDERED_BY_CYCLES)))


def read_run(folder: Path) -> Run:
    """Reads a run folder.

    Raises:
        StoredFileError: results.json or config.json is missing or damaged, or an optional file is damaged.
    """
    folder = Path(folder)
    # An evaluation made in Python leaves only its own folder.
    own = not (folder / "results.json").exists()
    rows = _results(folder / "evaluation" / "results.json" if own else folder / "results.json")
    outcomes_path = folder / "evaluation" / "outcomes.parquet"
    clean = _optional(folder / "evaluation" / "clean.json", _rows, [])
    outcomes = read_outcomes(outcomes_path) if outcomes_path.exists() else None
    cycles = folder / "evaluation-cycles"
    if cycles.exists():
        drawn = _results(cycles / "results.json")
        # Rows of one renderer in both would stand in the tables twice.
        if {row["renderer"] for row in drawn} != {"cycles"} or any(
            row["renderer"] == "cycles" for row in rows
        ):
            raise StoredFileError(
                f"{cycles} should hold what the detectors find in images of Blender Cycles, and results.json what they "
                "find in those of the differentiable renderer; remove it and run the evaluation again."
            )
        rows = rows + drawn
        clean = clean + [
            {**row, "dataset": _RENDERED_BY_CYCLES} if row.get("dataset") == _RENDERED else row
            for row in _optional(cycles / "clean.json", _rows, [])
        ]
        if outcomes is not None and (cycles / "outcomes.parquet").exists():
            outcomes += read_outcomes(cycles / "outcomes.parquet")
    return Run(
        folder=folder,
        config=_optional(folder / "config.json", _mapping, {})
        if own
        else _mapping(folder / "config.json"),
        environment=_optional(folder / "environment.json", _mapping, {}),
        rows=rows,
        timings=_optional(folder / "timings.json", _rows, []),
        clean=clean,
        detectors=_folders(folder / "detectors", "detector.json"),
        camouflages=_folders(folder / "camouflages", "camouflage.json"),
        outcomes=outcomes,
    )


def _results(path: Path) -> list[dict[str, Any]]:
    results = read_json(path)
    rows = results.get("rows") if isinstance(results, dict) else None
    if (
        not isinstance(rows, list)
        or not rows
        or not all(isinstance(r, dict) and r.keys() >= _ROW_KEYS for r in rows)
    ):
        raise StoredFileError(
            f"{path} holds no rows of this version's form; run the evaluation again."
        )
    return rows


def _optional(path: Path, read: Callable[[Path], Any], otherwise: Any) -> Any:
    return read(path) if path.exists() else otherwise


def _mapping(path: Path) -> Mapping[str, Any]:
    value = read_json(path)
    if not isinstance(value, dict):
        raise _other_form(path)
    return value


def _rows(path: Path) -> list[Mapping[str, Any]]:
    rows = read_jsonl(path) if path.suffix == ".jsonl" else read_json(path)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise _other_form(path)
    return rows


def _other_form(path: Path) -> StoredFileError:
    return StoredFileError(
        f"{path} is not of the form that this version writes; run its stage again."
    )


def _folders(parent: Path, file: str) -> dict[str, Mapping[str, Any]]:
    if not parent.is_dir():
        return {}
    return {path.parent.name: _mapping(path) for path in sorted(parent.glob(f"*/{file}"))}
