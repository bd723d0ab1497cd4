"""What the site has beside docs/: pages of the root folder, and a reference page for every room."""

import ast
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "skyproof"
# Pages of the root folder and their names on the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
_TITLES = {"skyproof": "used by all rooms"}


def rooms() -> dict[str, list[str]]:
    """The modules of every room by its name; those beside the rooms stand in room "skyproof".

    The command line is left out: `skyproof COMMAND --help` is made from the same docstrings.
    """
    found: dict[str, list[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] == "__main__" or parts == ("__init__",):
            continue
        room = parts[0] if len(parts) > 1 else "skyproof"
        if room == "cli":
            continue
        module = [part for part in parts if part != "__init__"]
        found.setdefault(room, []).append(".".join(["skyproof", *module]))
    return found


def summary(module: str, name: str) -> str:
    """The first sentence of what a module says about one of its names."""
    path = PACKAGE.parent / (module.replace(".", "/") + ".py")
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return ""


def public_names() -> str:
    """A page of the names that `import skyproof as sp` gives, as the package's stub tells them."""
    rows = []
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            module = f"skyproof.{node.module}"
            for alias in node.names:
                link = f"[`sp.{alias.name}`][{module}.{alias.name}]"
                rows.append(f"- {link}: {summary(module, alias.name)}")
    head = "# import skyproof as sp\n\nThese are the names that programs need.\n\n"
    return head + "\n".join(sorted(rows, key=str.lower)) + "\n"


def target_on_site(target: str, page: str) -> str | None:
    """Where a relative link of a page leads on the site; None where the site does not have it.

    Args:
        target: the link as it stands in the repository, relative to the page's file.
        page: the page's path below the repository's root.
    """
    path, _, anchor = target.partition("#")
    if not path:
        return target
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), path))
    here = PAGES.get(page, page.removeprefix("docs/"))
    if path in PAGES:
        there = PAGES[path]
    elif path.startswith("docs/"):
        there = path.removeprefix("docs/")
    elif (
        path.startswith("src/skyproof/")
        and not path.startswith("src/skyproof/cli/")
        and path.endswith(".py")
    ):
        module = path.removeprefix("src/").removesuffix(".py").removesuffix("/__init__").split("/")
        room = module[1] if len(module) > 2 or (PACKAGE / module[1]).is_dir() else "skyproof"
        there, anchor = f"reference/{room}.md", ".".join(module)
    else:
        return None
    there = posixpath.relpath(there, posixpath.dirname(here) or ".")
    return f"{there}#{anchor}" if anchor else there


def links_on_site(text: str, page: str) -> str:
    """A page with its relative links as the site needs them; links out of the site become text."""

    def link(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        if re.match(r"[a-z]+:", target):
            return match.group()
        there = target_on_site(target, page)
        return words if there is None else f"{picture}[{words}]({there})"

    # Every second part of the split is a code block.
    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    for index in range(0, len(parts), 2):
        parts[index] = re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", link, parts[index])
    return "".join(parts)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that do not lie in docs/."""
    for name, page in PAGES.items():
        text = links_on_site((ROOT / name).read_text(encoding="utf-8"), name)
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "reference/index.md", content=public_names()))
    for room, modules in rooms().items():
        text = (
            f"# {_TITLES.get(room, room)}\n\n"
            + "\n\n".join(f"::: {module}" for module in modules)
            + "\n"
        )
        files.append(File.generated(config, f"reference/{room}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns the links of a page in docs/ into links of the site."""
    if page.file.generated_by is not None:
        return markdown
    return links_on_site(markdown, f"docs/{page.file.src_uri}")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Appends the reference to the menu."""
    names: dict[str, str] = {"import skyproof as sp": "reference/index.md"}
    # The modules beside the rooms come last.
    order = sorted(rooms(), key=lambda room: (room in _TITLES, room))
    pages = [names, *({_TITLES.get(room, room): f"reference/{room}.md"} for room in order)]
    config.nav = [*(config.nav or []), {"Reference": pages}]
    return config
