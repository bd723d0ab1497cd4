"""Says in sentences what the tables of a reproduction by the preset quick hold.

    python tools/say_results.py runs/quick/tables

It prints the statements of docs/results/README.md, sections "What it says", "On Cycles" and "By
detectors of photographs", with the numbers of these tables. The words around them are those of the
runs so far: whether they still hold, a reader has to judge. What stands in brackets [so] is for
that reader, and is no part of a statement.
"""

from __future__ import annotations

import csv
import sys
import textwrap
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

Row = dict[str, str]

TEXTURES = ("U", "Pix", "Lc", "PixLc", "Fc", "PixFc")
MASKED = ("Ma", "PixMa", "LcMa", "PixLcMa", "FcMa", "PixFcMa")
COLUMNS = 100


class Tables:
    """The tables as they lie in a folder, each read when it is asked for.

    Args:
        folder: with the CSV files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self, name: str) -> list[Row]:
        """Reads a table."""
        with (self.folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    @cached_property
    def textures(self) -> dict[str, Row]:
        """The rows of textures by name."""
        return {row["attack"]: row for row in self.rows("textures")}

    @cached_property
    def curves(self) -> dict[tuple[str, float], Row]:
        """The rows of shapes and combinations by name and magnitude."""
        return {(row["attack"], float(row["pm"])): row for row in self.rows("curves")}

    @cached_property
    def added(self) -> dict[str, list[str]]:
        """What the second half of their steps added, by attack, start after start."""
        found: dict[str, list[str]] = {}
        for row in self.rows("convergence"):
            found.setdefault(row["attack"].rpartition("-")[0], []).append(number(row["added"]))
        return found


def number(value: str, decimals: int = 0) -> str:
    """Writes a number as the page does."""
    written = f"{float(value):.{decimals}f}"
    return (written if float(written) else written.lstrip("-")).replace("-", "−")


def span(row: Row, what: str = "easr") -> str:
    """Writes an interval."""
    return f"({number(row[f'{what}_low'])} to {number(row[f'{what}_high'])})"


def starts(row: Row) -> str:
    """Writes how far repeats of an attack lie apart."""
    low, high = (number(row[f"easr_repeat_{end}"]) for end in ("min", "max"))
    return low if low == high else f"{low} to {high}"


def cited(title: str, names: Sequence[str], table: str = "") -> str:
    """Writes the reference that the test of the page looks up."""
    rows = ", ".join(f"`{name}`" for name in names)
    return f"([{title}](quick/{table or title}.csv) {rows})"


def of_textures(tables: Tables) -> Iterator[str]:
    """Says what textures hide, beside their controls."""
    rows = tables.textures
    easr = {name: float(rows[f"T-{name}"]["easr"]) for name in (*TEXTURES, *MASKED)}
    falling = sorted(easr, key=lambda name: -easr[name])
    levels: list[float] = []
    for name in falling:
        if not levels or levels[-1] - easr[name] >= 1:
            levels.append(easr[name])
    free = [name for name in falling if name in TEXTURES]
    hide = ", ".join(f"T-{name} {number(rows[f'T-{name}']['easr'])}" for name in free[1:])
    first = rows[f"T-{free[0]}"]
    yield (
        f"**Twelve textures, [{len(levels)}] levels at least a point apart in the mean,** though "
        f"the intervals of neighbours overlap. T-{free[0]} hides {number(first['easr'])} % "
        f"{span(first)}, {hide} % {cited('textures', [f'T-{name}' for name in free])}."
    )
    three = [f"T-{name}" for name in falling if name != "U"]
    lie = ", ".join(f"of {name} {starts(rows[name])}" for name in three)
    yield (
        f"**Starts end alike.** Three starts hide, in percent, {lie}; of T-U, five, "
        f"{starts(rows['T-U'])} {cited('textures', ['T-U', *three])}."
    )
    masked = [number(rows[f"T-{name}"]["easr"]) for name in MASKED]
    yield (
        f"**A mask costs a fifth to two fifths.** T-Ma {masked[0]} and T-PixMa {masked[1]} %, with "
        f"few learnt colours {masked[2]} and {masked[3]}, with five colours of the ground "
        f"{masked[4]} and {masked[5]} % {cited('textures', [f'T-{name}' for name in MASKED])}."
    )
    drawn = [f"R-{name}" for name in ("U", "Pix", "Fc", "PixFc")]
    hide = ", ".join(f"{name} {number(rows[name]['easr'], 1)}" for name in drawn)
    yield (
        f"**Random patterns hide next to nothing**, as in the paper: {hide} %, means of ten draws "
        f"{cited('textures', drawn)}. So net rates are nearly the gross ones."
    )
    best = {name: rows[name] for name in ("T-U", "T-PixFcMa")}
    more = {
        name: f"{number(row['net_unlearnt_easr'])} points {span(row, 'net_unlearnt_easr')}"
        for name, row in best.items()
    }
    hide = " and ".join(
        f"{number(row['unlearnt_easr'], 1)} % beside {name} [{row['unlearnt_control']}]"
        for name, row in best.items()
    )
    yield (
        f"**It is due to learning.** The best control that was chosen and not learnt hides {hide}; "
        f"T-U hides {more['T-U']} more than it, T-PixFcMa {more['T-PixFcMa']} "
        f"{cited('textures', list(best))}."
    )
    found = {name: rows[f"T-{name}"] for name in ("Fc", "PixFc", "Pix", "Lc", "PixLc")}
    by_search = {name: number(row["unlearnt_easr"]) for name, row in found.items()}
    owed = [number(found[name]["net_unlearnt_easr"]) for name in ("Fc", "PixFc")]
    controls = {row["unlearnt_control"] for row in found.values()}
    yield (
        f"**A random search goes far with colours of the ground:** {by_search['Fc']} % under the "
        f"constraints of T-Fc and {by_search['PixFc']} % under those of T-PixFc, so that these "
        f"attacks owe {owed[0]} and {owed[1]} points to learning "
        f"{cited('textures', ['T-Fc', 'T-PixFc'])}. With free rectangles it finds "
        f"{by_search['Pix']} % {cited('textures', ['T-Pix'])}, and {by_search['Lc']} and "
        f"{by_search['PixLc']} % with palettes that begin at the ground's colours and may leave "
        f"them {cited('textures', ['T-Lc', 'T-PixLc'])}. [{', '.join(sorted(controls))}]"
    )


def of_shapes(tables: Tables) -> Iterator[str]:
    """Says what shapes hide, alone and on textures."""
    alone = {pm: row for (name, pm), row in tables.curves.items() if name == "S-O" and pm}
    hide = ", ".join(
        f"{number(row['easr'])} {span(row) + ' ' if pm == 0.4 else ''}at `PM {pm:g}`"
        for pm, row in alone.items()
    )
    unlearnt = ", ".join(
        f"{number(alone[pm]['unlearnt_easr'])} % at `PM {pm:g}` [{alone[pm]['unlearnt_control']}]"
        for pm in (0.4, 0.7, 1.0)
    )
    yield (
        f"**Shape alone is strong from PM 0.4 on.** S-O hides, in percent, {hide}; its three "
        f"starts at `PM 0.4` hide {starts(alone[0.4])} %. The best that nobody learnt hides "
        f"{unlearnt} {cited('curves', ['S-O'])}: there the size is the camouflage, not what was "
        "learnt."
    )
    names = [f"C-{name}-seq" for name in ("PixFcMa", "FcMa", "PixFc")]
    under = {name: tables.curves[name, 0.2] for name in names}
    goes = ", ".join(
        f"{name[2:-4]} goes from {number(tables.textures['T-' + name[2:-4]]['easr'])} to "
        f"{number(row['easr'])} %"
        for name, row in under.items()
    )
    stay = ", ".join(number(row["drawn_shape_easr"]) for row in under.values())
    adds = ", ".join(number(row["net_drawn_shape_easr"]) for row in under.values())
    yield (
        f"**A small shape rescues what constraints cost.** At `PM 0.2` {goes} "
        f"{cited('curves', names)}. The same textures under random shapes of that size stay at "
        f"{stay} % {cited('curves', names)}: the learnt shape adds {adds} points "
        f"{cited('curves', names)}."
    )


def of_analyses(tables: Tables) -> Iterator[str]:
    """Says what transfer, weather, starts, features and rules of matching show."""
    on = {row["attacked_on"]: row for row in tables.rows("transfer")}
    two = ("faster_rcnn", "retinanet")
    own = [f"T-U_on_yolov5-{start}" for start in range(3)]
    yield (
        "**Transfer between RetinaNet and Faster R-CNN is nearly full, with YOLOv5 it is not.** "
        f"Learnt on one of the first two, T-U hides {number(on[two[0]][two[1]])} and "
        f"{number(on[two[1]][two[0]])} % from the other, and {number(on[two[0]]['yolov5'])} and "
        f"{number(on[two[1]]['yolov5'])} % from YOLOv5 {cited('transfer', two)}. Learnt on YOLOv5 "
        f"it hides {number(on['yolov5']['yolov5'])} % there, {number(on['yolov5'][two[1]])} % from "
        f"RetinaNet and {number(on['yolov5'][two[0]])} % from Faster R-CNN "
        f"{cited('transfer', ['yolov5'])}. YOLOv5 also learnt from other images, those of this "
        f"run; its own attacks gain {', '.join(tables.added['T-U_on_yolov5'])} points in the "
        f"second half of their steps {cited('convergence', own)}."
    )
    means = {row["condition"]: row for row in tables.rows("weather") if row["detector"] == "mean"}
    every = means.pop("all weathers")
    falling = sorted(means, key=lambda condition: float(means[condition]["clear"]))
    ends = [f"{number(means[falling[end]]['clear'])} % ({falling[end]})" for end in (0, -1)]
    yield (
        f"**Weather changes little.** T-U hides {number(every['clear'])} % in all weathers "
        f"together, from {ends[0]} to {ends[1]}; learnt in all of them {number(every['all'])} % "
        f"there {cited('weather', ['mean'])}."
    )
    alike = next(row for row in tables.rows("variability") if row["attack"] == "T-U")
    yield (
        "**Several starts of T-U end alike in success, half alike in looks.** Five hide "
        f"{starts(tables.textures['T-U'])} % ([starts](quick/starts.csv)); their texels correlate "
        f"with {number(alike['correlation'], 2)}, square blocks of sixteen with "
        f"{number(alike['seen_correlation'], 2)} {cited('variability', ['T-U'])}."
    )
    near = {
        (row["detector"], row["shown"]): row["nearer_ground"] for row in tables.rows("embeddings")
    }
    detectors = {"retinanet": "RetinaNet", "faster_rcnn": "Faster R-CNN", "yolov5": "YOLOv5"}
    worn = ", ".join(
        f"{number(near[name, 'T-U'])} % for {title}" for name, title in detectors.items()
    )
    bare = ", ".join(number(near[name, "original"], 1) for name in detectors)
    yield (
        "**To the detectors' features, T-U lies nearer to ground than to a vehicle:** of its "
        f"vehicles {worn} {cited('embeddings', ['T-U'])}, of bare vehicles {bare} % "
        f"{cited('embeddings', ['original'])}."
    )
    rules = {row["attack"]: row for row in tables.rows("criteria")}
    names = ["T-U", "T-PixFcMa", "S-O@0.4"]
    overlap = [number(rules[name]["easr_iou_50"]) for name in names]
    alarms = [
        number(rules[name][f"false_alarms_per_km2_{when}"])
        for name, when in (("T-U", "original"), ("S-O@0.4", "adversarial"))
    ]
    yield (
        f"**The rule of matching hardly matters:** by overlap T-U hides {overlap[0]} %, T-PixFcMa "
        f"{overlap[1]} and S-O {overlap[2]} % at `PM 0.4`. False alarms are {alarms[0]} a square "
        f"kilometre without camouflage, and {alarms[1]} beside these shapes "
        f"{cited('criteria', names)}: thresholds are frozen on validation images, and too low here "
        "for all three detectors."
    )


def of_learning(tables: Tables) -> Iterator[str]:
    """Says what steps and rounding do."""
    rows = tables.rows("convergence")
    done = sum(row["converged"] == "yes" for row in rows)
    open_names = sorted({row["attack"] for row in rows if row["converged"] == "no"})
    gains = "; ".join(
        f"{name} {', '.join(tables.added[name])}" for name in ("T-Ma", "T-PixMa", "T-Pix")
    )
    named = [f"{name}-{start}" for name in ("T-Ma", "T-PixMa", "T-Pix") for start in range(3)]
    yield (
        f"**[{done} of {len(rows)}] attacks have converged:** they gain at most two points in the "
        f"second half of their steps. In points, {gains} {cited('convergence', named)}. "
        f"[not: {', '.join(open_names)}]"
    )
    ladder = tables.rows("ladder")
    falling = [row["attack"] for row in ladder if row["never_surely_falls"] != "yes"]
    most = max(
        tables.rows("gap"), key=lambda row: float(row["easr_before"]) - float(row["easr_after"])
    )
    yield (
        f"**No attack surely weakens with more steps**, [of {len(ladder)}; but {falling or 'none'}]"
        " ([ladder](quick/ladder.csv)), and rounding to few colours costs next to nothing: the "
        f"most is {most['attack']}, from {number(most['easr_before'], 1)} to "
        f"{number(most['easr_after'], 1)} % {cited('rounding', [most['attack']], 'gap')}."
    )
    half_widths = ", ".join(
        f"{name} {(float(row['easr_high']) - float(row['easr_low'])) / 2:.1f}"
        for name, row in tables.textures.items()
        if name.startswith("T-")
    )
    yield f"[Half-widths: {half_widths}]"


def of_cycles(tables: Tables) -> Iterator[str]:
    """Says what a path tracer leaves of it, where the run was given --cycles."""
    if not (tables.folder / "cycles.csv").exists():
        return
    moves = {row["kind"]: row for row in tables.rows("cycles")}
    rows, curves = tables.textures, tables.curves
    learnt = [f"T-{name}" for name in (*TEXTURES, *MASKED)]
    first = moves["textures"]
    headlines = ("T-U", "T-Ma", "T-PixFcMa")
    hide = ", ".join(
        f"{name} {number(rows[name]['cycles_easr'])} {span(rows[name], 'cycles_easr')}"
        for name in headlines
    )
    yield (
        f"**Textures:** twelve hide {number(first['cycles_easr'], 1)} % on the average instead of "
        f"{number(first['easr'], 1)}, {number(first['change'], 1)} points {span(first, 'change')}; "
        f"in the paper they fall from {number(first['paper_easr'], 1)} to "
        f"{number(first['paper_easr_blender'], 1)} % {cited('moves', ['textures'], 'cycles')}. "
        f"There hide {hide} % {cited('textures', headlines)}."
    )
    moved = sorted(learnt, key=lambda name: float(rows[name]["cycles_change"]))
    said = ", ".join(
        f"{name} {number(rows[name]['cycles_change'], 1)} {span(rows[name], 'cycles_change')}"
        for name in (moved[0], moved[1], moved[-2], moved[-1])
    )
    yield f"[Lose and gain most: {said}]"
    alone = {pm: row for (name, pm), row in curves.items() if name == "S-O" and pm}
    hide = ", ".join(
        f"{number(row['cycles_easr'])} instead of {number(row['easr'])} at `PM {pm:g}`, "
        f"{number(row['cycles_change'], 1)} points {span(row, 'cycles_change')}"
        for pm, row in alone.items()
    )
    yield f"**Shapes:** S-O hides {hide} {cited('curves', ['S-O'])}."
    combined, sequential = moves["combinations"], curves["C-PixFc-seq", 0.2]
    yield (
        f"**Shapes under a texture:** [{combined['camouflages']}] combinations hide "
        f"{number(combined['cycles_easr'], 1)} % instead of {number(combined['easr'], 1)} "
        f"{cited('moves', ['combinations'], 'cycles')}, C-PixFc-seq at `PM 0.2` "
        f"{number(sequential['cycles_easr'])} {span(sequential, 'cycles_easr')} "
        f"{cited('curves', ['C-PixFc-seq'])}."
    )
    drawn, bodies = moves["random textures"], moves["random shapes and combinations"]
    yield (
        f"**Random patterns:** textures hide {number(drawn['cycles_easr'], 1)} % on Cycles and "
        f"{number(drawn['easr'], 1)} on the renderer, where the paper's rise from "
        f"{number(drawn['paper_easr'], 1)} to {number(drawn['paper_easr_blender'], 1)} %; shapes "
        f"and combinations {number(bodies['cycles_easr'], 1)} and {number(bodies['easr'], 1)} "
        f"{cited('moves', ['random textures', 'random shapes and combinations'], 'cycles')}."
    )
    left = "cycles_net_unlearnt_easr"
    net = ", ".join(
        f"{name} {number(rows[name][left])} {span(rows[name], left)}" for name in headlines
    )
    shaped = {name: curves[name, pm] for name, pm in (("S-O", 0.4), ("C-PixFc-seq", 0.2))}
    also = ", ".join(
        f"{name} at `PM {row['pm']}` {number(row[left])} {span(row, left)}"
        for name, row in shaped.items()
    )
    yield (
        f"**Against the best that nobody learnt** stay, in points, {net} "
        f"{cited('textures', headlines)}, {also} {cited('curves', list(shaped))}."
    )
    agreement = {
        (row["compared"], row["attacks"]): number(row["spearman"], 2)
        for name in ("cycles_agreement", "agreement")
        for row in tables.rows(name)
    }
    told = "; ".join(f"{compared}, {n}: {rho}" for (compared, n), rho in agreement.items())
    yield f"**The order:** [{told}]"


def of_judges(tables: Tables) -> Iterator[str]:
    """Says what is left before detectors that no attack saw, where the run was given --judges."""
    if not (tables.folder / "judges.csv").exists():
        return
    rows = {row["attack"]: row for row in tables.rows("judges") if row["detector"] == "mean"}
    learnt = {name: row for name, row in rows.items() if not name.startswith("R-")}
    heads = ("T-U", "T-Ma", "T-PixFcMa", "S-O@0.4")
    hide = ", ".join(f"{name} {number(rows[name]['easr'])} % {span(rows[name])}" for name in heads)
    drawn = ", ".join(number(rows[name]["random_easr"], 1) for name in heads)
    yield (f"**Attacks carry over:** {hide}; random draws {drawn} {cited('judges', heads)}.")
    more = "net_unlearnt_easr"
    points = ", ".join(
        f"{name} {number(rows[name][more])} {span(rows[name], more)}" for name in heads
    )
    unsure = {
        name: f"{name} {number(row[more])} {span(row, more)}"
        for name, row in learnt.items()
        if float(row[f"{more}_low"]) <= 0
    }
    yield (
        f"**More than what nobody learnt**, in points: {points}; [not surely, of {len(learnt)}:] "
        f"{', '.join(unsure.values())} {cited('judges', [*heads, *unsure])}."
    )
    if rows["T-U"].get("cycles_easr"):
        there = ", ".join(
            f"{name} {number(rows[name]['cycles_easr'])} % {span(rows[name], 'cycles_easr')}, "
            f"{number(rows[name]['cycles_' + more])} points {span(rows[name], 'cycles_' + more)}"
            for name in heads
        )
        yield f"**On Cycles:** {there} {cited('judges', heads)}."
    seen = ", ".join(
        f"{row['detector']} {number(row['ap'])} on {row['set']}"
        for row in tables.rows("judges_clean")
    )
    yield f"[AP: {seen}]"


def main(folder: Path) -> None:
    """Prints the statements as items of a list."""
    tables = Tables(folder)
    for part in (of_textures, of_shapes, of_analyses, of_learning, of_cycles, of_judges):
        for statement in part(tables):
            print(
                textwrap.fill(
                    f"- {statement}",
                    COLUMNS,
                    subsequent_indent="  ",
                    break_long_words=False,
                    break_on_hyphens=False,
                )
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
