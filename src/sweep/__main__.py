"""`python -m src.sweep +sweep=NAME ...`: every run of one question of sweeps/, its results and its tables."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from src.errors import ConfigError
from src.reliability.command import run_command
from src.reliability.passwords import hide_in_process_list
from src.report.results import read_results_or_raise
from src.report.sweep_file import DimensionConfig
from src.sweep.compose import compose_sweep
from src.sweep.plan import Plan, make_plan
from src.sweep.run_plan import SweepCall, resume_command, run_plan, without_results
from src.sweep.run_status import is_finished_with_score
from src.training.identity import key_of


def main(overrides: list[str]) -> None:
    """Plan the sweep, train what is missing, write its tables. Raises HorizonError when a run has failed."""
    for override in overrides:
        hide_in_process_list(override)
    command, common = compose_sweep(overrides)
    sweep = command.sweep
    call, config = SweepCall.of(sweep, common, resume_command("src.sweep", overrides))
    if sweep.is_search and command.seeds > 1:
        raise ConfigError(f"seeds={command.seeds}: a search compares single runs; leave seeds= out")
    seeds = list(range(config.seed, config.seed + command.seeds))
    call = replace(call, common=[override for override in common if key_of(override) != "seed"])
    plan = make_plan(sweep, call.common, seeds, call.identify)
    results = partial(read_results_or_raise, call.reports, plan.scale, plan.specs)
    plan = without_results(plan, command, call.outputs, results)
    if command.dry_run:
        print(describe(plan, call.outputs))
        return
    run_plan(plan, command, call)


def describe(plan: Plan, outputs: Path) -> str:
    """The plan as text: every run with its state, its rows and the command that trains it."""
    lines = [f"# {plan.study}: {plan.sweep.title}"]
    if plan.sweep.is_search:
        space = [f"#   {key}: {_range(dimension)}" for key, dimension in plan.sweep.space.items()]
        return "\n".join(
            [*lines, f"# a search of {plan.sweep.trials} trials for the best {plan.sweep.objective}:", *space]
        )
    finished = sum(run_id in plan.published or is_finished_with_score(outputs / run_id) for run_id in plan.specs)
    results = len(plan.rows) * len(plan.seeds)
    lines.append(
        f"# {len(plan.rows)} rows x {len(plan.seeds)} seeds = {results} results of {len(plan.specs)} runs, "
        f"{finished} finished"
    )
    for spec in plan.specs.values():
        state = "to train"
        if spec.run_id in plan.published:
            state = "has its result"
        elif is_finished_with_score(outputs / spec.run_id):
            state = "finished"
        rows = plan.labels(spec.run_id) or [spec.label]
        same = f" ({len(rows)} rows that coincide share it)" if len(rows) > 1 else ""
        needs = f", starts from {spec.needs}" if spec.needs else ""
        lines += ["", f"# {' = '.join(rows)}, seed {spec.seed}{same}: {spec.run_id}, {state}{needs}", spec.command]
    return "\n".join(lines)


def _range(dimension: DimensionConfig) -> str:
    if dimension.choices is not None:
        return f"one of {dimension.choices}"
    return f"{dimension.low:g} to {dimension.high:g}" + (", logarithmic" if dimension.log else "")


if __name__ == "__main__":
    run_command(main)
