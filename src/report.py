"""`python -m src.report [phase=...] [scale=...]`: finished runs under paths.outputs into a table in paths.reports."""

from __future__ import annotations

import logging
from pathlib import Path

from src.command import run_command
from src.config import compose_config
from src.errors import DataError
from src.reporting.results import read_runs
from src.reporting.tables import experiment_tables
from src.training.run_folder import make_writable

logger = logging.getLogger(__name__)

NAMES = {
    (): "KGGI + OCSF",
    ("model.kggi.initialization=random",): "OCSF, random Gaussians",
    ("model.kggi.initialization=keypoint",): "KGGI + OCSF, keypoints only",
    ("model.kggi=null", "model.ocsf=null"): "radar only",
}


def main(overrides: list[str]) -> None:
    """Write `<phase>_<scale>.md` from every finished run of that phase and scale."""
    config, _ = compose_config(overrides)
    runs = read_runs(Path(config.paths.outputs), config.scale, config.phase.name)
    if not runs:
        raise DataError(f"{config.paths.outputs}: no finished run of {config.phase.name} at scale={config.scale}")
    try:
        tables = experiment_tables(runs, NAMES)
    except ValueError as error:
        raise DataError(f"{config.paths.outputs}: {error}; keep runs on different data in different folders") from error
    text = (
        f"# {config.phase.name}, scale {config.scale}\n\n"
        f"Data: {runs[0].data}; {config.phase.epochs} epochs; official TruckScenes metric on the validation split; "
        f"percent, mean ± standard deviation over seeds. Written by "
        f"`python -m src.report phase={config.phase.name} scale={config.scale}` from the runs\n\n```\n"
    )
    for settings in sorted({run.settings for run in runs}):
        for seed in sorted({run.seed for run in runs if run.settings == settings}):
            changes = " ".join([*settings, f"seed={seed}"])
            text += f"python -m src.train phase={config.phase.name} scale={config.scale} {changes}\n"
    path = Path(config.paths.reports) / f"{config.phase.name}_{config.scale}.md"
    make_writable(path.parent, "paths.reports")
    path.write_text(f"{text}```\n\n{tables}\n")
    print(tables)
    print(f"\nwritten: {path}")


if __name__ == "__main__":
    run_command(main)
