"""The one way to open a picture (known formats, a size limit, errors of one sentence); PNGs."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image

from skyproof.errors import SkyproofError, StoredFileError
from skyproof.files import refuse_special, write_beside

LARGEST_PX = 178_956_970
"""The most pixels of a picture that is decoded as a whole, some 13,377 x 13,377: Pillow's limit.

A header that claims more is refused before memory is allocated; imagery for tiles is read window by
window, and may be larger.
"""

_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""How pixels of each EXIF orientation are turned until the picture stands upright."""

# Pillow's other readers start programs (EPS runs Ghostscript) or are rarely maintained. The reader
# of JPEG also reads the pairs of pictures (MPO) that some cameras store.
_FORMATS = ("PNG", "JPEG", "TIFF", "JPEG2000", "BMP", "WEBP")


def open_picture(
    path: Path,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
    also: tuple[str, ...] = (),
) -> Image.Image:
    """Opens a picture and reads its header; formats are `_FORMATS` and Pillow's in `also`."""
    refuse_special(path, remedy, error=error)
    try:
        with warnings.catch_warnings():
            # Aerial pictures are large, and only Pillow's limit counts. Notes on damaged metadata
            # are not for the user, because only the pixels are read.
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
        # Damage makes Pillow's readers raise any exception.
        raise error(_unreadable(path, damage, remedy)) from damage
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


def write_png(path: Path, pixels: "UInt8[np.ndarray, 'H W ...']", compress_level: int = -1) -> None:
    """Writes bytes, grey or sRGB, as a PNG, whole or not at all; -1 is the usual compression."""
    with write_beside(path) as temporary:
        Image.fromarray(pixels).save(temporary, "PNG", compress_level=compress_level)


def read_pixels(
    path: Path, remedy: str, *, size_px: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Decodes a whole picture as sRGB bytes; arguments as of `whole_picture`."""
    # One copy: a conversion copies even if there is nothing to convert.
    return np.array(whole_picture(path, remedy, size_px=size_px))


def whole_picture(
    path: Path,
    remedy: str,
    *,
    size_px: tuple[int, int] | None = None,
    error: type[SkyproofError] = StoredFileError,
) -> Image.Image:
    """Decodes a whole picture to a Pillow image in RGB, upright by its EXIF orientation.

    `size_px`, if given, must be its size.
    """
    with open_picture(path, remedy, error=error) as picture:
        if size_px is not None and upright_size_px(picture) != size_px:
            width, height = upright_size_px(picture)
            raise error(
                f"{path} has {width} x {height} px, expected are {size_px[0]} x {size_px[1]}; "
                f"{remedy}."
            )
        # Read before the pixels, like the size: a PNG may name another orientation after them.
        turn = _TURNS.get(_not_turned(picture))
        pixels = _loaded(picture, "RGB", str(path), remedy, error)
        return pixels if turn is None else pixels.transpose(turn)


def exif_orientation(picture: Image.Image) -> int:
    """Returns how the pixels of an open picture are stored, 1 (upright) to 8; decodes nothing."""
    try:
        if picture.format == "PNG":
            # `getexif` would decode the whole of a PNG without EXIF data.
            exif = Image.Exif()
            exif.load(picture.info.get("exif", b""))
        else:
            exif = picture.getexif()
        orientation = exif.get(ExifTags.Base.Orientation)
    except Exception:
        # Damaged EXIF data can raise any exception, and are ignored.
        return 1
    return orientation if orientation in _TURNS else 1


def upright_size_px(picture: Image.Image) -> tuple[int, int]:
    """Returns width and height of an open picture as its EXIF orientation says."""
    width, height = picture.size
    return (height, width) if _not_turned(picture) >= 5 else (width, height)


def _not_turned(picture: Image.Image) -> int:
    """Returns the EXIF orientation, but 1 for TIFF, which Pillow itself turns upright."""
    return 1 if picture.format == "TIFF" else exif_orientation(picture)


def decoded(
    picture: Image.Image,
    mode: str,
    place: str,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
    also: tuple[str, ...] = (),
) -> "UInt8[np.ndarray, ...]":
    """Decodes an open picture, perhaps one that a library found inside another file.

    `mode` is Pillow's: "L" gives bytes `[H, W]`, "RGB" and "RGBA" `[H, W, 3 or 4]`. `place` names
    the picture in the error.
    """
    _refuse_giant(picture, place, remedy, error)
    # A picture made in memory has no format.
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
            return picture if picture.mode == mode else picture.convert(mode)
    except Exception as damage:
        # Damage makes Pillow's decoders, too, raise any exception.
        raise error(_unreadable(place, damage, remedy)) from damage


def _unreadable(place: Path | str, damage: Exception, remedy: str) -> str:
    reason = " ".join(str(damage).split())[:200] or type(damage).__name__
    return f"{place} cannot be read as a picture ({reason}); {remedy}."
