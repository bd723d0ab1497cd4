"""Can the attacks be trusted? Tests, gradients, convergence, other rules."""

from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.reproduction.cells import (
    Block,
    Heading,
    TextTable,
    Topic,
    at_equal_alarms,
    equal_alarm_columns,
    interval_cells,
    rate,
    value,
)
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.operating_points import alarms_in_words
from skyproof.results.result import LENIENT_MATCH
from skyproof.results.weak import weak_attacks
from skyproof.words import probability

_SURE = 0.05
_OVERLAP = "iou_50"
_LENIENT = f"easr_{LENIENT_MATCH}"


def trust_part(run: Reproduction, rows: Sequence[Mapping[str, Any]]) -> Topic:
    """Says whether chance explains the rows of the paper's tables, and how attacks converge."""
    signs: list[dict[str, Any]] = [
        {"attack": name, "detector": detector, **found}
        for name, record in run.results.records.items()
        for detector, found in (record.sign_test or {}).items()
    ]
    convergence = _convergence_rows(run)
    return Topic.of(
        "Can the attacks be trusted?",
        {"convergence": convergence, "signs": signs},
        _tests(run, rows),
        *_signs(signs),
        *_convergence(convergence),
        *_weak(weak_attacks(run.results)),
    )


def _tests(run: Reproduction, rows: Sequence[Mapping[str, Any]]) -> str:
    """Counts each camouflage once; a combination whose PM* is 0 is its texture."""
    learnt: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        if not row["attack"].startswith("R-"):
            learnt.setdefault(run.best.get(row["attack"], row["attack"]), row)

    def known(column: str) -> dict[str, float]:
        return {n: row[column] for n, row in learnt.items() if row[column] is not None}

    controlled = known("net_easr_low")
    below = [name for name, low in controlled.items() if low <= 0]
    single = [name for name in controlled if learnt[name]["random_draws"] == 1]
    chosen = known("net_strongest_control_easr_low")
    unsure = [name for name, low in chosen.items() if low <= 0]
    drawn = known("control_p_holm")
    like_drawn = [name for name, p in drawn.items() if p >= _SURE]
    tested = known("no_camouflage_p_holm")
    like_none = [name for name, p in tested.items() if p >= _SURE]
    return " ".join(
        part
        for part in (
            f"Placebo: for {len(controlled) - len(below)} of {len(controlled)} distinct "
            "camouflages above, the interval of the net EASR lies above zero.",
            _named("Not surely more than an average random draw", below),
            _named("Compared with a single draw, which says nothing about others", single),
            f"Of {len(chosen)}, {len(chosen) - len(unsure)} surely hide more than every control "
            "found without optimisation."
            if chosen
            else "",
            _named("Not surely due to learning", unsure),
            "Learnt against every draw of the random control on the same vehicles, swapped tile by "
            "tile, with Holm’s correction over the camouflages: "
            f"p < {_SURE} on every detector, for every repeat and every draw, for "
            f"{len(drawn) - len(like_drawn)} of {len(drawn)}.",
            _named("Not told from some draw on some detector", like_drawn),
            "Against no camouflage, which random patterns differ from, too (McNemar’s exact test, "
            f"corrected alike): {len(tested) - len(like_none)} of {len(tested)}.",
            _named("Not told from no camouflage on some detector", like_none),
        )
        if part
    )


def _named(what: str, names: Sequence[str]) -> str:
    return f"{what}: {', '.join(names)}." if names else ""


def _signs(rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    if not rows:
        return []
    lower = [row for row in rows if row["mean_change"] < 0]
    sure = [row for row in rows if row["p"] < _SURE]
    others = [row for row in rows if row["mean_change"] >= 0]
    text = (
        "Sign test: one step along an attack’s gradient lowered the mean score on the target in "
        f"{len(lower)} of {len(rows)} pairs of attack and detector; in {len(sure)} it fell "
        f"in more scenes than chance explains (exact, p < {_SURE})."
    )
    if others:
        grid = TextTable.of(
            others,
            [
                ("did not fall", "attack"),
                *((column, column) for column in ("detector", "scenes", "fell")),
                ("p", lambda row: probability(row["p"])),
                ("mean change", lambda row: f"{row['mean_change']:+.4f}".replace("-", "−")),
            ],
        )
        return [text, grid]
    return [text]


def _convergence_rows(run: Reproduction) -> list[dict[str, Any]]:
    """What each attack hid half-way and at the end, on scenes of its own world."""
    rows: list[dict[str, Any]] = []
    for name, record in run.results.records.items():
        found = record.convergence
        if found is None:
            continue
        rows.append(
            {
                "attack": name,
                "half_steps": found.steps[0],
                "steps": found.steps[1],
                "scenes": found.scenes,
                "hidden_half_way": 100 * found.hidden[0],
                "hidden": 100 * found.hidden[1],
                "added": 100 * (found.hidden[1] - found.hidden[0]),
                "converged": found.converged,
            }
        )
    return rows


def _convergence(rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    if not rows:
        return []
    others = [row for row in rows if not row["converged"]]
    text = (
        f"In {len(rows) - len(others)} of {len(rows)} attacks the second half of the "
        f"steps hid at most 2 points more, on {rows[0]['scenes']} scenes of the attack’s own "
        "world that no step saw. More steps may make the others stronger."
    )
    heading = Heading("Convergence", 3)
    if not others:
        return [heading, text]
    grid = TextTable.of(
        sorted(others, key=lambda row: -row["added"]),
        [
            ("not converged", "attack"),
            ("steps", "half_steps"),
            ("EASR", value("hidden_half_way")),
            ("steps", "steps"),
            ("EASR", value("hidden")),
        ],
    )
    return [heading, text, grid]


def _weak(attacks: Sequence[str]) -> list[Block]:
    if not attacks:
        return []
    return [
        Heading("Weak attacks", 3),
        f"Beaten by what they could have found: {'; '.join(attacks)}.",
    ]


def criteria_part(run: Reproduction) -> Topic:
    """Returns the mean EASR of attacks (no variants) by each rule, and their false alarms."""
    rows: list[dict[str, Any]] = []
    for camouflage in run.results.names:
        centre = run.results.row(camouflage)
        if camouflage.random or camouflage.variant or centre is None:
            continue
        row = {"attack": str(camouflage), **interval_cells("easr", centre.easr, 100.0)}
        row |= at_equal_alarms(run.results, centre)
        if overlap := run.results.row(camouflage, match=_OVERLAP):
            row |= interval_cells("easr_iou_50", overlap.easr, 100.0)
            row["ap_iou_50_original"] = 100 * overlap.ap_original
            row["ap_iou_50_adversarial"] = 100 * overlap.ap_adversarial
        if lenient := run.results.row(camouflage, match=LENIENT_MATCH):
            row |= interval_cells(_LENIENT, lenient.easr, 100.0)
            at = at_equal_alarms(run.results, lenient)
            row |= {f"{LENIENT_MATCH}_{key}": each for key, each in at.items()}
        row["false_alarms_per_km2_original"] = centre.false_alarms_per_km2_original
        row["false_alarms_per_km2_adversarial"] = centre.false_alarms_per_km2_adversarial
        rows.append(row)
    text = (
        "Above, a vehicle counts as found where a detection’s centre lies within 1 m of its own; "
        "here also where the boxes’ intersection over union is at least 0.5, and leniently where "
        "the detection’s centre lies anywhere in the vehicle’s box. False alarms are "
        "detections on no vehicle at the frozen threshold, per square kilometre of test ground, "
        "beside vehicles without and with the camouflage."
    )
    grid = TextTable.of(
        rows,
        [
            ("attack", "attack"),
            ("EASR", rate("easr")),
            *equal_alarm_columns(rows),
            ("EASR, IoU ≥ 0.5", rate("easr_iou_50")),
            ("EASR, centre in box", rate(_LENIENT)),
            ("AP, IoU ≥ 0.5", value("ap_iou_50_original")),
            ("AP then", value("ap_iou_50_adversarial")),
            ("false alarms per km²", value("false_alarms_per_km2_original", 0)),
            ("then", value("false_alarms_per_km2_adversarial", 0)),
        ],
    )
    heading = "By overlap, and false alarms"
    alarms = alarms_in_words(run.results.points)
    return Topic.of(heading, {"criteria": rows}, text, grid, *alarms)
