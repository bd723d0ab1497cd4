"""Every promise of SECURITY.md names tests that exist."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "SECURITY.md", ROOT / "docs" / "reliability.md")


def missing_tests(text: str) -> list[str]:
    """Tests, and files of tests, that a page names and that do not exist."""
    missing = []
    for path, _, name in re.findall(r"(tests/[\w/]+(?:\.py)?)(::(\w+))?", text):
        file = ROOT / path
        if not file.exists():
            missing.append(path)
        elif name:
            tree = ast.parse(file.read_text(encoding="utf-8"))
            known = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            missing += [f"{path}::{name}"] * (name not in known)
    return missing


def promises(text: str) -> dict[str, list[str]]:
    """The promises of a page, each with the tests that it names."""
    part = text.partition("## Promises")[2].partition("\n## ")[0]
    return {
        re.match(r"\*\*(.+?)\*\*", item)[1]: re.findall(r"tests/[\w/]+\.py::\w+", item)  # type: ignore[index]
        for item in re.split(r"^- ", part, flags=re.MULTILINE)[1:]
    }


def test_named_tests_exist() -> None:
    assert {page.name: missing_tests(page.read_text(encoding="utf-8")) for page in PAGES} == {
        page.name: [] for page in PAGES
    }


def test_every_promise_names_a_test() -> None:
    found = promises((ROOT / "SECURITY.md").read_text(encoding="utf-8"))
    assert len(found) >= 7
    assert [promise for promise, tests in found.items() if not tests] == []


def test_these_checks_can_fail() -> None:
    text = "`tests/test_files.py::test_nothing`, `tests/nowhere.py`, `tests/test_files.py`"
    assert missing_tests(text) == ["tests/test_files.py::test_nothing", "tests/nowhere.py"]
    page = "## Promises\n- **A.** `tests/a.py::test_a`\n- **B.** Nothing.\n## What\n- **C.**"
    assert promises(page) == {"A.": ["tests/a.py::test_a"], "B.": []}
