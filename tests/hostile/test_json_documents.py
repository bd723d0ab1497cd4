"""JSON documents of every kind but presets: scenes, fleets, ground, labels, cards, scores, runs."""

import pytest

from tests.hostile.documents import try_any_json, try_damage, try_mutations
from tests.hostile.kinds import JSON_KINDS
from tests.hostile.sandbox import Kind, Sandbox

pytestmark = [pytest.mark.slow, pytest.mark.parametrize("kind", JSON_KINDS, ids=str)]


def test_any_json(sandbox: Sandbox, kind: Kind) -> None:
    try_any_json(sandbox, kind, 12)


def test_one_mutation(sandbox: Sandbox, kind: Kind) -> None:
    try_mutations(sandbox, kind, 40)


def test_damaged_bytes(sandbox: Sandbox, kind: Kind) -> None:
    try_damage(sandbox, kind, 12)
