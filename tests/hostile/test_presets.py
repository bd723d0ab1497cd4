"""Presets of `reproduce`: what is in them becomes settings and arguments, never a shell's words."""

import subprocess

import pytest

from tests.hostile.documents import try_any_json, try_damage, try_mutations
from tests.hostile.kinds import PRESETS
from tests.hostile.sandbox import Sandbox

pytestmark = pytest.mark.slow

KIND = PRESETS[0]


@pytest.fixture(autouse=True)
def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dry run starts no process, whatever the preset says."""

    def start(self: object, *words: object, **options: object) -> None:
        raise AssertionError(f"started {words}")

    monkeypatch.setattr(subprocess.Popen, "__init__", start)


def test_the_usual_preset_is_taken(sandbox: Sandbox) -> None:
    assert sandbox.try_document(KIND, (sandbox.inputs / KIND.document).read_bytes()) == 0


def test_any_json(sandbox: Sandbox) -> None:
    try_any_json(sandbox, KIND, 40)


def test_one_mutation(sandbox: Sandbox) -> None:
    try_mutations(sandbox, KIND, 60)


def test_damaged_bytes(sandbox: Sandbox) -> None:
    try_damage(sandbox, KIND, 40)
