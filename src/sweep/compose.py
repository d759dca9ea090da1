"""The command line of `python -m src.sweep`, checked.

A run's configuration knows nothing of sweeps: what concerns the runner is composed apart, from conf/sweep.yaml.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.config import CONF, GROUPS, Config
from src.errors import ConfigError
from src.reliability.config_faults import hydra_message
from src.reliability.passwords import masked, shown_key
from src.report.sweep_file import SweepConfig
from src.sweep.sweep_files import load_sweep, sweep_files
from src.sweep.sweep_study import check_address
from src.training.identity import key_of

OWN_KEYS = ("sweep", "seeds", "workers", "storage", "dry_run", "trials", "published", "latency")
MOST_SEEDS = 1000


@dataclass(kw_only=True)
class SweepCommand:
    """Options of the runner itself and the sweep; the rest of the command line goes to every run."""

    seeds: int
    workers: int
    storage: str | None
    dry_run: bool
    trials: int | None
    published: bool
    latency: bool
    sweep: Any = None  # SweepConfig, of a file that Hydra does not read

    def __post_init__(self) -> None:
        for name, least in (("seeds", 1), ("workers", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, but got {getattr(self, name)}")
        if self.seeds > MOST_SEEDS:
            raise ConfigError(f"seeds must be at most {MOST_SEEDS}, but got {self.seeds}; seed=... says the first one")


def compose_sweep(overrides: list[str]) -> tuple[SweepCommand, list[str]]:
    """Split a command line into the runner's part, checked, and the overrides of every run.

    Raises ConfigError for an unknown sweep (naming those there are), a file that says what it may not, and bad values.
    """
    own = [override for override in overrides if key_of(override) in OWN_KEYS]
    rest = [override for override in overrides if override not in own]
    _check_places(overrides)
    chosen = [override.partition("=")[2] for override in own if key_of(override) == "sweep"]
    chosen = [name for name in chosen if name]  # `make sweep` without SWEEP says `+sweep=`
    if len(chosen) != 1:
        raise ConfigError(f"give one +sweep=NAME of {', '.join(sweep_files())}; got {' '.join(chosen) or 'none'}")
    # Taken as it is: an address may hold `=`, and Hydra's messages would show a password.
    storages = [override.partition("=")[2].strip("'\"") for override in own if key_of(override) == "storage"]
    own = [override for override in own if key_of(override) not in ("sweep", "storage")]
    try:
        command = _compose(load_sweep(chosen[0]), own)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(hydra_message(error, lambda: OWN_KEYS)) from error
    if storages and storages[-1] != "null":
        check_address(storages[-1])
        command.storage = storages[-1]
    return command, rest


def _check_places(overrides: list[str]) -> None:
    """Refuse what is no key of a run and nearly one of the runner, and passwords anywhere but in `storage`.

    Values are not shown: they may be a mistyped `storage=`.
    """
    of_runs = {field.name for field in dataclasses.fields(Config)} | set(GROUPS)
    for override in overrides:
        name = key_of(override)
        key = name.lstrip("~")
        near = difflib.get_close_matches(key.lower(), OWN_KEYS, n=1, cutoff=0.75)
        if near and "." not in key and name not in OWN_KEYS and key not in of_runs:
            raise ConfigError(f"{name}: did you mean {near[0]}?")
        if name != "storage" and masked(override) != override:
            raise ConfigError(
                f"{shown_key(name)}: holds what looks like a password; a database's address is given as storage=..."
            )


def _compose(sweep: SweepConfig, overrides: list[str]) -> SweepCommand:
    ConfigStore.instance().store(name="runner_options", node=SweepCommand)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        tree = compose("sweep", overrides=overrides)
    missing = OmegaConf.missing_keys(tree)
    if missing:
        raise ConfigError(f"{min(missing)} has no value")
    command: SweepCommand = OmegaConf.to_object(tree)
    if command.trials is not None and not sweep.is_search:
        raise ConfigError(f"trials={command.trials} is for searches; a sweep of rows trains each of them")
    if command.latency and not sweep.latency:
        raise ConfigError(f"latency=true: sweeps/{sweep.name}.yaml does not say latency: true; leave it out")
    if command.published and sweep.is_search:
        raise ConfigError("published=true is for sweeps of rows; a search goes on from its own trials")
    command.sweep = sweep if command.trials is None else dataclasses.replace(sweep, trials=command.trials)
    return command
