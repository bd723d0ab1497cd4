"""Which colours textures end with, and where these lie in the RGB cube (section S7)."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from skyproof.camouflage.name import CamouflageName
from skyproof.report.figures import GREY, as_files
from skyproof.reproduction.cells import (
    Block,
    Cell,
    Figure,
    Heading,
    Table,
    TextTable,
    Topic,
    number,
    span,
    value,
)
from skyproof.reproduction.drawing import figure_style, panels, rule
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored_looks import TextureLooks

_CHANNELS = ("red", "green", "blue")
_PLACES = ("faces", "edges", "corners")
_COLUMNS = 6
# Told apart by their lines, too.
_LINES: Any = (("#c0392b", "-"), ("#1e8449", "--"), ("#1f5fa8", ":"))
_RANDOM = "#d5dade"

Textures = Mapping[CamouflageName, Sequence[TextureLooks]]
"""What was measured of each texture, repeat by repeat or draw by draw."""


def colours_part(run: Reproduction) -> Topic:
    """Gives the shares by place in the RGB cube and the histograms, where they were measured."""
    heading = Heading("Colours")
    if run.looks is None:
        return Topic(blocks=[heading, "The textures’ colours were not measured in this run."])
    textures = defaultdict(list)
    for texture in run.looks.textures:
        textures[CamouflageName.read(texture.name).pooled].append(texture)
    rows = [_row(name, textures) for name in _learnt(textures)]
    histograms = _histograms(textures)
    bins = [
        {"attack": str(name), "channel": channel}
        | {f"share_{16 * index}": 100 * float(share) for index, share in enumerate(shares)}
        for name, found in histograms.items()
        for channel, shares in zip(_CHANNELS, found, strict=True)
    ]
    columns: list[tuple[str, str | Cell]] = [("texture", "attack"), ("repeats", "textures")]
    columns += [(f"{place}, %", partial(_mean, place=place)) for place in _PLACES]
    columns += [(f"random: {place}, %", value(f"random_{place}")) for place in _PLACES]
    blocks: list[Block] = [
        heading,
        "Where in the RGB cube the colours lie that learnt textures end with: shares of the "
        "painted surface whose red, green or blue is within a sixteenth of 0 or of 1. At a face "
        "one channel or more is, at an edge two or more, at a corner all three. Each texel counts "
        "by its mean area on the test vehicles, and only where they wear the texture. Brackets "
        "hold the range over repeats. Of uniformly random colours 32.2, 4.1 and 0.2 % lie there. "
        "“random” is the mean over draws of the random control.",
        TextTable.of(rows, columns),
        *_weather(rows),
        Figure(
            "colours",
            "Distribution of red, green and blue (lines) over 16 steps from 0 to 255, in percent "
            "of the painted surface, mean over repeats; grey: the random control, mean of channels",
            _figure(histograms),
        ),
    ]
    return Topic([Table("colours", rows), Table("colour_histograms", bins)], blocks)


def _histograms(textures: Textures) -> dict[CamouflageName, Float[np.ndarray, "3 B"]]:
    """Gives mean histograms over repeats of learnt textures, then over draws of their controls."""
    learnt = _learnt(textures)
    controls = [name for name in dict.fromkeys(name.control for name in learnt) if name in textures]
    return {
        name: np.mean([texture.histogram for texture in textures[name]], axis=0)
        for name in (*learnt, *controls)
    }


def _row(name: CamouflageName, textures: Textures) -> dict[str, Any]:
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


def _learnt(textures: Textures) -> list[CamouflageName]:
    """Lists what was learnt, variants below what they are variants of."""
    names = [name for name in textures if not name.random]
    bases = list(dict.fromkeys(name.base for name in names))
    return sorted(names, key=lambda name: (bases.index(name.base), name.variant != ""))


def _mean(row: Mapping[str, Any], place: str) -> str:
    mean = number(row[place])
    if row["textures"] < 2:
        return mean
    return f"{mean} ({span(row[f'{place}_min'], row[f'{place}_max'])})"


def _weather(rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Sets textures that were learnt in weather beside the same learnt under a clear sky."""
    faces = {row["attack"]: row["faces"] for row in rows}
    said = [
        f"Learnt in weather, {name} has {number(faces[f'{name}_weather'])} % at the faces, "
        f"{number(share)} % without."
        for name, share in faces.items()
        if f"{name}_weather" in faces
    ]
    return [" ".join(said)] if said else []


@figure_style("colours", font=9, title=9)
def _figure(histograms: Mapping[CamouflageName, Float[np.ndarray, "3 B"]]) -> dict[str, bytes]:
    """Draws a panel for every learnt texture; nothing without one."""
    learnt = [name for name in histograms if not name.random]
    if not learnt:
        return {}
    columns = min(_COLUMNS, len(learnt))
    lines = math.ceil(len(learnt) / columns)
    size = (1.2 + 1.9 * columns, 0.9 + 1.55 * lines)
    figure, grid = panels(lines, columns, *size, sharex=True, sharey=True)
    edges = np.linspace(0, 256, histograms[learnt[0]].shape[1] + 1)
    for axes, name in zip(grid.flat, learnt, strict=False):
        control = histograms.get(name.control)
        if control is not None:
            axes.stairs(100 * control.mean(axis=0), edges, fill=True, color=_RANDOM)
        for (colour, line), channel in zip(_LINES, histograms[name], strict=True):
            axes.stairs(100 * channel, edges, color=colour, linestyle=line, linewidth=1.4)
        axes.set_title(str(name))
        axes.set_xlim(0, 256)
        axes.set_xticks([0, 128, 255])
        rule(axes, "y")
    for axes in grid.flat[len(learnt) :]:
        axes.set_visible(False)
    # The lowest that is drawn in its column has the values below it.
    for axes in grid.flat[max(len(learnt) - columns, 0) : len(learnt)]:
        axes.tick_params(labelbottom=True)
    figure.supylabel("% of the painted surface", fontsize=10)
    figure.supxlabel("value of the channel (8 bits)", fontsize=10)
    handles: list[Any] = [
        Line2D([], [], color=colour, linestyle=line, label=channel)
        for (colour, line), channel in zip(_LINES, _CHANNELS, strict=True)
    ]
    handles.append(Patch(facecolor=_RANDOM, edgecolor=GREY, label="random control"))
    figure.legend(handles=handles, loc="outside upper right", ncols=4, fontsize=9)
    return as_files(figure)
