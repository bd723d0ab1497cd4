"""A hardened detector beside its parent: what each attack hides from them, and their baselines."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Struct

from skyproof.camouflage.name import CamouflageName
from skyproof.detectors.card import PARENT_FILE, Digest
from skyproof.documents import read_document
from skyproof.files import file_digest, inside
from skyproof.layout import Layout
from skyproof.report.figures import embedded
from skyproof.results.operating_points import EQUAL_ALARMS
from skyproof.results.result import FROZEN, MAIN_MATCH
from skyproof.results.results import RENDERER, Results
from skyproof.results.statistics.intervals import Interval
from skyproof.results.stored import Finite, Label
from skyproof.words import listed, percent

_REMEDY = "copy the whole folder again, or harden the detector again"

_Jpeg = Annotated[str, Meta(max_length=10**6, pattern="^data:image/jpeg;base64,[A-Za-z0-9+/=]+$")]
_Limits = tuple[Finite | None, Finite | None, Finite | None]


class _Rate(Struct, frozen=True):
    """Share of the vehicles found without camouflage, and share of these hidden, with limits."""

    found: Finite
    hidden: _Limits


class Parent(Struct, frozen=True):
    """The results of its parent's assessment that a hardened detector's folder keeps.

    Rates are by attack and operating point, AP without camouflage is by set of images. `attacks`
    were shown while it was hardened. The digests are of its weights and the test scenes.
    """

    rates: dict[Label, dict[Label, _Rate]]
    ap: dict[Label, _Limits]
    attacks: list[Label]
    weights_sha256: Digest
    scenes_sha256: Digest
    pictures: dict[Label, _Jpeg] = {}


@dataclass(frozen=True)
class Beside:
    """A hardened detector beside its parent, in pairs of before and after; or only sentences.

    At each operating point, `found` are shares of the vehicles without camouflage, and `hidden` the
    rates of each attack. `ap` is that of each set of images. `pictures` of a scene, by attack, are
    data URIs.
    """

    sentences: Sequence[str]
    points: Sequence[str] = ()
    found: Sequence[tuple[float, float]] = ()
    hidden: Mapping[str, Sequence[tuple[Interval, Interval]]] | None = None
    ap: Mapping[str, tuple[Interval, Interval]] | None = None
    pictures: Mapping[str, tuple[str, str]] | None = None


def as_parent(results: Results, attacks: Sequence[str], weights_sha256: str) -> Parent:
    """What to keep of the assessment of a detector that `attacks` harden, or have hardened."""
    rates, ap = _known_rates(results)
    pictures = first_pictures(results, rates)
    return Parent(rates, ap, [*attacks], weights_sha256, _scenes_of(results), pictures)


def parent_of(results: Results) -> Parent | None:
    """Reads what the folder of a run's only detector keeps of its parent; None without one."""
    if len(results.detectors) != 1:
        return None
    path = Layout(results.folder).detector(results.detectors[0]) / PARENT_FILE
    return read_document(path, Parent, _REMEDY) if path.exists() else None


def beside_parent(results: Results) -> Beside | None:
    """Compares a hardened detector with its parent; None without a parent or attacks on both."""
    parent = parent_of(results)
    if parent is None:
        return None
    if parent.scenes_sha256 != _scenes_of(results):
        told = "Its parent was assessed on other scenes, so their rates cannot be compared."
        return Beside([told, "Assess both by one command, with the same imagery, labels and seed."])
    old, (new, ap) = parent.rates, _known_rates(results)
    names = [name for name in new if name in old]
    attacks = [name for name in names if not CamouflageName.read(name).random]
    every = [of_one[name] for of_one in (old, new) for name in names]
    points = [point for point in (FROZEN, *EQUAL_ALARMS) if all(point in one for one in every)]
    if not attacks or not points:
        return None
    hidden = {
        name: [(_interval(old[name][p].hidden), _interval(new[name][p].hidden)) for p in points]
        for name in names
    }
    found = [(old[attacks[0]][p].found, new[attacks[0]][p].found) for p in points]
    shown = f"Hardening showed it {listed(parent.attacks)}; all other attacks were held out."
    aps = {key: (_interval(was), _interval(ap[key])) for key, was in parent.ap.items() if key in ap}
    own = first_pictures(results, [name for name in names if name in parent.pictures])
    pictures = {name: (parent.pictures[name], picture) for name, picture in own.items()}
    changed = _changed(points, found, {name: hidden[name] for name in attacks})
    return Beside([*changed, shown], points, found, hidden, aps, pictures)


def _changed(
    points: Sequence[str],
    found: Sequence[tuple[float, float]],
    hidden: Mapping[str, Sequence[tuple[Interval, Interval]]],
) -> list[str]:
    """Says at equal false alarms, where they are known, what attacks hide, and if surely less."""
    place = min(1, len(points) - 1)
    rate = EQUAL_ALARMS.get(points[place])
    where = f"At {rate} false alarms per km² of empty ground" if rate else "At its own threshold"
    rates = [(name, *pairs[place]) for name, pairs in hidden.items()]
    before = max((old.estimate, name) for name, old, _ in rates)
    after = max((new.estimate, name) for name, _, new in rates)
    fewer = [name for name, old, new in rates if old.minus(new).low > 0]
    return [
        f"{where} it finds {percent(found[place][1])} of the vehicles without camouflage, its "
        f"parent {percent(found[place][0])}. Of these, the strongest attack hides "
        f"{percent(after[0])} ({after[1]}), from its parent {percent(before[0])} ({before[1]}).",
        f"There, {listed(fewer)} surely hide{'s' * (len(fewer) == 1)} fewer vehicles than before."
        if fewer
        else "There, no attack surely hides fewer vehicles than before: hardening did not help, "
        "had too few steps, or the test is too small to tell.",
    ]


def _known_rates(results: Results) -> tuple[dict[str, dict[str, _Rate]], dict[str, _Limits]]:
    """Rates of attacks and best patterns at each operating point, and AP on each set of images."""
    rates: dict[str, dict[str, _Rate]] = {}
    for row in results.rows:
        name = row.camouflage
        other = (row.renderer, row.match) != (RENDERER, MAIN_MATCH) or name.kept_copy
        other |= name.random and name.choice != "pattern"
        for point in () if other else (FROZEN, *EQUAL_ALARMS):
            one = results.at(row, point)
            if one is not None and not math.isnan(one.found_before):
                rates.setdefault(str(name), {})[point] = _Rate(one.found_before, _limits(one.easr))
    ap = {one.dataset: _limits(one.ap_centre_1m) for one in results.baselines if one.vehicles}
    return rates, ap


def first_pictures(results: Results, attacks: Iterable[str]) -> dict[str, str]:
    """The detections in the first pictured scene with each attack, as JPEG in a data URI.

    A hash chose this scene, so that it is the same for every attack and detector.
    """
    first = {name: results.pairs(CamouflageName.read(name), RENDERER)[:1] for name in attacks}
    return {
        name: embedded(
            inside(folder, pair.adversarial, folder / "pairs.json"), lossless=False, largest_px=400
        )
        for name, every in first.items()
        for folder, pair in every
    }


def _scenes_of(results: Results) -> str:
    """Returns the digest of a run's test scenes; empty without any."""
    path = Layout(results.folder).scenes("test")
    return file_digest(path) if path.exists() else ""


def _limits(interval: Interval) -> _Limits:
    known = (interval.estimate, interval.low, interval.high)
    estimate, low, high = (None if math.isnan(value) else value for value in known)
    return estimate, low, high


def _interval(limits: _Limits) -> Interval:
    estimate, low, high = (math.nan if value is None else value for value in limits)
    return Interval(estimate, low, high)
