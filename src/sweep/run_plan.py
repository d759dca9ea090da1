"""What a sweep and the study do with a plan: train what is missing, measure latencies, write and show the tables."""

from __future__ import annotations

import copy
import dataclasses
import logging
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import torch

from src.config import PHASES, Config, compose_config
from src.errors import ConfigError, HorizonError, InterruptedRunError
from src.reliability.passwords import masked
from src.reliability.processes import die_with_parent
from src.report.results import publish_result, read_results_or_raise
from src.report.sweep_file import SweepConfig
from src.report.sweep_record import SweepRecord, read_records, suffix_of
from src.report.table_builder import write_sweep_tables
from src.report.time_left import progress_of
from src.sweep.compose import SweepCommand
from src.sweep.latency_runs import measure_latencies
from src.sweep.launcher import Launcher
from src.sweep.plan import Plan, RunIdentity, compose_file, join_overrides, split_machine, without_published
from src.sweep.record_writer import RecordWriter
from src.sweep.run_status import is_finished_with_score
from src.sweep.runner import Runner
from src.sweep.search import Search
from src.sweep.sweep_study import FORMAT, SweepStudy, default_storage
from src.training.handoff import find_source
from src.training.identity import key_of, run_identity
from src.training.run_folder import RunFolder, make_writable

logger = logging.getLogger(__name__)


class Identifier:
    """Run ids as `python -m src.train` computes them; command lines that differ in the seed alone are composed once."""

    def __init__(self) -> None:
        self._composed: dict[tuple[str, ...], tuple[Config, dict[str, Any]]] = {}

    def compose(self, overrides: list[str]) -> tuple[Config, dict[str, Any]]:
        """Compose as `compose_config`, once for command lines that differ in the seed alone."""
        plain = [override for override in overrides if not re.fullmatch(r"seed=\d+", override)]
        if tuple(plain) not in self._composed:
            self._composed[tuple(plain)] = compose_config(plain)
        config, tree = self._composed[tuple(plain)]
        seeds = [int(override.removeprefix("seed=")) for override in overrides if override not in plain]
        if not seeds:
            return config, tree
        return dataclasses.replace(config, seed=seeds[-1]), copy.deepcopy(tree) | {"seed": seeds[-1]}

    def __call__(self, overrides: list[str]) -> RunIdentity:
        """The run that a command line resolves to. Raises HorizonError for what `python -m src.train` refuses."""
        config, tree = self.compose(overrides)
        source = find_source(config, overrides, self.compose, PHASES)
        run_id = run_identity(tree, source.identity if source is not None else None)
        return RunIdentity(run_id, config.scale, source and source.overrides, config.phase.task)


def definition(plan: Plan, common: list[str]) -> dict[str, Any]:
    """What a study must have been made by. Rows may change: each run is known by what it is, not by its row."""
    if not plan.sweep.is_search:
        return {"format": FORMAT, "kind": "rows"}
    fixed, _ = split_machine(join_overrides(plan.sweep.overrides, common))
    space = {key: dataclasses.asdict(dimension) for key, dimension in sorted(plan.sweep.space.items())}
    return {
        "format": FORMAT,
        "kind": "search",
        "objective": plan.sweep.objective,
        "overrides": sorted(fixed),
        "seeds": plan.seeds,
        "space": space,
    }


def resume_command(module: str, overrides: list[str]) -> str:
    """The command line that goes on with this one, without passwords."""
    return shlex.join(["python", "-m", module, *[masked(override) for override in overrides]])


@dataclass(frozen=True)
class SweepCall:
    """What all sweeps of one command line share."""

    common: list[str]  # overrides of every run
    identify: Identifier
    outputs: Path
    reports: Path
    resume_command: str
    failed: dict[str, str] = field(default_factory=dict)  # reasons by run id; a later sweep does not train them again

    @classmethod
    def of(cls, sweep: SweepConfig, common: list[str], resume_command: str) -> tuple[Self, Config]:
        """The call, and the configuration that all rows of `sweep`, one of its sweeps, have in common.

        Raises ConfigError naming the sweep's file for what it says wrongly.
        """
        identify = Identifier()
        compose_file(sweep, common, identify)
        config, _ = identify.compose(join_overrides(sweep.overrides, common))
        outputs, reports = Path(config.paths.outputs), Path(config.paths.reports)
        return cls(common, identify, outputs, reports, resume_command), config


def without_results(plan: Plan, command: SweepCommand, outputs: Path, results: Callable[[], Collection[str]]) -> Plan:
    """The plan without training what counts by its result; `results` reads those there are, by run id, where any may.

    With `published` they all do. Without workers those of runs that are not finished here: these are published anew.
    """
    if command.published:
        return without_published(plan, results(), training=command.workers > 0)
    if command.workers or plan.sweep.is_search:
        return plan
    elsewhere = [run for run in results() if not is_finished_with_score(outputs / run)]
    return without_published(plan, elsewhere, training=False)


def run_plan(plan: Plan, command: SweepCommand, call: SweepCall) -> None:
    """Train what is missing, measure latencies, write and show the tables.

    Raises InterruptedRunError when it was stopped, HorizonError when a run has failed, ConfigError before anything is
    trained for tables that are another sweep's.
    """
    outputs, reports = call.outputs, call.reports
    make_writable(outputs / "sweeps", "paths.outputs")
    make_writable(reports / "sweeps", "paths.reports")
    check_table_names(plan, reports)
    check_data_of_finished(plan, call.identify, outputs)
    storage = command.storage or default_storage(outputs)
    study = SweepStudy(outputs, plan.study, storage, definition(plan, call.common))
    launcher = Launcher(
        [sys.executable, "-m", "src.train"],
        study.folder,
        command.workers,
        visible_gpus(),
        in_child=partial(die_with_parent, signal.SIGTERM),  # a killed runner leaves checkpoints, no orphans
        group=plan.study,
    )
    writer = RecordWriter(plan, study, call.resume_command, outputs, reports, command.published)
    publish = partial(publish_result, reports=reports)
    if plan.sweep.is_search:
        runner = Search(plan, study, writer, launcher, publish, call.common, call.identify)
    else:
        runner = Runner(plan, study, writer, launcher, publish, failed=call.failed)
    record = runner.run()
    if runner.stop.requested:
        print(progress_of(record, command.workers, time.time()))
        raise InterruptedRunError(
            f"the sweep was stopped; nothing finished is lost, resume it with\n    {call.resume_command}"
        )
    missed: list[str] = []
    if plan.sweep.latency and (command.workers or command.latency):
        missed = measure_latencies(record, outputs, reports, runner, command.latency)
    problems = [*(missed if command.latency else []), *runner.publish_and_list_faults(strictly=True)]
    write_and_show_tables(record, call, problems)


def check_table_names(plan: Plan, reports: Path) -> None:
    """Raises ConfigError where a table would replace one of another sweep."""
    own = {table.name for table in plan.sweep.tables}
    for record in read_records(reports, plan.scale)[0]:
        same = own & {table.name for table in record.sweep.tables}
        if same and record.name != plan.sweep.name and record.suffix == suffix_of(plan.changes):
            raise ConfigError(
                f"sweeps/{plan.sweep.name}.yaml: sweep {record.name} has tables of the same name, which it would "
                f"replace: {', '.join(sorted(same))}; name them otherwise"
            )


def check_data_of_finished(plan: Plan, identify: Identifier, outputs: Path) -> None:
    """Raises DataError where a finished run was trained on other data than `data.root` holds, as training it would."""
    finished = [
        spec
        for spec in plan.specs.values()
        if any(key_of(override) == "data.root" for override in spec.machine)
        and spec.run_id not in plan.published
        and is_finished_with_score(outputs / spec.run_id)
    ]
    if not finished:
        return
    from src.assembly import check_data, samples_of  # the reader is not needed before

    known: dict[str, dict[str, Any]] = {}

    def find(config: Config) -> dict[str, Any]:
        key = repr((config.data, config.model.sensors))
        if key not in known:
            known[key] = samples_of(config)
        return known[key]

    for spec in finished:
        config, _ = identify.compose(join_overrides(spec.overrides, spec.machine))
        check_data(config, outputs / spec.run_id, RunFolder(outputs, spec.run_id).read_result()[0], find)


def write_and_show_tables(record: SweepRecord, call: SweepCall, problems: list[str]) -> None:
    """Write and show the tables of the published results. Raises HorizonError listing what failed, `problems` first."""
    failed = [run for run in record.runs.values() if run.state == "failed"]
    if failed:
        problems = [*problems, f"{len(failed)} of {len(record.runs)} runs failed:"]
        for run in failed:
            log = str(call.outputs / run.log) if run.log is not None else "none"
            problems.append(f"  {run.label}, seed {run.seed} ({run.run_id}): {run.reason}; log: {log}")
        problems.append(f"the same command retries them:\n    {call.resume_command}")
    try:
        paths = write_sweep_tables(call.reports, record, read_results_or_raise(call.reports, record.scale, record.runs))
    except HorizonError as error:
        if not problems:
            raise
        paths = []
        problems.append(str(error))
    for path in paths:
        if path.suffix == ".md":
            print(f"\n{path.read_text()}")
    for path in paths:
        print(f"table: {path}")
    print(progress_of(record, 1, time.time()))
    if problems:
        raise HorizonError("\n".join(problems))


def visible_gpus() -> list[str]:
    """Names of the GPUs this process may use, as CUDA_VISIBLE_DEVICES writes them."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name for name in chosen.split(",") if name.strip()] if torch.cuda.device_count() else []
    return [str(index) for index in range(torch.cuda.device_count())]
