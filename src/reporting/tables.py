"""Runs into Markdown: one row per experiment, mean and spread over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable

from src.reporting.results import RunResult

RANGES = ("0-25", "25-50", "50-100", "100-150")


def experiment_tables(runs: list[RunResult], names: dict[tuple[str, ...], str]) -> str:
    """Two tables: the summary, and AP by class; percent, mean ± standard deviation over seeds, best mean in bold.

    `names` labels known settings; others show their overrides. Raises ValueError when the runs are of different data.
    """
    if len({run.data for run in runs}) > 1:
        raise ValueError(f"a table never mixes data, but these runs used {sorted({run.data for run in runs})}")
    groups: dict[tuple[str, ...], list[RunResult]] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        groups.setdefault(run.settings, []).append(run)
    order = sorted(groups, key=lambda key: -statistics.mean(run.metrics["mAP"] for run in groups[key]))
    labels = [names.get(key) or f"`{' '.join(key) or 'defaults'}`" for key in order]

    summary: dict[str, Callable[[RunResult], float]] = {
        "mAP": lambda run: run.metrics["mAP"],
        "NDS": lambda run: run.metrics["NDS"],
        "car AP": lambda run: run.metrics["classes"]["car"]["AP"],
    }
    summary |= {f"mAP {name} m": lambda run, name=name: run.metrics["ranges"][name]["mAP"] for name in RANGES}
    rows = [groups[key] for key in order]
    text = _table("experiment", labels, rows, summary)
    text += "\n\n" + _table(
        "experiment",
        labels,
        rows,
        {name: lambda run, name=name: run.metrics["classes"][name]["AP"] for name in runs[0].metrics["classes"]},
    )
    text += "\n\n| experiment | seeds | parameters | time, s | peak memory, MiB |\n|---|---|---|---|---|"
    for label, group in zip(labels, rows, strict=True):
        seeds = ", ".join(str(run.seed) for run in group)
        slowest, largest = max(run.seconds for run in group), max(run.peak_memory_mib for run in group)
        text += f"\n| {label} | {seeds} | {group[0].parameters / 1e6:.2f} M | {slowest:.0f} | {largest} |"
    return text


def _table(
    corner: str, labels: list[str], rows: list[list[RunResult]], columns: dict[str, Callable[[RunResult], float]]
) -> str:
    means = {
        name: [statistics.mean(100 * read(run) for run in group) for group in rows] for name, read in columns.items()
    }
    lines = [f"| {corner} | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for place, (label, group) in enumerate(zip(labels, rows, strict=True)):
        cells = []
        for name, read in columns.items():
            mean = means[name][place]
            text = f"{mean:.1f}"
            if len(group) > 1:
                text += f" ± {statistics.stdev(100 * read(run) for run in group):.1f}"
            cells.append(f"**{text}**" if len(rows) > 1 and mean == max(means[name]) else text)
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)
