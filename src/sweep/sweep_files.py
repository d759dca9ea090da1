"""The files of sweeps/, read and checked."""

from __future__ import annotations

import dataclasses
import difflib
import json
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from src.config import CONF, SCALES
from src.errors import ConfigError
from src.reliability.config_faults import hydra_message
from src.report.json_format import parse_as
from src.report.plain_yaml import check_plain_yaml
from src.report.sweep_file import (
    DimensionConfig,
    PaperRowConfig,
    PlotConfig,
    RowConfig,
    SweepConfig,
    TableConfig,
)

SWEEPS = CONF.parent / "sweeps"
FILE_PARTS = (SweepConfig, RowConfig, TableConfig, PlotConfig, PaperRowConfig, DimensionConfig)
FILE_KEYS = [field.name for part in FILE_PARTS for field in dataclasses.fields(part)]


def sweep_files() -> dict[str, Path]:
    """Every file of sweeps/ by its name."""
    return {path.stem: path for path in sorted(SWEEPS.glob("*.yaml"))}


def load_sweep(name: str) -> SweepConfig:
    """One file of sweeps/. Raises ConfigError naming the file and what is wrong with it."""
    files = sweep_files()
    if name not in files:
        near = difflib.get_close_matches(name, files, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(f"sweep={name}: there is no sweeps/{name}.yaml; {hint}there are {', '.join(files)}")
    where = f"sweeps/{name}.yaml"
    try:
        check_plain_yaml(files[name].read_text(encoding="utf-8"))
        content = OmegaConf.to_container(OmegaConf.load(files[name]), resolve=False)  # reads 1e-3 as YAML 1.2 does
        _refuse_interpolation(content)
        if isinstance(content, dict):
            if "name" in content:
                raise ConfigError(f"name={content['name']}: a sweep has its file's name; leave it out")
            content |= {"name": name}
        sweep = parse_as(SweepConfig, json.dumps(content), known=FILE_KEYS)
    except ConfigError as error:
        raise ConfigError(str(error) if str(error).startswith(where) else f"{where}: {error}") from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}: {hydra_message(error, lambda: FILE_KEYS)}") from error
    except (YAMLError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, OSError) as error:
        words = " ".join(str(error).split())
        hint = "; write on, off, yes and no in quotes" if words.endswith(("is True", "is False")) else ""
        raise ConfigError(f"{where}: {words}{hint}") from error
    for row in sweep.rows:
        if row.scales is not None and not row.scales:
            raise ConfigError(f"{where}, row {row.label!r}: scales is empty; name one, or leave it out for all")
    named = {"scales": {scale for row in sweep.rows for scale in row.scales or ()}}
    named["scale_overrides"] = {scale for part in (sweep, *sweep.rows) for scale in part.scale_overrides}
    for key, scales in named.items():
        if unknown := sorted(scales - set(SCALES)):
            raise ConfigError(f"{where}: {key}: there is no scale {', '.join(unknown)}; there are {', '.join(SCALES)}")
    return sweep


def _refuse_interpolation(content: Any, where: str = "") -> None:
    """Raises ConfigError for `${`: labels go on to Hydra as they stand, and a file has nothing to refer to."""
    if isinstance(content, dict | list):
        for key, value in content.items() if isinstance(content, dict) else enumerate(content):
            _refuse_interpolation(value, f"{where}.{key}" if where else str(key))
    elif isinstance(content, str) and "${" in content:
        raise ConfigError(f"{where}: must not hold ${{, but is {content!r}")
