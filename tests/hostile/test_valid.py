"""The documents that the hostile ones are made of are read: a refusal is not for another reason."""

import pytest

from tests.hostile import kinds
from tests.hostile.sandbox import Kind, Sandbox

ALL = [*kinds.SCENES, *kinds.GROUND, *kinds.DATASETS, *kinds.LABELS, *kinds.TEXTS, *kinds.CARDS]
ALL += [*kinds.SCORES, *kinds.RUNS]


@pytest.mark.parametrize("kind", ALL, ids=str)
def test_a_valid_document_is_taken(sandbox: Sandbox, kind: Kind) -> None:
    assert sandbox.try_document(kind, (sandbox.inputs / kind.document).read_bytes()) == 0
