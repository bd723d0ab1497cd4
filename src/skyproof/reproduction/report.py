"""A reproduction's report: the page of any run, and the paper's tables in it and beside it."""

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from skyproof.console import say
from skyproof.errors import RunFolderError
from skyproof.files import alone, refuse_links, write_bytes
from skyproof.report.baseline import precheck_part
from skyproof.report.report import Section, templates, write_report
from skyproof.reproduction.agreement import agreement_part
from skyproof.reproduction.cells import Block, Figure, Heading, Table, Topic, as_markdown, number
from skyproof.reproduction.cycles import cycles_part
from skyproof.reproduction.features import features_part
from skyproof.reproduction.held_out import held_out_part
from skyproof.reproduction.looks import colours_part, looks_part
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.tables import main_part, practicality_part, shape_table, texture_table
from skyproof.reproduction.transfer import transfer_part
from skyproof.reproduction.trust import criteria_part, trust_part
from skyproof.reproduction.variability import variability_part
from skyproof.reproduction.weather import weather_part
from skyproof.results.results import Results
from skyproof.words import detector_name


def write_reproduction_report(out: Path) -> None:
    """Writes a run's report, with the paper's tables beside it where its attacks were scored."""
    results = Results.open(out)
    run = Reproduction(results)
    layout = run.layout
    refuse_links(layout.folder)
    with alone(layout.tables):
        if layout.tables.exists() and not layout.results.exists():
            raise RunFolderError(
                f"{layout.tables} is there without a results.json beside it, so it may not be of "
                "skyproof and is not replaced; move it away."
            )
        sections = []
        files: dict[str, bytes] = {}
        if run.comparable:
            topics = _topics(run)
            # A figure is left out if the run lacks what it shows.
            blocks = [
                block
                for topic in topics
                for block in topic.blocks
                if not isinstance(block, Figure) or block.files
            ]
            template = templates("skyproof.reproduction").get_template("blocks.html.j2")
            html = template.render(blocks=blocks)
            sections.append(Section("Beside the paper", Markup(html.rstrip("\n"))))
            files = _files(run, [table for topic in topics for table in topic.tables], blocks)
        page = write_report(results, sections=sections)
        for name, content in files.items():
            write_bytes(layout.tables / name, content)
    say(f"Report: {page.resolve()}")


def _topics(run: Reproduction) -> list[Topic]:
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
        weather_part(run),
        features_part(run),
        practicality_part(run),
        colours_part(run),
        variability_part(run),
        looks_part(run),
    ]


def _files(run: Reproduction, tables: Sequence[Table], blocks: Sequence[Block]) -> dict[str, bytes]:
    """What is written beside the page, by file name, the page in Markdown last."""
    textures, shapes, *_ = tables
    texts = {f"{table.name}.csv": table.csv() for table in tables}
    texts["textures.md"] = texture_table(textures.rows).markdown() + "\n"
    texts["shape_combined.md"] = shape_table(shapes.rows).markdown() + "\n"
    files = {name: text.encode() for name, text in texts.items()}
    for figure in blocks:
        if isinstance(figure, Figure):
            files |= {f"{figure.name}.{ending}": data for ending, data in figure.files.items()}
    listed = "\n".join(f"- [{table.name}.csv]({table.name}.csv)" for table in tables)
    page = [*_preamble(run), *blocks, Heading("Files"), listed]
    return files | {"README.md": as_markdown(page).encode()}


def _preamble(run: Reproduction) -> list[Block]:
    """Returns the text above the tables on their own page."""
    title = run.results.config.title or "The paper’s tables"
    precheck = " ".join(precheck_part(run.results).sentences)
    parts: list[Block] = [Heading(title, 1), f"**Worth attacking?** {precheck}"]
    scores = {detector: number(run.original_ap(detector)) for detector in run.detectors}
    known = [f"{detector_name(name)} {ap} %" for name, ap in scores.items() if ap != number(None)]
    checked = f" (AP with centres within 1 m: {', '.join(known)})" if known else ""
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
    methods = {record.method for record in run.results.records.values() if record.method}
    if methods:
        parts.append(f"Method of the attacks: {', '.join(sorted(methods))}.")
    about = run.results.environment
    if about:
        versions = [f"{name} {about.get(name) or '–'}" for name in ("skyproof", "commit", "torch")]
        lines = [
            "; ".join(f"`{command}`" for command in about.get("commands", [])),
            ", ".join(versions),
            f"{about.get('cores') or '–'} cores of {about.get('cpu') or '–'}, device "
            f"{about.get('device') or '–'}; started {about.get('started') or '–'}",
        ]
        seconds = sum(row.seconds for row in run.results.timings)
        if seconds:
            lines.append(f"all jobs together {seconds / 3600:.1f} h")
        parts.append("\n".join(f"- {line}" for line in lines))
    return parts
