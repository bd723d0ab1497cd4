"""The paper's tables as parts of the report and as files of their own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from skyproof.paper.cells import Block, Figure, Grid, Heading, as_markdown
from skyproof.paper.page import paper_sections, shape_table, standing, texture_table
from skyproof.paper.reproduction import Reproduction
from skyproof.paper.tables import reproduction_tables
from skyproof.report.colour_figure import colour_figure
from skyproof.report.embedding_figure import embedding_figure
from skyproof.report.gate import read_gate
from skyproof.report.judges_figure import judges_figure
from skyproof.report.looks_figures import looks_figures
from skyproof.report.practicality_figure import easr_against_practicality
from skyproof.report.variability_figure import variability_figure
from skyproof.report.weather_figure import weather_figure
from skyproof.results.results import Results


@dataclass(frozen=True)
class PaperPart:
    """What a report shows of the paper.

    Attributes:
        html: tables, figure and text for the page.
        files: what is written beside it, by file name, the page in Markdown last.
    """

    html: Markup
    files: Mapping[str, bytes]


def paper_part(results: Results) -> PaperPart | None:
    """Sets a run beside the paper; None where too few of the paper's attacks were scored.

    Raises:
        ConfigurationError: the magnitudes of a shape were judged by different detectors.
    """
    run = Reproduction(results)
    if not run.comparable:
        return None
    tables = reproduction_tables(run)
    figures = {
        "easr_vs_pr": easr_against_practicality(run),
        "colours": colour_figure(run),
        "variability": variability_figure(run),
        **looks_figures(run),
    }
    figures |= {f"judges-{table}": judges_figure(run, table) for table in run.judges}
    if "embedding_points" in tables:
        figures["embeddings"] = embedding_figure(tables["embedding_points"], tables["embeddings"])
    if "weather" in tables:
        figures["weather"] = weather_figure(tables["weather"])
    # Where a run lacks what a figure shows there is none.
    blocks = [
        block
        for block in paper_sections(run, tables)
        if not isinstance(block, Figure) or figures[block.name]
    ]
    files = {f"{name}.csv": table.csv().encode() for name, table in tables.items()}
    files["textures.md"] = (texture_table(tables["textures"]).markdown() + "\n").encode()
    files["shape_combined.md"] = (shape_table(tables["shape_combined"]).markdown() + "\n").encode()
    files |= {
        f"{name}.{ending}": picture
        for name, pictures in figures.items()
        for ending, picture in pictures.items()
    }
    files["README.md"] = as_markdown([*_preamble(run), *blocks, *_files(list(tables))]).encode()
    drawn = {
        name: Markup(_inline(pictures["svg"].decode()))
        for name, pictures in figures.items()
        if pictures
    }
    return PaperPart(Markup("\n").join(_html(block, drawn) for block in blocks), files)


def _preamble(run: Reproduction) -> list[Block]:
    """Says what stands above the tables where they are a page of their own."""
    title = run.results.config.title or "The paper’s tables"
    gate = " ".join(read_gate(run.results).sentences)
    parts: list[Block] = [Heading(title, 1), f"**Worth attacking?** {gate}"]
    scores = standing(run)
    checked = f" (AP with centres within 1 m: {scores})" if scores else ""
    real = any(check.real for check in run.results.checks)
    if run.results.sources == ["procedural"] and not real:
        parts.append(
            "**Synthetic data only.** Ground and vehicles are computer-generated, and the "
            f"detectors were trained and checked on such images alone{checked}, not on real ones. "
            "The numbers say how attacks compare in that world; they are not evidence about real "
            "imagery."
        )
    else:
        parts.append(
            f"Every vehicle that is tested is computer-generated{checked}. The numbers say how "
            "attacks compare on rendered vehicles; they are not evidence about painted ones."
        )
    return [*parts, *_about(run)]


def _about(run: Reproduction) -> list[Block]:
    about = run.results.environment
    if not about:
        return []
    versions = [f"{name} {about.get(name) or '–'}" for name in ("skyproof", "commit", "torch")]
    commands = "; ".join(f"`{command}`" for command in about.get("commands", []))
    lines = [
        f"- {commands}",
        f"- {', '.join(versions)}",
        f"- {about.get('cores') or '–'} cores of {about.get('cpu') or '–'}, device "
        f"{about.get('device') or '–'}; started {about.get('started') or '–'}",
    ]
    if run.hours:
        lines.append(f"- all jobs together {run.hours:.1f} h")
    return ["\n".join(lines)]


def _files(names: Sequence[str]) -> list[Block]:
    return [Heading("Files"), "\n".join(f"- [{name}.csv]({name}.csv)" for name in names)]


def _html(block: Block, drawn: Mapping[str, Markup]) -> Markup:
    if isinstance(block, Heading):
        level = block.level + 1
        return Markup("<h{0}>{1}</h{0}>").format(level, block.text)
    if isinstance(block, Figure):
        return Markup(
            '<figure class="wide"><div class="scroll">{}</div><figcaption>{}</figcaption></figure>'
        ).format(drawn[block.name], block.caption)
    if isinstance(block, Grid):
        return _grid(block)
    return Markup("<p>{}</p>").format(block)


def _grid(grid: Grid) -> Markup:
    head = Markup("").join(Markup("<th>{}</th>").format(cell) for cell in grid.header)
    lines = [
        Markup("<tr>{}</tr>").format(
            Markup("").join(Markup("<td>{}</td>").format(_breakable(cell)) for cell in row)
        )
        for row in grid.rows
    ]
    return Markup(
        '<div class="scroll"><table class="plain"><thead><tr>{}</tr></thead>\n'
        "<tbody>{}</tbody></table></div>"
    ).format(head, Markup("\n").join(lines))


def _breakable(cell: str) -> Markup:
    """An interval goes below its value."""
    value, bracket, limits = cell.partition(" (")
    if not bracket:
        return escape(cell)
    return Markup('{}<br><span class="soft">({}</span>').format(value, limits)


def _inline(svg: str) -> str:
    return re.sub(r"^.*?(?=<svg)", "", svg, flags=re.DOTALL)
