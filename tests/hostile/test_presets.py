"""Presets of `reproduce`: what is in them becomes settings and arguments, never a shell's words."""

import subprocess
from types import SimpleNamespace
from typing import Any

import pytest

import skyproof.reproduction.command
from tests.hostile.documents import try_any_json, try_damage, try_mutations
from tests.hostile.kinds import PRESETS
from tests.hostile.sandbox import Sandbox

pytestmark = pytest.mark.slow

KIND = PRESETS[0]


@pytest.fixture(autouse=True)
def no_snakemake(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Snakemake's own check of a plan takes seconds; what it would be asked is kept."""
    asked: list[list[str]] = []

    def run(words: list[str], **options: Any) -> Any:
        assert not options.get("shell")
        asked.append(words)
        return SimpleNamespace(returncode=0, stderr="")

    names = {name: getattr(subprocess, name) for name in ("Popen", "PIPE", "DEVNULL", "STDOUT")}
    shim = SimpleNamespace(run=run, **names)
    monkeypatch.setattr(skyproof.reproduction.command, "subprocess", shim)
    return asked


def test_the_usual_preset_is_taken(sandbox: Sandbox, no_snakemake: list[list[str]]) -> None:
    assert sandbox.try_document(KIND, (sandbox.inputs / KIND.document).read_bytes()) == 0
    assert len(no_snakemake) == 1


def test_any_json(sandbox: Sandbox) -> None:
    try_any_json(sandbox, KIND, 40)


def test_one_mutation(sandbox: Sandbox) -> None:
    try_mutations(sandbox, KIND, 60)


def test_damaged_bytes(sandbox: Sandbox) -> None:
    try_damage(sandbox, KIND, 40)
