"""What the textures of a run look like in numbers: their colours, and how alike repeats are."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.reproduction.count_colours import count_colours, worn_area
from skyproof.reproduction.likeness import Worn, likeness
from skyproof.vehicles.vehicle import VehicleBatch


def measure_looks(
    folders: Sequence[Path],
    vehicles: VehicleBatch,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measures textures on the vehicles that wear them, each texel by its area there.

    Args:
        folders: of camouflages. Those that are no textures are passed over; repeats of one texture
            are compared with each other, and as many draws of its control.
        vehicles: procedural vehicles on the template of `make_template`.
        progress: called with (folders done, folders in all).

    Returns:
        "textures" with a row of `ColourCounts` each; "pairs" with a row for every two repeats:
        "correlation" and "distance" of `Likeness`, and the same as "seen_...", coarsely.

    Raises:
        StoredFileError: a folder is damaged.
    """
    compared = _compared([folder.name for folder in folders])
    # Where textures are worn depends on their mask alone.
    areas: dict[bool, Float[Tensor, "512 512"]] = {}
    worn: dict[str, tuple[Worn, Worn]] = {}
    rows = []
    for done, folder in enumerate(folders, 1):
        texture = load_camouflage(folder)
        if isinstance(texture, UniversalTexture):
            masked = texture.constraints.masked
            if masked not in areas:
                areas[masked] = worn_area(vehicles, texture.mask(vehicles))
            counts = count_colours(texture.bytes(), areas[masked])
            rows.append({"name": folder.name, **asdict(counts)})
            if folder.name in compared:
                fine = Worn.of(texture.bytes(), areas[masked])
                worn[folder.name] = (fine, fine.seen())
        if progress:
            progress(done, len(folders))
    pairs = [
        _pair(worn, first, second)
        for first, second in itertools.combinations(worn, 2)
        if compared[first] == compared[second]
    ]
    return {"textures": rows, "pairs": pairs}


def _compared(names: Sequence[str]) -> dict[str, CamouflageName]:
    """Says of which texture a name is a repeat: for learnt ones, and as many draws of each."""
    pooled = {name: CamouflageName.read(name).pooled for name in names}
    learnt = Counter(of for of in pooled.values() if not of.random)
    most: Counter[CamouflageName] = Counter()
    for of, repeats in learnt.items():
        most[of.control] = max(most[of.control], repeats)
    kept: dict[str, CamouflageName] = {}
    for name, of in pooled.items():
        if not of.random or list(kept.values()).count(of) < most[of]:
            kept[name] = of
    return kept


def _pair(worn: dict[str, tuple[Worn, Worn]], first: str, second: str) -> dict[str, Any]:
    fine, seen = map(likeness, worn[first], worn[second])
    coarsely = {f"seen_{key}": value for key, value in asdict(seen).items()}
    return {"first": first, "second": second, **asdict(fine), **coarsely}
