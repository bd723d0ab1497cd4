"""What the report says of attacks by answers, from vehicles that are hidden by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyproof.files import write_json
from skyproof.report.queries import query_part
from skyproof.report.report import write_report
from skyproof.results.results import Results
from skyproof.results.score_folder import ScoreRecord, write_record
from skyproof.results.statistics.intervals import Interval
from tests.results.test_worst import scored

IMAGES = 6000


def missed(hides: dict[str, set[int]]) -> dict[str, set[int]]:
    """With the vehicle that is never found before, which would count against EASR if found."""
    return {name: places | {4} for name, places in hides.items()}


def sought(folder: Path, *names: str) -> None:
    """Says of camouflages that they were sought by answers."""
    for name in names:
        record = {"queries": {"images": IMAGES}}
        content = {"format": 2, "camouflage": {"name": name}, "record": record}
        write_json(folder / "camouflages" / name / "camouflage.json", content)


@pytest.mark.parametrize(("by_gradients", "alarmed"), [(set(), True), ({0, 1}, False)])
def test_gradients_that_hide_less_than_answers_raise_an_alarm(
    tmp_path: Path, by_gradients: set[int], alarmed: bool
) -> None:
    hides = {"T-U": by_gradients, "T-U_transfer": {0}, "T-U_asked": {0, 1, 2, 3}, "R-U-0": set()}
    sought(tmp_path, "T-U_asked")
    found = query_part(scored(tmp_path, missed(hides)))
    assert found is not None
    assert not found.only
    (row,) = found.rows
    assert row.gradients is not None
    assert row.gradients.estimate == pytest.approx(len(by_gradients) / 4)
    assert row.queried.estimate == pytest.approx(1)
    # Five vehicles are too few to be sure of half of them.
    assert bool(found.alarms) == alarmed
    page = write_report(tmp_path).read_text()
    assert ("Gradient masking: " in page) == alarmed
    assert ("no sign of gradient masking" in page) != alarmed
    if alarmed:
        assert "T-U hides 0" in found.alarms[0]
        assert "by queries: +100 points" in found.alarms[0]


@pytest.mark.parametrize(("low", "alarmed"), [(0.01, False), (0.24, True), (-0.02, False)])
def test_what_another_start_can_change_is_no_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, low: float, alarmed: bool
) -> None:
    sought(tmp_path, "T-U_asked")
    results = scored(tmp_path, missed({"T-U": {0}, "T-U_transfer": {0}, "T-U_asked": {0, 1}}))
    more = Interval(low + 0.03, low, low + 0.06)
    monkeypatch.setattr(Results, "difference", lambda *_: more)
    found = query_part(results)
    assert found is not None
    assert bool(found.alarms) == alarmed
    assert ("Another start of an attack" in found.conclusion) == (0 < low < 0.2)
    assert ("do not hide significantly more" in found.conclusion) == (low < 0)


def test_of_a_black_box_the_curve_begins_with_what_was_carried_over(tmp_path: Path) -> None:
    hides = {
        "T-Ma": {0, 1, 2},
        "T-Ma_transfer": {0},
        "T-Ma_asked1500": {0, 1},
        "R-Ma_search": {1},
        "R-Ma_search_asked1500": set(),
    }
    sought(tmp_path, "T-Ma", "R-Ma_search")
    # Two of the three are still seen, beside where they are.
    seen = hides | {"T-Ma": {0}}
    found = query_part(scored(tmp_path, missed(hides), missed(seen)))
    assert found is not None
    assert found.only
    assert not found.alarms
    (row,) = found.rows
    assert row.lenient is not None
    assert row.lenient.estimate == pytest.approx(0.25)
    rates = [row.transfer, row.queried, row.searched]
    assert [rate.estimate for rate in rates if rate] == pytest.approx([0.25, 0.75, 0.25])
    assert (row.gradients, row.images) == (None, IMAGES)
    page = write_report(tmp_path).read_text()
    assert "This detector is a black box" in page
    assert "by gradients" not in page


def test_a_detector_that_was_only_checked_hides_no_alarm(tmp_path: Path) -> None:
    hides = {"T-U": set(), "T-U_transfer": {0}, "T-U_asked": {0, 1, 2, 3}, "R-U-0": set()}
    sought(tmp_path, "T-U_asked")
    scored(tmp_path, missed(hides))
    other = tmp_path / "scores" / "zoo"
    write_record(other, ScoreRecord({"other": 0.5}))
    write_json(other / "baselines.json", {"rows": []})
    results = Results.open(tmp_path)
    assert (results.detectors, results.all_detectors) == (["retinanet"], ["retinanet", "other"])
    found = query_part(results)
    assert found is not None
    assert found.alarms
    assert "Gradient masking: " in write_report(tmp_path).read_text()


def test_where_nothing_was_asked_nothing_is_said(tmp_path: Path) -> None:
    assert query_part(scored(tmp_path, missed({"T-U": {0}, "R-U_search": {1}}))) is None
    assert "Query attacks" not in write_report(tmp_path).read_text()
