"""Settings that the command line does not show, as options, so that tests can be tiny."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tyro._arguments import ArgumentDefinition

from skyproof import main


@contextmanager
def expert_options() -> Iterator[None]:
    """Commands take every setting as an option inside the block."""
    parse = main._parse

    def parse_all(*given):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ArgumentDefinition, "is_suppressed", lambda _: False)
            return parse(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(main, "_parse", parse_all)
        yield


PROGRAM = (
    "from skyproof.main import main\n"
    "from tests.expert_options import expert_options\n"
    "with expert_options():\n"
    "    main()\n"
)
"""What a process of its own runs instead of `-m skyproof`; the checkout is on its path."""
