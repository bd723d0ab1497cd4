"""Datasets: annotations, through every command that reads them."""

import pytest

from tests.hostile.documents import try_any_json, try_damage, try_mutations
from tests.hostile.kinds import DATASETS
from tests.hostile.sandbox import Kind, Sandbox

pytestmark = pytest.mark.parametrize("kind", DATASETS, ids=str)


def test_any_json(sandbox: Sandbox, kind: Kind) -> None:
    try_any_json(sandbox, kind, 12)


def test_one_mutation(sandbox: Sandbox, kind: Kind) -> None:
    try_mutations(sandbox, kind, 40)


def test_damaged_bytes(sandbox: Sandbox, kind: Kind) -> None:
    try_damage(sandbox, kind, 12)
