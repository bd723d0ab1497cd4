"""The style and the files of the figures that a reproduction draws."""

import io
from collections.abc import Iterator
from contextlib import contextmanager

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from skyproof.report.figures import STYLE


@contextmanager
def figure_style(name: str, *, font: float = 11, title: float = 12) -> Iterator[None]:
    """Draws with bold titles at the left; `name` keeps the SVG's ids apart from those of others."""
    titles = {"titlelocation": "left", "titleweight": "bold", "titlesize": title}
    style = STYLE | {f"axes.{key}": value for key, value in titles.items()}
    with plt.rc_context(style | {"svg.hashsalt": name, "font.size": font}):
        yield


def as_files(figure: Figure) -> dict[str, bytes]:
    """Returns a figure as SVG and as PNG, by file ending, and closes it."""
    written = {}
    for ending in ("svg", "png"):
        stream = io.BytesIO()
        about = {"Date": None} if ending == "svg" else {}
        figure.savefig(stream, format=ending, dpi=130, metadata=about)
        written[ending] = stream.getvalue()
    plt.close(figure)
    return written
