"""The text under a sweep's table: what was run, and which of the paper's orderings hold here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from src.report.comparisons import EQUAL, UNDECIDED, Comparison
from src.report.metric_names import Metric
from src.report.result_schema import Latency, is_busy
from src.report.results import RunResult
from src.report.sweep_record import SweepRecord
from src.report.sweep_table import SweepRow, SweepTable
from src.training.identity import key_of

SYNTHETIC = "synthetic highway"
MAIN = ("mAP", "NDS")
"""Metrics that the finding is about; in a table without them it is about all."""
OF_EVERY_CAPTION = ("phase", "model")
"""Common overrides that a table's title and rows tell."""
NAMED = 3
"""Orderings that hold are named up to this number."""


def describe_table(table: SweepTable, record: SweepRecord, results: dict[str, RunResult], complete: bool) -> str:
    """Data, scale, epochs, seeds, commits and devices of a table, and what its differences are taken to.

    `results` are those of the rows that it shows.
    """
    seeds = sorted({seed for row in table.rows for seed in row.runs} or {run.seed for run in record.runs.values()})
    data = "Data: no run has finished yet"
    if results:
        any_result = next(iter(results.values()))
        data = f"Data: {any_result.dataset}, split {any_result.data.get('split', 'unknown')}"
    parts = [data, f"scale {record.scale}"]
    settings = sweep_settings(record)
    parts += [f"with {' '.join(settings)}"] if settings else []
    parts += describe_epochs(results.values())
    parts.append(f"seed{'s' if len(seeds) > 1 else ''} {_listed(seeds)}{', of which means' if len(seeds) > 1 else ''}")
    parts += describe_machines(results.values())
    text = "; ".join(parts) + "."
    text += _scene_intervals(results)
    if table.shows_differences:
        text += f" Differences are to {' or '.join(table.baselines)}, seed by seed, with Student's 95 % interval."
    if not table.is_search:
        text += " Bold is decided against every other row" + ("." if complete else " whose seeds have all finished.")
    return text + _latency(table, [result.latency for result in results.values() if result.latency is not None])


def sweep_settings(record: SweepRecord) -> list[str]:
    """What all runs of a sweep override, but for what its title and rows tell."""
    return [one for one in record.sweep.overrides if key_of(one) not in OF_EVERY_CAPTION] + record.changes


def describe_epochs(results: Iterable[RunResult]) -> list[str]:
    """How long each phase was trained."""
    by_phase: dict[str, set[int]] = {}
    for result in results:
        by_phase.setdefault(result.phase, set()).add(result.epochs)
    return [
        f"{phase}: {_listed(sorted(epochs))} epoch{'' if epochs == {1} else 's'}"
        for phase, epochs in sorted(by_phase.items())
    ]


def describe_starts(pairs: Iterable[tuple[RunResult, RunResult]]) -> str:
    """Which runs began from another training of one run than the one they are compared with, and of how many pairs it
    is not recorded; empty where none did.

    Such pairs share less than their seed says.
    """
    pairs = {tuple(run.run_id for run in pair): pair for pair in pairs}
    starts = [found for pair in pairs.values() if (found := _starts(*pair)) is not None]
    apart = list(dict.fromkeys(run.run_id for run, *weights in starts if None not in weights and len({*weights}) > 1))
    unknown = sum(None in weights for _, *weights in starts)
    parts = []
    if apart:
        parts.append(
            "Of runs that begin from one run's weights, these began from another training of it than the one that they "
            f"are compared with, whose noise is in those differences and intervals: {', '.join(apart)}."
        )
    if unknown:
        parts.append(f"Of {counted(unknown, 'such pair')} it is not recorded whether both began from one training.")
    return " ".join(parts)


def _starts(first: RunResult, second: RunResult) -> tuple[RunResult, str | None, str | None] | None:
    """Of two runs the one that began from the other, or from the run that both begin from, with the digests of the
    weights that it began from and of those that the other has or began from."""
    for run, other in ((first, second), (second, first)):
        if run.initialized_from == other.run_id:
            return run, run.initial_weights, other.weights
        if run.initialized_from is not None and run.initialized_from == other.initialized_from:
            return run, run.initial_weights, other.initial_weights
    return None


def describe_machines(results: Iterable[RunResult]) -> list[str]:
    """The code that trained, and where."""
    code, devices = set(), set()
    for result in results:
        code.add(result.commit[:10] + ("+" if result.commit.endswith("+") else ""))
        threads = f"{counted(result.processes, 'process')} of {counted(result.threads, 'thread')}"
        devices.add(f"{result.device}, {threads}{_products(result)}")
    return [words + _listed(sorted(found)) for words, found in (("code ", code), ("", devices)) if found]


def _products(result: RunResult) -> str:
    """In what a run multiplied that asks for bfloat16 where the processor has it; empty for one that did not say."""
    if result.config.get("precision") != "bf16-products" or not result.cpu_products:
        return ""
    dtype = "float32" if result.cpu_products["bfloat16"] == "never" else "bfloat16"
    return f" (matrix products in {dtype})"


def _scene_intervals(results: dict[str, RunResult]) -> str:
    counts = sorted({result.scenes for result in results.values() if result.intervals})
    return f" In brackets 95 % intervals over the {_listed(counts)} validation scenes." if counts else ""


def _latency(table: SweepTable, timed: list[Latency]) -> str:
    """Where a table's latencies were measured and what stands after their ±; empty for a table without any."""
    if not timed or not any(column.name.startswith("latency.") for column in table.columns):
        return ""
    text = f" Latency on {_listed(sorted({place_of(latency) for latency in timed}))}"
    if not all(latency.get("trained", True) for latency in timed):
        some = "" if not any(latency.get("trained", True) for latency in timed) else ", of some rows"
        text += f"{some} of fresh weights that are as busy as trained ones"
    if any(is_busy(latency.get("load"), latency.get("cores")) for latency in timed):
        text += ", measured on a busy machine, so rows may differ by what else ran"
    if all(cell.frames is None for row in table.rows for cell in row.cells):
        return f"{text}."
    return (
        f"{text}; after ± of a latency that one run has stands half the range of the middle half of its frames, and "
        "two rows no further apart than the sum of theirs are undecided."
    )


def place_of(latency: Latency) -> str:
    """Processor and threads of a measurement."""
    name = latency.get("processor") or latency.get("device") or "an unnamed device"
    return f"{name}, {counted(latency.get('threads', 1), 'thread')}"


def describe_orderings(
    columns: list[Metric], rows: list[SweepRow], result: RunResult | None, complete: bool
) -> list[str]:
    """What trained rows were checked for, and in one sentence what was found. `result` is any of the table's."""
    if result is None:
        return ["No run has finished yet."]
    frame = _frame(result, any(cell.paper is not None for row in rows for cell in row.cells))
    main = [place for place, column in enumerate(columns) if column.name in MAIN]
    groups = [(columns[place].title, [place]) for place in main] or [("Over all metrics", list(range(len(columns))))]
    orderings = {where: _compare_rows(columns, rows, places) for where, places in groups}
    parts = [_found(where, found) for where, found in orderings.items() if found]
    if not parts:
        alone = "One row is trained here, so there is nothing to compare it with."
        return [frame, "No two of the rows can be compared yet." if len(rows) > 1 else alone]
    text = f"{'' if complete else 'So far: '}{'; '.join(parts)}"
    text += (
        ": one seed never decides"
        if all(one.found.low is None for found in orderings.values() for one in found)
        else ""
    )
    return [frame, f"{text}."]


class Ordering(NamedTuple):
    """Two rows in the order that the paper states, or a row and its baseline, and how they compare here."""

    metric: str  # with a colon where there are several, else nothing
    first: str  # label
    second: str
    better: bool | None  # the first one here; None if undecided or equal
    found: Comparison
    stated: bool  # the paper has the first one before the other

    @property
    def words(self) -> str:
        """The order in words, with its metric."""
        return f"{self.metric}{self.first} before {self.second}"


def _compare_rows(columns: list[Metric], rows: list[SweepRow], places: list[int]) -> list[Ordering]:
    """Compare rows that the paper tells apart, its better one first; without its numbers, rows with their baselines."""
    orderings = []
    by_label = {row.label: row for row in rows}
    for place in places:
        column = columns[place]
        prefix = f"{column.title}: " if len(places) > 1 else ""
        stated = [row for row in rows if row.cells[place].paper is not None]
        stated.sort(key=lambda row: row.cells[place].paper, reverse=column.higher_is_better)
        pairs = [
            (first, second)
            for rank, first in enumerate(stated)
            for second in stated[rank + 1 :]
            if first.cells[place].paper != second.cells[place].paper
        ]
        if not stated:
            pairs = [(row, by_label[row.baseline]) for row in rows if row.baseline in by_label and not row.is_baseline]
        for first, second in pairs:
            found = first.cells[place].compared_with(second.cells[place], column)
            if found is not None:
                better = found.favours(column) if found.decided else None
                orderings.append(Ordering(prefix, first.label, second.label, better, found, bool(stated)))
    return orderings


def _found(where: str, orderings: list[Ordering]) -> str:
    """How many of the paper's orderings hold, are the other way round, undecided or equal; or which rows are better."""
    equal = sum(one.found.equal for one in orderings)
    left = sum(one.better is None for one in orderings) - equal
    of_paper = all(one.stated for one in orderings)
    one, many = ("ordering of two rows", "orderings of two rows") if of_paper else ("comparison", "comparisons")
    if equal == len(orderings):
        return f"{where}: {f'the one {one}' if equal == 1 else f'all {equal} {many}'} equal"
    if left == len(orderings):
        return f"{where}: {f'the one {one}' if left == 1 else f'all {left} {many}'} undecided"
    held = [pair for pair in orderings if pair.better]
    turned = [pair for pair in orderings if pair.better is False]
    if of_paper:
        parts = [
            f"{len(held)} of {len(orderings)} {one if len(orderings) == 1 else many} hold{'s' * (len(held) == 1)} here"
        ]
        parts[0] += f" ({_listed([pair.words for pair in held])})" if 0 < len(held) <= NAMED else ""
        parts += [f"{len(turned)} the other way round ({_listed([pair.words for pair in turned])})"] if turned else []
    else:
        alike: dict[tuple[str, str], list[str]] = {}
        for word, pairs in (("better", held), ("worse", turned)):
            for pair in pairs:
                alike.setdefault((pair.metric, f"{word} than {pair.second}"), []).append(pair.first)
        parts = [f"{metric}{' and '.join(rows)} {words}" for (metric, words), rows in alike.items()]
    parts += [f"{count} {word}" for word, count in {UNDECIDED: left, EQUAL: equal}.items() if count]
    return f"{where}: {('; ' if any(pair.metric for pair in orderings) else ', ').join(parts)}"


def describe_search(
    states: list[str], trials: int, objective: Metric, best: tuple[str, list[str], float] | None
) -> list[str]:
    """What became of a search's trials, and the best one: its label, what the search chose for it, its objective."""
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("pruned", "failed"))
    text = f"{states.count('done')} of {counted(trials, 'trial')} finished, {counts}."
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
    """What the numbers can say, and what they cannot."""
    synthetic = result.data["name"] == SYNTHETIC
    where = f"{f'the {SYNTHETIC}' if synthetic else result.data['name']}, scale {result.scale}"
    if not has_paper:
        return f"Seen on {where}; the paper has no numbers for these rows."
    size = "" if result.scale == "paper" else ", which is not the paper's size of model and training"
    end = ": neither results on TruckScenes nor comparable with the paper's in size" if synthetic else size
    return f"A check whether the paper's orderings appear on {where}{end}."


def _listed(items: list[object]) -> str:
    return ", ".join(str(item) for item in items)


def counted(number: int, noun: str) -> str:
    """`1 seed`, `2 seeds`."""
    return f"{number} {noun}{'' if number == 1 else 'es' if noun.endswith('s') else 's'}"
