"""The documents that the hostile ones are made of are read: a refusal is not for another reason."""

import pytest

from tests.hostile.kinds import JSON_KINDS, TEXTS
from tests.hostile.sandbox import Kind, Sandbox


@pytest.mark.parametrize("kind", [*JSON_KINDS, *TEXTS], ids=str)
def test_a_valid_document_is_taken(sandbox: Sandbox, kind: Kind) -> None:
    assert sandbox.try_document(kind, (sandbox.inputs / kind.document).read_bytes()) == 0
