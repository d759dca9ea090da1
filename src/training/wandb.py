"""Weights & Biases beside metrics.csv. Absent, unreachable or dead, it stops no run and loses none of its numbers."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from lightning.pytorch.loggers.logger import Logger, rank_zero_experiment
from lightning.pytorch.utilities import rank_zero_only

from src.errors import ConfigError
from src.training.run_folder import RunFolder

logger = logging.getLogger(__name__)

INIT_LIMIT_S = 15.0
"""How long the service may take to accept a run; an unreachable one delays the start by up to about twice this."""
FINISH_LIMIT_S = 60.0
"""How long the last data may take to be sent; the rest stays in the run's folder."""
LONGEST_NAME = 128
"""Longest name of a group or job type that the service takes."""
T = TypeVar("T")


@dataclass(kw_only=True)
class WandbConfig:
    """Weights & Biases (`logger.wandb`)."""

    project: str
    offline: bool  # written into the run's folder only, for `wandb sync`
    group: str | None  # runs that are shown together; a sweep gives its name and scale
    row: str | None  # label of the sweep's row, the second level of grouping (W&B's job type)

    def __post_init__(self) -> None:
        for name in ("project", "group", "row"):
            value = getattr(self, name)
            if value is not None and not 0 < len(value.strip()) <= LONGEST_NAME:
                raise ConfigError(f"logger.wandb.{name} must have 1 to {LONGEST_NAME} characters, but has {len(value)}")


class WandbRun(Logger):
    """A Lightning logger over one W&B run, which it drops with a warning at the first error."""

    def __init__(self, run: Any, folder: RunFolder) -> None:
        super().__init__()
        self._run, self._folder = run, folder

    @property
    def name(self) -> str:
        """Name in Lightning's bookkeeping."""
        return "wandb"

    @property
    def version(self) -> str:
        """The run's own name, under which W&B knows it too."""
        return self._folder.run_id

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """W&B's run, None once it was dropped."""
        return self._run

    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: the run was started with its configuration."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """One row; steps that W&B has from before a restart are not sent again."""

        def send(run: Any) -> None:
            if step is None or step >= run.step:  # W&B's own counter; it refuses older steps with a warning for each
                run.log(metrics, step=step)

        self._attempt(send)

    @rank_zero_only
    def finish(self, scores: dict[str, Any], pictures: Path) -> str | None:
        """Send the score tables and the pictures, and end the run.

        Returns where it can be seen, or the command that sends an offline run; None where W&B was dropped.
        """

        def send(run: Any) -> str:
            import wandb

            tables = {
                name: wandb.Table(*_table(name, scores[name])) for name in ("classes", "ranges") if name in scores
            }
            shown = sorted(pictures.glob("*.png"))
            run.log(tables | {f"pictures/{_picture_name(path)}": wandb.Image(str(path)) for path in shown})
            run.summary.update({name: value for name, value in scores.items() if _is_number(value)})
            offline = run.settings.mode == "offline"
            where = f"wandb sync {run.settings.sync_dir}" if offline else run.url
            run.finish()
            return where

        return self._attempt(send)

    def _attempt(self, action: Callable[[Any], T]) -> T | None:
        """What the action gives; None where W&B was dropped, before or now."""
        if self._run is None:
            return None
        try:
            return action(self._run)
        except Exception as error:  # W&B's own errors and those of a dead helper process; none is worth a training
            self._run = None
            logger.warning(
                "W&B failed (%s) and is not written any more; %s has everything, and what W&B has so far can be sent "
                "with: wandb sync %s",
                _reason(error),
                self._folder.path,
                self._folder.path / "wandb" / "latest-run",
            )
            return None


def start_wandb(
    config: WandbConfig,
    folder: RunFolder,
    tree: dict[str, Any],  # configuration of the run as plain values
    earlier: Iterable[dict[str, str]],  # rows of metrics.csv that the run resumes from
) -> WandbRun | None:
    """A W&B run named as the run folder, written below it; offline where the service cannot be reached.

    A resumed run logs the earlier rows again: offline runs cannot be continued, so a new one of the same
    name replaces those of earlier starts; online, what the service has already is left out. None, with a warning,
    where W&B is not installed or does not start.
    """
    try:
        import wandb
    except ImportError as error:
        logger.warning("W&B is not installed (%s; pip install wandb); the run continues with metrics.csv alone", error)
        return None
    run = None
    for mode in ("offline",) if config.offline else ("online", "offline"):
        try:
            run = _init(wandb, mode, config, folder, tree)
            break
        except Exception as error:  # W&B raises its own, varying types; the run must not depend on a web service
            remedy = "it is written offline instead" if mode == "online" else "the run continues with metrics.csv alone"
            logger.warning("W&B could not start %s (%s); %s", mode, _reason(error), remedy)
            wandb.teardown()  # the failed attempt would still hold the run's name
    if run is None:
        return None
    started = WandbRun(run, folder)
    for row in earlier:
        values = {name: float(value) for name, value in row.items() if name != "step"}
        started.log_metrics(values, int(row["step"]))
    for old in (folder.path / "wandb").glob(f"offline-run-*-{folder.run_id}"):
        if str(old) != str(run.settings.sync_dir):
            shutil.rmtree(old, ignore_errors=True)
    return started


def _init(wandb: Any, mode: str, config: WandbConfig, folder: RunFolder, tree: dict[str, Any]) -> Any:
    """W&B's run. Raises what W&B raises, and RuntimeError instead of asking the terminal for a key."""
    if mode == "online" and not wandb.login(prompt=False, verify=False):
        raise RuntimeError("there is no API key; give one once with: wandb login")
    phase, seed = tree["phase"]["name"], tree["seed"]
    return wandb.init(
        project=config.project,
        id=folder.run_id,
        name=folder.run_id if config.row is None else f"{config.row}, seed {seed}",
        group=config.group,
        job_type=config.row,
        tags=[phase, tree["scale"], f"seed {seed}"],
        config=tree,
        dir=str(folder.path),
        mode=mode,
        resume="allow" if mode == "online" else None,
        settings=wandb.Settings(
            silent=True,
            console="off",  # the terminal is in log.txt
            init_timeout=INIT_LIMIT_S,
            finish_timeout=FINISH_LIMIT_S,
            finish_timeout_raises=True,
        ),
    )


def _table(name: str, rows: dict[str, dict[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows of every number that all entries have."""
    keys = [key for key in next(iter(rows.values()), {}) if all(_is_number(row.get(key)) for row in rows.values())]
    return [name, *keys], [[entry, *(row[key] for key in keys)] for entry, row in rows.items()]


def _picture_name(path: Path) -> str:
    """Name of a picture without the sample's token, so that W&B compares runs picture by picture."""
    return "_".join(path.stem.split("_")[:2])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0] or type(error).__name__
