"""The three texture constraints (section 3.3), and the names made of them: Pix, Lc or Fc, Ma."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from skyproof.errors import ConfigurationError

_WORDS = ("Pix", "Lc", "Fc", "Ma")
_WORD = re.compile("|".join(_WORDS))


@dataclass(frozen=True)
class TextureConstraints:
    """One of the 12 texture settings {–, Pix} × {–, Lc, Fc} × {–, Ma}.

    Attributes:
        pixelised: Pix, one colour per square block of texels.
        colours: "free"; "learnt" (Lc), a few colours that the attack chooses; "fixed" (Fc).
        masked: Ma, only painted body panels are changed.
    """

    pixelised: bool = False
    colours: Literal["free", "learnt", "fixed"] = "free"
    masked: bool = False

    @property
    def name(self) -> str:
        """The words put together, such as "PixFcMa"; "U" without any constraint."""
        colours = {"free": "", "learnt": "Lc", "fixed": "Fc"}[self.colours]
        return ("Pix" if self.pixelised else "") + colours + ("Ma" if self.masked else "") or "U"

    @property
    def in_words(self) -> str:
        """The texture for people: "free texture on the whole vehicle"."""
        where = "on painted panels" if self.masked else "on the whole vehicle"
        if self.colours == "free":
            return f"{'texture in blocks' if self.pixelised else 'free texture'} {where}"
        colours = "ground colours" if self.colours == "fixed" else "a few optimised colours"
        return f"{'blocks' if self.pixelised else 'texture'} in {colours} {where}"

    @classmethod
    def parse(cls, text: str) -> TextureConstraints:
        """Reads the constraints that `name` gave this text.

        Raises:
            ConfigurationError: an unknown word, the same one twice, another order, or both Lc and
                Fc.
        """
        if text == "U":
            return cls()
        words = _WORD.findall(text)
        if not words or "".join(words) != text:
            raise ConfigurationError(
                f"Unknown texture constraints {text!r}: write U for none, or put together Pix, Lc "
                "or Fc, and Ma, such as PixFcMa."
            )
        if "Lc" in words and "Fc" in words:
            raise ConfigurationError(
                f"Lc and Fc exclude each other, but {text!r} has both: colours are either learnt "
                "(Lc) or fixed (Fc)."
            )
        colours: Literal["free", "learnt", "fixed"] = (
            "learnt" if "Lc" in words else "fixed" if "Fc" in words else "free"
        )
        constraints = cls(pixelised="Pix" in words, colours=colours, masked="Ma" in words)
        if constraints.name != text:
            raise ConfigurationError(
                f"Texture constraints {text!r} must be written {constraints.name!r}."
            )
        return constraints
