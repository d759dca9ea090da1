"""One table of a sweep as plain data, *paper | here*, and as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from src.report.escaping import escape_latex, escape_markdown
from src.report.metric_names import Metric

MISSING = "–"
PAPER = "paper"
"""State of a row that only the paper has, and its part of a column."""
HERE, BASELINE = "here", "to baseline"
"""The other parts of a column."""


@dataclass
class TableCell:
    """One metric of one row, in the table's unit."""

    paper: float | None = None
    values: dict[int, float] = field(default_factory=dict)  # here, by seed
    differences: dict[int, float] = field(default_factory=dict)  # to the baseline with the same seed
    paper_difference: float | None = None
    frames: float | None = None  # of a latency that one run has: half the range of the middle half of its frames
    best: bool = False  # of the finished rows here; each of those that tie at the digits shown
    paper_best: bool = False

    @property
    def seeds(self) -> int:
        """Runs behind the mean."""
        return len(self.values)

    @property
    def mean(self) -> float | None:
        """Over seeds; None without any."""
        return _mean(self.values)

    @property
    def spread(self) -> float | None:
        """Standard deviation over seeds; None of fewer than two."""
        return _spread(self.values)

    @property
    def uncertainty(self) -> float:
        """What stands after ±: over seeds, or of one run's frames; 0 where neither is known."""
        spread = self.spread if self.spread is not None else self.frames
        return spread if spread is not None else 0.0

    @property
    def difference(self) -> float | None:
        """Mean over seeds of what this row has more than the baseline; None where no seed has both."""
        return _mean(self.differences)

    @property
    def difference_spread(self) -> float | None:
        """Standard deviation of the differences; None of fewer than two."""
        return _spread(self.differences)


@dataclass(frozen=True)
class ShownCell:
    """One number of a row, as every form of the table shows it."""

    part: str  # see SweepTable.parts
    text: str
    value: float | None  # sorting goes by it
    best: bool = False
    verdict: str = ""  # `better` or `worse` than the baseline at the digits shown


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
    text: list[str] = field(default_factory=list)  # what the numbers say: a frame, then one finding each

    def has_paper(self, column: int) -> bool:
        """Whether the paper has a number in this column."""
        return any(row.cells[column].paper is not None for row in self.rows)

    @property
    def baselines(self) -> list[str]:
        """Labels of the rows that trained rows are compared with, each once; without any there are no differences."""
        compared = [row for row in self.rows if row.state != PAPER and not row.is_baseline]
        return list(dict.fromkeys(row.baseline for row in compared if row.baseline is not None))

    @property
    def has_notes(self) -> bool:
        """Whether some row lacks numbers for a reason."""
        return any(row.note for row in self.rows)

    @property
    def corner(self) -> str:
        """Head of the labels."""
        return "trial" if self.is_search else "row"

    def parts(self, column: int) -> list[str]:
        """What stands under a metric's name: the paper's number and the difference where there are any."""
        parts = [PAPER] if self.has_paper(column) else []
        return [*parts, HERE, *([BASELINE] if self.baselines else [])]

    def shown(self, row: SweepRow) -> Iterator[ShownCell]:
        """The row's numbers, as many for each column as it has parts."""
        for place, (column, cell) in enumerate(zip(self.columns, row.cells, strict=True)):
            gain = rounded(cell.difference or 0.0, column) * (1 if column.higher_is_better else -1)
            verdict = "better" if gain > 0 else "worse" if gain < 0 else ""
            difference = ShownCell(BASELINE, format_difference(cell, column, row.done), cell.difference, False, verdict)
            cells = {
                PAPER: ShownCell(PAPER, format_paper(cell.paper, column), cell.paper, cell.paper_best),
                HERE: ShownCell(HERE, format_here(cell, column, row.done), cell.mean, cell.best),
                BASELINE: ShownCell(BASELINE, "baseline", 0.0) if row.is_baseline else difference,
            }
            yield from map(cells.__getitem__, self.parts(place))

    def to_markdown(self) -> str:
        """Title, table, caption, text."""
        header = [self.corner]
        for place, column in enumerate(self.columns):
            header += [f"{column.heading}: {name}" for name in self.parts(place)]
        header += self._ends
        lines = [f"| {' | '.join(map(escape_markdown, header))} |", "|---" * len(header) + "|"]
        lines += [f"| {' | '.join(self._line(row, escape_markdown, '**{}**'.format))} |" for row in self.rows]
        frame, *points = map(escape_markdown, self.text or [""])
        title, caption = escape_markdown(self.title), escape_markdown(self.caption)
        parts = [f"# {title}", "\n".join(lines), caption, frame, "\n".join(f"- {point}" for point in points)]
        return "\n\n".join(part for part in parts if part) + "\n"

    def to_csv(self) -> str:
        """Plain numbers, one column each, in the table's units; empty where there is none."""
        header = [self.corner, "state", "note", "seeds done", "seeds planned"]
        header += ["overrides"] if self.is_search else []
        for column in self.columns:
            header += [f"{column.name} {part}" for part in ("paper", "mean", "std", "n", "diff", "diff std", "diff n")]
            header.append(f"{column.name} paper diff")
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        for row in self.rows:
            line: list[object] = [row.label, row.state, row.note, row.done, row.planned]
            line += [" ".join(row.overrides)] if self.is_search else []
            for cell in row.cells:
                here = [cell.mean, cell.spread, cell.seeds, cell.difference, cell.difference_spread]
                line += [cell.paper, *here, len(cell.differences), cell.paper_difference]
            writer.writerow([round(value, 6) if isinstance(value, float) else value for value in line])
        return text.getvalue()

    def to_latex(self) -> str:
        """A table environment for booktabs."""
        bold = "\\textbf{{{}}}".format
        first, second, rules, at = [""], [self.corner], [], 2
        for place, column in enumerate(self.columns):
            parts = self.parts(place)
            first.append(f"\\multicolumn{{{len(parts)}}}{{c}}{{{escape_latex(column.heading)}}}")
            rules.append(f"\\cmidrule(lr){{{at}-{at + len(parts) - 1}}}")
            second += parts
            at += len(parts)
        first += [""] * len(self._ends)
        second += self._ends
        kinds = "l" + "r" * (at - 2) + "l" * len(self._ends)
        lines = [" & ".join(self._line(row, escape_latex, bold)) + r" \\" for row in self.rows]
        text = [f"\\par\\medskip\\footnotesize {' '.join(map(escape_latex, self.text))}"] if self.text else []
        return "\n".join(
            [
                "% needs \\usepackage{booktabs}", "\\begin{table}", "\\centering",
                f"\\caption{{{escape_latex(self.title)}. {escape_latex(self.caption)}}}",
                f"\\label{{tab:{''.join(c if c.isalnum() else '-' for c in self.name)}}}",
                f"\\begin{{tabular}}{{{kinds}}}", "\\toprule", " & ".join(first) + r" \\", " ".join(rules),
                " & ".join(map(escape_latex, second)) + r" \\", "\\midrule", *lines, "\\bottomrule",
                "\\end{tabular}", *text, "\\end{table}", "",
            ]
        )  # fmt: skip

    @property
    def _ends(self) -> list[str]:
        return ["seeds", *(["chosen"] if self.is_search else []), *(["state"] if self.has_notes else [])]

    def _line(self, row: SweepRow, escape: Callable[[str], str], bold: Callable[[str], str]) -> list[str]:
        """The row's cells, escaped."""
        line = [escape(row.label)]
        line += [bold(escape(cell.text)) if cell.best else escape(cell.text) for cell in self.shown(row)]
        seeds = f"{row.done}" if row.done == row.planned else f"{row.done} of {row.planned}"
        line.append(escape(MISSING if row.state == PAPER else seeds))
        line += [escape(" ".join(row.overrides))] if self.is_search else []
        return line + ([escape(row.note)] if self.has_notes else [])


def rounded(value: float, metric: Metric) -> float:
    """At the digits that are shown, and never -0.0."""
    return round(value, metric.digits) + 0.0


def format_paper(value: float | None, metric: Metric, signed: bool = False) -> str:
    """A number of the paper with the digits it was given with, at least the metric's."""
    if value is None:
        return MISSING
    digits = max(metric.digits, len(f"{value:g}".partition(".")[2]))
    return f"{value:{'+' if signed else ''}.{digits}f}"


def format_here(cell: TableCell, metric: Metric, done: int) -> str:
    """Mean ± standard deviation; of one run's latency ± `TableCell.frames`; n where not all `done` have it."""
    if cell.mean is None:
        return MISSING
    text = f"{rounded(cell.mean, metric):.{metric.digits}f}"
    known = cell.spread is not None or cell.frames is not None
    text += f" ± {cell.uncertainty:.{metric.digits}f}" if known else ""
    return text + (f" (n = {cell.seeds})" if cell.seeds != done else "")


def format_difference(cell: TableCell, metric: Metric, done: int | None = None) -> str:
    """What the row has more than the baseline; in brackets the paper's, and n where not all `done` runs have both."""
    text, notes = MISSING, []
    if cell.difference is not None:
        text = f"{rounded(cell.difference, metric):+.{metric.digits}f}"
        text += f" ± {cell.difference_spread:.{metric.digits}f}" if cell.difference_spread is not None else ""
        notes += [f"n = {len(cell.differences)}"] if done not in (None, len(cell.differences)) else []
    if cell.paper_difference is not None:
        notes.append(f"paper {format_paper(cell.paper_difference, metric, signed=True)}")
    return f"{text} ({', '.join(notes)})" if notes else text


def _mean(values: dict[int, float]) -> float | None:
    return statistics.mean(values.values()) if values else None


def _spread(values: dict[int, float]) -> float | None:
    return statistics.stdev(values.values()) if len(values) > 1 else None
