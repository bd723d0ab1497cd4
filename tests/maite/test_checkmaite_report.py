"""The report for checkmaite, without checkmaite: it asks for a MAITE below 0.10."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType, SimpleNamespace
from typing import Any, Generic, TypeVar

import pytest

CORE = "checkmaite.core"
One, Two, Three, Four, Five = (TypeVar(name) for name in ("One", "Two", "Three", "Four", "Five"))


class Named:
    """Keeps what it is made of."""

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)


class Run(Named, Generic[One, Two]):
    """A run, as far as its report asks."""


class Capability(Generic[One, Two, Three, Four, Five]):
    """A capability that is not run."""


def put_in_place(monkeypatch: pytest.MonkeyPatch, name: str, **content: Any) -> None:
    module = ModuleType(name)
    vars(module).update(content)
    monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Any:
    put_in_place(monkeypatch, "checkmaite")
    put_in_place(monkeypatch, CORE)
    put_in_place(
        monkeypatch,
        f"{CORE}.capability_core",
        Capability=Capability,
        CapabilityConfigBase=Named,
        CapabilityOutputsBase=Named,
        CapabilityRunBase=Run,
        Number=SimpleNamespace(ZERO=0, ONE=1, MANY=2),
    )
    put_in_place(monkeypatch, f"{CORE}.report", InlineTextReport=Named)
    name = "skyproof.maite.checkmaite_plugin"
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name)
    sys.modules.pop(name, None)


def test_found_again_does_not_make_up_for_lost(plugin: Any) -> None:
    """28 of 100 are lost and 25 others found since: 72 % of the found are still found, not 97."""
    row = {
        **{"easr": 0.03, "easr_low": -0.02, "easr_high": 0.08, "found_before": 100},
        **{"asr": 0.28, "asr_low": 0.22, "asr_high": 0.35},
    }
    outputs = SimpleNamespace(hidden={"mine": row, "kept": {**row, "asr_low": None}})
    run = plugin.SkyproofCamouflageRun(outputs=outputs, model_metadata=[{"id": "theirs"}])
    for share, word in ((0.8, "missed"), (0.7, "open"), (0.6, "met")):
        page = run.collect_md_report(share).content
        assert f"| mine | 28 % | 22 % to 35 % | 3 % | -2 % to 8 % | 100 | {word} |" in page
        assert page.rstrip().endswith("| not known |")
