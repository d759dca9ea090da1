"""`python -m src.report [scale=...] [phase=...]`: everything finished at one scale, into paths.reports.

Results of the runs under paths.outputs, a page per phase, the tables of every sweep, the page of the claims, and the
dashboard.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from src.config import PHASES, Config, compose_config, refuse_options_of_others
from src.errors import ConfigError, DataError
from src.files.atomic_write import write_whole
from src.pictures.comparison import BarPanel, draw_comparison
from src.pictures.forest import ForestGroup, ForestRow, draw_forest
from src.pictures.trade_off import TradeOff, draw_trade_off
from src.reliability.command import run_command
from src.report.claims import Claim, Finding, judge, load_claims, verdict_of
from src.report.claims_page import claims_page, why_page
from src.report.metric_names import DETECTION, RANGES, SPEEDS, find_metric
from src.report.pages import (
    FURTHER,
    PHASES_OF,
    called_by_changes,
    compared_experiments,
    comparison_page,
    left_out,
    phase_page,
    runs_on_page,
    split_by_data,
    without_dropout,
)
from src.report.results import RunResult, finished_runs, publish_result, read_results
from src.report.score_tables import BY_RANGE, BY_SPEED, ERROR_BY_SPEED, Experiment, estimate
from src.report.sweep_record import SweepRecord, read_records
from src.report.sweep_table import MISSING
from src.report.sweep_text import counted, place_of
from src.report.table_builder import is_current, write_sweep_tables
from src.sweep.sweep_files import load_sweep
from src.training.run_folder import make_writable


def main(overrides: list[str]) -> None:
    """Write all that can be written, show the page of `phase`, and end with what could not be.

    Raises DataError for run folders, results, records and claims that are broken, once the rest is done.
    """
    config, _ = compose_config(overrides, reads_data=False)
    refuse_options_of_others(config, "report")
    outputs, reports = Path(config.paths.outputs), Path(config.paths.reports)
    make_writable(reports, "paths.reports")
    faults: list[str] = []
    for folder in finished_runs(outputs, config.scale):
        with noted_in(faults):
            publish_result(folder, reports)
    results, broken = read_results(reports, config.scale)
    records, broken_records = read_records(reports, config.scale)
    faults += [*map(str, broken.values()), *map(str, broken_records.values())]
    pages = write_pages(config, results, {run for record in records for run in record.runs})
    tables: list[Path] = []
    pictures: list[Path] = []
    for record in records:
        with noted_in(faults):
            tables += write_sweep_tables(reports, record, results)
            pictures += write_trade_off(reports, record, results)
    claims: list[Path] = []
    if faults:
        faults.append("the page of the claims is as it was: what is broken would count as not run")
    else:
        with noted_in(faults):
            claims += write_claims(reports, config.scale, records, results)
    if not pages and not records:
        what = (
            f"{outputs}: no finished run of {config.phase.name} at scale={config.scale}, nor a result of that scale in "
            f"{reports}; give the scale and the phase of what was trained, or train it with python -m src.train"
        )
        raise DataError("\n".join([what, *faults]))
    from src.dashboard.single_file import export_dashboard  # its templates are not needed before

    dashboard = reports / "dashboard.html"
    export_dashboard(reports, outputs, dashboard)
    if (name := page_name(config.phase.name, config.phase.task)) in pages:
        text = pages[name].read_text()
        print(text[text.index("\n| ") + 1 :])
    for path in [*pages.values(), *tables, *pictures, *claims, dashboard]:
        print(f"written: {path}")
    if faults:
        raise DataError("\n".join(["all else is written, but", *faults]))


@contextmanager
def noted_in(faults: list[str]) -> Iterator[None]:
    """Note a ConfigError or DataError raised within in `faults`, so that what is broken costs no other page."""
    try:
        yield
    except (ConfigError, DataError) as error:
        faults.append(str(error))


def write_pages(config: Config, results: dict[str, RunResult], in_sweeps: Collection[str]) -> dict[str, Path]:
    """`<page_name>_<scale>.md` of every phase and task that has runs."""
    models = {result.phase: result.model for result in results.values() if result.phase in PHASES}
    defaults = {phase: defaults_of(config.scale, phase, model) for phase, model in models.items()}
    runs = called_by_changes(results.values(), defaults)
    groups = {}
    for task in dict.fromkeys(run.task for run in runs):
        own = [run for run in runs if run.task == task]
        groups |= {page_name(phase, task): runs_on_page(own, phase, in_sweeps) for phase in PHASES if phase != FURTHER}
    reports = Path(config.paths.reports)
    return {name: write_page(reports, name, config.scale, runs) for name, runs in groups.items() if runs}


def page_name(phase: str, task: str) -> str:
    """`<phase>`; of another task than detection `<phase>_<task>`."""
    return phase if task == DETECTION else f"{phase}_{task}"


def defaults_of(scale: str, phase: str, model: str) -> dict[str, Any]:
    """Configuration of a run without settings: of the default model or, where that lacks the phase, of `model`.

    The latter lacks the model's name, which thus counts as a setting.
    """
    choices = [f"scale={scale}", f"phase={phase}"]
    try:
        return compose_config(choices, reads_data=False)[1]
    except ConfigError:
        tree = compose_config([*choices, f"model={model}"], reads_data=False)[1]
        return tree | {"model": {key: value for key, value in tree["model"].items() if key != "name"}}


def write_page(reports: Path, name: str, scale: str, runs: list[RunResult]) -> Path:
    """One phase's page of `runs` on its default data; phase 2's holds its runs against phase 1's, with a picture."""
    runs, others = split_by_data(runs, name if name in PHASES_OF else runs[0].phase)
    if name in PHASES_OF:
        experiments = compared_experiments(runs)
        picture = f"pictures/{name}_{scale}.png"
        draw_comparison(reports / picture, bar_panels(without_dropout(experiments)), f"{name}, scale {scale}")
        text = comparison_page(experiments, scale, picture)
    else:
        text = phase_page(runs, scale)
    path = reports / f"{name}_{scale}.md"
    write_whole(path, text + left_out(others))
    return path


def write_claims(reports: Path, scale: str, records: list[SweepRecord], results: dict[str, RunResult]) -> list[Path]:
    """The pages of the claims and their picture, once any has a result; sweeps that a command line changed are others.

    `README.md` at the default scale, `claims_<scale>.md` at another; `claims_why_<scale>.md` for what lies behind them.
    Raises ConfigError for a file of claims that is wrong.
    """
    by_sweep = {record.name: record for record in records if not record.changes}
    findings = [(claim, judge(claim, by_sweep, results)) for claim in load_claims(load_sweep)]
    if not any(finding.found for _, found in findings for finding in found):
        return []
    is_default = scale == compose_config([])[0].scale
    path = reports / ("README.md" if is_default else f"claims_{scale}.md")
    picture = f"pictures/claims_{scale}.png"
    draw_claims(reports / picture, findings, scale)
    why = path.with_name(f"claims_why_{scale}.md")
    reasons = why_page(findings, scale, path.name)
    if reasons:
        write_whole(why, reasons)
    else:
        why.unlink(missing_ok=True)
    address = why.name if reasons else None
    write_whole(path, claims_page(findings, by_sweep, scale, picture, address, in_words=is_default))
    return [path, why] if reasons else [path]


def draw_claims(path: Path, findings: list[tuple[Claim, list[Finding]]], scale: str) -> None:
    """All measures in percentage points, claim by claim."""
    groups = []
    for number, (claim, found) in enumerate(findings, start=1):
        rows, before = [], ""
        for finding in found:
            measure, effect = finding.measure, finding.found
            if measure.metric.unit != "%" or measure.comparison.asks is not None:
                continue
            text = measure.comparison.text
            label, before = "" if text == before else text, text
            numbers = MISSING
            if effect is not None:
                numbers = f"{effect.numbers}   {effect.pairs} seed{'s' if effect.pairs > 1 else ''}"
            ends = (effect.mean, effect.low, effect.high) if effect is not None else (None, None, None)
            verdict, more = str(finding.verdict), (measure.paper, measure.decides)
            rows.append(ForestRow(label, measure.metric.title, verdict, numbers, *ends, *more))
        groups.append(ForestGroup(f"{number}. {claim.config.sentence}", str(verdict_of(found)), rows))
    draw_forest(path, groups, f"The paper's claims, scale {scale}", "difference of the two rows, percentage points")


def write_trade_off(reports: Path, record: SweepRecord, results: dict[str, RunResult]) -> list[Path]:
    """mAP over the milliseconds of a frame, where at least two rows of a sweep that times them were timed.

    Latencies are of the machine that timed most: others do not compare. Neither results of earlier trainings count nor
    rows that score the weights of another row.
    """
    if not record.sweep.latency:
        return []
    score, cost = (find_metric(name, record.name) for name in ("mAP", "latency.total"))
    rows = {
        row.label: [results[run] for run in record.rows[row.label].values() if is_current(record, run, results)]
        for row in record.sweep.rows
        if row.weights is None and row.label in record.rows
    }
    places = Counter(place_of(run.latency) for found in rows.values() for run in found if run.latency is not None)
    points, place = [], max(places, key=places.get, default="")
    for label, found in rows.items():
        timed = [run for run in found if run.latency is not None and place_of(run.latency) == place]
        accuracy, time = estimate(found, score), estimate(timed, cost)
        if accuracy is not None and time is not None:
            seeds = "" if len(found) == max(map(len, rows.values())) else f", {counted(len(found), 'seed')}"
            points.append(TradeOff(f"{label}{seeds}", time.mean, *accuracy))
    if len(points) < 2:
        return []
    path = reports / "pictures" / f"{record.name}_latency_{record.scale}{record.suffix}.png"
    title = f"{record.sweep.title}, scale {record.scale}"
    draw_trade_off(path, points, title, f"milliseconds from frame to boxes, {place}", score.heading)
    return [path]


def bar_panels(experiments: list[Experiment]) -> list[BarPanel]:
    """mAP by distance and by speed, and the velocity error by speed."""
    panels = []
    for title, columns, names, unit in (
        ("mAP by distance, %", BY_RANGE, RANGES, "m"),
        ("mAP by speed, %, over the classes that occur there", BY_SPEED, SPEEDS, "m/s"),
        ("mAVE by speed, m/s, over the classes that occur there (less is better)", ERROR_BY_SPEED, SPEEDS, "m/s"),
    ):
        bars = {e.label.replace("`", ""): [estimate(e.runs, c) for c in columns] for e in experiments}
        panels.append(BarPanel(title, [f"{name} {unit}" for name in names], bars, columns[0].digits))
    return panels


if __name__ == "__main__":
    run_command(main)
