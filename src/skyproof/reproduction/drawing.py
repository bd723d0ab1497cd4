"""What the figures of all analyses share: their style, panels side by side, and lines behind."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib import pyplot as plt

from skyproof.report.figures import STYLE


@contextmanager
def figure_style(name: str, *, font: float = 11, title: float = 12) -> Iterator[None]:
    """Draws with bold titles at the left; `name` tells the SVG's ids from those of others."""
    titles = {"titlelocation": "left", "titleweight": "bold", "titlesize": title}
    style = STYLE | {f"axes.{key}": value for key, value in titles.items()}
    with plt.rc_context(style | {"svg.hashsalt": name, "font.size": font}):
        yield


def panels(lines: int, columns: int, width: float, height: float, **shared: Any) -> tuple[Any, Any]:
    """Makes a figure, in inches, and the grid of its axes."""
    size = (width, height)
    return plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained", **shared)


def rule(axes: Any, along: str = "both") -> None:
    """Draws pale lines behind what is shown, at the ticks of an axis or of both."""
    axes.grid(axis=along, color="#e3e7eb")
    axes.set_axisbelow(True)
