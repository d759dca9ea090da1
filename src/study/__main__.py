"""`python -m src.study`: the sweeps of the paper's claims, each comparison with as many seeds as it needs, and others.

At the first of `LOOKS` every row of every sweep is trained, sweep by sweep in the order of the claims, those that no
claim names last; at each later one the rows of the comparisons that are still open, unless pairs of the look before are
missing. What fails costs nothing else and is not tried again in the same call. How claims are decided: docs/scores.md.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, pairwise

from src.errors import ConfigError, DataError, HorizonError, InterruptedRunError
from src.reliability.command import run_command
from src.reliability.passwords import hide_in_process_list
from src.report.claims import Claim, ComparisonConfig, Finding, Verdict, judge, load_claims, verdict_of
from src.report.comparisons import LOOKS
from src.report.results import RunResult, read_results_or_raise
from src.report.sweep_record import RunState, SweepRecord, read_record, record_path
from src.report.table_builder import check_results, is_current
from src.report.time_left import progress_line
from src.sweep.compose import SweepCommand, compose_sweep
from src.sweep.plan import Plan, changes_of, make_plan
from src.sweep.run_plan import SweepCall, resume_command, run_plan, without_results
from src.sweep.run_status import is_finished_with_score
from src.sweep.sweep_files import load_sweep
from src.training.identity import key_of

logger = logging.getLogger(__name__)

ALL_OPEN = ", if all stays open, with the seeds of the looks before"
SET_BY_THE_RULE = ("sweep", "seed", "seeds", "trials", "latency")
BESIDE = (
    "standing",
    "single_frame",
    "query_models",
    "camera_keypoints",
    "radar_velocity",
    "frame_factors",
    "memory_factors",
    "sparser",
    "scaling",
    "training_scenes",
)
"""Sweeps of detectors' accuracy that no claim names. `learning_rates` and `tune` choose what the others run with."""


def main(overrides: list[str]) -> None:
    """Train what the claims still need, show what they come to. Raises HorizonError listing what failed."""
    for override in overrides:
        hide_in_process_list(override)
        if key_of(override) in SET_BY_THE_RULE:
            raise ConfigError(
                f"{override}: the claims say which sweeps and seeds are run and measured; leave {key_of(override)}= out"
            )
    study = read_study(overrides)
    if study.options.dry_run:
        print(study.describe())
        return
    problems: dict[str, str] = {}  # by sweep, as it stands after its last look
    for before, look in pairwise((0, *LOOKS)):
        steps = study.steps(look, study.results(), before)
        for step in steps:
            if not study.options.workers and not study.worth_recording(step, look):
                continue
            logger.info("%s", study.progress(steps, look, study.results()))
            name = step.plan.study
            problems.pop(name, None)
            try:
                run_plan(step.plan, study.commands[step.plan.sweep.name], study.call)
            except InterruptedRunError:
                raise
            except HorizonError as error:  # costs no other sweep
                problems[name] = f"{name}: {error}"
                logger.error("%s", problems[name])  # at once: whatever else may end this call, it has been said
    print(study.verdicts())
    if problems:
        raise HorizonError("\n".join(problems.values()))


@dataclass(frozen=True)
class SweepAtLook:
    """A sweep at one look."""

    plan: Plan
    rows: list[str]  # those that the look is for: at the first all, later those of open comparisons


@dataclass
class Study:
    """The claims, and the sweeps that they name and those beside them as the command line makes them."""

    claims: list[Claim]
    commands: dict[str, SweepCommand]  # by the sweep's name, in the order of the claims, then `BESIDE`
    call: SweepCall
    scale: str

    @property
    def options(self) -> SweepCommand:
        """Options of the runner, the same for every sweep."""
        return next(iter(self.commands.values()))

    def results(self) -> dict[str, RunResult]:
        """What has finished so far, by run id. Raises DataError naming what cannot be read."""
        return read_results_or_raise(self.call.reports, self.scale)

    def records(self) -> dict[str, SweepRecord]:
        """The records there are, by the sweep's name."""
        records: dict[str, SweepRecord] = {}
        for name, command in self.commands.items():
            changes = changes_of(command.sweep.at_scale(self.scale), self.call.common)
            path = record_path(self.call.reports, name, self.scale, changes)
            with suppress(DataError):  # none yet, or one that the runner will replace
                records[name] = read_record(path)
        return records

    def findings(self, results: dict[str, RunResult]) -> list[tuple[Claim, list[Finding]]]:
        """What these results say of each claim. Raises DataError for results that no table takes."""
        records = self.records()
        for record in records.values():
            check_results(record, results)
        return [(claim, judge(claim, records, results)) for claim in self.claims]

    def steps(self, look: int, results: dict[str, RunResult], before: int = 0) -> list[SweepAtLook]:
        """What each sweep trains for a look, without those of which nothing is open any more.

        A comparison of fewer than `before` pairs waits for them: partners of runs that are missing tell nothing. Of a
        claim that one of its measures does not show nothing is open. Raises ConfigError where the command line makes
        one run of both rows of a comparison.
        """
        undecided = [found for _, found in self.findings(results) if verdict_of(found) is not Verdict.NOT]
        still = [
            one.measure.comparison
            for one in chain.from_iterable(undecided)
            if one.is_open and one.common_seeds >= before
        ]
        first, steps = min(LOOKS), []
        for name, command in self.commands.items():
            labels = [row.label for row in command.sweep.rows]
            rows = {label for one in still if one.sweep == name for label in (one.row, one.over)}
            if look > first and not rows:
                continue
            seeds: dict[str, Sequence[int]] = {label: range(look if label in rows else first) for label in labels}
            seeds |= self.recorded_seeds(name, results)
            plan = make_plan(command.sweep, self.call.common, seeds, self.call.identify)
            for one in self.deciding(name):
                for _, run_id in plan.rows[one.row].items() & plan.rows[one.over].items():
                    raise ConfigError(
                        f"the command line makes one run, {run_id}, of {one.row!r} and {one.over!r} of "
                        f"sweeps/{name}.yaml, which a claim compares; leave out what these rows set themselves"
                    )
            plan = without_results(plan, command, self.call.outputs, lambda: results)
            steps.append(SweepAtLook(plan, [label for label in labels if look == first or label in rows]))
        return steps

    def deciding(self, sweep: str) -> list[ComparisonConfig]:
        """The comparisons of a sweep that decide claims, each once for every measure of it that does."""
        measures = chain.from_iterable(claim.measures for claim in self.claims)
        return [one.comparison for one in measures if one.decides and one.comparison.sweep == sweep]

    def recorded_seeds(self, sweep: str, results: dict[str, RunResult]) -> dict[str, Sequence[int]]:
        """Seeds of rows that decide no claim, for which any will do: those of the record, where they are enough.

        Counted are runs that would not be trained, and that are what the row still says.
        """
        record, command = self.records().get(sweep), self.commands[sweep]
        if record is None:
            return {}
        deciding = {label for one in self.deciding(sweep) for label in (one.row, one.over)}
        if command.workers and not command.published:
            results = {run: one for run, one in results.items() if is_finished_with_score(self.call.outputs / run)}
        there: dict[str, Sequence[int]] = {
            row.label: [
                seed for seed, run in record.rows.get(row.label, {}).items() if is_current(record, run, results)
            ]
            for row in command.sweep.rows
        }
        planned = make_plan(command.sweep, self.call.common, there, self.call.identify).rows
        kept = {
            label: [seed for seed, run in runs.items() if run == record.rows[label][seed]]
            for label, runs in planned.items()
            if label not in deciding
        }
        return {label: seeds for label, seeds in kept.items() if len(seeds) >= min(LOOKS)}

    def worth_recording(self, step: SweepAtLook, look: int) -> bool:
        """Whether to record a look without training: the first if any run is finished, a later one if all pairs of a
        comparison are.

        Finished are runs with a score here or with a published result.
        """
        plan = step.plan
        finished = {
            label: [
                run in plan.published or is_finished_with_score(self.call.outputs / run)
                for run in plan.rows[label].values()
            ]
            for label in step.rows
        }
        if look == min(LOOKS):
            return any(chain.from_iterable(finished.values()))
        complete = {label for label, runs in finished.items() if all(runs)}
        return any({one.row, one.over} <= complete for one in self.deciding(plan.sweep.name))

    def progress(self, steps: list[SweepAtLook], look: int, results: dict[str, RunResult]) -> str:
        """How far a look is, over all its sweeps, and the time left as far as runs finished here tell it."""
        runs = {}
        for spec in (spec for step in steps for spec in step.plan.specs.values()):
            done = is_finished_with_score(self.call.outputs / spec.run_id)
            took = results[spec.run_id].training_s if done and spec.run_id in results else None
            counts = done or any(spec.run_id in step.plan.published for step in steps)
            state = "done" if counts else "waiting"
            runs[spec.run_id] = RunState(**spec.stored, state=state, started=None if took is None else 0.0, ended=took)
        name = f"study at scale {self.scale}, {look} seeds"
        return progress_line(name, runs.values(), self.options.workers, time.time())

    def describe(self) -> str:
        """The plan as text: what each look trains, later ones if what is open now stays so; then the verdicts."""
        results, lines = self.results(), []
        for look in LOOKS:
            steps = self.steps(look, results)
            if not steps:
                continue
            lines.append(f"# {self.progress(steps, look, results)}{ALL_OPEN if look > min(LOOKS) else ''}")
            lines += [f"#   {step.plan.sweep.name}: {'; '.join(step.rows)}" for step in steps]
        return "\n".join([*lines, self.verdicts()])

    def verdicts(self) -> str:
        """A line per claim, followed by one for each of its measures that finished runs lack."""
        lines = []
        for claim, found in self.findings(self.results()):
            lines.append(f"{claim.config.name}: {verdict_of(found)} ({claim.config.sentence})")
            lines += [
                f"  {one.measure.comparison.text}: no {one.measure.metric.name} in the results of "
                f"{', '.join(one.lacking)}, whose pairs do not count"
                for one in found
                if one.measure.decides and one.lacking
            ]
        return "\n".join(lines)


def read_study(overrides: list[str]) -> Study:
    """The study of a command line. Raises ConfigError for claims, sweeps and options that are wrong."""
    claims = load_claims(load_sweep)
    names = dict.fromkeys([*(measure.comparison.sweep for claim in claims for measure in claim.measures), *BESIDE])
    composed = {name: compose_sweep([f"+sweep={name}", *overrides]) for name in names}
    commands = {name: command for name, (command, _) in composed.items()}
    command, common = next(iter(composed.values()))
    call, config = SweepCall.of(command.sweep, common, resume_command("src.study", overrides))
    return Study(claims, commands, call, config.scale)


if __name__ == "__main__":
    run_command(main)
