"""One table of a sweep as plain data, *paper | here*, and as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field

from src.report.comparisons import Comparison, compare
from src.report.escaping import escape_latex, escape_markdown, markdown_table
from src.report.metric_names import Metric
from src.report.sweep_file import MAX_COLUMNS

MISSING = "–"
PAPER = "paper"
"""State of a row that only the paper has."""
BETWEEN = " | "
"""Between the paper's number and ours."""


@dataclass
class TableCell:
    """One metric of one row, in the table's unit."""

    paper: float | None = None
    values: dict[int, float] = field(default_factory=dict)  # here, by seed
    bounds: tuple[float, float] | None = None  # 95 % over scenes: the mean of the runs' bounds, where all have some
    comparison: Comparison | None = None  # to the baseline
    paper_difference: float | None = None
    frames: float | None = None  # of a latency that one run has: half the range of the middle half of its frames
    place: str | None = None  # where that latency was measured
    best: bool = False  # decided against every other finished row
    paper_best: bool = False

    @property
    def seeds(self) -> int:
        """Runs behind the mean."""
        return len(self.values)

    @property
    def mean(self) -> float | None:
        """Mean over seeds; None without any."""
        return statistics.mean(self.values.values()) if self.values else None

    def compared_with(self, other: TableCell, metric: Metric) -> Comparison | None:
        """What this row has more than the other; None where they share no seed, or were timed on different machines.

        Frames decide between latencies of one run each: what is trained does not change them, what else runs does.
        """
        if self.frames is None or other.frames is None:
            return compare(self.values, other.values, metric.digits)
        if self.place != other.place:
            return None
        gap, half = self.mean - other.mean, self.frames + other.frames
        return Comparison(gap, gap - half, gap + half, 1, metric.digits)


@dataclass(frozen=True)
class ShownCell:
    """One cell as every form of the table shows it: the paper's part, None where its column has none, and ours."""

    paper: str | None
    here: str
    value: float | None = None  # sorting goes by it
    best: bool = False
    paper_best: bool = False
    verdict: str = ""  # of a difference that is decided: `better` or `worse` than the baseline

    def text(self, escape: Callable[[str], str], bold: Callable[[str], str]) -> str:
        """*paper | here*, escaped."""
        here = bold(escape(self.here)) if self.best else escape(self.here)
        if self.paper is None:
            return here
        paper = bold(escape(self.paper)) if self.paper_best else escape(self.paper)
        return f"{paper}{escape(BETWEEN)}{here}"


@dataclass
class SweepRow:
    """One row of a table."""

    label: str
    cells: list[TableCell]  # one per column
    state: str  # a sweep_record.State: what is left of its runs; or PAPER
    note: str = ""  # why numbers are missing
    planned: int = 0  # seeds
    done: int = 0
    baseline: str | None = None  # label of the row that its differences are taken to; its own for a baseline
    runs: dict[int, str] = field(default_factory=dict)  # run id by seed
    overrides: list[str] = field(default_factory=list)  # of a trial: what the search chose

    @property
    def is_baseline(self) -> bool:
        """Whether differences are taken to this row."""
        return self.label == self.baseline


@dataclass(frozen=True)
class Head:
    """What stands over a column or before a line: a row of the sweep, a metric, or the difference in one."""

    text: str
    note: str = ""
    row: SweepRow | None = None
    metric: Metric | None = None


@dataclass
class SweepTable:
    """One table as plain data; whoever shows it shows this."""

    name: str  # of its files, without the scale
    scale: str
    title: str
    caption: str  # data, scale, epochs, seeds, commits, device
    columns: list[Metric]
    rows: list[SweepRow]
    is_search: bool
    text: list[str] = field(default_factory=list)  # what was checked, and in one sentence what was found

    def has_paper(self, column: int) -> bool:
        """Whether the paper has a number in this column."""
        return any(row.cells[column].paper is not None for row in self.rows)

    @property
    def transposed(self) -> bool:
        """Whether metrics are the lines, as there are too many for columns."""
        return not self.is_search and len(self.columns) >= MAX_COLUMNS

    @property
    def shows_differences(self) -> bool:
        """Whether each metric has a second column; a wide table has no room for them."""
        return bool(self.baselines) and 1 + 2 * len(self.columns) <= MAX_COLUMNS

    @property
    def baselines(self) -> list[str]:
        """Labels of the rows that trained rows are compared with, each once; without any there are no differences."""
        compared = [row for row in self.rows if row.state != PAPER and not row.is_baseline]
        return list(dict.fromkeys(row.baseline for row in compared if row.baseline is not None))

    @property
    def corner(self) -> str:
        """Text of the upper left cell: what the lines are, and what a cell holds."""
        what = "trial" if self.is_search else "metric" if self.transposed else "row"
        return f"{what}: {PAPER}{BETWEEN}here" if any(map(self.has_paper, range(len(self.columns)))) else what

    @property
    def heads(self) -> list[Head]:
        """Heads of the columns after the corner."""
        if self.transposed:
            return [self._row_head(row) for row in self.rows]
        heads = []
        for column in self.columns:
            heads.append(Head(column.heading, metric=column))
            heads += [Head(f"{column.title} to baseline", metric=column)] if self.shows_differences else []
        return heads + ([Head("chosen")] if self.is_search else [])

    @property
    def lines(self) -> list[tuple[Head, list[ShownCell]]]:
        """Every line with what stands before it."""
        by_row = [[self._shown(row, place) for place in range(len(self.columns))] for row in self.rows]
        if self.transposed:
            metrics = (Head(column.heading, metric=column) for column in self.columns)
            return [(head, [cells[place][0] for cells in by_row]) for place, head in enumerate(metrics)]
        lines = [(self._row_head(row), [cell for cells in of_row for cell in cells])
                 for row, of_row in zip(self.rows, by_row, strict=True)]  # fmt: skip
        if self.is_search:
            for head, cells in lines:
                cells.append(ShownCell(None, " ".join(head.row.overrides)))
        return lines

    def _row_head(self, row: SweepRow) -> Head:
        notes = [row.note] if row.note else []
        counts = {other.done for other in self.rows if other.state != PAPER}
        if row.state != PAPER and not self.is_search and (row.done != row.planned or len(counts) > 1):
            of = f" of {row.planned}" if row.done != row.planned else ""
            notes.insert(0, f"{row.done}{of} seed{'s' if max(row.done, row.planned) != 1 else ''}")
        return Head(row.label, "; ".join(notes), row)

    def _shown(self, row: SweepRow, place: int) -> list[ShownCell]:
        """The cell, and its difference where there is a column for it."""
        column, cell, has_paper = self.columns[place], row.cells[place], self.has_paper(place)
        paper = format_paper(cell.paper, column) if has_paper else None
        shown = [ShownCell(paper, format_here(cell, column, row.done), cell.mean, cell.best, cell.paper_best)]
        if self.shows_differences and row.is_baseline:
            shown.append(ShownCell(None, "baseline", 0.0))
        elif self.shows_differences:
            found, paper = cell.comparison, format_paper(cell.paper_difference, column, signed=True)
            verdict = "" if found is None or not found.decided else "better" if found.favours(column) else "worse"
            text = MISSING if found is None else format_difference(found, row.done)
            value = None if found is None else found.mean
            shown.append(ShownCell(paper if has_paper else None, text, value, verdict=verdict))
        return shown

    def to_markdown(self) -> str:
        """Title, table, caption, text."""
        heads = [escape_markdown(text) for text in (self.corner, *map(_headed, self.heads))]
        lines = [
            [escape_markdown(_headed(head)), *(cell.text(escape_markdown, "**{}**".format) for cell in cells)]
            for head, cells in self.lines
        ]
        parts = [f"# {escape_markdown(self.title)}", markdown_table(heads, lines)]
        parts += map(escape_markdown, [self.caption, *self.text])
        return "\n\n".join(part for part in parts if part) + "\n"

    def to_csv(self) -> str:
        """Plain numbers, one column each, in the table's units; empty where there is none."""
        header = ["trial" if self.is_search else "row", "state", "note", "seeds done", "seeds planned"]
        header += ["overrides"] if self.is_search else []
        names = ("paper", "mean", "low", "high", "n", "diff", "diff low", "diff high", "diff n", "paper diff")
        header += [f"{column.name} {name}" for column in self.columns for name in names]
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        for row in self.rows:
            line: list[object] = [row.label, row.state, row.note, row.done, row.planned]
            line += [" ".join(row.overrides)] if self.is_search else []
            for cell in row.cells:
                low, high = cell.bounds or (None, None)
                found = cell.comparison
                gain = [None, None, None, 0] if found is None else [found.mean, found.low, found.high, found.pairs]
                line += [cell.paper, cell.mean, low, high, cell.seeds, *gain, cell.paper_difference]
            writer.writerow([round(value, 6) if isinstance(value, float) else value for value in line])
        return text.getvalue()

    def to_latex(self) -> str:
        """A table environment for booktabs, shrunk to the line where it is wider."""
        bold = "\\textbf{{{}}}".format
        lines = [
            [escape_latex(_headed(head)), *(cell.text(escape_latex, bold) for cell in cells)]
            for head, cells in self.lines
        ]
        heads = [self.corner, *(_headed(head) for head in self.heads)]
        text = [f"\\par\\medskip\\footnotesize {' '.join(map(escape_latex, self.text))}"] if self.text else []
        return "\n".join(
            [
                "% needs \\usepackage{adjustbox,booktabs}", "\\begin{table}", "\\centering",
                f"\\caption{{{escape_latex(self.title)}. {escape_latex(self.caption)}}}",
                f"\\label{{tab:{''.join(c if c.isalnum() else '-' for c in self.name)}}}",
                "\\begin{adjustbox}{max width=\\linewidth}",
                f"\\begin{{tabular}}{{l{'r' * (len(heads) - 1)}}}", "\\toprule",
                " & ".join(map(escape_latex, heads)) + r" \\", "\\midrule",
                *(" & ".join(line) + r" \\" for line in lines), "\\bottomrule",
                "\\end{tabular}", "\\end{adjustbox}", *text, "\\end{table}", "",
            ]
        )  # fmt: skip


def rounded(value: float, metric: Metric) -> float:
    """The value rounded to the digits that are shown, never -0.0."""
    return round(value, metric.digits) + 0.0


def format_paper(value: float | None, metric: Metric, signed: bool = False) -> str:
    """A number of the paper with the digits it was given with, at least the metric's."""
    if value is None:
        return MISSING
    digits = max(metric.digits, len(f"{value:g}".partition(".")[2]))
    return f"{value:{'+' if signed else ''}.{digits}f}"


def format_here(cell: TableCell, metric: Metric, done: int) -> str:
    """Mean with its interval, or with a latency's ± `TableCell.frames`; n where not all `done` runs have it."""
    if cell.mean is None:
        return MISSING
    text = format_score(cell.mean, cell.bounds, metric)
    text += f" ± {cell.frames:.{metric.digits}f}" if cell.frames is not None else ""
    return text + (f" (n = {cell.seeds})" if cell.seeds != done else "")


def format_score(value: float, bounds: tuple[float, float] | None, metric: Metric) -> str:
    """A number in the table's unit with its interval."""
    numbers = [f"{rounded(number, metric):.{metric.digits}f}" for number in (value, *(bounds or ()))]
    return numbers[0] + (f" [{numbers[1]}, {numbers[2]}]" if bounds is not None else "")


def format_difference(found: Comparison, done: int) -> str:
    """See `Comparison.text`; n where not all `done` runs have a partner."""
    return found.text + (f" (n = {found.pairs})" if found.pairs != done else "")


def _headed(head: Head) -> str:
    return f"{head.text} ({head.note})" if head.note else head.text
