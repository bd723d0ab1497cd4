"""What camouflages look like: colours in the RGB cube (section S7), and figures of the test."""

import math
import textwrap
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from skyproof.camouflage.name import CamouflageName
from skyproof.files import inside
from skyproof.pictures import read_pixels
from skyproof.report.figures import BLUE, GREY, INK, ORANGE, panels, rule
from skyproof.reproduction.cells import Cell, Figure, TextTable, Topic, number, span, value
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored import Strip, TextureLooks

_REMEDY = "copy the whole folder again, or score again"
_ACROSS = 12
_STRIP_INCHES = 1.25
# Rows of a portrait, of which the second shows the camouflage from above.
_PORTRAIT_ROWS = 4
_CHANNELS = ("red", "green", "blue")
_PLACES = ("faces", "edges", "corners")
_ACROSS_COLOURS = 6
# Told apart by their lines, too.
_LINES: Any = (("#c0392b", "-"), ("#1e8449", "--"), ("#1f5fa8", ":"))
_RANDOM = "#d5dade"

Textures = Mapping[CamouflageName, Sequence[TextureLooks]]
"""What was measured of each texture, repeat by repeat or draw by draw."""


def colours_part(run: Reproduction) -> Topic:
    """Returns the shares by place in the RGB cube and the histograms, where they were measured."""
    if run.looks is None:
        return Topic.of("Colours", {}, "The textures’ colours were not measured in this run.")
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
    return Topic.of(
        "Colours",
        {"colours": rows, "colour_histograms": bins},
        "Where in the RGB cube the colours lie that learnt textures end with: shares of the "
        "painted surface whose red, green or blue is within a sixteenth of 0 or of 1. At a face "
        "one channel or more is, at an edge two or more, at a corner all three. Each texel counts "
        "by its mean area on the test vehicles, and only where they wear the texture. Brackets "
        "hold the range over repeats. Of uniformly random colours 32.2, 4.1 and 0.2 % lie there. "
        "“random” is the mean over draws of the random control.",
        TextTable.of(rows, columns),
        _weather(rows),
        Figure(
            "colours",
            "Distribution of red, green and blue (lines) over 16 steps from 0 to 255, in percent "
            "of the painted surface, mean over repeats; grey: the random control, mean of channels",
            _colours(histograms),
        ),
    )


def _histograms(textures: Textures) -> dict[CamouflageName, Float[np.ndarray, "3 B"]]:
    """Returns mean histograms over repeats of optimised textures, then over draws of controls."""
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
    """Lists optimised textures, each variant below its base."""
    names = [name for name in textures if not name.random]
    bases = list(dict.fromkeys(name.base for name in names))
    return sorted(names, key=lambda name: (bases.index(name.base), name.variant != ""))


def _mean(row: Mapping[str, Any], place: str) -> str:
    ends = f" ({span(row[f'{place}_min'], row[f'{place}_max'])})"
    return number(row[place]) + (ends if row["textures"] > 1 else "")


def _weather(rows: Sequence[Mapping[str, Any]]) -> str:
    """Compares textures optimised in weather with the same ones optimised under a clear sky."""
    faces = {row["attack"]: row["faces"] for row in rows}
    said = [
        f"Learnt in weather, {name} has {number(faces[f'{name}_weather'])} % at the faces, "
        f"{number(share)} % without."
        for name, share in faces.items()
        if f"{name}_weather" in faces
    ]
    return " ".join(said)


@figure_style("colours", font=9, title=9)
def _colours(histograms: Mapping[CamouflageName, Float[np.ndarray, "3 B"]]) -> dict[str, bytes]:
    """Draws a panel for every learnt texture; nothing without one."""
    learnt = [name for name in histograms if not name.random]
    if not learnt:
        return {}
    columns = min(_ACROSS_COLOURS, len(learnt))
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
    # The lowest panel of each column has the values below it.
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


@figure_style("looks", font=9)
def looks_part(run: Reproduction) -> Topic:
    """Draws what was tested; figures whose data the run lacks are empty."""
    looks = run.looks
    figures = [
        Figure(
            "classes",
            "Kinds of vehicles in the test images; in brackets their share of all in sight",
            _classes(run),
        ),
        Figure(
            "samples",
            "The same test scenes as bare ground, with vehicles as built, and with the freest and "
            "the most constrained of the learnt textures, shapes and combinations",
            _strips(run, looks.samples if looks else ()),
        ),
        Figure(
            "sensor",
            "From the renderer’s samples to a photograph’s sharpness: one sample a pixel, four by "
            "four averaged, and blurred as the ground is",
            _strips(run, looks.sensor if looks else ()),
        ),
        Figure(
            "maps",
            "Every learnt camouflage, of several repeats the first: its texture and its "
            "displacement (nose up, roof in the middle; brighter is farther out), where it has "
            "them, and worn, from above",
            _maps(run),
        ),
        Figure(
            "displacement",
            "A learnt displacement map and its axes of symmetry (dashed): the middle of the roof "
            "and of the underside, where the left border is the right one. Both lie in the plane "
            "that halves the vehicle lengthwise. Underside and wheels stay where they are, and "
            "what lies between vertices is not read: there the map holds what it began with",
            _displacement(run),
        ),
    ]
    return Topic.of("What was tested", {}, *figures)


def _classes(run: Reproduction) -> dict[str, bytes]:
    """Draws how often each kind of vehicle was seen in the test, and its number of vehicles."""
    tiles = run.results.counts
    if not tiles.series:
        return {}
    in_sight = next(iter(tiles.series.values()))[:, 0]
    seen: Counter[str] = Counter()
    vehicles: dict[str, set[str]] = {}
    for (_, vehicle), count in zip(tiles.cells, in_sight.tolist(), strict=True):
        kind = vehicle.rpartition("-")[0] or vehicle
        seen[kind] += count
        vehicles.setdefault(kind, set()).add(vehicle)
    kinds = [kind for kind, _ in seen.most_common()]
    whole = sum(seen.values())
    figure, grid = panels(1, 1, 6.4, 0.9 + 0.34 * len(kinds))
    axes = grid[0, 0]
    axes.barh(kinds, [seen[kind] for kind in kinds], color=BLUE, height=0.65)
    for place, kind in enumerate(kinds):
        text = (
            f" {seen[kind]} ({100 * seen[kind] / whole:.1f} %), of {len(vehicles[kind])} vehicles"
        )
        axes.text(seen[kind], place, text, va="center", fontsize=9, color=INK)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.45 * max(seen.values()))
    axes.set_xlabel("vehicles seen in the test images")
    return as_files(figure)


def _strips(run: Reproduction, strips: Sequence[Strip]) -> dict[str, bytes]:
    """Rows of images, each with what it shows at its left."""
    if not strips:
        return {}
    folder = run.layout.looks
    images = [
        read_pixels(inside(folder, strip.file, folder / "looks.json"), _REMEDY) for strip in strips
    ]
    columns = round(images[0].shape[1] / images[0].shape[0])
    # The labels take the rest of the width.
    width = 1.3 + _STRIP_INCHES * columns
    figure, grid = panels(len(strips), 1, width, (_STRIP_INCHES + 0.06) * len(strips))
    figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)
    for axes, strip, image in zip(grid.flat, strips, images, strict=True):
        axes.imshow(image, interpolation="nearest")
        side = image.shape[0]
        for border in range(side, image.shape[1], side):
            axes.axvline(border - 0.5, color="white", linewidth=2)
        label = textwrap.fill(strip.label, 14)
        axes.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=9)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    return as_files(figure)


def _maps(run: Reproduction) -> dict[str, bytes]:
    """Every learnt camouflage as its map and on a vehicle."""
    cells = []
    for name in run.results.names:
        if name.random or name.variant:
            continue
        portrait = run.results.pattern(name, "on_vehicle.png")
        flat = _flat(run, name)
        if portrait is not None and flat:
            worn = read_pixels(portrait, _REMEDY)
            side = worn.shape[0] // _PORTRAIT_ROWS
            cells.append((name, flat, worn[side : 2 * side, :side]))
    if not cells:
        return {}
    # Each takes as many places of a line as it has pictures.
    places: list[tuple[int, int]] = []
    line = column = 0
    for _, flat, _ in cells:
        wide = len(flat) + 1
        if column + wide > _ACROSS:
            line, column = line + 1, 0
        places.append((line, column))
        column += wide
    figure, grid = panels(line + 1, _ACROSS, 1.05 * _ACROSS, 1.28 * (line + 1))
    for axes in grid.flat:
        axes.set_axis_off()
    for (line, column), (name, flat, worn) in zip(places, cells, strict=True):
        shown = grid[line, column : column + len(flat) + 1]
        for axes, pixels in zip(shown, [*flat, worn], strict=True):
            axes.imshow(pixels, interpolation="antialiased")
        shown[0].set_title(str(name), fontsize=8)
    return as_files(figure)


def _flat(run: Reproduction, name: CamouflageName) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The maps of the first repeat that the run keeps, the texture first."""
    folder = run.layout.camouflages
    places = [folder / str(each) for each in (name.with_repeat(0), name)]
    paths = [place / file for file in ("texture.png", "displacement.png") for place in places]
    return [read_pixels(path, _REMEDY) for path in paths if path.exists()]


def _displacement(run: Reproduction) -> dict[str, bytes]:
    """The first learnt shape's map with its two axes of symmetry, which are one plane."""
    shapes = [name for name in run.results.names if name.kind == "shape" and not name.random]
    maps = [(name, flat[0]) for name in shapes if (flat := _flat(run, name))]
    if not maps:
        return {}
    name, values = maps[0]
    side = values.shape[0]
    figure, grid = panels(1, 1, 5.2, 3.9)
    axes = grid[0, 0]
    shown = axes.imshow(
        values[..., 0] / 255, cmap="cividis", vmin=0, vmax=1, interpolation="nearest"
    )
    for column in (-0.5, side / 2 - 0.5, side - 0.5):
        axes.axvline(column, color=ORANGE, linewidth=3, linestyle="--", clip_on=False)
    axes.set_xticks(
        [-0.5, side / 4 - 0.5, side / 2 - 0.5, 3 * side / 4 - 0.5, side - 0.5],
        ["underside", "left", "roof", "right", "underside"],
    )
    axes.set_yticks([0, side - 1], ["nose", "tail"])
    axes.tick_params(length=0)
    axes.set_title(str(name), fontsize=10)
    figure.colorbar(shown, ax=axes, label="displacement, as a share of PM · W")
    return as_files(figure)
