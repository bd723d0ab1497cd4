"""The detectors that ship with skyproof, so that a first report needs no training.

`reference/README.md`, beside their folders, tells how they were made. Imports no torch.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skyproof.errors import ConfigurationError, StoredFileError

REFERENCE_DETECTORS = ("retinanet", "faster_rcnn")
"""YOLOv5 is trained on the user's machine, because its library has another licence."""

REFERENCE_FOLDER = Path(__file__).with_name("reference")


def reference_folder(name: str) -> Path:
    """Returns the folder of a detector that ships with skyproof; refuses the name of another."""
    if name not in REFERENCE_DETECTORS:
        raise ConfigurationError(
            f"{name[:100]!r} does not come trained, only {' and '.join(REFERENCE_DETECTORS)} do; "
            "train it (skyproof train), or name one of these."
        )
    return REFERENCE_FOLDER / name


def detector_folder(place: str | Path) -> Path:
    """The folder of a path, or of the name of a detector that ships; an own folder goes first."""
    folder = Path(place)
    named = str(place) in REFERENCE_DETECTORS and not folder.exists()
    return REFERENCE_FOLDER / folder.name if named else folder


@contextmanager
def reinstalled(folder: Path) -> Iterator[None]:
    """Adds the advice to install skyproof again to errors about a detector that ships with it."""
    try:
        yield
    except StoredFileError as error:
        if folder.parent != REFERENCE_FOLDER:
            raise
        wrong = str(error).partition(";")[0].rstrip(".")
        raise StoredFileError(
            f"A detector that came with skyproof cannot be used: {wrong}; install skyproof again."
        ) from error
