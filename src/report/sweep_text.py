"""The text under a sweep's table: what was run, and which of the paper's orderings hold here."""

from __future__ import annotations

import statistics

from src.report.metric_names import Metric
from src.report.orderings import LEAST_SEEDS, Ordering, describe_test, find_orderings, paired_gains
from src.report.results import Latency, RunResult
from src.report.sweep_record import SweepRecord
from src.report.sweep_table import SweepRow, SweepTable, format_paper, rounded

SYNTHETIC = "synthetic highway"
MAIN = ("mAP", "NDS")
"""Columns whose rows are compared one by one; a table without them has its first one compared so."""


def describe_table(table: SweepTable, record: SweepRecord, results: dict[str, RunResult], complete: bool) -> str:
    """Data, scale, epochs, seeds, commits and devices of a table, and what its differences are taken to."""
    seeds = sorted({seed for runs in record.rows.values() for seed in runs} or {r.seed for r in record.runs.values()})
    data = "Data: no run has finished yet"
    if results:
        any_result = next(iter(results.values()))
        data = f"Data: {any_result.dataset}, split {any_result.data.get('split', 'unknown')}"
    parts = [data, f"scale {record.scale}"]
    parts += [f"with {' '.join(record.changes)}"] if record.changes else []
    if results:
        by_phase: dict[str, set[int]] = {}
        for result in results.values():
            by_phase.setdefault(result.phase, set()).add(result.epochs)
        for phase, epochs in sorted(by_phase.items()):
            parts.append(f"{phase}: {_listed(sorted(epochs))} epoch{'' if epochs == {1} else 's'}")
    spread = "mean ± standard deviation" if len(seeds) > 1 else "one seed, so no spread"
    parts.append(f"seed{'s' if len(seeds) > 1 else ''} {_listed(seeds)}: {spread}")
    code, devices = set(), set()
    for result in results.values():
        code.add(result.commit[:10] + ("+" if result.commit.endswith("+") else ""))
        threads = f"{_counted(result.processes, 'process')} of {_counted(result.threads, 'thread')}"
        devices.add(f"{result.device}, {threads}")
    for words, found in (("code ", code), ("", devices)):
        parts += [words + _listed(sorted(found))] if found else []
    text = "; ".join(parts) + "."
    text += "" if complete else " Bold is the best of the rows whose seeds have all finished."
    if table.baselines:
        brackets = "; the paper's in brackets" if any(map(table.has_paper, range(len(table.columns)))) else ""
        text += f" Differences are to {' or '.join(table.baselines)}, seed by seed{brackets}."
    return text + _latency(table, [result.latency for result in results.values() if result.latency is not None])


def _latency(table: SweepTable, timed: list[Latency]) -> str:
    """Where a table's latencies were measured and what stands after their ±; empty for a table without any."""
    if not timed or not any(column.name.startswith("latency.") for column in table.columns):
        return ""
    places = {
        f"{latency.get('processor') or latency.get('device') or 'an unnamed device'}, "
        f"{_counted(latency.get('threads', 1), 'thread')}"
        for latency in timed
    }
    text = f" Latency on {_listed(sorted(places))}"
    if any(is_busy(latency.get("load"), latency.get("cores")) for latency in timed):
        text += ", measured on a busy machine, so rows may differ by what else ran"
    if all(cell.frames is None for row in table.rows for cell in row.cells):
        return f"{text}."
    return (
        f"{text}; after ± of a latency that one run has stands half the range of the middle half of its frames, and "
        "none is bold where the best and the next are no further apart than these."
    )


def is_busy(load: float | None, cores: int | None) -> bool:
    """Whether more than half of the processor was taken when a measurement began; not known of older files."""
    return load is not None and cores is not None and load > 0.5 * cores


def findings(columns: list[Metric], rows: list[SweepRow], result: RunResult | None, complete: bool) -> list[str]:
    """What the numbers of trained rows say: a frame, then a sentence each. `result` is any of the table's."""
    if result is None:
        return ["No run has finished yet."]
    main = [name for name in MAIN if name in [column.name for column in columns]] or [columns[0].name]
    baselines = {row.label: row.baseline for row in rows if row.baseline is not None}
    sentences, tested = [], []  # `tested`: common seeds of each comparison
    for place, column in enumerate(columns):
        paper = {row.label: row.cells[place].paper for row in rows if row.cells[place].paper is not None}
        values = {row.label: row.cells[place].values for row in rows}
        orderings = find_orderings(paper, values, column.higher_is_better, column.digits)
        if orderings:
            sentences.append(_count(column, orderings, complete))
        if column.name in main:
            for first, second in _pairs(orderings, values, baselines):
                sentences.append(_comparison(column, first, second, paper, values))
                tested.append(len(paired_gains(values[first], values[second])))
    decisive = sum(seeds >= LEAST_SEEDS for seeds in tested)
    if tested and not decisive:
        sentences.append(
            f"With {_counted(max(tested), 'seed')} no sign test can decide at 5 %, however clear the numbers look: "
            f"that takes {LEAST_SEEDS} seeds."
        )
    if decisive > 1:
        sentences.append(f"The p-values of these {decisive} sign tests are not corrected for their number.")
    if not sentences:
        alone = "One row is trained here, so there is nothing to compare it with."
        sentences.append("No two of the rows can be compared yet." if len(rows) > 1 else alone)
    has_paper = any(cell.paper is not None for row in rows for cell in row.cells)
    return [_frame(result, has_paper), *sentences]


def describe_search(
    states: list[str], trials: int, objective: Metric, best: tuple[str, list[str], float] | None
) -> list[str]:
    """What became of a search's trials, and the best one: its label, what the search chose for it, its objective."""
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("pruned", "failed"))
    text = f"{states.count('done')} of {_counted(trials, 'trial')} finished, {counts}."
    if best is None:
        return [text]
    label, chosen, value = best
    number = f"{objective.title} {value * objective.scale:.{objective.digits}f}"
    return [
        text,
        f"The best one, {label}, reaches {number} with {' '.join(chosen)}. It was chosen on the split that it is "
        "scored by, which flatters it: train it with other seeds before it is compared.",
    ]


def _frame(result: RunResult, has_paper: bool) -> str:
    synthetic = result.data["name"] == SYNTHETIC
    where = f"{f'the {SYNTHETIC}' if synthetic else result.data['name']}, scale {result.scale}"
    if not has_paper:
        text = f"Seen on {where}; the paper has no numbers for these rows."
        return text + (" It says nothing about results on TruckScenes." if synthetic else "")
    if synthetic:
        return (
            f"A check on {where}, of what the paper found on TruckScenes: it can show whether the paper's orderings "
            "appear here. Its numbers are not results on TruckScenes, and how large they are does not compare with the "
            "paper's."
        )
    size = "" if result.scale == "paper" else ", which is not the paper's size of model and training"
    return f"A check on {where}{size}, of the paper's orderings."


def _pairs(
    orderings: list[Ordering], values: dict[str, dict[int, float]], baselines: dict[str, str]
) -> list[tuple[str, str]]:
    """Rows to compare one by one: each with its baseline; without any, each of the paper's with its next one."""
    if baselines:
        pairs = [(label, base) for label, base in baselines.items() if label != base and base in values]
        return [(label, base) for label, base in pairs if paired_gains(values[label], values[base])]
    nearest: dict[str, str] = {}
    for ordering in orderings:  # the first one of a row stands nearest
        nearest.setdefault(ordering.better, ordering.worse)
    return list(nearest.items())


def _count(column: Metric, orderings: list[Ordering], complete: bool) -> str:
    ties = sum(ordering.ties for ordering in orderings)
    holding = sum(ordering.holds for ordering in orderings)
    broken = [f"{o.better} before {o.worse}" for o in orderings if not (o.holds or o.ties)]
    so_far = "" if complete else "so far "
    if len(orderings) == 1:
        verb = "ties at the digits shown" if ties else "does not hold here" if broken else "holds here"
        return f"{column.title}: {so_far}the paper's one ordering of two rows {verb} in the mean."
    text = f"{column.title}: {so_far}{holding} of the paper's {len(orderings)} orderings of two "
    text += f"rows {'holds' if holding == 1 else 'hold'} here in the mean"
    text += f", {ties} {'ties' if ties == 1 else 'tie'} at the digits shown" if ties else ""
    return text + (f"; those that do not: {', '.join(broken)}." if broken else ".")


def _comparison(
    column: Metric, first: str, second: str, paper: dict[str, float], values: dict[str, dict[int, float]]
) -> str:
    """One row against another: the paper's difference, the one here, and the sign test over seeds."""
    differences = list(paired_gains(values[first], values[second]).values())
    mean, digits = rounded(statistics.mean(differences), column), column.digits
    here = f"here {mean:+.{digits}f}"
    here += f" ± {statistics.stdev(differences):.{digits}f}" if len(differences) > 1 else ""
    toward = 1.0 if column.higher_is_better else -1.0
    text, of_paper = f"{column.title}, {first} against {second}: ", 0.0
    if first in paper and second in paper:
        of_paper = round(paper[first] - paper[second], 6) + 0.0
        text += f"paper {format_paper(of_paper, column, signed=True)}, "
    if of_paper:
        toward = 1.0 if of_paper > 0 else -1.0
        verdict = ", in the paper's order" if mean * toward > 0 else ", not in the paper's order"
        side = "on the paper's side"
    else:
        verdict, side = "", "better"
    if mean == 0:
        verdict = ", no difference at the digits shown"
    wins, losses = (sum(sign * toward * d > 0 for d in differences) for sign in (1, -1))
    seeds = f"{wins} of {_counted(len(differences), 'seed')} {side} ({describe_test(wins, losses)})"
    return f"{text}{here}{verdict}; {seeds}."


def _listed(items: list[object]) -> str:
    return ", ".join(str(item) for item in items)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 'es' if noun.endswith('s') else 's'}"
