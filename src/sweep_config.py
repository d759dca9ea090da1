"""The command line of `python -m src.sweep`, and the files of sweeps/ that it names, checked.

A run's configuration knows nothing of sweeps: what concerns the runner is composed apart, from conf/sweep.yaml.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from src.config import CONF, hydra_message
from src.errors import ConfigError
from src.reporting.sweep_file import SweepConfig

SWEEPS = CONF.parent / "sweeps"
OWN_KEYS = ("sweep", "seeds", "workers", "storage", "dry_run")


@dataclass(kw_only=True)
class SweepCommand:
    """What the runner is told; the rest of the command line goes to every run."""

    sweep: SweepConfig | None = None  # `+sweep=<file of sweeps/>`
    seeds: int
    workers: int
    storage: str | None
    dry_run: bool

    def __post_init__(self) -> None:
        for name in ("seeds", "workers"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, but got {getattr(self, name)}")


def sweep_files() -> dict[str, Path]:
    """Every file of sweeps/ by its name."""
    return {path.stem: path for path in sorted(SWEEPS.glob("*.yaml"))}


def compose_sweep(overrides: list[str]) -> tuple[SweepCommand, list[str]]:
    """Split a command line into the runner's part, checked, and the overrides of every run.

    Raises ConfigError for an unknown sweep (naming those there are), a file that says what it may not, and bad values.
    """
    own = [override for override in overrides if override.lstrip("+").split("=")[0] in OWN_KEYS]
    rest = [override for override in overrides if override not in own]
    chosen = [override for override in own if override.lstrip("+").startswith("sweep=")]
    if len(chosen) != 1:
        raise ConfigError(f"give one +sweep=NAME of {', '.join(sweep_files())}; got {' '.join(chosen) or 'none'}")
    name = chosen[0].split("=", 1)[1]
    own = [override for override in own if override not in chosen]
    try:
        command = _compose(load_sweep(name), own)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(hydra_message(error)) from error
    return command, rest


def load_sweep(name: str) -> SweepConfig:
    """One file of sweeps/. Raises ConfigError naming the file and what is wrong with it."""
    files = sweep_files()
    if name not in files:
        near = difflib.get_close_matches(name, files, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(f"sweep={name}: there is no sweeps/{name}.yaml{hint} There are {', '.join(files)}")
    try:
        content = OmegaConf.merge(OmegaConf.structured(SweepConfig), OmegaConf.load(files[name]), {"name": name})
        return OmegaConf.to_object(content)
    except ConfigError:
        raise
    except (OmegaConfBaseException, YAMLError, ValueError, OSError) as error:
        raise ConfigError(f"sweeps/{name}.yaml: {' '.join(str(error).split())}") from error


def _compose(sweep: SweepConfig, overrides: list[str]) -> SweepCommand:
    ConfigStore.instance().store(name="sweep_command", node=SweepCommand)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        tree = compose("sweep", overrides=overrides)
    missing = OmegaConf.missing_keys(tree)
    if missing:
        raise ConfigError(f"{min(missing)} has no value")
    tree.sweep = sweep
    return OmegaConf.to_object(tree)
