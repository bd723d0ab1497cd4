"""The verdict on each detector by a requirement, for the report and for `verdict.json`."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from markupsafe import Markup
from msgspec import Struct

import skyproof
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.files import file_digest, write_json
from skyproof.layout import Layout
from skyproof.report.figures import chances_figure
from skyproof.report.hardened import parent_of
from skyproof.report.tiles import attack_tiles, paint_tiles
from skyproof.results.likeness import Likeness
from skyproof.results.precheck import findings, worst
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER, Results
from skyproof.results.rows_file import flat_row
from skyproof.results.statistics.acceptance import Decision, Evidence, Requirement, decide
from skyproof.results.statistics.planning import assume_from_pilot, chances_on_tiles, tiles_to_show
from skyproof.scenes.scene import scenes_digest
from skyproof.words import body_name, detector_name, interval, listed, percent

_REMEDY = "move it away, or report again with --accept and --reject"

# What the verdict says of each baseline, by the main and the lenient rule.
_BASELINE = (
    *("dataset", "real", "vehicles", "ap_centre_1m", "ap_centre_in_box"),
    *("recall", "recall_centre_in_box", "called_another_class"),
)

Answer = Literal[
    "accepted", "rejected", "undecided", "not applicable", "not valid for this imagery"
]


@dataclass(frozen=True)
class Ruling:
    """The verdict on one detector; "not applicable" if the test cannot tell.

    It is "not valid" if the detector does not see rendered vehicles like photographed ones.

    `attacks` is the evidence by camouflage and renderer, the strongest first. `more_vehicles` on
    such tiles would decide; it is 0 if decided, None if no number would or there is no verdict.
    `paint` is the plain paint of the precheck that rejects the detector, in words, if one does.
    """

    detector: str
    answer: Answer
    sentences: Sequence[str]
    more_vehicles: int | None
    attacks: dict[str, Evidence]
    paint: tuple[str, Evidence] | None = None


@dataclass(frozen=True)
class Acceptance:
    """The page's part on the verdict: requirement, rulings, operating characteristic and scope.

    `suite` are the version and digest of the suite if all of it was scored, "incomplete" if not,
    and None in a run without one.
    """

    requirement: Requirement
    rulings: Sequence[Ruling]
    figure: Markup | None
    validity: str
    suite: dict[str, Any] | Literal["incomplete"] | None


class _StoredVerdict(Struct, frozen=True):
    requirement: Requirement


def read_requirement(path: Path) -> Requirement | None:
    """Reads the requirement of an earlier report; None without one."""
    return read_document(path, _StoredVerdict, _REMEDY).requirement if path.exists() else None


def rule(results: Results, requirement: Requirement, alarms: Sequence[str]) -> Acceptance:
    """Decides on each detector of a run.

    Attacks are all camouflages on all renderers, query attacks and chosen controls, each repeat by
    itself; single random draws and copies of unfinished camouflages are none. A detector that
    failed its precheck is not accepted, but attacks or a plain paint of the precheck may reject it,
    unless it has no precheck or failed on unchanged renders, so that the test cannot tell. Nothing
    accepts or rejects a detector that does not see renders like photographs of this ground. With
    alarms of gradient masking, or if a part of the suite was not scored, no detector is accepted,
    because other attacks could hide more.
    """
    suite, unscored = scored_suite(results)
    doubts = [unscored] if unscored else []
    if alarms:
        doubts.append("the detector masks its gradients (“Query attacks”, below)")
    rulings = []
    for name in results.detectors:
        ruling = _ruled(name, results, requirement)
        rulings.append(_doubted(ruling, requirement, doubts) if doubts else ruling)
    figure = _figure(results, requirement) if any(each.attacks for each in rulings) else None
    return Acceptance(requirement, rulings, figure, _validity(results), suite)


def _ruled(name: str, results: Results, requirement: Requirement) -> Ruling:
    """Decides on one detector by its precheck and the attacks."""
    precheck = results.prechecks.get(name)
    found = [] if precheck is None else findings(precheck)
    failed = [each for each in found if each.outcome == "failed"]
    scenes = results.test_scenes
    attacks = attack_tiles(results.counts, name, scenes)
    likeness = results.likeness_of(name)
    if likeness is not None and likeness.judges_nobody:
        return _not_valid(likeness)
    if not attacks and found and not failed:
        raise ConfigurationError(
            "A verdict expects optimised camouflages or chosen controls among the scores, "
            f"found none for {name}; attack the detector, then score and report again."
        )
    if precheck is None:
        return _no_verdict(name, "no precheck of it is here (skyproof precheck)")
    # Findings begin with those of the baselines.
    of_sets = zip(precheck.sets, found, strict=False)
    rendered = worst([finding for baseline, finding in of_sets if not baseline.real])
    if rendered in failed:
        return _no_verdict(name, f"it failed the precheck: {rendered.words}")
    tried = precheck.paints_tried if not scenes or precheck.was_made_on(scenes) else 0
    if attacks or tried:
        paints = paint_tiles(precheck, scenes) if tried else {}
        decision = decide(attacks, requirement, paints, paints_tried=tried)
        if decision.answer == "rejected" or not failed:
            return _ruling(name, decision, results, requirement)
    return _no_verdict(name, f"it failed the precheck: {worst(found).words}")


def _no_verdict(name: str, why: str) -> Ruling:
    sentence = (
        f"{detector_name(name)}: no verdict, because {why}. A detector that fails without "
        "camouflage cannot be accepted for its robustness to camouflage."
    )
    return Ruling(name, "not applicable", [sentence], None, {})


def _not_valid(likeness: Likeness) -> Ruling:
    name = detector_name(likeness.detector)
    sentences = [
        f"{name}: NOT VALID FOR THIS IMAGERY, because the detector does not see rendered vehicles "
        "like photographed ones. What camouflages and paints on rendered vehicles hide from it "
        "says nothing about vehicles on this ground.",
        likeness.sentence,
    ]
    return Ruling(likeness.detector, "not valid for this imagery", sentences, None, {})


def scored_suite(results: Results) -> tuple[dict[str, Any] | Literal["incomplete"] | None, str]:
    """Returns what `Acceptance` says about the suite, and a clause on what is missing from it."""
    suite = results.config.suite
    if suite is None:
        return None, ""
    if not suite.scored:
        return "incomplete", "the run folder does not say which camouflages the suite has"
    scored = {
        (key.camouflage, key.detector)
        for key in results.counts.series
        if (key.renderer, key.match) == (RENDERER, MAIN_MATCH)
    }
    missing = [
        name
        for name in suite.scored
        if not all((name, detector) in scored for detector in results.detectors)
    ]
    if missing:
        first = ", ".join(missing[:3])
        return "incomplete", (
            f"{len(missing)} of the {len(suite.scored)} camouflages of the suite were not scored "
            f"({first}{', …' if len(missing) > 3 else ''})"
        )
    return {"version": suite.version, "sha256": suite.sha256}, ""


def write_verdict(results: Results, acceptance: Acceptance, alarms: Sequence[str]) -> None:
    """Writes `verdict.json`: the answers, and digests of everything that they rest on."""
    layout = Layout(results.folder)
    digests = {name: card.weights_sha256 for name, card in results.cards.items()}
    scored = {key.camouflage for key in results.counts.series}
    parent = parent_of(results)
    alarms_of = {name: own[0].false_alarms_per_km2 for name, own in results.points.items() if own}
    document = {
        "skyproof": skyproof.__version__,
        "suite": acceptance.suite,
        "requirement": asdict(acceptance.requirement),
        "alarms": list(alarms),
        "detectors": [
            {
                "detector": ruling.detector,
                "answer": ruling.answer,
                "sentences": list(ruling.sentences),
                "more_vehicles": ruling.more_vehicles,
                "baselines": [
                    {name: row[name] for name in _BASELINE}
                    for row in map(flat_row, results.baselines)
                    if row["detector"] == ruling.detector
                ],
                **_likeness(results, ruling.detector),
                "false_alarms_per_km2": alarms_of.get(ruling.detector),
                "weights_sha256": digests.get(ruling.detector, ""),
                **({} if parent is None else {"parent_sha256": parent.weights_sha256}),
                "attacks": {name: asdict(said) for name, said in ruling.attacks.items()},
                "paint": None
                if ruling.paint is None
                else {"name": ruling.paint[0], **asdict(ruling.paint[1])},
            }
            for ruling in acceptance.rulings
        ],
        "validity": acceptance.validity,
        "sha256": {
            "scenes": scenes_digest(results.test_scenes) if results.test_scenes else "",
            "backgrounds": _digest(layout.backgrounds),
            "fleet": _digest(layout.fleets / "test"),
            "settings": _digest(layout.config),
            "camouflages": {
                folder.name: _digest(folder)
                for folder in sorted(layout.camouflages.glob("*"))
                if folder.name in scored and (folder / "camouflage.json").exists()
            },
        },
    }
    write_json(layout.verdict, document)


def _likeness(results: Results, detector: str) -> dict[str, Any]:
    """The comparison with photographed vehicles, by each rule; empty where it was not measured."""
    rows = [flat_row(row) for row in results.likeness if row.detector == detector]
    return {"likeness": rows} if rows else {}


def _ruling(name: str, decision: Decision, results: Results, requirement: Requirement) -> Ruling:
    attacks = dict(sorted(decision.attacks.items(), key=lambda item: -item[1].share))
    shown = detector_name(name)
    if decision.paint is not None:
        paint, hidden = decision.paint
        said = [
            f"{shown} is REJECTED: the plain paint {paint} hides {_lost(hidden)}, significantly "
            f"more than {percent(requirement.accept)}. The bounds allow for the choice of the "
            "worst paint of the precheck."
        ]
        if attacks:
            said.append(f"{_worst_attack(attacks)}.")
        return Ruling(name, "rejected", said, 0, attacks, decision.paint)
    worst_attack = _worst_attack(attacks)
    more: int | None = 0
    if decision.answer == "accepted":
        said = [
            f"{shown} is ACCEPTED: every attack hides significantly less than "
            f"{percent(requirement.reject)}.",
            f"{worst_attack}.",
        ]
    elif decision.answer == "rejected":
        excess = f"significantly more than {percent(requirement.accept)}"
        said = [f"{shown} is REJECTED: {worst_attack}, {excess}."]
    else:
        in_sight = next(iter(results.counts.series.values()))[:, 0]
        tiles, of_all = decision.more_tiles, results.counts.tiles
        more = None if tiles is None else math.ceil(tiles * in_sight.sum() / of_all)
        enough = (
            "At this rate no number of vehicles would decide."
            if more is None
            else f"About {more:,} more test vehicles on {decision.more_tiles:,} more tiles would "
            f"decide at this rate.{_imagery(decision.more_tiles or 0, results)}"
        )
        said = [f"{shown} is UNDECIDED: {worst_attack}.", enough]
    return Ruling(name, decision.answer, said, more, attacks)


def _worst_attack(attacks: Mapping[str, Evidence]) -> str:
    """Says in a clause what the first of some attacks hides."""
    name, said = next(iter(attacks.items()))
    rank = f"worst of {len(attacks)} attacks" if len(attacks) > 1 else "only attack"
    return f"{name}, the {rank}, hides {_lost(said)}"


def _lost(said: Evidence) -> str:
    return (
        f"{percent(said.share)} of the vehicles found before (bounds "
        f"{interval(said.at_least, said.at_most)})"
    )


def _doubted(ruling: Ruling, requirement: Requirement, doubts: Sequence[str]) -> Ruling:
    """Withdraws the acceptance of a detector because of doubts about the test."""
    if ruling.answer != "accepted":
        return ruling
    sentences = [
        f"{detector_name(ruling.detector)} is UNDECIDED: every attack hides significantly less "
        f"than {percent(requirement.reject)}, but {listed(doubts)}, so other attacks could hide "
        "more.",
        *ruling.sentences[1:],
    ]
    return replace(ruling, answer="undecided", sentences=sentences, more_vehicles=None)


def _imagery(more_tiles: int, results: Results) -> str:
    """Says how much imagery shows this number of further tiles, or that none does."""
    scenes = len(results.test_scenes)
    needed = results.counts.tiles + more_tiles
    if not scenes:
        return ""
    if needed >= scenes:
        return (
            f" {scenes} test scenes cannot show so many. Ask for a wider gap between the two "
            "shares, or allow larger risks."
        )
    return f" Imagery with about {tiles_to_show(needed, scenes):,} test tiles is enough."


def _figure(results: Results, requirement: Requirement) -> Markup | None:
    try:
        assumptions = assume_from_pilot(results.counts)
    except ConfigurationError:
        return None
    chances = chances_on_tiles(requirement, assumptions, results.counts.tiles)
    return Markup(chances_figure(chances, requirement))


def _validity(results: Results) -> str:
    scenes = results.test_scenes
    if not scenes:
        return "The scope of the verdict is unknown: the file of the test scenes is missing."
    kinds = sorted(
        {body_name(each.vehicle.rpartition("-")[0]) for one in scenes for each in one.placements}
    )
    weather = sorted({scene.weather.condition for scene in scenes})
    drawn = results.sources in (["procedural"], [])
    ground = "the procedural one" if drawn else ", ".join(results.sources[:3])
    gsds_cm = sorted({round(100 * scene.camera.gsd_m, 1) for scene in scenes})
    resolution = " and ".join(f"{each:g}" for each in gsds_cm)
    tilts = [math.degrees(scene.camera.tilt_rad) for scene in scenes]
    suns = [math.degrees(scene.sun.elevation_rad) for scene in scenes]
    return (
        f"Scope: ground like {ground}, {resolution} cm a pixel, the camera "
        f"up to {max(tilts):.0f}° off the vertical, the sun {min(suns):.0f}° to {max(suns):.0f}° "
        f"high, {' and '.join(weather)} weather, vehicles of the kinds {', '.join(kinds)}, and "
        "these attacks. Another attack needs another test."
    )


def _digest(path: Path) -> str:
    """Returns the SHA-256 of a file, or of a folder's files and their names; empty if missing."""
    if path.is_file():
        return file_digest(path)
    total = hashlib.sha256()
    # Logs are left out, because they hold times, which differ between equal runs.
    files = [each for each in sorted(path.rglob("*")) if each.is_file() and each.suffix != ".jsonl"]
    for each in files:
        total.update(f"{each.relative_to(path)} {_digest(each)}\n".encode())
    return total.hexdigest() if files else ""
