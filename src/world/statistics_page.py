"""The page that shows a data set's figures beside the real ones: tables in Markdown, curves by class and distance."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from src.files.atomic_write import write_whole
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import INK
from src.pictures.learning_curves import LINE_COLOURS, style_axes
from src.world.real_comparison import FEWEST_BOXES, Cell, FigureTable

PLOTTED = {
    "support": "Boxes with a radar point, %",
    "support_grown": "Boxes with a radar point once grown by 0.5 m, %",
    "hidden": "Boxes of which less than 40 % is visible, %",
    "ranges": "Radar points by range, % in bins of 5 m",
}
WORLD_COLOUR, REAL_COLOUR = LINE_COLOURS[0], INK
PANEL_PX, PANELS_PER_ROW = 250, 4


def write_page(folder: Path, tables: list[FigureTable], what: str, command: str) -> Path:
    """`statistics.md` in a folder with its pictures; `what` says which data set it is, `command` how to measure it."""
    for table in tables:
        if table.name in PLOTTED:
            draw_table(folder / f"{table.name}.png", table, PLOTTED[table.name])
    path = folder / "statistics.md"
    write_whole(path, page_text(tables, what, command))
    return path


def page_text(tables: list[FigureTable], what: str, command: str) -> str:
    """The page in Markdown."""
    lines = [
        "# The synthetic highway beside MAN TruckScenes",
        "",
        f"{what}. `{command}` counts it from its own files and writes this page.",
        "",
        "Cells are *this data set / MAN TruckScenes*, with the number of boxes in brackets; bold where they differ by "
        f"more than the page allows and the real figure rests on at least {FEWEST_BOXES} boxes. The real figures are "
        "third-party measurements published in public repositories, which we could not check; "
        "`src/world/real_statistics.yaml` holds them with the source of each. Where a table says nothing else they are "
        "of v1.2-mini: ten scenes, six of them in cities and terminals.",
        "",
        *verdict(tables),
        "",
    ]
    for table in tables:
        lines += [f"## {table.title}", ""]
        if table.name in PLOTTED:
            lines += [f"![{PLOTTED[table.name]}]({table.name}.png)", ""]
        if table.name != "ranges":
            lines += [*table_lines(table), ""]
        if table.sources:
            lines += [f"Unit: {table.unit}. Trust: {table.trust}. Source: {'; '.join(table.sources)}.", ""]
        else:
            lines += [f"Unit: {table.unit}. No real figure is known.", ""]
    return "\n".join(lines)


def verdict(tables: list[FigureTable]) -> list[str]:
    """For each table with an allowance how many cells keep it, and those that do not."""
    lines = []
    for table in tables:
        if table.allowed is None:
            continue
        beyond, compared = table.beyond(), table.compared()
        allowed = f"{table.allowed:g}"
        if table.allowed_heavy is not None:
            allowed += f" (truck, bus, trailer: {table.allowed_heavy:g})"
        text = f"- {table.title}: {compared - len(beyond)} of {compared} cells within {allowed} points"
        cells = (f"{group} {column} m {world:.0f} / {real:.0f}" for group, column, world, real in beyond)
        lines.append(f"{text}; beyond: {', '.join(cells)}" if beyond else text)
    return lines


def table_lines(table: FigureTable) -> list[str]:
    """One table in Markdown."""
    columns, beyond = table.columns(), {(group, column) for group, column, *_ in table.beyond()}
    lines = ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for group in table.groups():
        cells = []
        for column in columns:
            here, there = table.world.get(group, {}).get(column), table.real.get(group, {}).get(column)
            text = _pair(here, there) if table.real else _number(here)
            cells.append(f"**{text}**" if (group, column) in beyond else text)
        lines.append(f"| {group.replace('_', ' ')} | " + " | ".join(cells) + " |")
    return lines


def _pair(here: Cell | None, there: Cell | None) -> str:
    return "" if here is None and there is None else f"{_number(here)} / {_number(there)}"


def _number(cell: Cell | None) -> str:
    if cell is None:
        return "–"
    value, boxes = cell
    text = f"{value:.0f}" if abs(value) >= 20 or value == round(value) else f"{value:.1f}"
    return text if boxes is None else f"{text} ({boxes})"


def draw_table(path: Path, table: FigureTable, title: str) -> None:
    """One panel per row: the world's curve and the real one over distance."""
    groups, columns = table.groups(), table.columns()
    rows = -(-len(groups) // PANELS_PER_ROW)
    across = min(len(groups), PANELS_PER_ROW)
    canvas = Canvas(SHEET_PX, 80 + rows * PANEL_PX)
    canvas.text(12, 10, title, 20, bold=True)
    keys = [
        Line2D([], [], color=WORLD_COLOUR, marker="o", label="this data set"),
        Line2D([], [], color=REAL_COLOUR, marker="s", label="MAN TruckScenes (hollow: fewer than 50 boxes)"),
    ]
    canvas.legend(12, 42, keys)
    width = (SHEET_PX - 40) / across
    for place, group in enumerate(groups):
        row, column = divmod(place, PANELS_PER_ROW)
        axes = canvas.axes(50 + column * width, 100 + row * PANEL_PX, width - 50, PANEL_PX - 70)
        style_axes(axes, group.replace("_", " "))
        _draw_curve(axes, columns, table.world.get(group, {}), WORLD_COLOUR, "o")
        _draw_curve(axes, columns, table.real.get(group, {}), REAL_COLOUR, "s")
        step = max(1, len(columns) // 8)
        axes.set_xticks(range(0, len(columns), step), columns[::step])
        axes.set_xlim(-0.5, len(columns) - 0.5)
        axes.set_xlabel("distance, m", fontsize=9, labelpad=1)
        axes.set_ylim(0, 100 if table.allowed is not None or table.name == "support_grown" else None)
    canvas.save(path, photographs=False)


def _draw_curve(axes: Axes, columns: list[str], row: dict[str, Cell], colour: str, marker: str) -> None:
    known = [(place, row[name]) for place, name in enumerate(columns) if name in row]
    axes.plot([place for place, _ in known], [cell[0] for _, cell in known], color=colour, linewidth=1.6)
    for place, (value, boxes) in known:
        filled = colour if boxes is None or boxes >= FEWEST_BOXES else "white"
        axes.plot(place, value, marker=marker, color=colour, markerfacecolor=filled, markersize=5)
