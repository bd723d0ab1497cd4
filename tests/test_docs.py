"""The pages that people read: plain English, lines that fit, links that lead somewhere."""

import ast
import inspect
import io
import re
import shlex
from contextlib import redirect_stdout, suppress
from dataclasses import is_dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import get_args, get_type_hints

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

MOST_NAMES = 24
MOST_COMMANDS = 14
MOST_OPTIONS = 130

# Command lines and names of the docs that the program does not have yet.
COMING: set[str] = set()


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


def public_names():
    """The names of `import skyproof as sp`."""
    stub = (SOURCE / "__init__.pyi").read_text(encoding="utf-8")
    return re.findall(r" as (\w+)$", stub, flags=re.MULTILINE)


def used_names():
    """The public names that the Python of the pages and of the examples uses."""
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py"))
    for text in pages().values():
        code += "".join(re.findall(r"^```python\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL))
    return {*re.findall(r"\bsp\.(\w+)", code)}


def command_names():
    """The names of all commands."""
    return sorted(name for group in COMMANDS.values() for name in group)


def help_of(command):
    """The lines that `skyproof COMMAND --help` prints into a file."""
    said = io.StringIO()
    with redirect_stdout(said), suppress(SystemExit):
        tyro.cli(load_command(command), args=["--help"])
    return said.getvalue().splitlines()


def options_of(command):
    """The options that a user sees, nested and positional ones too, without --help."""
    lines = help_of(command)
    return [line.split()[0] for line in lines if re.match(r"  (--\w|[A-Z[])", line)]


def unknown_options(text, known):
    """The options in a page's sentences that no command has."""
    code = re.findall(r"`([^`\n]*)`", prose(text))
    named = {option for each in code for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*", each)}
    return named - known - {"--help", "--version"}


def option_classes(command):
    """A command's dataclass, those that it inherits from, and those of its nested settings."""
    found, waiting = [], [load_command(command)]
    while waiting:
        kind = waiting.pop()
        if is_dataclass(kind) and kind not in found:
            found += [base for base in kind.__mro__ if is_dataclass(base)]
            waiting += get_type_hints(kind).values()
        waiting += get_args(kind)
    return found


def all_words(place):
    """The words of a page, or of every page below a folder."""
    path = ROOT / place
    files = path.rglob("*.md") if path.is_dir() else [path]
    return sum(words(file.read_text(encoding="utf-8")) for file in files)


def test_python_in_the_docs_names_what_exists():
    missing = {path.name: {*missing_names(text)} - COMING for path, text in pages().items()}
    assert {name: names for name, names in missing.items() if names} == {}


def test_public_names_are_few_and_used():
    assert len(public_names()) <= MOST_NAMES
    assert {*public_names()} - used_names() == set()


def test_commands_and_options_are_few():
    options = {command: options_of(command) for command in command_names()}
    assert len(options) <= MOST_COMMANDS
    assert sum(map(len, options.values())) <= MOST_OPTIONS, options


def test_docs_keep_to_their_budgets():
    counted = {place: all_words(place) for place in BUDGETS}
    assert {place: many for place, many in counted.items() if many > BUDGETS[place]} == {}


@pytest.mark.parametrize(
    ("measure", "budget"), [(headless, HEADLESS), (wheres, WHERE), (semicolons, SEMICOLONS)]
)
def test_pages_are_in_plain_english(measure, budget):
    texts = {path.relative_to(ROOT).as_posix(): text for path, text in pages().items()}
    found = {name: measure(text) for name, text in texts.items()}
    assert {name: bad for name, bad in found.items() if too_many(bad, budget, texts[name])} == {}, (
        "too many in these pages"
    )
    everything = "\n\n".join(texts.values())
    assert not too_many(measure(everything), budget, everything), found


def test_pages_keep_to_the_glossary():
    found = {path.name: forbidden_words(text) for path, text in pages().items()}
    assert {name: bad for name, bad in found.items() if bad} == {}


@pytest.mark.parametrize("command", command_names())
def test_options_are_told_in_plain_english(command):
    for kind in option_classes(command):
        assert begins_with_a_preposition(inspect.getsource(kind)) == []
        assert forbidden_words(inspect.getdoc(kind)) == []


def test_public_names_commands_and_options_keep_to_the_glossary():
    names = public_names()
    for command in command_names():
        names += [command, *options_of(command)]
    assert forbidden_names(names) == []


def test_commands_in_the_docs_are_ones_that_the_program_takes():
    refused = {path.name: {*unparsable(text)} - COMING for path, text in pages().items()}
    assert {name: lines for name, lines in refused.items() if lines} == {}


def test_options_in_the_docs_exist():
    known = {name.rstrip(",") for command in command_names() for name in options_of(command)}
    unknown = {path.name: unknown_options(text, known) for path, text in pages().items()}
    assert {name: options for name, options in unknown.items() if options} == {}


def test_lines_fit_in_100_columns():
    assert {path.name: long_lines(text) for path, text in pages().items() if long_lines(text)} == {}


def test_relative_links_lead_to_a_file_and_a_heading():
    broken = {path.name: broken_links(path, text) for path, text in pages().items()}
    assert {name: links for name, links in broken.items() if links} == {}


def test_these_checks_can_fail(tmp_path):
    assert long_lines("x" * 101 + "\n|" + "x" * 100) == ["x" * 101]
    assert long_lines("[a](https://" + "x" * 100 + ")") == []
    block = "```\n$S render --backgrounds b \\\n  --fleet f --out o\nskyproof paint --red\n```\n"
    block += "```\nskyproof render --blue\nskyproof score --detectors a --out b --workers 2\n```\n"
    assert unparsable(block) == [
        "paint --red",
        "render --blue",
        "score --detectors a --out b --workers 2",
    ]
    assert unknown_options("`--red 2`, `-b --blue`", {"--red"}) == {"--blue"}
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
