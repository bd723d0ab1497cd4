"""What holds in all tests.

Shape annotations are checked but in whole runs, commands judge on few scenes, and equal figures are
drawn once.

Each worker has one thread, because two workers share two cores.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxtyping import config as jaxtyping
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
# Checking shapes takes 30 % of the time of what renders or attacks, and the tests of each room have
# checked them.
WHOLE_RUNS = {"assessment", "cli", "generator", "hostile", "reproduction"}

import pytest  # noqa: E402
import torch  # noqa: E402

from tests.drawn_once import figures_are_drawn_once  # noqa: E402
from tests.expert_options import expert_options  # noqa: E402
from tests.few_scenes import few_scenes_judge  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def few_scenes() -> Iterator[None]:
    """Commands judge what they learn or choose on few scenes."""
    with few_scenes_judge():
        yield


@pytest.fixture(scope="session", autouse=True)
def every_setting() -> Iterator[None]:
    """Commands take settings that the command line does not show."""
    with expert_options():
        yield


@pytest.fixture(scope="session", autouse=True)
def drawn_once() -> Iterator[None]:
    """A report whose numbers stay draws no figure again."""
    with figures_are_drawn_once():
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Checks shapes in the tests of one room, and not in whole runs."""
    whole = item.get_closest_marker("slow") or WHOLE_RUNS & set(item.path.parts)
    jaxtyping.update("jaxtyping_disable", bool(whole))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keeps a file's tests in one process, and all that share the world of tests/hostile."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler.loadfile import LoadFileScheduling

    class Files(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            hostile = nodeid.startswith("tests/hostile/")
            return "tests/hostile" if hostile else super()._split_scope(nodeid)

    return Files(config, log)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Torch has two threads, as on two cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)
