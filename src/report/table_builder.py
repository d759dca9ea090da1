"""A sweep's tables from its record and its results: which numbers stand in which row, and what each row lacks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from src.errors import DataError
from src.files.atomic_write import write_whole
from src.report.metric_names import Metric, find_metric
from src.report.results import RunResult
from src.report.score_tables import mean_bounds
from src.report.sweep_file import TableConfig
from src.report.sweep_record import RunState, SweepRecord
from src.report.sweep_table import PAPER, SweepRow, SweepTable, TableCell
from src.report.sweep_text import (
    describe_orderings,
    describe_search,
    describe_starts,
    describe_table,
    place_of,
)
from src.training.identity import RUN_ID, key_of, without_keys, without_legacy_defaults

EARLIER = "; the number is of an earlier training"
"""Added to the note on a run that has a result, though it is to be trained, trains, or failed."""


def sweep_tables(record: SweepRecord, results: dict[str, RunResult]) -> list[SweepTable]:
    """The tables of one sweep at one scale, from the results of its runs by run id; other results do not matter.

    Raises DataError as `check_results`.
    """
    used = check_results(record, results)
    return [_table(record, used, table) for table in _table_configs(record)]


def write_sweep_tables(reports: Path, record: SweepRecord, results: dict[str, RunResult]) -> list[Path]:
    """Write `tables/<table>_<scale><suffix of the record>.{md,csv,tex}` under `reports`; returns their paths.

    A result that is not among `results` is a missing one, and the table says so. Raises as `sweep_tables`, and OSError
    naming the file for a disk that does not take it.
    """
    written = []
    for table in sweep_tables(record, results):
        stem = reports / "tables" / f"{table.name}_{table.scale}{record.suffix}"
        for ending, text in (("md", table.to_markdown()), ("csv", table.to_csv()), ("tex", table.to_latex())):
            path = stem.with_name(f"{stem.name}.{ending}")
            write_whole(path, text)
            written.append(path)
    return written


def check_results(record: SweepRecord, results: Mapping[str, RunResult]) -> dict[str, RunResult]:
    """The results of a sweep's runs among all.

    Raises DataError naming the runs when they are of different scales or data, are not of the seed that they stand
    for, or differ in more than their seed within a row.
    """
    used = {run_id: results[run_id] for run_id in _run_ids(record) if run_id in results}
    check_same_data(record, used)
    check_rows(record, used)
    return used


def check_same_data(record: SweepRecord, results: dict[str, RunResult]) -> None:
    """Raises DataError naming the runs when results of one sweep are of different scales or data."""
    groups: dict[str, list[str]] = {}
    for run_id, result in results.items():
        data = ", ".join(f"{key} {value}" for key, value in sorted(result.data.items()))
        groups.setdefault(f"scale {result.scale}, {data}", []).append(run_id)
    unknown = [run_id for run_id, result in results.items() if result.scale != record.scale]
    if len(groups) > 1 or unknown:
        found = "; ".join(f"{' '.join(runs)} ({what})" for what, runs in groups.items())
        raise DataError(
            f"sweep {record.name}, scale {record.scale}: a table never mixes scales or data, but its runs are {found}; "
            "delete those of one kind under results/ in the reports folder and train them on the same data"
        )


def check_rows(record: SweepRecord, results: dict[str, RunResult]) -> None:
    """Raises DataError naming the runs when one is not of the seed it stands for, or a row's differ in other settings.

    Configurations decide, not how they were typed: what is typed may be the default.
    """
    where = f"sweep {record.name}, scale {record.scale}"
    remedy = "delete the wrong one under results/ in the reports folder and give the sweep's command again"
    rows = {} if record.sweep.is_search else record.rows
    planned = {run_id: run.seed for run_id, run in record.runs.items()}
    planned |= {run_id: seed for runs in rows.values() for seed, run_id in runs.items()}
    for run_id, result in results.items():
        if result.seed != planned[run_id]:
            raise DataError(
                f"{where}: {run_id} stands for seed {planned[run_id]}, but its result is of seed {result.seed}; "
                f"{remedy}"
            )
    for label, runs in rows.items():
        first, *others = [results[run_id] for run_id in runs.values() if run_id in results] or [None]
        for other in others:
            if _experiment(other) != _experiment(first):
                raise DataError(
                    f"{where}, row {label}: a row never mixes configurations, but {first.run_id} and {other.run_id} "
                    f"differ in more than their seed; {remedy}"
                )


def _experiment(result: RunResult) -> tuple[object, ...]:
    """What the runs of a row have in common; the run whose weights each begins with is of its seed, named or not."""
    source = result.config.get("phase", {}).get("init_from")
    named = RUN_ID.fullmatch(str(source))
    phase = named["phase"] if named else source
    config = without_keys(without_legacy_defaults(result.config), ["seed", "phase.init_from"])
    return result.model, result.phase, phase, config or result.settings


def _table_configs(record: SweepRecord) -> list[TableConfig]:
    columns = [record.sweep.objective] if record.sweep.is_search else ["mAP", "NDS"]
    return record.sweep.tables or [TableConfig(name=record.name, title=record.sweep.title, columns=columns)]


def _run_ids(record: SweepRecord) -> list[str]:
    """Runs that a table shows, without those that others only start from."""
    if not record.sweep.is_search:
        return list(dict.fromkeys(run_id for runs in record.rows.values() for run_id in runs.values()))
    sources = {run.needs for run in record.runs.values()}
    return [run_id for run_id in record.runs if run_id not in sources]


def _table(record: SweepRecord, results: dict[str, RunResult], config: TableConfig) -> SweepTable:
    sweep, is_search = record.sweep, record.sweep.is_search
    columns = [find_metric(name, config.name, sweep.task) for name in config.columns]
    if is_search:
        objective = find_metric(sweep.objective, record.name, sweep.task)
        rows, best = _trials(record, results, columns, objective)
    else:
        rows = _rows(record, results, config, columns)
    _mark_best(rows, columns)
    table = SweepTable(config.name, record.scale, config.title, "", columns, rows, is_search)
    trained = [row for row in rows if row.state != PAPER]
    complete = is_search or all(row.state == "done" for row in trained)
    shown = {run_id: results[run_id] for row in rows for run_id in row.runs.values() if run_id in results}
    table.caption = describe_table(table, record, shown, complete)
    if is_search:
        table.text = describe_search([row.state for row in rows], sweep.trials, objective, best)
    else:
        table.text = describe_orderings(columns, trained, next(iter(shown.values()), None), complete)
    if sweep.note is not None:
        table.text = [sweep.note, *table.text]
    if starts := describe_starts(_compared(record, table, results)):
        table.text.append(starts)
    return table


def _compared(
    record: SweepRecord, table: SweepTable, results: dict[str, RunResult]
) -> Iterator[tuple[RunResult, RunResult]]:
    """Runs of one seed that a table compares: of a row and its baseline; without any baseline, of each two rows."""
    for place, row in enumerate(table.rows):
        others = [] if table.baselines else [other.runs for other in table.rows[place + 1 :]]
        for other in [record.rows[row.baseline]] if row.baseline in record.rows else others:
            for seed, run_id in row.runs.items():
                if run_id != other.get(seed) and {run_id, other.get(seed)} <= results.keys():
                    yield results[run_id], results[other[seed]]


def _rows(
    record: SweepRecord, results: dict[str, RunResult], config: TableConfig, columns: list[Metric]
) -> list[SweepRow]:
    """Rows in the order of the sweep's file, the paper's own last; or those that the table names, in its order."""
    sweep = record.sweep
    rows: dict[str, SweepRow] = {}
    for row in sweep.rows:
        runs = record.rows.get(row.label, {})
        own = {seed: results.get(run_id) for seed, run_id in runs.items()}
        cells = [_cell(own, column, row.paper.get(column.name)) for column in columns]
        done = sum(is_current(record, run_id, results) for run_id in runs.values())
        state, note = _state(record, runs, results)
        baseline = sweep.baseline_of(row.label)
        rows[row.label] = SweepRow(row.label, cells, state, note, len(runs), done, baseline, dict(runs))
    for other in sweep.paper_rows:
        cells = [TableCell(paper=other.paper.get(column.name)) for column in columns]
        rows[other.label] = SweepRow(other.label, cells, PAPER, baseline=sweep.baseline)
    for row in rows.values():
        _take_differences(row, rows.get(row.baseline or ""), columns)
    return list(rows.values()) if config.rows is None else [rows[label] for label in config.rows]


def _trials(
    record: SweepRecord, results: dict[str, RunResult], columns: list[Metric], objective: Metric
) -> tuple[list[SweepRow], tuple[str, list[str], float] | None]:
    """Trials by objective, the best first; pruned, failed and open ones below. And the best, see `describe_search`."""
    scored: list[tuple[SweepRow, float | None]] = []
    for run_id in _run_ids(record):
        run, result = record.runs[run_id], results.get(run_id)
        cells = [_cell({run.seed: result}, column) for column in columns]
        state, note = _state(record, {run.seed: run_id}, results)
        if state == "pruned" and run.value is not None:
            note = f"pruned at {objective.title} {run.value * objective.scale:.{objective.digits}f}"
            note += EARLIER if result is not None else ""
        chosen = [override for override in run.overrides if key_of(override) in record.sweep.space]
        done = int(is_current(record, run_id, results))
        row = SweepRow(run.label, cells, state, note, 1, done, None, {run.seed: run_id}, chosen)
        scored.append((row, run.value if result is None else result.metrics.get(objective.name)))
    order = ("done", "pruned", "failed", "running", "waiting")
    scored.sort(key=lambda pair: (order.index(pair[0].state), -pair[1] if pair[1] is not None else float("inf")))
    best = next(((r.label, r.overrides, v) for r, v in scored[:1] if r.state == "done" and v is not None), None)
    return [row for row, _ in scored], best


def _take_differences(row: SweepRow, baseline: SweepRow | None, columns: list[Metric]) -> None:
    if baseline is None or row is baseline:
        return
    for cell, base, column in zip(row.cells, baseline.cells, columns, strict=True):
        cell.comparison = cell.compared_with(base, column)
        if cell.paper is not None and base.paper is not None:
            cell.paper_difference = round(cell.paper - base.paper, 6)  # 18.6 - 20.3 is -1.6999999999999993


def _mark_best(rows: list[SweepRow], columns: list[Metric]) -> None:
    """The finished row that is decided against each other one, and the paper's best number, column by column."""
    for place, column in enumerate(columns):
        best = max if column.higher_is_better else min
        finished = [row.cells[place] for row in rows if row.state == "done" and row.cells[place].mean is not None]
        papers = {row.cells[place].paper for row in rows} - {None}
        for cell in finished:
            against = [cell.compared_with(other, column) for other in finished if other is not cell]
            cell.best = bool(against) and all(found is not None and found.favours(column) for found in against)
        for row in rows:
            row.cells[place].paper_best = len(papers) > 1 and row.cells[place].paper == best(papers)


def _cell(results: dict[int, RunResult | None], metric: Metric, paper: float | None = None) -> TableCell:
    found = {seed: result.metrics.get(metric.name) for seed, result in results.items() if result is not None}
    values = {seed: metric.scale * value for seed, value in found.items() if value is not None}
    bounds = mean_bounds([results[seed] for seed in values], metric)
    cell = TableCell(paper=paper, values=values, bounds=bounds)
    if len(values) == 1:
        (result,) = (results[seed] for seed in values)
        cell.frames = _frames(result, metric.name)
        cell.place = None if cell.frames is None else place_of(result.latency)
    return cell


def _frames(result: RunResult, metric: str) -> float | None:
    """Half the range of the middle half of a run's frames; of the frames per second by that of their time."""
    group, _, part = metric.partition(".")
    if group != "latency" or result.latency is None:
        return None
    spreads = result.latency.get("spread_ms", {})
    total = result.metrics.get("latency.total")
    if part == "fps" and total and "total" in spreads:
        return 0.5 * spreads["total"] / total * result.metrics["latency.fps"]
    return 0.5 * spreads[part] if part in spreads else None


def is_current(record: SweepRecord, run_id: str, results: dict[str, RunResult]) -> bool:
    """Whether there is a result and the record does not say that it is of an earlier training."""
    return run_id in results and (run_id not in record.runs or record.runs[run_id].state == "done")


def _state(record: SweepRecord, runs: dict[int, str], results: dict[str, RunResult]) -> tuple[str, str]:
    """State of a row, and what is to be said of the runs that have not finished, or have no result."""
    open_runs = {seed: run_id for seed, run_id in runs.items() if not is_current(record, run_id, results)}
    if not open_runs and runs:
        return "done", ""
    states, notes = set(), []
    for seed, run_id in open_runs.items():
        run = record.runs.get(run_id)
        state = run.state if run is not None else "waiting"
        states.add(state)
        note = _note(run, run_id, has_result=run_id in results)
        note += f", seed {seed}" if len(runs) > 1 and (state in ("failed", "done") or run_id in results) else ""
        notes.append(note + (EARLIER if run_id in results else ""))
    state = next((s for s in ("failed", "done", "running", "pruned", "waiting") if s in states), "waiting")
    state = "failed" if state == "done" else state  # done without a result
    return state, "; ".join(dict.fromkeys(notes)) or "not run yet"


def _note(run: RunState | None, run_id: str, has_result: bool) -> str:
    if run is None or run.state == "waiting":
        return "waiting" if has_result else "not run yet"
    if run.state == "failed":
        return f"failed{' again' if has_result else ''}: {run.reason or 'no reason recorded'} ({run.log or 'no log'})"
    if run.state == "done":
        return f"result missing or not readable: results/{run_id}.json"
    return run.state
