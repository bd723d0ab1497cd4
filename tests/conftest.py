"""Shape annotations are checked at run time in tests, and a folder's tests share a process.

Each worker has one thread, because two workers share two cores.
"""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

os.environ.setdefault("OMP_NUM_THREADS", "1")
TESTS = Path(__file__).parent
SOURCES = TESTS.parent / "src"
# Of modules without arrays mypy says as much, and checking each of their calls took 7 and 15 % of
# the time of the two test files where it was measured.
SHAPED = [
    ".".join(file.relative_to(SOURCES).with_suffix("").parts)
    for file in sorted(SOURCES.rglob("*.py"))
    if "jaxtyping import" in file.read_text(encoding="utf-8")
]
install_import_hook(SHAPED, "beartype.beartype")

import torch  # noqa: E402

torch.set_num_threads(1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Groups tests by folder for `--dist loadgroup`.

    So what they share, such as a finished run, is made once and not once in every process.
    """
    for item in items:
        folder = item.path.relative_to(TESTS).parts[0]
        item.add_marker(pytest.mark.xdist_group(folder))
