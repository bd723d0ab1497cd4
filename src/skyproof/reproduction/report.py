"""A reproduction's report: the page of any run, and the paper's tables in it and beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup, escape

from skyproof.console import say
from skyproof.errors import RunFolderError
from skyproof.files import alone, write_bytes
from skyproof.report.precheck import precheck_part
from skyproof.report.report import Section, write_report
from skyproof.reproduction.agreement import agreement_part
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Heading,
    TextTable,
    Topic,
    as_markdown,
    number,
)
from skyproof.reproduction.colours import colours_part
from skyproof.reproduction.criteria import criteria_part
from skyproof.reproduction.cycles import cycles_part
from skyproof.reproduction.features import features_part
from skyproof.reproduction.held_out import held_out_part
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.looks import looks_part
from skyproof.reproduction.practicality import practicality_part
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.tables import main_part, shape_table, texture_table
from skyproof.reproduction.trainings import trainings_part
from skyproof.reproduction.transfer import transfer_part
from skyproof.reproduction.trust import trust_part
from skyproof.reproduction.variability import variability_part
from skyproof.reproduction.weather import weather_part
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER, Results
from skyproof.words import detector_name


def write_paper_report(*, out: Path) -> None:
    """Writes the report of the run folder `out`."""
    say(f"Report: {write_reproduction_report(out).resolve()}")


def write_reproduction_report(run_folder: str | Path) -> Path:
    """Writes the report of a run with the paper's tables in it, and `tables/` beside it.

    Without enough of the paper's attacks it is the report of any run, and there are no tables.

    Returns:
        The page's path.

    Raises:
        StoredFileError: nothing was scored yet, or a file is damaged; names the file.
        ConfigurationError: the scores do not belong together.
        RunFolderError: the page or the tables cannot be written, or `tables/` may not be ours.
    """
    results = Results.open(run_folder)
    layout = PaperLayout(results.folder)
    with alone(layout.tables):
        if layout.tables.exists() and not layout.results.exists():
            raise RunFolderError(
                f"{layout.tables} is there without a results.json beside it, so it may not be of "
                "skyproof and is not replaced; move it away."
            )
        part = paper_part(results)
        if part is None:
            return write_report(results)
        page = write_report(results, sections=[Section("Beside the paper", part.html)])
        for name, content in part.files.items():
            write_bytes(layout.tables / name, content)
    return page


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
        ConfigurationError: the magnitudes of a shape were scored by different detectors.
    """
    run = Reproduction(results)
    if not run.comparable:
        return None
    parts = _parts(run)
    tables = [table for part in parts for table in part.tables]
    # Where a run lacks what a figure shows there is none.
    blocks = [
        block
        for part in parts
        for block in part.blocks
        if not isinstance(block, Figure) or block.files
    ]
    textures, shapes, *_ = tables
    files = {f"{table.name}.csv": table.csv().encode() for table in tables}
    files["textures.md"] = (texture_table(textures.rows).markdown() + "\n").encode()
    files["shape_combined.md"] = (shape_table(shapes.rows).markdown() + "\n").encode()
    for figure in blocks:
        if isinstance(figure, Figure):
            files |= {f"{figure.name}.{ending}": data for ending, data in figure.files.items()}
    names = [table.name for table in tables]
    files["README.md"] = as_markdown([*_preamble(run), *blocks, *_files(names)]).encode()
    return PaperPart(Markup("\n").join(map(_html, blocks)), files)


def _parts(run: Reproduction) -> list[Topic]:
    """The topics of the report, in its order."""
    main = main_part(run)
    textures, shapes, _ = main.tables
    rows = [*textures.rows, *shapes.rows]
    return [
        main,
        agreement_part(run),
        cycles_part(run, rows),
        held_out_part(run),
        trust_part(run, rows),
        criteria_part(run),
        transfer_part(run),
        trainings_part(run),
        weather_part(run),
        features_part(run),
        practicality_part(run),
        colours_part(run),
        variability_part(run),
        looks_part(run),
    ]


def _preamble(run: Reproduction) -> list[Block]:
    """Says what stands above the tables where they are a page of their own."""
    title = run.results.config.title or "The paper’s tables"
    gate = " ".join(precheck_part(run.results).sentences)
    parts: list[Block] = [Heading(title, 1), f"**Worth attacking?** {gate}"]
    scores = _standing(run)
    checked = f" (AP with centres within 1 m: {scores})" if scores else ""
    real = any(check.real for check in run.results.baselines)
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


def _standing(run: Reproduction) -> str:
    """Says what the detectors score on the images without camouflage, by centres within 1 m."""
    scores = []
    for detector in run.detectors:
        row = next(
            (
                row
                for row in run.results.rows
                if (row.detector, row.renderer, row.match) == (detector, RENDERER, MAIN_MATCH)
            ),
            None,
        )
        if row is not None and row.ap_original == row.ap_original:
            scores.append(f"{detector_name(detector)} {number(100 * row.ap_original)} %")
    return ", ".join(scores)


def _files(names: Sequence[str]) -> list[Block]:
    return [Heading("Files"), "\n".join(f"- [{name}.csv]({name}.csv)" for name in names)]


def _html(block: Block) -> Markup:
    if isinstance(block, Heading):
        level = block.level + 1
        return Markup("<h{0}>{1}</h{0}>").format(level, block.text)
    if isinstance(block, Figure):
        return Markup(
            '<figure class="wide"><div class="scroll">{}</div><figcaption>{}</figcaption></figure>'
        ).format(_inline(block.files["svg"].decode()), block.caption)
    if isinstance(block, TextTable):
        return _grid(block)
    return Markup("<p>{}</p>").format(block)


def _grid(grid: TextTable) -> Markup:
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


def _inline(svg: str) -> Markup:
    return Markup(svg[svg.index("<svg") :])
