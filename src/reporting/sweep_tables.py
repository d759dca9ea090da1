"""A sweep's tables from its record and its results: which numbers stand in which row, and what each row lacks."""

from __future__ import annotations

from pathlib import Path

from src.errors import DataError
from src.overrides import key_of
from src.reporting.metric_names import METRICS, Metric
from src.reporting.orderings import paired_gains
from src.reporting.results import RunResult, read_result, result_path
from src.reporting.sweep_file import TableConfig
from src.reporting.sweep_record import RunState, SweepRecord
from src.reporting.sweep_table import PAPER, Cell, SweepRow, SweepTable
from src.reporting.sweep_text import describe_differences, describe_runs, describe_search, findings
from src.reporting.writing import write_whole


def sweep_tables(record: SweepRecord, results: dict[str, RunResult]) -> list[SweepTable]:
    """The tables of one sweep at one scale, from the results of its runs by run id; other results do not matter.

    Raises DataError naming the runs when they are of different scales or data.
    """
    used = {run_id: results[run_id] for run_id in _run_ids(record) if run_id in results}
    check_same_data(record, used)
    return [_search_table(record, used, table) if record.sweep.is_search else _row_table(record, used, table)
            for table in _table_configs(record)]  # fmt: skip


def write_sweep_tables(reports: Path, record: SweepRecord, results: dict[str, RunResult] | None = None) -> list[Path]:
    """Write `tables/<table>_<scale>.{md,csv,tex}` under `reports`; returns their paths.

    Results that are not given are read; one that cannot be read is a missing one, and the table says so. Raises as
    `sweep_tables`, and OSError naming the file for a disk that does not take it.
    """
    if results is None:
        results = {}
        for run_id in _run_ids(record):
            try:
                results[run_id] = read_result(result_path(reports, run_id))
            except DataError:  # the row's state names the file
                continue
    written = []
    for table in sweep_tables(record, results):
        stem = reports / "tables" / f"{table.name}_{table.scale}"
        for ending, text in (("md", table.to_markdown()), ("csv", table.to_csv()), ("tex", table.to_latex())):
            path = stem.with_name(f"{stem.name}.{ending}")
            write_whole(path, text)
            written.append(path)
    return written


def check_same_data(record: SweepRecord, results: dict[str, RunResult]) -> None:
    """Raises DataError naming the runs when results of one sweep are of different scales or data."""
    groups: dict[str, list[str]] = {}
    for run_id, result in results.items():
        data = ", ".join(f"{key} {value}" for key, value in sorted(result.data.items()))
        groups.setdefault(f"scale {result.scale}, {data}", []).append(run_id)
    strange = [run_id for run_id, result in results.items() if result.scale != record.scale]
    if len(groups) > 1 or strange:
        found = "; ".join(f"{' '.join(runs)} ({what})" for what, runs in groups.items())
        raise DataError(
            f"sweep {record.name}, scale {record.scale}: a table never mixes scales or data, but its runs are {found}; "
            "delete those of one kind under results/ in the reports folder and train them on the same data"
        )


def _table_configs(record: SweepRecord) -> list[TableConfig]:
    columns = [record.sweep.objective] if record.sweep.is_search else ["mAP", "NDS"]
    return record.sweep.tables or [TableConfig(name=record.name, title=record.sweep.title, columns=columns)]


def _run_ids(record: SweepRecord) -> list[str]:
    """Runs that a table shows, without those that others only start from."""
    if not record.sweep.is_search:
        return list(dict.fromkeys(run_id for runs in record.rows.values() for run_id in runs.values()))
    sources = {run.needs for run in record.runs.values()}
    return [run_id for run_id in record.runs if run_id not in sources]


def _row_table(record: SweepRecord, results: dict[str, RunResult], config: TableConfig) -> SweepTable:
    columns, sweep = [METRICS[name] for name in config.columns], record.sweep
    rows: dict[str, SweepRow] = {}
    for row in sweep.rows:
        runs = record.rows.get(row.label, {})
        own = {seed: results.get(run_id) for seed, run_id in runs.items()}
        cells = [Cell(paper=row.paper.get(column.name), values=_values(own, column)) for column in columns]
        done = sum(result is not None for result in own.values())
        state, note = _state(record, runs, results)
        baseline = sweep.baseline_of(row.label)
        rows[row.label] = SweepRow(row.label, cells, state, note, len(runs), done, baseline, dict(runs), x=row.x)
    for other in sweep.paper_rows:
        cells = [Cell(paper=other.paper.get(column.name)) for column in columns]
        rows[other.label] = SweepRow(other.label, cells, PAPER, baseline=sweep.baseline)
    for row in rows.values():
        _take_differences(row, rows.get(row.baseline or ""))
    shown = [rows[label] for label in config.rows] if config.rows is not None else list(rows.values())
    _mark_best(shown, columns)
    table = SweepTable(config.name, record.scale, config.title, "", columns, shown, is_search=False)
    trained = [row for row in shown if row.state != PAPER]
    complete = all(row.state == "done" for row in trained)
    table.caption = describe_runs(record, results, complete)
    table.caption += describe_differences(table.baselines, any(map(table.has_paper, range(len(columns)))))
    table.text = findings(columns, trained, next(iter(results.values()), None), complete)
    return table


def _search_table(record: SweepRecord, results: dict[str, RunResult], config: TableConfig) -> SweepTable:
    """Trials by objective, the best first; pruned, failed and open ones below."""
    columns = [METRICS[name] for name in config.columns]
    objective = METRICS[record.sweep.objective]
    scored: list[tuple[SweepRow, float | None]] = []
    for run_id in _run_ids(record):
        run, result = record.runs[run_id], results.get(run_id)
        cells = [Cell(values=_values({run.seed: result}, column)) for column in columns]
        state, note = _state(record, {run.seed: run_id}, results)
        if state == "pruned" and run.value is not None:
            note = f"pruned at {objective.title} {run.value * objective.scale:.{objective.digits}f}"
        chosen = [override for override in run.overrides if key_of(override) in record.sweep.space]
        row = SweepRow(run.label, cells, state, note, 1, int(result is not None), None, {run.seed: run_id}, chosen)
        scored.append((row, run.value if result is None else result.metrics.get(objective.name)))
    order = ("done", "pruned", "failed", "running", "waiting")
    scored.sort(key=lambda pair: (order.index(pair[0].state), -pair[1] if pair[1] is not None else float("inf")))
    rows = [row for row, _ in scored]
    _mark_best(rows, columns)
    table = SweepTable(config.name, record.scale, config.title, "", columns, rows, is_search=True)
    table.caption = describe_runs(record, results, complete=True)
    best = next(((r.label, r.overrides, v) for r, v in scored[:1] if r.state == "done" and v is not None), None)
    table.text = describe_search([row.state for row in rows], record.sweep.trials, objective, best)
    return table


def _take_differences(row: SweepRow, baseline: SweepRow | None) -> None:
    if baseline is None or row is baseline:
        return
    for cell, base in zip(row.cells, baseline.cells, strict=True):
        cell.differences = paired_gains(cell.values, base.values)
        if cell.paper is not None and base.paper is not None:
            cell.paper_difference = round(cell.paper - base.paper, 6)  # 18.6 - 20.3 is -1.6999999999999993


def _mark_best(rows: list[SweepRow], columns: list[Metric]) -> None:
    """The best mean of the finished rows and the paper's best number, column by column; none where all are equal."""
    for place, column in enumerate(columns):
        best = max if column.higher_is_better else min
        means = {row.cells[place].mean for row in rows if row.state == "done"} - {None}
        papers = {row.cells[place].paper for row in rows} - {None}
        for row in rows:
            cell = row.cells[place]
            cell.best = len(means) > 1 and row.state == "done" and cell.mean == best(means)
            cell.paper_best = len(papers) > 1 and cell.paper == best(papers)


def _values(results: dict[int, RunResult | None], metric: Metric) -> dict[int, float]:
    found = {seed: result.metrics.get(metric.name) for seed, result in results.items() if result is not None}
    return {seed: metric.scale * value for seed, value in found.items() if value is not None}


def _state(record: SweepRecord, runs: dict[int, str], results: dict[str, RunResult]) -> tuple[str, str]:
    """State of a row, and what is to be said of the runs without a result."""
    open_runs = {seed: run_id for seed, run_id in runs.items() if run_id not in results}
    if not open_runs and runs:
        return "done", ""
    states, notes = set(), []
    for seed, run_id in open_runs.items():
        run = record.runs.get(run_id)
        state = run.state if run is not None else "waiting"
        states.add(state)
        notes.append(_note(run, run_id) + (f", seed {seed}" if len(runs) > 1 and state in ("failed", "done") else ""))
    state = next((s for s in ("failed", "done", "running", "pruned", "waiting") if s in states), "waiting")
    state = "failed" if state == "done" else state  # done without a result
    return state, "; ".join(dict.fromkeys(notes)) or "not run yet"


def _note(run: RunState | None, run_id: str) -> str:
    if run is None or run.state == "waiting":
        return "not run yet"
    if run.state == "failed":
        return f"failed: {run.reason or 'no reason recorded'} ({run.log or 'no log'})"
    if run.state == "done":
        return f"result missing or not readable: results/{run_id}.json"
    return run.state
