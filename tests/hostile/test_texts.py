"""Text files of others: YOLO boxes and classes, boxes of DOTA, VisDrone and Pascal VOC."""

import pytest

from tests.hostile.documents import try_contents, try_damage
from tests.hostile.kinds import TEXTS
from tests.hostile.sandbox import Kind, Sandbox
from tests.hostile.values import mutated_text

pytestmark = [pytest.mark.slow, pytest.mark.parametrize("kind", TEXTS, ids=str)]


def test_one_word_or_line(sandbox: Sandbox, kind: Kind) -> None:
    text = (sandbox.inputs / kind.document).read_text()
    try_contents(sandbox, kind, mutated_text(text), 50)


def test_damaged_bytes(sandbox: Sandbox, kind: Kind) -> None:
    try_damage(sandbox, kind, 20)
