"""The name of a camouflage, parsed into its parts, and the names of an attack's controls."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, cast, get_args

from skyproof.errors import ConfigurationError
from skyproof.ranges import is_name

Choice = Literal["plain", "best", "search", "pattern"]
CHOICES: tuple[Choice, ...] = get_args(Choice)
"""How a control is chosen without optimisation: the best plain paint (of 27, with every vertex out
in a shape), the best of many random draws, the result of a random search, or the best of many
patterns in ground colours that no training draws from."""

IN_WEATHER = "weather"
"""The variant that was optimised in all weathers instead of clear days alone: "T-U_weather"."""

TRANSFER = "transfer"
"""The variant that was optimised on other detectors than the assessed one: "T-U_transfer"."""

QUERIED = "asked"
"""The variant of a query attack on a detector that has gradients: "T-U_asked"."""

_COPY = rf"(?:step\d+|relaxed|{QUERIED}\d+)"

Colours = Literal["free", "learnt", "fixed"]
_COLOURS: tuple[Colours, ...] = get_args(Colours)
"""From the widest choice to the narrowest."""

Kind = Literal["texture", "shape", "combination", "other"]
Order = Literal["seq", "par"]

_WHOLE = re.compile(r"(?P<base>[^_]*?)(?:_(?P<variant>.*?))?(?:-(?P<repeat>\d+))?", re.DOTALL)
# A user may join words with "_"; only what skyproof itself adds to a foreign name is its variant.
_FOREIGN = re.compile(
    rf"(?P<base>.*?)(?:_(?P<variant>{_COPY}(?:_{_COPY})*))?(?:-(?P<repeat>\d+))?", re.DOTALL
)
_FOREIGN_CONTROL = re.compile(
    rf"(?P<base>R-.*?)(?:_(?P<variant>{'|'.join(CHOICES)}))?(?:-(?P<repeat>\d+))?", re.DOTALL
)
_NAME = re.compile(
    r"(?P<kind>[TR])-(?P<texture>[A-Za-z]+)|(?P<random>R-)?"
    r"(?:S-O|C-(?P<combined>[A-Za-z]+)(?:-(?P<order>seq|par))?)@(?P<magnitude>[-+.\w]+)"
)
_WORDS = re.compile("Pix|Lc|Fc|Ma")


@dataclass(frozen=True)
class TextureConstraints:
    """One of the 12 texture settings {–, Pix} × {–, Lc, Fc} × {–, Ma} (section 3.3).

    Attributes:
        pixelised: Pix, one colour per square block of texels.
        colours: "free"; "learnt" (Lc), a few colours that the attack chooses; "fixed" (Fc).
        masked: Ma, only painted body panels are changed.
    """

    pixelised: bool = False
    colours: Colours = "free"
    masked: bool = False

    @property
    def name(self) -> str:
        """The words put together, such as "PixFcMa"; "U" without any constraint."""
        colours = {"free": "", "learnt": "Lc", "fixed": "Fc"}[self.colours]
        return "Pix" * self.pixelised + colours + "Ma" * self.masked or "U"

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
        """Reads the constraints that `name` gave this text, and refuses any other text."""
        if text == "U":
            return cls()
        words = _WORDS.findall(text)
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
        colours: Colours = "learnt" if "Lc" in words else "fixed" if "Fc" in words else "free"
        constraints = cls(pixelised="Pix" in words, colours=colours, masked="Ma" in words)
        if constraints.name != text:
            raise ConfigurationError(
                f"Texture constraints {text!r} must be written {constraints.name!r}."
            )
        return constraints


@dataclass(frozen=True)
class CamouflageName:
    """The parts of a name such as "C-PixFc-seq@0.2_on_retinanet-1"; `str` gives it back.

    Names that skyproof did not give (a user's "mine-2") are of kind "other". They have a label,
    which may hold any "_" ("winter_white"), and a repeat. Their only variants are the copies that
    an attack keeps, and for a control how it was chosen.

    Attributes:
        constraints: None if vehicles keep their own paint.
        magnitude: perturbation magnitude PM of the shape in [0, 1]; None if the shape stays.
        order: of a combination. A random control has none, unless it puts a random shape on the
            attack's own texture ("R-C-Fc-seq@0.2").
        random: whether it is a control.
        variant: text after the first "_", such as "on_retinanet", "step10", "weather"; or empty.
        repeat: digits that number the attack's seed or the random draw; or empty.
    """

    kind: Kind
    constraints: TextureConstraints | None = None
    magnitude: float | None = None
    order: Order | None = None
    random: bool = False
    variant: str = ""
    repeat: str = ""
    label: str = ""

    def __post_init__(self) -> None:
        if self.magnitude is not None and not 0 <= self.magnitude <= 1:
            raise ConfigurationError(
                f"{self} expects a perturbation magnitude (PM) from 0 to 1 after the @, "
                f"got {self.magnitude:g}."
            )

    @classmethod
    def parse(cls, text: str) -> CamouflageName:
        """Reads the name of a camouflage that skyproof can make, and refuses any other."""
        base, variant, repeat = _parts(_WHOLE, text)
        match = _NAME.fullmatch(base)
        random = match is not None and (match["kind"] == "R" or match["random"] is not None)
        if match is None or (match["combined"] and not match["order"] and not random):
            raise ConfigurationError(
                f"{text[:200]!r} names no camouflage; expected for instance T-U, T-PixFcMa, "
                "S-O@0.4, C-Fc-seq@0.2 or C-Fc-par@0.2, or a random control such as R-PixFc, "
                "R-S-O@0.4 or R-C-Fc@0.2."
            )
        words = match["texture"] or match["combined"]
        constraints = TextureConstraints.parse(words) if words else None
        magnitude = _magnitude(match["magnitude"]) if match["magnitude"] else None
        kind: Kind = "texture" if match["texture"] else "combination" if words else "shape"
        order = cast("Order | None", match["order"])
        name = cls(kind, constraints, magnitude, order, random, variant, repeat)
        if name.choice == "plain" and constraints not in (None, _plain(constraints)):
            raise ConfigurationError(
                f"{text[:200]} names the best plain paint, which only U (all over) and Ma (on "
                "painted parts) have, as in R-U_plain, R-Ma_plain or R-C-Ma@0.2_plain."
            )
        if name.choice == "pattern" and (kind != "texture" or constraints != _plain(constraints)):
            raise ConfigurationError(
                f"{text[:200]} names the best pattern; give R-U_pattern (all over) or R-Ma_pattern "
                "(on painted parts)."
            )
        if name.choice is not None and name.order is not None:
            raise ConfigurationError(
                f"{text[:200]} would choose among draws of a shape on one texture; give "
                f"{replace(name, order=None)}."
            )
        # The text becomes the name of a folder.
        if not is_name(text) or not is_name(str(name)):
            raise ConfigurationError(
                f"{text[:200]!r} names no camouflage: expected at most 150 characters without "
                "separators."
            )
        return name

    @classmethod
    def read(cls, text: str) -> CamouflageName:
        """Reads any name; one that `parse` refuses or would write otherwise is of kind "other"."""
        with suppress(ConfigurationError):
            name = cls.parse(text)
            if str(name) == text:
                return name
        random = text.startswith("R-")
        base, variant, repeat = _parts(_FOREIGN_CONTROL if random else _FOREIGN, text)
        name = cls("other", random=random, variant=variant, repeat=repeat, label=base)
        # A name that cannot be put together again ("T-U_") is all label.
        return name if str(name) == text else cls("other", random=random, label=text)

    def __str__(self) -> str:
        """The name in tables and of folders."""
        variant = f"_{self.variant}" if self.variant else ""
        repeat = f"-{self.repeat}" if self.repeat else ""
        at = "" if self.magnitude is None else f"@{self.magnitude:g}"
        return f"{self.family}{at}{variant}{repeat}"

    @property
    def family(self) -> str:
        """The name without magnitude, variant and repeat: "S-O", "C-Fc-seq", "R-C-Fc", "T-U"."""
        if self.kind == "other":
            return self.label
        drawn = "R-" if self.random else ""
        if self.kind == "shape":
            return f"{drawn}S-O"
        assert self.constraints is not None
        if self.kind == "texture":
            return f"{'R' if self.random else 'T'}-{self.constraints.name}"
        order = "" if self.order is None else f"-{self.order}"
        return f"{drawn}C-{self.constraints.name}{order}"

    @property
    def in_words(self) -> str:
        """The camouflage for people: "blocks in ground colours on painted panels"."""
        if not self.variant or self.choice:
            return self._drawn_in_words
        made = {
            TRANSFER: ", optimised on other detectors",
            QUERIED: ", by a query attack",
            IN_WEATHER: ", optimised in all weathers",
        }
        return self._drawn_in_words + made.get(self.variant, f" ({self.variant})")

    @property
    def _drawn_in_words(self) -> str:
        if self.kind == "other":
            return self.label
        texture = "" if self.constraints is None else self.constraints.in_words
        shape = (
            "" if self.magnitude is None else f"up to {100 * self.magnitude:g}\u202f% of the width"
        )
        if self.choice == "plain":
            paint = "best plain paint" if texture else "own paint"
            where = " on painted panels" if self.constraints and self.constraints.masked else ""
            return f"{paint}{where}" + (f", every vertex out {shape}" if shape else "")
        if texture and shape:
            words = f"{texture}, with a changed shape ({shape})"
        else:
            words = texture or f"changed shape ({shape})"
        if self.choice == "pattern" and self.constraints:
            where = "painted panels" if self.constraints.masked else "the whole vehicle"
            return f"best of many random patterns in ground colours on {where}"
        drawn = {"best": "best of many random draws: ", "search": "random search: "}
        return drawn.get(self.choice or "", "random: " if self.random else "") + words

    @property
    def pooled(self) -> CamouflageName:
        """The row it belongs to: the name without its repeat, "T-U-1" to "T-U"."""
        return replace(self, repeat="")

    @property
    def number(self) -> int:
        """The repeat as a number, 0 without one."""
        return int(self.repeat or 0)

    @property
    def base(self) -> CamouflageName:
        """The name without variant and repeat, "T-U_on_retinanet-1" to "T-U"."""
        return replace(self, variant="", repeat="")

    def with_variant(self, variant: str) -> CamouflageName:
        """The name with one more variant, "T-U-0" and "step10" to "T-U_step10-0"."""
        return replace(self, variant=f"{self.variant}_{variant}" if self.variant else variant)

    def with_repeat(self, repeat: int) -> CamouflageName:
        """The name of one repeat, "T-U" and 1 to "T-U-1"."""
        return replace(self, repeat=str(repeat))

    def after_queries(self, images: int) -> CamouflageName:
        """The copy kept after so many images, "T-U" and "T-U_asked" to "T-U_asked1500"."""
        kept = f"{QUERIED}{images}"
        return self.with_variant(kept) if self.choice else replace(self, variant=kept)

    @property
    def kept_copy(self) -> bool:
        """Whether it is a copy that an attack kept: "T-U_step10", "T-U_asked1500"."""
        return re.fullmatch(rf"(?:.*_)?{_COPY}", self.variant) is not None

    @property
    def choice(self) -> Choice | None:
        """How a control is chosen: "R-Ma_plain", "R-PixFc_best", "R-S-O@0.4_search"; else None."""
        return cast(Choice, self.variant) if self.random and self.variant in CHOICES else None

    @property
    def has_candidates(self) -> bool:
        """Whether it is a control that is chosen from others: a plain paint, or the best of N."""
        return self.choice not in (None, "search")

    @property
    def takes_palette(self) -> bool:
        """Whether its colours come from a palette (Fc), or are optimised from there (Lc, Pix).

        Random controls draw colours freely; a sequential shape takes the texture of another attack.
        """
        if self.constraints is None or self.order == "seq":
            return False
        if self.constraints.colours == "fixed" or self.choice == "pattern":
            return True
        optimised = not self.random or self.choice == "search"
        return optimised and (self.constraints.colours == "learnt" or self.constraints.pixelised)

    @property
    def control(self) -> CamouflageName:
        """The random control, "T-PixMa" to "R-PixMa", "C-Fc-seq@0.2" to "R-C-Fc@0.2"."""
        if self.kind == "other":
            rest = self.label.partition("-")[2]
            return CamouflageName.read(f"R-{rest}")
        return replace(self.base, random=True, order=None)

    @property
    def chosen_controls(self) -> tuple[CamouflageName, ...]:
        """Controls of `CHOICES`: "R-Ma_plain", "R-PixMa_best", "R-PixMa_search", "R-Ma_pattern".

        A shape has no pattern, and a combination that of its texture.
        """
        random = self.control
        plain = replace(random, constraints=_plain(random.constraints))
        controls = [plain, random, random]
        if plain.constraints is not None:
            controls.append(replace(plain, kind="texture", magnitude=None))
        return tuple(map(CamouflageName.with_variant, controls, CHOICES))

    def meets(self, other: CamouflageName) -> bool:
        """Whether every camouflage of this name is also one of the other: "T-PixFcMa" of "T-Ma"."""
        own, wider = self.constraints, other.constraints
        if own is None or wider is None:
            within = own is wider
        else:
            within = (
                own.pixelised >= wider.pixelised
                and own.masked >= wider.masked
                and _COLOURS.index(own.colours) >= _COLOURS.index(wider.colours)
            )
        return within and (self.magnitude or 0) <= (other.magnitude or 0)

    @property
    def random_shape(self) -> CamouflageName | None:
        """A random shape on the attack's own texture, "C-Fc-seq@0.2" to "R-C-Fc-seq@0.2"."""
        combined = self.order is not None and not self.random
        return replace(self.base, random=True) if combined else None


def _parts(pattern: re.Pattern[str], text: str) -> tuple[str, str, str]:
    match = pattern.fullmatch(text)
    assert match is not None
    return match["base"], match["variant"] or "", match["repeat"] or ""


def _magnitude(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(
            f"A perturbation magnitude (PM) is a number from 0 to 1, but {text!r} follows the @."
        ) from None


def _plain(constraints: TextureConstraints | None) -> TextureConstraints | None:
    """The constraints of a plain paint under the same mask."""
    return None if constraints is None else TextureConstraints(masked=constraints.masked)


def chosen_controls(
    attacks: Mapping[CamouflageName, int], searches: int = 1
) -> dict[CamouflageName, int]:
    """Maps every chosen control of some attacks to the steps of the longest attack that has it.

    Several searches are numbered as repeats. One start alone moves what a search finds by 14 to 20
    points.
    """
    steps: dict[CamouflageName, int] = {}
    for name, count in attacks.items():
        for control in name.chosen_controls:
            several = control.choice == "search" and searches > 1
            repeats = map(control.with_repeat, range(searches)) if several else [control]
            for repeat in repeats:
                steps[repeat] = max(count, steps.get(repeat, 0))
    return steps
