"""The pages that people read: plain English, lines that fit, links that lead somewhere."""

import ast
import re
import shlex
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import tyro

from skyproof.errors import SkyproofError
from skyproof.main import COMMANDS, load_command
from tests.prose import (
    HEADLESS,
    SEMICOLONS,
    WHERE,
    begins_with_a_preposition,
    forbidden_names,
    forbidden_words,
    headless,
    option_texts,
    prose,
    semicolons,
    sentences,
    too_many,
    wheres,
    words,
)

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "skyproof"
LONGEST = 100
# The most words of a page, or of all Markdown below a folder, tables and code included.
BUDGETS = {"README.md": 700, "CHANGELOG.md": 1_000, "docs": 35_000, "docs/results": 8_000}

# Pages that are still to be rewritten in plain English, and budgets that are still to be kept.
NOT_YET: set[str] = set()
NOT_YET_SHORT: set[str] = set()
# Rooms of the code whose option texts are still to be rewritten, and names still to be changed.
NOT_YET_ROOMS = {
    "assessment",
    "attacks",
    "camouflage",
    "cli",
    "cycles",
    "datasets",
    "detectors",
    "files.py",
    "gate",
    "generator",
    "imagery",
    "layout.py",
    "loop.py",
    "maite",
    "measure",
    "paper",
    "plans",
    "render",
    "report",
    "reproduction",
    "results",
    "scenes",
    "vehicles",
}
NOT_YET_NAMES = {"GateRecord", "CleanSet"}
# Command lines and names of the docs that the program does not have yet.
COMING = {"render --backgrounds $T/cleared --fleet $F --split train --count 2000 --out $T/rendered"}


def pages():
    """Every Markdown page and its text."""
    found = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return {path: path.read_text(encoding="utf-8") for path in sorted(found)}


def long_lines(text):
    """Lines beyond 100 columns; rows of tables and the addresses of links cannot be broken."""
    return [
        line
        for line in text.split("\n")
        if not line.startswith("|") and len(re.sub(r"\]\([^)]*\)", "]", line)) > LONGEST
    ]


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
    for command, *options in commands(text):
        try:
            tyro.cli(load_command(command), args=options, console_outputs=False)
        except (SystemExit, SkyproofError):
            refused.append(" ".join([command, *options]))
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


def plain_pages():
    """The pages that are written in plain English, by their paths below the root."""
    found = {path.relative_to(ROOT).as_posix(): text for path, text in pages().items()}
    assert set(found) >= NOT_YET
    return {name: text for name, text in found.items() if name not in NOT_YET}


def room_texts():
    """The sources of the modules whose option texts are in plain English, by their paths."""
    paths = [path.relative_to(SOURCE) for path in sorted(SOURCE.rglob("*.py"))]
    return {
        path.as_posix(): (SOURCE / path).read_text(encoding="utf-8")
        for path in paths
        if path.parts[0] not in NOT_YET_ROOMS
    }


def all_words(place):
    """The words of a page, or of every page below a folder."""
    path = ROOT / place
    files = path.rglob("*.md") if path.is_dir() else [path]
    return sum(words(file.read_text(encoding="utf-8")) for file in files)


def test_python_in_the_docs_names_what_exists():
    missing = {path.name: {*missing_names(text)} - COMING for path, text in pages().items()}
    assert {name: names for name, names in missing.items() if names} == {}


def test_docs_keep_to_their_budgets():
    counted = {place: all_words(place) for place in BUDGETS if place not in NOT_YET_SHORT}
    assert {place: many for place, many in counted.items() if many > BUDGETS[place]} == {}


@pytest.mark.parametrize(
    ("measure", "budget"), [(headless, HEADLESS), (wheres, WHERE), (semicolons, SEMICOLONS)]
)
def test_pages_are_in_plain_english(measure, budget):
    pages = plain_pages()
    found = {name: measure(text) for name, text in pages.items()}
    assert {name: bad for name, bad in found.items() if too_many(bad, budget, pages[name])} == {}, (
        "too many in these pages"
    )
    everything = "\n\n".join(pages.values())
    assert not too_many(measure(everything), budget, everything), found


def test_pages_keep_to_the_glossary():
    found = {name: forbidden_words(text) for name, text in plain_pages().items()}
    assert {name: bad for name, bad in found.items() if bad} == {}


def test_option_texts_have_a_subject():
    found = {name: begins_with_a_preposition(text) for name, text in room_texts().items()}
    assert {name: bad for name, bad in found.items() if bad} == {}


def test_option_texts_keep_to_the_glossary():
    found = {
        name: forbidden_words("\n\n".join(option_texts(text).values()))
        for name, text in room_texts().items()
    }
    assert {name: bad for name, bad in found.items() if bad} == {}


def test_public_names_and_commands_keep_to_the_glossary():
    stub = (SOURCE / "__init__.pyi").read_text(encoding="utf-8")
    public = re.findall(r" as (\w+)$", stub, flags=re.MULTILINE)
    options = [name for path, text in room_texts().items() if path.startswith("cli/")
               for name in option_texts(text)]  # fmt: skip
    names = [*public, *(name for group in COMMANDS.values() for name in group), *options]
    assert {*forbidden_names(names)} - NOT_YET_NAMES == set()


def test_commands_in_the_docs_are_ones_that_the_program_takes():
    refused = {path.name: {*unparsable(text)} - COMING for path, text in pages().items()}
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


def test_measures_of_plain_english_can_fail():
    page = """# What stands in a heading is free

| what | where |
| -- | -- |
| nobody looks | here |

What is a threshold? It says what `what` found, where it is; whoever asks
is told. A user who asks knows who answers: [them](https://what.where).

```
what, where; nobody
```
"""
    assert [words(sentence) for sentence in sentences(page)] == [2, 1, 12, 7, 1]
    assert len(headless(page)) == 4
    assert len(wheres(page)) == len(semicolons(page)) == 1
    assert too_many(headless(page), HEADLESS, page)
    assert too_many(wheres(page) * 2, WHERE, page)
    assert not too_many(wheres(page), WHERE, page)
    assert not too_many(wheres(page) * 2, WHERE, page + "\n\n" + "word " * 1000)


def test_the_glossary_can_fail():
    assert len(forbidden_words("The gates judge a learnt texture.\n\n`gate`, judged by eye")) == 3
    assert forbidden_words("Vehicles learnt from photographs are found by the baseline.") == []
    names = ["GateRecord", "LoadedDetector", "Looks.seed", "--in-a-box", "Boxes"]
    assert forbidden_names(names) == ["GateRecord", "Looks.seed", "--in-a-box"]


def test_option_texts_can_fail():
    source = '''
class Draws:
    """Draws.

    Attributes:
        seed: of every
            random number.
        height, width: sides in pixels.
        draws: number of draws; of each
            control.
    """
'''
    assert option_texts(source) == {
        "Draws.seed": "of every random number.",
        "Draws.height": "sides in pixels.",
        "Draws.width": "sides in pixels.",
        "Draws.draws": "number of draws; of each control.",
    }
    assert begins_with_a_preposition(source) == ["Draws.seed: of every random number."]
