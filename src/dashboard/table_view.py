"""A sweep's table as the templates show it: the same numbers and words as in the files, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, field

from src.report.sweep_table import PAPER, SweepTable, format_difference, format_here, format_paper


@dataclass(frozen=True, kw_only=True)
class ColumnView:
    """The head of a column: the metric, and which of its numbers."""

    metric: str
    part: str  # `paper`, `here`, `to baseline`
    lower_is_better: bool


@dataclass(frozen=True, kw_only=True)
class CellView:
    """One cell; `value` is what sorting goes by."""

    text: str
    value: float | None
    note: str = ""  # below the text
    kind: str = ""  # `paper`, `here`, `difference better`, `difference worse`, `difference`
    best: bool = False


@dataclass(frozen=True, kw_only=True)
class RowView:
    """One row; `seeds` are its finished or planned runs by seed."""

    label: str
    state: str
    is_paper: bool  # only the paper has it
    is_baseline: bool
    cells: list[CellView]
    seeds: dict[int, str]
    partly: bool  # some of its seeds are not finished
    finished: str  # `1 of 3`
    chosen: str  # of a trial of a search
    note: str


@dataclass(frozen=True, kw_only=True)
class TableView:
    """One table."""

    name: str
    title: str
    caption: str
    corner: str
    columns: list[ColumnView]
    rows: list[RowView]
    is_search: bool
    text: list[str] = field(default_factory=list)


def table_view(table: SweepTable) -> TableView:
    """The table, with the numbers that its files have."""
    columns, parts = [], []
    for place, metric in enumerate(table.columns):
        shown = table.parts(place)
        parts.append(shown)
        columns += [
            ColumnView(metric=metric.heading, part=part, lower_is_better=not metric.higher_is_better) for part in shown
        ]
    rows = []
    for row in table.rows:
        cells = []
        for metric, cell, shown in zip(table.columns, row.cells, parts, strict=True):
            for part in shown:
                if part == PAPER:
                    text, value = format_paper(cell.paper, metric), cell.paper
                    cells.append(CellView(text=text, value=value, kind="paper", best=cell.paper_best))
                elif part == "here":
                    text = format_here(cell, metric, row.done)
                    cells.append(CellView(text=text, value=cell.mean, kind="here", best=cell.best))
                else:
                    text = "baseline" if row.is_baseline else format_difference(cell, metric, row.done)
                    value = 0.0 if row.is_baseline else cell.difference
                    gain = round(value or 0.0, metric.digits) * (1 if metric.higher_is_better else -1)
                    kind = "difference" + (" better" if gain > 0 else " worse" if gain < 0 else "")
                    text, _, note = text.replace("-", "\N{MINUS SIGN}").partition(" (")
                    cells.append(CellView(text=text, note=note.rstrip(")"), value=value, kind=kind))
        rows.append(
            RowView(
                label=row.label, state=row.state, is_paper=row.state == PAPER, is_baseline=row.is_baseline, cells=cells,
                seeds=row.runs, partly=row.done != row.planned, finished=f"{row.done} of {row.planned}",
                chosen=" ".join(row.overrides), note=row.note,
            )
        )  # fmt: skip
    return TableView(
        name=table.name, title=table.title, caption=table.caption, corner=table.corner,
        columns=columns, rows=rows, is_search=table.is_search, text=table.text,
    )  # fmt: skip
