"""The one way to open a picture: known formats, a stated limit, one sentence."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from skyproof.errors import SkyproofError, StoredFileError

LARGEST_PX = 178_956_970
"""The most pixels of a picture that is decoded as a whole, some 13,377 x 13,377: what Pillow allows
at most. A header that claims more is refused before memory is asked for; imagery that is cut into
tiles is read window by window, and may be larger."""

# Others of Pillow's readers start programs (EPS runs Ghostscript) or are rarely looked after. What
# reads JPEG also reads the pictures in pairs (MPO) of some cameras.
_FORMATS = ("PNG", "JPEG", "TIFF", "JPEG2000", "BMP", "WEBP")


def open_picture(
    path: Path,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
    also: tuple[str, ...] = (),
) -> Image.Image:
    """Reads the header of a picture; its pixels are decoded by `read_pixels`, or by Pillow.

    Args:
        path: a PNG, JPEG, TIFF, JPEG 2000, BMP or WebP file.
        remedy: what the error advises, such as "replace it, or leave it out".
        error: the class of the error.
        also: further formats of Pillow's.

    Raises:
        SkyproofError: the file is missing, of another format, damaged, or has more than
            `LARGEST_PX` pixels.
    """
    try:
        with warnings.catch_warnings():
            # Aerial pictures are large; only what Pillow refuses is too large. Nor are notes on
            # damaged metadata for the user: pixels are all that is taken.
            warnings.simplefilter("ignore")
            picture = Image.open(path, formats=(*_FORMATS, *also))
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}.") from None
    except Image.DecompressionBombError:
        raise error(
            f"{path} says that it has more than {LARGEST_PX:,} pixels (some 13,377 x 13,377), "
            f"which is too large to be read at once; cut it into parts, or {remedy}."
        ) from None
    except Exception as damage:
        # Pillow's readers meet damage with any exception there is.
        raise error(
            f"{path} cannot be read as a picture ({_reason(damage)}); {remedy}."
        ) from damage
    try:
        _refuse_giant(picture, str(path), remedy, error)
    except error:
        picture.close()
        raise
    return picture


def _refuse_giant(
    picture: Image.Image, place: str, remedy: str, error: type[SkyproofError]
) -> None:
    width, height = picture.size
    if width * height > LARGEST_PX:
        raise error(
            f"{place} has {width:,} x {height:,} px, more than {LARGEST_PX:,} pixels in all, which "
            f"is too large to be read at once; cut it into parts, or {remedy}."
        )


def read_pixels(
    path: Path,
    remedy: str,
    *,
    size_px: tuple[int, int] | None = None,
    error: type[SkyproofError] = StoredFileError,
) -> UInt8[np.ndarray, "H W 3"]:
    """Decodes a whole picture as sRGB bytes.

    Args:
        path: as of `open_picture`.
        remedy: what the error advises.
        size_px: width and height that it must have, where they are known; refused before decoding.
        error: the class of the error.

    Raises:
        SkyproofError: as of `open_picture`, or the size is another.
    """
    # One copy: a conversion copies even where there is nothing to convert.
    return np.array(whole_picture(path, remedy, size_px=size_px, error=error))


def whole_picture(
    path: Path,
    remedy: str,
    *,
    size_px: tuple[int, int] | None = None,
    error: type[SkyproofError] = StoredFileError,
) -> Image.Image:
    """Decodes a whole picture as Pillow's, in RGB, for those who want parts of it.

    Args:
        path, remedy, size_px, error: as of `read_pixels`.

    Raises:
        SkyproofError: as of `read_pixels`.
    """
    with open_picture(path, remedy, error=error) as picture:
        if size_px is not None and picture.size != size_px:
            width, height = picture.size
            raise error(
                f"{path} has {width} x {height} px, expected are {size_px[0]} x {size_px[1]}; "
                f"{remedy}."
            )
        return _loaded(picture, "RGB", str(path), remedy, error)


def decoded(
    picture: Image.Image,
    mode: str,
    place: str,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
    also: tuple[str, ...] = (),
) -> UInt8[np.ndarray, ...]:
    """Decodes a picture that is open, perhaps by a library that found it inside another file.

    Args:
        picture: as Pillow opened it.
        mode: Pillow's name of what its pixels shall be: "L", "RGB" or "RGBA".
        place: what an error calls it.
        remedy: what the error advises.
        error: the class of the error.
        also: further formats of Pillow's.

    Returns:
        Bytes, `[H, W]` of "L", else `[H, W, 3 or 4]`.

    Raises:
        SkyproofError: it is of another format, damaged or too large.
    """
    _refuse_giant(picture, place, remedy, error)
    # One that was made in memory has no format.
    if picture.format not in (None, "MPO", *_FORMATS, *also):
        raise error(f"{place} is a picture of the format {picture.format}; {remedy}.")
    return np.array(_loaded(picture, mode, place, remedy, error))


def _loaded(
    picture: Image.Image, mode: str, place: str, remedy: str, error: type[SkyproofError]
) -> Image.Image:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture.load()
            # A conversion copies even where there is nothing to convert.
            return picture if picture.mode == mode else picture.convert(mode)
    except Exception as damage:
        # As above.
        raise error(
            f"{place} cannot be read as a picture ({_reason(damage)}); {remedy}."
        ) from damage


def _reason(damage: Exception) -> str:
    return " ".join(str(damage).split())[:200] or type(damage).__name__
