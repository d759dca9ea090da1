"""From a sweep's file, the command line and the seeds to the list of runs, each once, in the order they are trained."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

from src.errors import ConfigError, HorizonError
from src.report.metric_names import DETECTION
from src.report.sweep_file import RowConfig, SweepConfig
from src.report.sweep_record import suffix_of
from src.training.identity import OUTSIDE_IDENTITY, canonical, is_of, key_of, train_command


@dataclass(frozen=True)
class RunIdentity:
    """The run that a command line after `python -m src.train` resolves to."""

    run_id: str
    scale: str
    source: list[str] | None  # command line of the run whose weights it starts from
    task: str = DETECTION


Identify = Callable[[list[str]], RunIdentity]


@dataclass(frozen=True)
class RunSpec:
    """One planned run."""

    run_id: str
    overrides: list[str]  # what it is
    seed: int
    label: str  # of its first row; for a run that others only start from: what it is
    needs: str | None = None  # run whose weights it starts from
    machine: list[str] = field(default_factory=list)  # where and how it computes; stored nowhere

    @property
    def stored(self) -> dict[str, Any]:
        """What records and trials keep of it."""
        return {name: value for name, value in vars(self).items() if name != "machine"}

    @property
    def command(self) -> str:
        """The shell command that trains it."""
        return train_command([*self.overrides, *self.machine])


@dataclass(frozen=True)
class Plan:
    """All runs of a sweep; none yet for a search."""

    sweep: SweepConfig
    scale: str
    seeds: list[int]
    changes: list[str] = field(default_factory=list)  # by the command line, of every row; see `changes_of`
    rows: dict[str, dict[int, str]] = field(default_factory=dict)  # run id by label and seed
    specs: dict[str, RunSpec] = field(default_factory=dict)  # by run id, what is needed before what needs it
    published: frozenset[str] = frozenset()  # runs that are not trained since their results are there

    @property
    def study(self) -> str:
        """Name of the study that coordinates it."""
        return f"{self.sweep.name}-{self.scale}{suffix_of(self.changes)}"

    def labels(self, run_id: str) -> list[str]:
        """Rows that show this run."""
        return [label for label, runs in self.rows.items() if run_id in runs.values()]


def join_overrides(*parts: list[str]) -> list[str]:
    """All of them in order, each key once: where its last value stands."""
    joined: dict[str, str] = {}
    for override in (override for part in parts for override in part):
        joined.pop(key_of(override), None)
        joined[key_of(override)] = override
    return list(joined.values())


def split_machine(overrides: list[str]) -> tuple[list[str], list[str]]:
    """(what a run is, where and how it computes): the second part goes to its process and is stored nowhere."""
    machine = [override for override in overrides if is_of(override, OUTSIDE_IDENTITY)]
    return [override for override in overrides if override not in machine], machine


def changes_of(sweep: SweepConfig, common: list[str]) -> list[str]:
    """What the command line makes of a sweep that its file does not say, sorted: with it, it is another experiment.

    Raises ConfigError for a phase other than the file's own.
    """
    common = join_overrides(common)
    phases = [override for override in common if key_of(override) == "phase"]
    for where, overrides in [("overrides", sweep.overrides), *((f"row {r.label!r}", r.overrides) for r in sweep.rows)]:
        for own in overrides:
            if phases and key_of(own) == "phase" and _value_of(own) != _value_of(phases[0]):
                raise ConfigError(
                    f"{phases[0]} contradicts {own} of sweeps/{sweep.name}.yaml, {where}; "
                    "leave it out or change the file"
                )
    outside = (*OUTSIDE_IDENTITY, "seed", "scale")
    rows = [join_overrides(sweep.overrides, row.overrides) for row in sweep.rows] or [sweep.overrides]
    said = set.intersection(*({canonical(override) for override in row} for row in rows))
    return sorted(change for change in common if not is_of(change, outside) and canonical(change) not in said)


def _value_of(override: str) -> str:
    return override.partition("=")[2].strip("'\"")


def make_plan(
    sweep: SweepConfig, common: list[str], seeds: Sequence[int] | Mapping[str, Sequence[int]], identify: Identify
) -> Plan:
    """Plan every row with every seed; seed by seed, and of each seed first what several rows start from.

    `seeds` may be those of each row, by its label; `common` is the command line's part for every run. Raises
    ConfigError naming file and row for one that does not compose or is of another scale than the others.
    """
    scale = compose_file(sweep, common, identify).scale
    sweep = sweep.at_scale(scale)
    by_row = seeds if isinstance(seeds, Mapping) else dict.fromkeys((row.label for row in sweep.rows), seeds)
    every = list(dict.fromkeys(chain(*by_row.values()) if by_row else seeds))
    plan = Plan(sweep, scale, every, changes_of(sweep, common))
    if sweep.is_search:
        return plan
    rows = {row.label: row for row in sweep.rows}

    def specs_of(row: RowConfig, seed: int) -> list[RunSpec]:
        """The row's run with a seed, preceded by those whose weights it starts from."""
        overrides = join_overrides(sweep.overrides, row.overrides, common, [f"seed={seed}"])
        sources = specs_of(rows[row.weights], seed) if row.weights is not None else []
        if sources:
            untrained = [f"phase.init_from={sources[-1].run_id}", "phase.epochs=0"]
            overrides = join_overrides(overrides, untrained)
        found = _compose(sweep, row, overrides, common, identify)
        if found.scale != scale:
            raise ConfigError(
                f"sweeps/{sweep.name}.yaml, row {row.label!r}: scale={found.scale}, but the sweep is of scale "
                f"{scale}; a table never mixes scales, give scale=... on the command line"
            )
        if not sources:
            return run_specs_of(overrides, seed, row.label, identify)
        own, machine = split_machine(overrides)
        return [*sources, RunSpec(found.run_id, own, seed, row.label, sources[-1].run_id, machine)]

    for seed in every:
        needed: list[RunSpec] = []
        own: list[RunSpec] = []
        for row in (row for row in sweep.rows if seed in by_row[row.label]):
            *sources, spec = specs_of(row, seed)
            needed += sources
            own.append(spec)
            plan.rows.setdefault(row.label, {})[seed] = spec.run_id
        labelled = {spec.run_id: spec for spec in reversed(own)}  # the first row gives its label
        for spec in [*needed, *own]:
            plan.specs.setdefault(spec.run_id, labelled.get(spec.run_id, spec))
    return plan


def without_published(plan: Plan, results: Collection[str], *, training: bool = True) -> Plan:
    """The plan without training what has a result, by its run id, nor weights that only such runs start from.

    A run with a result is trained all the same where one without begins from its weights; not where nothing is trained
    at all.
    """
    needed: set[str | None] = set()
    for spec in reversed(plan.specs.values()) if training else ():
        if spec.run_id in needed or (spec.run_id not in results and plan.labels(spec.run_id)):
            needed |= {spec.run_id, spec.needs}
    specs = {run_id: spec for run_id, spec in plan.specs.items() if run_id in needed or plan.labels(run_id)}
    return replace(plan, specs=specs, published=frozenset(specs) & set(results) - needed)


def compose_file(sweep: SweepConfig, common: list[str], identify: Identify) -> RunIdentity:
    """The run of the file's own overrides and the command line. Raises ConfigError naming whichever is at fault."""
    return _compose(sweep, None, join_overrides(sweep.overrides, common), common, identify)


def run_specs_of(overrides: list[str], seed: int, label: str, identify: Identify) -> list[RunSpec]:
    """The run of a command line, preceded by those whose weights it starts from, in training order."""
    found = identify(overrides)
    sources: list[RunSpec] = []
    if found.source is not None:
        what = label if label.startswith("weights for ") else f"weights for {label}"
        sources = run_specs_of(found.source, seed, what, identify)
    needs = sources[-1].run_id if sources else None
    own, machine = split_machine(overrides)
    return [*sources, RunSpec(found.run_id, own, seed, label, needs, machine)]


def _compose(
    sweep: SweepConfig, row: RowConfig | None, overrides: list[str], common: list[str], identify: Identify
) -> RunIdentity:
    """Identify a row; errors name it, unless the command line alone already fails the same way."""
    where = f"sweeps/{sweep.name}.yaml" + (f", row {row.label!r}" if row is not None else ", overrides")
    try:
        found = identify(overrides)
    except HorizonError as error:
        try:
            identify(common)
        except HorizonError as of_command:
            if str(of_command) == str(error):
                raise
        raise ConfigError(f"{where}: {error}") from error
    if found.task != sweep.task:
        raise ConfigError(f"{where}: phase.task={found.task}, but the sweep is of task {sweep.task}")
    return found
