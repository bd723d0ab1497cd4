"""Shape annotations are checked at run time in tests.

Each worker has one thread, because two workers share two cores.
"""

import os
from pathlib import Path

from jaxtyping import install_import_hook

os.environ.setdefault("OMP_NUM_THREADS", "1")
SOURCES = Path(__file__).parents[1] / "src"
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
