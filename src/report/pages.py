"""The pages under reports/: which runs belong on one, what experiments are called, and the text around the tables."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import yaml

from src.report.escaping import as_code, escape_markdown
from src.report.metric_names import DETECTION, SPEEDS, Metric
from src.report.plain_yaml import load_plain_yaml
from src.report.results import NOT_A_SETTING, RunResult, settings_of
from src.report.score_tables import (
    BY_LONG_RANGE,
    BY_RANGE,
    BY_SPEED,
    CAR_BY_SPEED,
    CAR_ERROR_BY_SPEED,
    ERROR_BY_SPEED,
    NORMALIZED_BY_SPEED,
    OF_HISTORY,
    OF_MEMORY,
    SUMMARY,
    Experiment,
    class_table,
    cost_table,
    gain_table,
    group_runs,
    metrics_of,
    score_table,
)
from src.training.identity import (
    LEGACY_DEFAULTS,
    OUTSIDE_IDENTITY,
    TEMPORAL_DATA_KEYS,
    canonical,
    is_of,
    key_of,
    leaves,
    train_command,
)

FURTHER = "phase1_further"
"""What phase 2 is compared with; it stands on that page alone."""
PHASES_OF = {"phase2": ("phase1", FURTHER, "phase2")}
"""Whose runs a phase's page reads; other phases' pages read their own."""

ANNEALED = ("optim.final_lr_ratio=1.0e-4", "optim.rise_fraction=0.4")
"""The full one-cycle schedule that phase 1 takes at mini where no phase follows."""

NAMES = {
    ("phase1",): "KGGI + OCSF",
    ("phase1", *ANNEALED): "KGGI + OCSF, annealed",
    ("phase1", "model=crt_fusion", *ANNEALED): "CRT-Fusion, annealed",
    ("phase1", "model=dense_bev", *ANNEALED): "BEVFusion, annealed",
    ("phase1", "model.kggi.initialization=random"): "OCSF, random Gaussians",
    ("phase1", "model.kggi.initialization=keypoint"): "KGGI + OCSF, keypoints only",
    ("phase1", "model.kggi=null", "model.ocsf=null"): "radar only",
}
for _phase in ("lrs_occupancy", "lrs_forecast", "lrs_detection"):
    NAMES[_phase, "model=lrs4fusion"] = "LRS4Fusion"
    _without = ("model.measured_motion=false", "model.neck.finest_scale=4", "model=lrs4fusion")
    NAMES[_phase, *_without] = "LRS4Fusion, no measured motion, boxes from V4"
NAMES_OF_COMPARISON = {
    ("phase1",): "phase 1",
    (FURTHER,): "phase 1 continued, no memory",
    ("phase2",): "phase 2",
    (
        "phase2",
        "model.dptf.bev_path.velocity_compensation=false",
        "model.dptf.gaussian_path.velocity_compensation=false",
    ): "phase 2, no velocity compensation",
}
"""Names of the experiments that a page compares, by phase and sorted settings, in the order of the page."""

DROPOUT = "data.sensor_dropout="
OF_THE_PHASE = ("model.dptf", "data.sensor_dropout")

SCORES = (
    "means over seeds, in brackets 95 % intervals over the validation scenes; bold is decided against every other row."
)
METRIC = f"official TruckScenes metric on the validation split; {SCORES}"

BY_SPEED_TEXT = """By speed of the ground truth (a match follows its ground truth whatever speed it states, a false
positive the speed it states; in normalised mAP all count at every speed, see docs/scores.md). Means over the classes
that occur at that speed; the velocity error (m/s, at 2 m) of a
class that does not reach a recall of 0.1 counts as 1, the official rule, so read it beside the AP. Some classes have
few boxes at a speed; the car's numbers stand on the most."""

DROPOUT_TEXT = """From the share `data.sensor_dropout` of the frames, never a clip's first, all sensor data are taken
away, in training and in validation: what is found there comes from the memory alone. These rows compare with one
another only."""

GAIN_TEXT = """Differences between runs of the same seed with Student's 95 % interval; what contains zero is undecided,
and so is one seed; rows that agree in every pair are equal. Percentage points, and m/s for velocity errors, where less
is better."""

MEMORY_TEXT = """Recall at 2 m, whatever the score, of objects with fewer than 3 returns in the accumulated input that
had 3 or more at most eight key frames before (hidden); the shares of objects with an occupied cell inside and within
2.4 m of a remembered Gaussian. Of remembered Gaussians: the share within 2.4 m of an object, the share of opacity below
0.1, and the error of their velocity beside objects of 10 m/s and more."""


def called_by_changes(results: Iterable[RunResult], defaults: dict[str, dict[str, Any]]) -> list[RunResult]:
    """Each run called by what differs from the configuration of a run without settings, of its phase in `defaults`.

    So an older default never passes for today's.
    """
    runs: dict[str, RunResult] = {}
    for result in results:
        own = defaults.get(result.phase, {})
        changes = without_defaults(result.overrides, own) + changed_since(result, own)
        runs[result.run_id] = replace(result, overrides=changes)
    return [_as_by_phase(run, runs, defaults) for run in runs.values()]


def runs_on_page(results: Iterable[RunResult], phase: str, in_sweeps: Collection[str]) -> list[RunResult]:
    """Runs of `results` that the page of `phase` shows; none when there is none of the phase itself.

    Phase 1, and phase 1 continued, stand on phase 2's page without their ablations. Runs of sweeps (their ids are
    `in_sweeps`) have tables of their own: an experiment of which all runs are such is shown only if it has a name here.
    Weights that were scored once more with other settings are left to the tables of their sweeps.
    """
    names = NAMES_OF_COMPARISON if phase in PHASES_OF else NAMES
    results = list(results)
    beside_sweeps = {(run.phase, run.settings) for run in results if run.run_id not in in_sweeps}
    shown = []
    for run in results:
        belongs = run.phase == phase or (run.phase in PHASES_OF.get(phase, ()) and not run.settings)
        belongs = belongs and run.epochs > 0
        known = (run.phase, *_settings_without_dropout(run)) in names
        if belongs and (known or (run.phase, run.settings) in beside_sweeps):
            shown.append(run)
    return shown if any(run.phase == phase for run in shown) else []


def _as_by_phase(run: RunResult, runs: Mapping[str, RunResult], defaults: dict[str, dict[str, Any]]) -> RunResult:
    """`run` without its `phase.init_from` where that names the very run which its phase starts from anyway.

    That run has the same settings, but for what only the phase itself has, as its memory.
    """
    source = runs.get(str(run.config["phase"].get("init_from")))
    usual = defaults.get(run.phase, {}).get("phase", {}).get("init_from")
    if source is None or (source.phase, source.seed) != (usual, run.seed):
        return run
    others = [change for change in run.overrides if key_of(change) != "phase.init_from"]
    shared = tuple(change for change in settings_of(others) if not is_of(change, OF_THE_PHASE))
    return replace(run, overrides=others) if shared == source.settings else run


def split_by_data(runs: list[RunResult], phase: str) -> tuple[list[RunResult], list[RunResult]]:
    """The runs on the phase's default data, which a page shows, and those on other data.

    Default is what most of the phase's own runs without settings read, else most of its runs.
    """
    own = [run for run in runs if run.phase == phase]
    plain = Counter(run.dataset for run in own if not run.settings)
    every = Counter(run.dataset for run in own)
    default = max(every, key=lambda data: (plain[data], every[data], data))
    kept = [run for run in runs if run.dataset == default]
    return kept, [run for run in runs if run.dataset != default]


def left_out(others: list[RunResult]) -> str:
    """The line of a page that says which runs are not on it; none where there are none."""
    if not others:
        return ""
    named = ", ".join(f"{as_code([run.run_id])} ({escape_markdown(run.dataset)})" for run in others)
    return f"\nLeft out, since a table never mixes data: {named}.\n"


def without_defaults(overrides: list[str], defaults: dict[str, Any]) -> list[str]:
    """The last override of each key, less those that say what `defaults` say.

    A sweep spells out the value of its baseline, which is then the same run as one without settings. `defaults` whose
    model has no name are of the model that is chosen, which stays a setting.
    """
    last = {key_of(override): override for override in overrides}
    other = {key: override for key, override in last.items() if not _is_default(key, override, defaults)}
    of_its_model = "name" not in defaults.get("model", {})
    parts = tuple(f"{key}." for key in other if key != "model" or not of_its_model)  # there another choice has others
    return [override for key, override in last.items() if key in other or key.startswith(parts)]


def changed_since(run: RunResult, defaults: dict[str, Any]) -> list[str]:
    """What a run had by default and today's `defaults` say otherwise, as overrides.

    Keys that only one of the two knows are left out, except younger ones with a value of before.
    """
    free = [*map(key_of, run.overrides), *OUTSIDE_IDENTITY, *NOT_A_SETTING, "phase.name"]
    if defaults.get("model", {}).get("name", run.model) == run.model:
        free = [key for key in free if key != "model"]  # else the choice of another model frees all of it
    if not run.config["phase"].get("temporal", True):
        free += [f"data.{key}" for key in TEMPORAL_DATA_KEYS]
    had = LEGACY_DEFAULTS | leaves(run.config)
    return [
        f"{key}={json.dumps(had[key]) if not isinstance(had[key], str) else had[key]}"
        for key, today in leaves(defaults).items()
        if key in had and had[key] != today and not is_of(key, free)
    ]


def _is_default(key: str, override: str, defaults: dict[str, Any]) -> bool:
    value: Any = defaults
    for name in key.split("."):
        if not isinstance(value, dict) or name not in value:
            return False
        value = value[name]
    try:
        said = load_plain_yaml(canonical(override).partition("=")[2])
    except yaml.YAMLError:
        return False
    if isinstance(value, dict):  # a part is chosen by its name
        return said is not None and said == value.get("name")
    return said == value and isinstance(said, bool) == isinstance(value, bool)  # to Python, 1 is true


def phase_page(runs: list[RunResult], scale: str) -> str:
    """The runs of one phase: summary, AP by class, cost; of another task than detection its numbers and cost.

    Raises ValueError when they are of different data.
    """
    experiments = group_runs(runs, lambda run: NAMES.get((run.phase, *run.settings)))
    if runs[0].task == DETECTION:
        tables = [score_table(experiments, columns) for columns in (SUMMARY, BY_RANGE, BY_LONG_RANGE)]
        tables += [class_table(experiments), cost_table(experiments)]
        what = f"{', '.join(map(str, sorted({run.epochs for run in runs})))} epochs"
    else:
        what = f"task {runs[0].task}"
        tables = [score_table(experiments, metrics_of(runs[0])), cost_table(experiments, epochs=True)]
    return _page(runs[0].phase, scale, what, runs) + "\n\n".join(filter(None, tables)) + "\n"


def compared_experiments(runs: list[RunResult]) -> list[Experiment]:
    """The experiments of phase 2's page, in its order. Raises ValueError when the runs are of different data."""

    def name(run: RunResult) -> str | None:
        dropout = [setting for setting in run.settings if setting.startswith(DROPOUT)]
        known = NAMES_OF_COMPARISON.get((run.phase, *_settings_without_dropout(run)))
        if known and dropout:
            return f"{known}, {as_code(dropout)}"
        return known or f"{run.phase.replace('phase', 'phase ')}, {as_code(run.settings)}"

    def place(experiment: Experiment) -> float:
        known, key = list(NAMES_OF_COMPARISON), tuple(part for part in experiment.key if not part.startswith(DROPOUT))
        return known.index(key) if key in known else len(known)

    return sorted(group_runs(runs, name), key=place)


def comparison_page(experiments: list[Experiment], scale: str, picture: str) -> str:
    """Phase 2 against phase 1 and against its own parts: scores, by speed, by class, cost, and gains seed by seed.

    `experiments` are `compared_experiments`; `picture` is the address of their bars, seen from the page.
    """
    runs = [run for experiment in experiments for run in experiment.runs]
    dropout = [experiment for experiment in experiments if experiment not in without_dropout(experiments)]
    experiments = without_dropout(experiments)
    text = _page("phase2", scale, "rows of phase 2 and of phase 1 continued start from their seed's phase 1", runs)
    summary = (SUMMARY, BY_RANGE)
    by_speed = (BY_SPEED, NORMALIZED_BY_SPEED, CAR_BY_SPEED, ERROR_BY_SPEED, CAR_ERROR_BY_SPEED)
    text += f"![Scores by distance and by speed]({picture})\n\n{_tables(experiments, summary)}\n\n"
    if memory := score_table(experiments, OF_MEMORY + OF_HISTORY):
        text += f"## What is remembered\n\n{MEMORY_TEXT}\n\n{memory}\n\n"
    text += f"## By speed\n\n{BY_SPEED_TEXT}{_boxes_by_speed(runs)}\n\n{_tables(experiments, by_speed)}\n\n"
    text += f"## AP by class\n\n{class_table(experiments)}\n\n"
    text += (
        f"## Cost\n\nOf the phase itself, without the one it starts from.\n\n{cost_table(experiments, epochs=True)}\n"
    )
    subject = next((experiment for experiment in experiments if experiment.key == ("phase2",)), None)
    others = [experiment for experiment in experiments if experiment is not subject]
    parts = (SUMMARY, BY_RANGE, OF_MEMORY + OF_HISTORY, *by_speed)
    if subject is not None and others:
        text += f"\n## Gain of phase 2\n\n{GAIN_TEXT}\n\n{_gains(subject, others, parts)}\n"
    if dropout:
        text += f"\n## With sensor dropout\n\n{DROPOUT_TEXT}\n\n{_tables(dropout, (SUMMARY, *by_speed))}\n"
        text += f"\n{_gains(dropout[0], dropout[1:], parts)}\n" if dropout[1:] else ""
    return text


def _tables(experiments: list[Experiment], parts: Sequence[list[Metric]]) -> str:
    return "\n\n".join(filter(None, (score_table(experiments, columns) for columns in parts)))


def _gains(subject: Experiment, others: list[Experiment], parts: Sequence[list[Metric]]) -> str:
    return "\n\n".join(filter(None, (gain_table(subject, others, columns) for columns in parts)))


def without_dropout(experiments: list[Experiment]) -> list[Experiment]:
    """Experiments whose frames all have their sensors."""
    return [experiment for experiment in experiments if not any(part.startswith(DROPOUT) for part in experiment.key)]


def _boxes_by_speed(runs: list[RunResult]) -> str:
    """How much ground truth the speed classes have, from any run that was scored by them."""
    for run in runs:
        counts = [tuple(run.metrics.get(f"speeds.{n}.{key}") for key in ("boxes", "car.boxes")) for n in SPEEDS]
        if (None, None) not in counts:
            listed = (f"{n} m/s {boxes} (cars {cars})" for n, (boxes, cars) in zip(SPEEDS, counts, strict=True))
            return f" Ground truth: {', '.join(listed)}."
    return ""


def _settings_without_dropout(run: RunResult) -> tuple[str, ...]:
    return tuple(setting for setting in run.settings if not setting.startswith(DROPOUT))


def _page(phase: str, scale: str, what: str, runs: list[RunResult]) -> str:
    """Title, conventions and the commands of the runs."""
    text = (
        f"# {phase}, scale {scale}\n\n"
        f"Data: {runs[0].dataset}; {what}; {METRIC if runs[0].task == DETECTION else SCORES} Written by "
        f"`python -m src.report phase={phase} scale={scale}` from the runs\n\n```\n"
    )
    for run in sorted(runs, key=lambda run: (run.phase, run.settings, run.seed)):
        text += f"{train_command([f'phase={run.phase}', f'scale={scale}', *run.settings, f'seed={run.seed}'])}\n"
    return f"{text}```\n\n"
