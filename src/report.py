"""`python -m src.report [phase=...] [scale=...]`: finished runs under paths.outputs into a page in paths.reports.

Phase 2's page holds its runs against phase 1's, and has a picture.
"""

from __future__ import annotations

from pathlib import Path

from src.command import run_command
from src.config import compose_config
from src.errors import DataError
from src.pictures.comparison import BarPanel, draw_comparison
from src.reporting.pages import PHASES_OF, compared_experiments, comparison_page, phase_page, runs_on_page, seeing
from src.reporting.results import read_runs
from src.reporting.tables import BY_RANGE, BY_SPEED, ERROR_BY_SPEED, RANGES, SPEEDS, Experiment, mean_and_spread
from src.training.run_folder import make_writable


def main(overrides: list[str]) -> None:
    """Write `<phase>_<scale>.md` from every finished run that belongs on it."""
    config, _ = compose_config(overrides)
    phase, scale = config.phase.name, config.scale
    runs = runs_on_page(read_runs(Path(config.paths.outputs), scale, PHASES_OF.get(phase, (phase,))), phase)
    if not runs:
        raise DataError(f"{config.paths.outputs}: no finished run of {phase} at scale={scale}")
    reports = Path(config.paths.reports)
    make_writable(reports, "paths.reports")
    try:
        if phase in PHASES_OF:
            experiments = compared_experiments(runs)
            picture = f"pictures/{phase}_{scale}.png"
            draw_comparison(reports / picture, bar_panels(seeing(experiments)), f"{phase}, scale {scale}")
            text = comparison_page(experiments, scale, picture)
        else:
            text = phase_page(runs, scale, config.phase.epochs)
    except ValueError as error:
        raise DataError(f"{config.paths.outputs}: {error}; keep runs on different data in different folders") from error
    path = reports / f"{phase}_{scale}.md"
    path.write_text(text)
    print(text[text.index("\n| ") + 1 :])
    print(f"written: {path}")


def bar_panels(experiments: list[Experiment]) -> list[BarPanel]:
    """mAP by distance and by speed, and the velocity error by speed."""
    panels = []
    for title, columns, names, unit in (
        ("mAP by distance, %", BY_RANGE, RANGES, "m"),
        ("mAP by speed, %, over the classes that occur there", BY_SPEED, SPEEDS, "m/s"),
        ("mAVE by speed, m/s, over the classes that occur there (less is better)", ERROR_BY_SPEED, SPEEDS, "m/s"),
    ):
        bars = {e.label: [mean_and_spread(e.values(c.metric), c) for c in columns] for e in experiments}
        panels.append(BarPanel(title, [f"{name} {unit}" for name in names], bars, columns[0].digits))
    return panels


if __name__ == "__main__":
    run_command(main)
