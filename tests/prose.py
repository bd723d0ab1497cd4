"""Measures of plain English: of the pages, and of the texts that become `--help`.

The budgets are those of docs that read well. The docs of Foolbox, httpx, SAHI, supervision, Equinox
and PyTorch3D have up to 0.6 headless "what", 2.1 "where" and 2.7 semicolons per 1,000 words.
Measured by these functions, the descriptions of the packages that skyproof builds on have 0.5, 0.6
and 2.7 (91,000 words).
"""

import ast
import re
from fractions import Fraction

# Per 1,000 words of prose.
HEADLESS = Fraction(6, 10)
WHERE = Fraction(2)
SEMICOLONS = Fraction(3)

# A clause without a head has no noun to stand for: "what hides it", "whoever can write",
# "nobody looks there". "The reader who asks" has one.
_HEADLESS = re.compile(
    r"\b(what|whatever|whoever|whichever is|nobody)\b"
    r"|(?:^|[.,:;(]\s+|\b(?:and|or|of|to|by|for|from|with|that|say|says|knows)\s+)who\b",
    re.IGNORECASE,
)
_WHERE = re.compile(r"\bwhere\b", re.IGNORECASE)

# Words for which docs/conventions.md has another: as a pattern, and the word to use.
GLOSSARY = {
    r"clean (?:AP|recall|precision|set|images?)": "baseline",
    r"judges?(?! by|\.csv)": "held-out detector",
    r"teachers?": "detector",
    r"gates?": "precheck",
    r"worth attacking": "precheck",
    r"unlearnt": "control",
    r"(?:nobody|never) learnt": "control",
    r"learnt (?:texture|camouflage|shape|pattern|colour|palette)s?": "optimised",
    r"by (?:its |their |the detector's )?answers": "query attack",
    r"answers alone": "black-box detector",
    r"(?<!clear )coats?": "paint",
    r"embeddings?(?!\.csv)": "features",
    r"headlines?": "result",
    r"(?:wears?|worn|wearing)": "with the camouflage",
    r"half a vehicle (?:finds|counts)": "lenient rule",
    r"vehicles? (?:is |are )?lost": "missed or hidden",
}
# The same for names of the public face, commands and options, word by word.
NAMES = {"judge", "judges", "teacher", "gate", "clean", "recipe", "coat", "coats"} | {
    "embedding", "embeddings", "looks", "answers", "asked", "unlearnt", "headline", "box", "worn"
}  # fmt: skip

_PREPOSITIONS = {
    "about", "across", "after", "against", "among", "as", "at", "before", "below", "beside",
    "between", "beyond", "by", "for", "from", "in", "into", "of", "on", "onto", "over", "per",
    "than", "through", "to", "under", "until", "with", "within", "without",
}  # fmt: skip


def prose(page):
    """A page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", page, flags=re.MULTILINE | re.DOTALL)


def sentences(page):
    """What a page says: its paragraphs, list items and table cells, as plain sentences.

    Left out are code, headings, heads of tables, the addresses of links, and questions.
    """
    text = prose(page)
    text = re.sub(r"^\|.*\n(?=\|[ :|-]+\n)", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(#.*|\|[ :|-]+)$", "", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "CODE", text)
    text = re.sub(r"\s*\|\s*", ".\n\n", text)
    text = re.sub(r"^\s*(?:[-*]|\d+\.)\s", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"[*_]{1,2}", "", text)
    found = []
    for paragraph in re.split(r"\n\s*\n", text):
        line = " ".join(paragraph.split())
        found += [part for part in re.split(r"(?<=[.!?:])\s+", line) if re.search(r"\w", part)]
    return [sentence for sentence in found if not sentence.endswith("?")]


def words(text):
    """The number of words, as `wc -w` counts them."""
    return len(text.split())


def headless(page):
    """The sentences with a headless "what", "who", "whoever" or "nobody"."""
    return [sentence for sentence in sentences(page) for _ in _HEADLESS.finditer(sentence)]


def wheres(page):
    """The sentences with a "where"."""
    return [sentence for sentence in sentences(page) for _ in _WHERE.finditer(sentence)]


def semicolons(page):
    """The sentences with a semicolon."""
    return [sentence for sentence in sentences(page) for _ in re.finditer(";", sentence)]


def too_many(found, budget, text):
    """Whether a page has more of something than its budget allows; a short page may have one."""
    return len(found) > max(1, budget * sum(map(words, sentences(text))) / 1000)


def forbidden_words(text):
    """Words of a text for which the glossary has another."""
    found = []
    for sentence in sentences(text):
        for pattern, better in GLOSSARY.items():
            found += [
                f"{match.group()!r} is {better}: {sentence}"
                for match in re.finditer(rf"\b{pattern}\b", sentence, re.IGNORECASE)
            ]
    return found


def forbidden_names(names):
    """Names of which a word, split at capitals, underscores and hyphens, is forbidden."""
    return [
        name
        for name in names
        if NAMES & {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}
    ]


def option_texts(source):
    """What the docstrings of a module's classes say of their attributes: `Class.name` to text."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.ClassDef):
            continue
        _, _, section = (ast.get_docstring(node) or "").partition("Attributes:\n")
        # Further lines of a text are indented deeper.
        for entry in re.findall(r"^    (\w.*(?:\n     +.*)*)", section, flags=re.MULTILINE):
            names, _, text = entry.partition(":")
            for name in names.split(","):
                found[f"{node.name}.{name.strip()}"] = " ".join(text.split())
    return found


def begins_with_a_preposition(source):
    """The attributes whose text lacks its subject: "seed: of the bootstrap."."""
    return [
        f"{name}: {text}"
        for name, text in option_texts(source).items()
        if text and re.split(r"\W", text)[0].lower() in _PREPOSITIONS
    ]
