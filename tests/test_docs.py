"""The pages that people read: lines that fit, links that lead somewhere."""

import ast
import re
import shlex
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import tyro

from skyproof.errors import SkyproofError
from skyproof.main import load_command

ROOT = Path(__file__).parents[1]
LONGEST = 100
# Tables that `skyproof report` writes.
GENERATED = ROOT / "docs" / "results" / "quick"


def pages():
    """Every Markdown page that somebody wrote, and its text."""
    found = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return {
        path: path.read_text(encoding="utf-8")
        for path in sorted(found)
        if GENERATED not in path.parents
    }


def long_lines(text):
    """Lines beyond 100 columns; rows of tables and the addresses of links cannot be broken."""
    return [
        line
        for line in text.split("\n")
        if not line.startswith("|") and len(re.sub(r"\]\([^)]*\)", "]", line)) > LONGEST
    ]


def prose(text):
    """A page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(text):
    """The anchors that a page's headings have on GitHub and, with the same rule, on the site."""
    headings = re.findall(r"^#+ (.+)$", prose(text), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(path, text):
    """Relative links of a page that lead to no file, or to no heading of it."""
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        found = file.exists()
        if found and anchor:
            found = anchor in anchors(file.read_text(encoding="utf-8"))
        if not found:
            broken.append(target)
    return broken


def commands(text):
    """The words of every `skyproof` command line in a page's code blocks, without placeholders."""
    found = []
    for block in re.findall(r"^```\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").split("\n"):
            line = re.sub(r"^(\.venv/bin/skyproof|\$S)\b", "skyproof", line.strip())
            if line.startswith("skyproof ") and not re.search(r"\.\.\.|…|COMMAND|\w\|\w", line):
                found.append(shlex.split(line, comments=True)[1:])
    return found


def unparsable(text):
    """The command lines of a page that the program would refuse: unknown commands and options."""
    refused = []
    for words in commands(text):
        try:
            tyro.cli(load_command(words[0]), args=words[1:], console_outputs=False)
        except (SystemExit, SkyproofError):
            refused.append(" ".join(words))
    return refused


def missing_names(text):
    """Names of skyproof that a page's Python uses, and that do not exist."""
    missing = []
    for block in re.findall(r"^```python\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("skyproof"):
                place, names = node.module, [alias.name for alias in node.names]
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "sp":
                place, names = "skyproof", [node.attr]
            else:
                continue
            module = import_module(place) if find_spec(place) else None
            missing += [f"{place}.{name}" for name in names if not hasattr(module, name)]
    return missing


def test_python_in_the_docs_names_what_exists():
    missing = {path.name: missing_names(text) for path, text in pages().items()}
    assert {name: names for name, names in missing.items() if names} == {}


def test_the_readme_is_short():
    assert (ROOT / "README.md").read_text(encoding="utf-8").count("\n") <= 130


def test_commands_in_the_docs_are_ones_that_the_program_takes():
    refused = {path.name: unparsable(text) for path, text in pages().items()}
    assert {name: lines for name, lines in refused.items() if lines} == {}


def test_lines_fit_in_100_columns():
    assert {path.name: long_lines(text) for path, text in pages().items() if long_lines(text)} == {}


def test_relative_links_lead_to_a_file_and_a_heading():
    broken = {path.name: broken_links(path, text) for path, text in pages().items()}
    assert {name: links for name, links in broken.items() if links} == {}


def test_these_checks_can_fail(tmp_path):
    assert long_lines("x" * 101 + "\n|" + "x" * 100) == ["x" * 101]
    assert long_lines("[a](https://" + "x" * 100 + ")") == []
    block = "```\n$S scenes --backgrounds b \\\n  --fleet f --out o\nskyproof paint --red\n```\n"
    assert unparsable(block + "```\nskyproof scenes --blue\n```\n") == [
        "paint --red",
        "scenes --blue",
    ]
    block = "```python\nimport skyproof as sp\nfrom skyproof.errors import Sorry\nsp.attack\n```\n"
    assert missing_names(block + "```python\nsp.surrender\n```\n") == [
        "skyproof.errors.Sorry",
        "skyproof.surrender",
    ]
    page = tmp_path / "page.md"
    page.write_text("# What is *this*, then?\n[a](#what-is-this-then) [b](#what) [c](nowhere.md)\n")
    assert broken_links(page, page.read_text()) == ["#what", "nowhere.md"]
