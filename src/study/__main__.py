"""`python -m src.study`: the sweeps of the paper's claims, each comparison with as many seeds as it needs, and others.

At the first of `LOOKS` every row of every sweep is trained, sweep by sweep in the order of the claims, those that no
claim names last; at each later one the rows of the comparisons that are still open, unless pairs of the look before are
missing. How they are decided: docs/scores.md.
"""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, pairwise

from src.errors import ConfigError, DataError, HorizonError, InterruptedRunError
from src.reliability.command import run_command
from src.reliability.passwords import hide_in_process_list
from src.report.claims import Claim, Finding, Verdict, judge, load_claims, verdict_of
from src.report.comparisons import LOOKS
from src.report.results import RunResult, read_results_or_raise
from src.report.sweep_record import RunState, SweepRecord, read_record, record_path
from src.report.table_builder import check_results
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
    problems = []
    for before, look in pairwise((0, *LOOKS)):
        plans = study.plans(look, study.results(), before)
        for plan in plans:
            if not study.options.workers and not study.worth_recording(plan, look):
                continue
            logger.info("%s", study.progress(plans, look, study.results()))
            command = study.commands[plan.sweep.name]
            try:
                run_plan(plan, command, study.call)
            except InterruptedRunError:
                raise
            except HorizonError as error:  # costs no other sweep
                problems.append(f"{plan.study}: {error}")
    print(study.verdicts())
    if problems:
        raise HorizonError("\n".join(problems))


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

    def plans(self, look: int, results: dict[str, RunResult], before: int = 0) -> list[Plan]:
        """What each sweep trains for a look, without those of which nothing is open any more.

        A comparison of fewer than `before` pairs waits for them: partners of runs that are missing tell nothing. Of a
        claim that one of its measures does not show nothing is open. Of a row that decides no claim any seeds will do
        for the first look, so those of its record that have results stay if they are enough.
        """
        undecided = [found for _, found in self.findings(results) if verdict_of(found) is not Verdict.NOT]
        still = [
            one.measure.comparison
            for one in chain.from_iterable(undecided)
            if one.is_open and one.common_seeds >= before
        ]
        measures = chain.from_iterable(claim.measures for claim in self.claims)
        deciding = {
            (one.comparison.sweep, label)
            for one in measures
            if one.decides
            for label in (one.comparison.row, one.comparison.over)
        }
        recorded = {
            (name, label): [seed for seed, run in runs.items() if run in results]
            for name, record in self.records().items()
            for label, runs in record.rows.items()
        }
        first, plans = min(LOOKS), []
        for name, command in self.commands.items():
            rows = {row for one in still if one.sweep == name for row in (one.row, one.over)}
            if look > first and not rows:
                continue
            seeds = {row.label: range(look if row.label in rows else first) for row in command.sweep.rows}
            for label in seeds.keys() - rows:
                there = recorded.get((name, label), [])
                if (name, label) not in deciding and len(there) >= first:
                    seeds[label] = there
            plan = make_plan(command.sweep, self.call.common, seeds, self.call.identify)
            plans.append(without_results(plan, command, self.call.outputs, lambda: results))
        return plans

    def worth_recording(self, plan: Plan, look: int) -> bool:
        """Whether to record a look without training: the first if any run is finished, a later one if all pairs of a
        comparison are.

        Finished are runs with a score here or with a published result.
        """
        finished = {
            label: [run in plan.published or is_finished_with_score(self.call.outputs / run) for run in runs.values()]
            for label, runs in plan.rows.items()
            if len(runs) == look
        }
        if look == min(LOOKS):
            return any(chain.from_iterable(finished.values()))
        measures = chain.from_iterable(claim.measures for claim in self.claims)
        compared = [one.comparison for one in measures if one.decides and one.comparison.sweep == plan.sweep.name]
        complete = {label for label, runs in finished.items() if all(runs)}
        return any({one.row, one.over} <= complete for one in compared)

    def progress(self, plans: list[Plan], look: int, results: dict[str, RunResult]) -> str:
        """How far a look is, over all its sweeps, and the time left as far as runs finished here tell it."""
        runs = {}
        for spec in (spec for plan in plans for spec in plan.specs.values()):
            done = is_finished_with_score(self.call.outputs / spec.run_id)
            took = results[spec.run_id].training_s if done and spec.run_id in results else None
            counts = done or any(spec.run_id in plan.published for plan in plans)
            state = "done" if counts else "waiting"
            runs[spec.run_id] = RunState(**spec.stored, state=state, started=None if took is None else 0.0, ended=took)
        name = f"study at scale {self.scale}, {look} seeds"
        return progress_line(name, runs.values(), self.options.workers, time.time())

    def describe(self) -> str:
        """The plan as text: what each look trains, later ones if what is open now stays so; then the verdicts."""
        results, lines = self.results(), []
        for look in LOOKS:
            plans = self.plans(look, results)
            if not plans:
                continue
            lines.append(f"# {self.progress(plans, look, results)}{ALL_OPEN if look > min(LOOKS) else ''}")
            for plan in plans:
                rows = [label for label, runs in plan.rows.items() if len(runs) == look]
                lines.append(f"#   {plan.sweep.name}: {'; '.join(rows)}")
        return "\n".join([*lines, self.verdicts()])

    def verdicts(self) -> str:
        """A line per claim."""
        return "\n".join(
            f"{claim.config.name}: {verdict_of(found)} ({claim.config.sentence})"
            for claim, found in self.findings(self.results())
        )


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
