"""Where in the RGB cube the colours of learnt textures end, beside their random controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np
from jaxtyping import Float

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.cells import Block, Figure, Grid, Heading, Table, number, span
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored_looks import TextureLooks

CHANNELS = ("red", "green", "blue")
_PLACES = ("faces", "edges", "corners")
_MISSING = "The textures’ colours were not measured in this run."


def colour_tables(run: Reproduction) -> list[Table]:
    """Gives the shares by place in the RGB cube and the histograms; empty where not measured."""
    if run.looks is None:
        return []
    textures = _by_name(run.looks.textures)
    rows = [_row(name, textures) for name in _learnt(textures)]
    histograms = [
        {"attack": str(name), "channel": channel}
        | {f"share_{16 * index}": 100 * float(share) for index, share in enumerate(bins)}
        for name, found in colour_histograms(run).items()
        for channel, bins in zip(CHANNELS, found, strict=True)
    ]
    return [Table("colours", rows), Table("colour_histograms", histograms)]


def colours_section(run: Reproduction, tables: Mapping[str, Table]) -> list[Block]:
    """Says where colours end; in one sentence that nothing was measured, where that is so."""
    heading = Heading("Colours")
    if "colours" not in tables:
        return [heading, _MISSING]
    rows = [
        [
            row["attack"],
            str(row["textures"]),
            *(_mean(row, place) for place in _PLACES),
            *(number(row[f"random_{place}"]) for place in _PLACES),
        ]
        for row in tables["colours"].rows
    ]
    header = ["texture", "repeats"]
    header += [f"{place}, %" for place in _PLACES] + [f"random: {place}, %" for place in _PLACES]
    return [
        heading,
        "Where in the RGB cube the colours lie that learnt textures end with: shares of the "
        "painted surface whose red, green or blue is within a sixteenth of 0 or of 1. At a face "
        "one channel or more is, at an edge two or more, at a corner all three. Each texel counts "
        "by its mean area on the test vehicles, and only where they wear the texture. Brackets "
        "hold the range over repeats. Of uniformly random colours 32.2, 4.1 and 0.2 % lie there. "
        "“random” is the mean over draws of the random control.",
        Grid(header, rows),
        *_weather(tables["colours"]),
        Figure(
            "colours",
            "Distribution of red, green and blue (lines) over 16 steps from 0 to 255, in percent "
            "of the painted surface, mean over repeats; grey: the random control, mean of channels",
        ),
    ]


def colour_histograms(run: Reproduction) -> dict[CamouflageName, Float[np.ndarray, "3 B"]]:
    """Gives mean histograms over repeats of learnt textures, then over draws of their controls."""
    if run.looks is None:
        return {}
    textures = _by_name(run.looks.textures)
    learnt = _learnt(textures)
    controls = [name for name in dict.fromkeys(name.control for name in learnt) if name in textures]
    return {
        name: np.mean([texture.histogram for texture in textures[name]], axis=0)
        for name in (*learnt, *controls)
    }


def _row(
    name: CamouflageName, textures: Mapping[CamouflageName, Sequence[TextureLooks]]
) -> dict[str, Any]:
    row: dict[str, Any] = {"attack": str(name), "textures": len(textures[name])}
    for place in _PLACES:
        shares = [100 * getattr(texture, place) for texture in textures[name]]
        row |= {place: fmean(shares), f"{place}_min": min(shares), f"{place}_max": max(shares)}
    draws = textures.get(name.control, [])
    row["random_draws"] = len(draws)
    for place in _PLACES:
        shares = [100 * getattr(texture, place) for texture in draws]
        row[f"random_{place}"] = fmean(shares) if shares else None
    return row


def _by_name(textures: Sequence[TextureLooks]) -> dict[CamouflageName, list[TextureLooks]]:
    found: dict[CamouflageName, list[TextureLooks]] = {}
    for texture in textures:
        found.setdefault(CamouflageName.read(texture.name).pooled, []).append(texture)
    return found


def _learnt(textures: Mapping[CamouflageName, Any]) -> list[CamouflageName]:
    """Lists what was learnt, variants below what they are variants of."""
    names = [name for name in textures if not name.random]
    bases = list(dict.fromkeys(name.base for name in names))
    return sorted(names, key=lambda name: (bases.index(name.base), name.variant != ""))


def _mean(row: Mapping[str, Any], place: str) -> str:
    mean = number(row[place])
    if row["textures"] < 2:
        return mean
    return f"{mean} ({span(row[f'{place}_min'], row[f'{place}_max'])})"


def _weather(table: Table) -> list[Block]:
    """Sets textures that were learnt in weather beside the same learnt under a clear sky."""
    faces = {row["attack"]: row["faces"] for row in table.rows}
    said = [
        f"Learnt in weather, {name.removesuffix('_weather')} has {number(share)} % at the faces, "
        f"{number(faces[name.removesuffix('_weather')])} % without."
        for name, share in faces.items()
        if name.endswith("_weather") and name.removesuffix("_weather") in faces
    ]
    return [" ".join(said)] if said else []
