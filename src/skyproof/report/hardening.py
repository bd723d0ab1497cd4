"""Images to add to training, and the commands that make them; never how to hide."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skyproof import words
from skyproof.camouflage.name import CamouflageName
from skyproof.layout import Layout
from skyproof.results.conditions import Bin, Panel
from skyproof.results.findings import findings
from skyproof.results.result import Result
from skyproof.results.results import Results

_STRONGEST = 2
# Kinds of change in a precheck that are paints.
_PAINTS = ("paint_body", "paint_whole", "two_tone", "control")


@dataclass(frozen=True)
class Hardening:
    """Images that train the weaknesses away.

    Attributes:
        paints: whether images of many paints come first.
        images: sentences that name the images to add.
        commands: commands that render them in the run folder.
    """

    paints: bool
    images: Sequence[str]
    commands: Sequence[str]


def hardening(
    results: Results,
    every: Sequence[Result],
    panels: Callable[[Result], Sequence[Panel]],
) -> Hardening | None:
    """Names the images that help against the strongest attacks, and how to make them.

    They show vehicles and tiles of the attack split. Those of the test would flatter the next test.

    Args:
        results: of the run.
        every: result to quote of each camouflage.
        panels: gives success by condition.

    Returns:
        None where no attack hides anything for sure, or the run folder lacks what is needed.
    """
    layout = Layout(results.folder)
    fleet = layout.fleets / "attack"
    sure = [row for row in every if row.easr.low > 0]
    known = [row for row in sure if _folder(results, row.camouflage) is not None]
    ranked = sorted(known, key=lambda row: -row.easr.estimate)[:_STRONGEST]
    needed = (layout.backgrounds / "index.json", fleet)
    if not ranked or not results.test_scenes or not all(place.exists() for place in needed):
        return None
    names = [shlex.quote(str(_folder(results, row.camouflage))) for row in ranked]
    shown = " and ".join(str(row.camouflage) for row in ranked)
    images = [
        f"{shown} {'hide' if len(ranked) > 1 else 'hides'} most. Add images of such vehicles with "
        "their labels to the training images. The commands below render them on the ground and "
        "with the vehicles of the attack, not those of the test."
    ]
    for row in ranked:
        for panel in panels(row):
            extremes = _extremes(panel)
            if extremes is not None and _apart(*extremes):
                images.append(
                    f"{row.camouflage} hides most at {panel.title.lower()} "
                    f"{_told(extremes[0])}: include such views."
                )
    size_px = results.test_scenes[0].camera.size_px
    paints = _fails_at_paints(results)
    attack = "--backgrounds backgrounds --fleet fleets/attack"
    commands = [
        f"skyproof render {attack} --split attack --count 400 --seed 1 --settings.size-px "
        f"{size_px} --camouflage camouflages/{name} --labels yolo --out hardening/{name}"
        for name in names
    ]
    if paints:
        painted = "--backgrounds backgrounds --fleet hardening/fleets/train"
        commands = [
            "skyproof vehicles --counts 200 1 1 1 --seed 1 --out hardening/fleets",
            f"skyproof render {painted} --split attack --count 800 --seed 2 --settings.size-px "
            f"{size_px} --labels yolo --out hardening/paints",
            *commands,
        ]
    return Hardening(paints, images, commands)


def _fails_at_paints(results: Results) -> bool:
    """Whether a detector failed its precheck at paints or random patterns."""
    records = [record for name, record in results.prechecks.items() if name in results.detectors]
    found = [each for record in records for each in findings(record)]
    return any(
        each.outcome == "failed" and bool(each.rates) and each.rates[0].kind in _PAINTS
        for each in found
    )


def readings(panels: Sequence[Panel]) -> list[str]:
    """Says in one sentence per panel whether the intervals of its extremes part company."""
    sentences = []
    for panel in panels:
        extremes = _extremes(panel)
        if extremes is None:
            continue
        most, least = extremes
        if _apart(most, least):
            sentences.append(
                f"{panel.title}: most hidden at {_told(most)}, least at {_told(least)}; the "
                "intervals do not overlap."
            )
        else:
            sentences.append(f"{panel.title}: no clear difference; the intervals overlap.")
    return sentences


def _extremes(panel: Panel) -> tuple[Bin, Bin] | None:
    """Gives the bins where most and least is hidden; None where fewer than two have limits."""
    known = [bar for bar in panel.bins if bar.rate.low == bar.rate.low]
    if len(known) < 2:
        return None
    least = min(known, key=lambda bar: bar.rate.estimate)
    return max(known, key=lambda bar: bar.rate.estimate), least


def _apart(most: Bin, least: Bin) -> bool:
    return most.rate.low > least.rate.high


def _told(bar: Bin) -> str:
    return f"{bar.label} ({words.percent(bar.rate.estimate)})".replace("\n", " ")


def _folder(results: Results, camouflage: CamouflageName) -> str | None:
    """Gives the name of a camouflage's folder in the run, of the first of its repeats."""
    names = (str(camouflage), str(camouflage.with_repeat(0)))
    return next((name for name in names if name in results.records), None)
