"""The figures of what is tested: kinds of vehicles, samples, the sensor's steps, maps."""

import textwrap
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from skyproof.camouflage.name import CamouflageName
from skyproof.files import inside
from skyproof.pictures import read_pixels
from skyproof.report.figures import BLUE, INK, ORANGE, as_files
from skyproof.reproduction.cells import Figure, Heading, Topic
from skyproof.reproduction.drawing import figure_style, panels
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored_looks import Strip

_REMEDY = "copy the whole folder again, or score again"
_ACROSS = 12
_STRIP_INCHES = 1.25
# Of a portrait: its second row shows the camouflage from above.
_PORTRAIT_ROWS = 4


@figure_style("looks", font=9)
def looks_part(run: Reproduction) -> Topic:
    """Draws what was tested; figures of what the run lacks are empty."""
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
    return Topic(blocks=[Heading("What was tested"), *figures])


def _classes(run: Reproduction) -> dict[str, bytes]:
    """Bars of how often each kind of vehicle was seen in the test, and of how many vehicles."""
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
