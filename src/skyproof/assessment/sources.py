"""Digests of the user's own files, so that a replaced file is noticed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from skyproof.detectors.reference_detectors import detector_folder
from skyproof.files import file_digest

_READ = (".txt", ".yaml", ".json", ".geojson")
"""Suffixes of label files, and of a detector card, which holds the digest of the weights."""

_SIDES = (".shp", ".dbf", ".prj")
"""The files of a Shapefile."""


def source_digests(paths: Iterable[Path]) -> dict[str, str]:
    """Computes the SHA-256 of checkpoints, detector cards, and labels in a file or a folder."""
    return {str(path): _digest(detector_folder(path)) for path in paths}


def _digest(path: Path) -> str:
    total = hashlib.sha256()
    for file in _files(path):
        total.update(f"{file.name} {file_digest(file)}\n".encode())
    return total.hexdigest()


def _files(path: Path) -> list[Path]:
    if (path / "detector.json").is_file():
        return [path / "detector.json"]
    if path.is_dir():
        return sorted(each for each in path.iterdir() if each.suffix.lower() in _READ)
    if path.suffix.lower() == ".shp":
        return [side for suffix in _SIDES if (side := path.with_suffix(suffix)).is_file()]
    return [path]
