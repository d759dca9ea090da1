"""The root of a run's configuration, and what every entry point does before it starts.

Values live in conf/; this file names them, gives types, and turns the composed tree into dataclasses. Only entry points
import it: everything below receives plain values or its own small dataclass.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import Enum
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.data.data_config import DataConfig
from src.errors import CheckpointError, ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models import FAMILIES, phase_option_names, plain_phase_options, read_phase_options
from src.models.backbones.image import ImageEncoderConfig
from src.ops.precision import Precision
from src.reliability.config_faults import check_tree, hydra_message
from src.reliability.passwords import masked, shown_key
from src.reliability.untrusted import fault_of_tree
from src.training.identity import LEGACY_DEFAULTS, key_of
from src.training.optim import OptimConfig
from src.training.phases import PhaseConfig
from src.training.run_folder import PathsConfig, Resume
from src.training.trainer_config import TrainerConfig
from src.training.true_motion import Oracle
from src.training.wandb import WandbConfig
from src.world.world_config import WorldConfig

CONF = Path(__file__).resolve().parent.parent / "conf"
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir())
PHASES = sorted(path.stem for path in (CONF / "phase").glob("*.yaml"))
SCALES = sorted(path.stem for path in (CONF / "scale").glob("*.yaml"))

COMMANDS_OF_OPTIONS = {
    "checkpoint": ("evaluate", "predict", "export", "replay", "benchmark"),
    "predictions": ("evaluate",),
    "scene": ("predict",),
    "out": ("evaluate", "predict", "export", "world", "benchmark"),
    "preview": ("world",),
    "compare": ("world",),
    "oracle": ("evaluate",),
    "suite": ("benchmark",),
}
"""Options of single commands, and the commands that read them."""
FILES_AND_NAMES = (
    *("checkpoint", "predictions", "out", "scene", "data.root", "phase.init_from"),
    *("paths.outputs", "paths.reports"),
)
"""What a shell variable that is not set leaves empty."""
NO_DATA = "none"
"""Root of recorded data in a command that reads none."""


@dataclass(kw_only=True)
class GridConfig:
    """The BEV grid; see `BEVGrid`."""

    cells: list[int]  # [rows, columns]
    cell_m: float
    centre_m: list[float]  # [x, y]
    z_range_m: list[float]  # [low, high]

    def build(self) -> BEVGrid:
        """The checked grid."""
        return BEVGrid(tuple(self.cells), self.cell_m, tuple(self.centre_m), tuple(self.z_range_m))


@dataclass(kw_only=True)
class RunDataConfig(DataConfig):
    """The data of a run, and where they come from."""

    world: WorldConfig | None  # the synthetic highway to write on first use; null = recorded data


@dataclass(kw_only=True)
class LoggerConfig:
    """Loggers beside metrics.csv."""

    wandb: WandbConfig | None


class BenchmarkSuite(Enum):
    """What `python -m src.benchmark` measures."""

    model = "model"
    ops = "ops"
    scaling = "scaling"
    training = "training"
    latency = "latency"
    soak = "soak"
    metric = "metric"
    reader = "reader"
    launches = "launches"
    gpu = "gpu"


NOT_GIVEN = (None, False, Oracle.none, BenchmarkSuite.model)
"""Values of options of single commands that say nothing to the others."""


@dataclass(kw_only=True)
class Config:
    """Everything a run is made of."""

    grid: GridConfig
    model: Any  # the chosen model's own dataclass, see FAMILIES
    backbone: ImageEncoderConfig
    data: RunDataConfig
    phase: PhaseConfig
    trainer: TrainerConfig
    logger: LoggerConfig
    optim: OptimConfig
    paths: PathsConfig
    scale: str
    precision: str
    seed: int
    resume: Resume
    checkpoint: str | None
    predictions: str | None
    out: str | None
    scene: str | None
    preview: bool
    compare: bool
    suite: BenchmarkSuite
    oracle: Oracle

    def __post_init__(self) -> None:
        if self.precision not in list(Precision):
            raise ConfigError(f"precision must be one of {[*map(str, Precision)]}, but got {self.precision!r}")
        if not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed must be at least 0 and below 2**32, but got {self.seed}")
        if self.model.name not in FAMILIES:
            raise ConfigError(f"model.name={self.model.name}: must be one of {', '.join(FAMILIES)}")
        if self.phase.name not in PHASES:
            known = ", ".join(PHASES)
            raise ConfigError(f"phase.name={self.phase.name}: must be one of {known}; choose with phase=...")
        read_phase_options(self.model.name, self.phase.options)
        self.grid.build()
        if self.phase.temporal and not self.model.temporal_part:
            raise ConfigError(
                f"model={self.model.name} has no memory to train in phase={self.phase.name}; use phase=phase1"
            )
        for key in FILES_AND_NAMES:
            value = attrgetter(key)(self)
            if value is not None and not value.strip():
                raise ConfigError(
                    f"{key} is empty; give a path, or leave {key} out (was an unset shell variable meant?)"
                )
        if "lidar" in self.model.sensors and self.data.world is not None and not self.data.world.lidar:
            raise ConfigError(
                f"model={self.model.name} reads LiDAR, which this world lacks; give data.world.lidar=true"
            )
        if self.data.batch_size % self.trainer.num_processes:
            raise ConfigError(
                f"data.batch_size={self.data.batch_size} is the total over all devices and must be divisible by "
                f"trainer.devices={self.trainer.devices} times trainer.num_nodes={self.trainer.num_nodes}"
            )

    @property
    def image_size_px(self) -> tuple[int, int] | None:
        """(height, width) of the images that the model uses, None for a model without."""
        return tuple(self.backbone.image_size_px) if "camera" in self.model.sensors else None

    @property
    def draw_seed(self) -> int:
        """What order, augmentation and dropout of the training are drawn from.

        `seed`, but for a phase that goes on from another: with the same it would see that one's epochs once more.
        """
        if self.phase.init_from is None:
            return self.seed
        return int.from_bytes(hashlib.sha256(f"{self.seed}/{self.phase.name}".encode()).digest()[:4], "little")


def _register() -> None:
    """Tell Hydra the types: the root as `run`, each model's as `model/schema_<name>`."""
    store = ConfigStore.instance()
    store.store(name="run", node=Config)
    for name, (schema, _) in FAMILIES.items():
        store.store(group="model", name=f"schema_{name}", node=schema)


def refuse_options_of_others(config: Config, command: str) -> None:
    """Raises ConfigError for an option of single commands that this one, `train` for instance, would ignore."""
    for option, users in COMMANDS_OF_OPTIONS.items():
        if command not in users and (value := getattr(config, option)) not in NOT_GIVEN:
            names = " or ".join(f"python -m src.{user}" for user in users)
            said = "true" if value is True else getattr(value, "value", value)
            raise ConfigError(f"{option}={said}: an option of {names}; leave it out")


def compose_config(
    overrides: list[str],
    reads_data: bool = True,  # else data.root may be missing
) -> tuple[Config, dict[str, Any]]:
    """Compose conf/ with command-line overrides into checked dataclasses.

    Returns the configuration and the same as a plain tree (what a checkpoint and `config.yaml` keep).
    Raises ConfigError naming the key for anything unknown, mistyped, missing or impossible.
    """
    tree = compose_tree(overrides)
    if not reads_data and OmegaConf.is_missing(tree.data, "root"):
        tree.data.root = NO_DATA
    config, plain = build_config(tree), OmegaConf.to_container(tree, resolve=True, enum_to_str=True)
    plain["phase"]["options"] = plain_phase_options(config.model.name, config.phase.options)
    return config, plain


def compose_tree(overrides: list[str]) -> DictConfig:
    """conf/ with the overrides, types checked but values not yet; see `compose_config`."""
    _register()
    for override in overrides:
        if override.startswith("-"):
            raise ConfigError(f"{override}: options are written key=value, without dashes")
        if override.startswith("~"):
            raise ConfigError(f"{override}: keys cannot be removed; a part is switched off with {override[1:]}=null")
        _refuse_hidden(override)
        group, _, name = override.partition("=")
        if group in GROUPS and name.startswith("["):
            raise ConfigError(f"{override}: {group} is one file of conf/{group}/, not a list of them")
        if override.startswith("phase.name="):
            raise ConfigError(f"{override}: runs are told apart by this name; choose a phase with phase=...")
    _check_phase(overrides)
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            tree = compose("config", overrides=overrides)
        if not tree.phase.temporal:
            # In code: a later at_scale file would revive a part that a phase file sets to null.
            family = OmegaConf.get_type(tree.model)
            if family.temporal_part:
                tree.model[family.temporal_part] = None
            for switch in family.temporal_switches:
                OmegaConf.update(tree.model, switch, False)
        return tree
    except (HydraException, OmegaConfBaseException, OverflowError) as error:  # the last: beyond every float
        raise ConfigError(hydra_message(error, _known_keys)) from error
    except (ValueError, AssertionError) as error:  # Hydra's own words for these name neither the key nor the remedy
        raise ConfigError(
            f"{' '.join(overrides)}: a choice of conf/ ({', '.join(GROUPS)}) needs one of its names, and a key below a "
            f"part that is null needs the part first, as in logger=wandb logger.wandb.project=... ({error})"
        ) from error


def _check_phase(overrides: list[str]) -> None:
    """Raises ConfigError for a phase of another model, before what it sets at a scale is missed in this one."""
    chosen = _default_choices() | {key_of(override): override.partition("=")[2] for override in overrides}
    model, phase = chosen["model"], chosen["phase"]
    if model in FAMILIES and phase in PHASES:
        fitting = [name for name in PHASES if _options_of(name) == phase_option_names(model)]
        if phase not in fitting:
            raise ConfigError(f"phase={phase} is no phase of model={model}; use phase={' or '.join(fitting)}")


@cache
def _default_choices() -> dict[str, str]:
    """Name by group, by conf/config.yaml."""
    defaults = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").defaults, resolve=False)
    return {group: name for entry in defaults if isinstance(entry, dict) for group, name in entry.items()}


@cache
def _options_of(phase: str) -> set[str]:
    """Keys of the phase's options, by its file."""
    return set(OmegaConf.load(CONF / "phase" / f"{phase}.yaml").options)


def _refuse_hidden(override: str) -> None:
    """Raises ConfigError for what brings in more than it shows, or shows what should stay hidden.

    The file of a sweep may come from somebody else, and what is composed is written into config.yaml, logs and pages.
    """
    name = key_of(override)
    if "${" in override:
        raise ConfigError(f"{masked(override)}: must not refer to something else; the shell fills in $VARIABLES")
    if name.partition("/")[0].partition(".")[0] == "hydra":
        raise ConfigError(f"{name}: settings of Hydra itself are none of a run's")
    if masked(override) != override:
        raise ConfigError(
            f"{shown_key(name)}: holds what looks like a password, which would be written down with the run"
        )


def build_config(tree: DictConfig) -> Config:
    """Turn a composed tree into dataclasses; see `compose_config`."""
    try:
        missing = OmegaConf.missing_keys(tree)
        if missing:
            raise ConfigError(f"{min(missing)} has no value; give {min(missing)}=... on the command line")
        config = OmegaConf.to_object(tree)
    except OmegaConfBaseException as error:
        raise ConfigError(hydra_message(error, _known_keys)) from error
    check_tree(config, tree)
    return config


def restore_config(stored: dict[str, Any], overrides: list[str]) -> Config:
    """A configuration as a checkpoint stores it, with the keys named in `overrides` replaced.

    A group choice (`data=truckscenes`) replaces that whole group, at the checkpoint's scale and phase; `model=` only
    says whose keys may follow. A key of `trainer` that is younger than the checkpoint has today's value, one of
    LEGACY_DEFAULTS the value stated there. `paths` are the command's own: where it reads and writes is not for a file
    to say, least of all a stranger's; so is `oracle`.
    Raises CheckpointError when the stored tree does not fit this version of the code, ConfigError for another model,
    scale or phase and for a key below a part that the checkpoint does not have.
    """
    fault = fault_of_tree(stored)
    if fault is not None:
        raise CheckpointError(f"the checkpoint's configuration is not one of plain values: {fault}")
    model, phase = (
        stored[key].get("name") if isinstance(stored.get(key), dict) else None for key in ("model", "phase")
    )
    scale = stored.get("scale")
    for key, value, known in (("model", model, FAMILIES), ("phase", phase, PHASES), ("scale", scale, SCALES)):
        if not isinstance(value, str) or value not in known:
            raise CheckpointError(f"the checkpoint is of {key} {value!r:.80}; this version knows {sorted(known)}")
    changes = {change.key_or_group: change for change in OverridesParser.create().parse_overrides(overrides)}
    fixed = {"scale": scale, "model": model, "phase": phase, "phase.temporal": stored["phase"].get("temporal")}
    for key, own in fixed.items():
        if key in changes and changes[key].value() != own:
            raise ConfigError(f"{key}={changes[key].value()}: the checkpoint is of {key}={own}; leave {key}= out")
    own = [f"{key}={fixed[key]}" for key in ("scale", "model", "phase")]
    tree, fresh = OmegaConf.create(stored), compose_tree([*own, *overrides])
    tree.paths, tree.oracle = fresh.paths, fresh.oracle
    for key, before in LEGACY_DEFAULTS.items():
        part, leaf = key.rpartition(".")[::2]
        if all(isinstance(OmegaConf.select(whole, part), DictConfig) for whole in (tree, fresh)):
            if leaf in OmegaConf.select(fresh, part) and leaf not in OmegaConf.select(tree, part):
                OmegaConf.update(tree, key, before)
    changes.pop("model", None)  # only says whose keys may follow: the checkpoint's own values stay
    for key in sorted(changes, key=lambda key: key.count(".")):  # a part before what lies in it
        place = key.replace("/", ".")  # of a choice below a group, as model/roi
        part = place.rpartition(".")[0]
        if part and OmegaConf.select(tree, part) is None:
            raise ConfigError(f"{key}: the checkpoint has no {part}")
        OmegaConf.update(tree, place, OmegaConf.select(fresh, place), merge=False)
    schema = OmegaConf.structured(Config)
    try:
        schema.model = OmegaConf.structured(FAMILIES[model][0])
        return build_config(OmegaConf.merge(schema, {"trainer": fresh.trainer}, tree))
    except (OmegaConfBaseException, ConfigError, OverflowError) as error:  # the last: a whole number beyond every float
        changed = "".join(f" with {masked(override)}" for override in overrides)
        raise CheckpointError(f"the checkpoint's configuration{changed} does not fit this code: {error}") from None


def _known_keys() -> list[str]:
    """Every key of the default tree, dotted."""
    _register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        tree = compose("config")

    def walk(node: Any, prefix: str) -> list[str]:
        if not isinstance(node, dict):
            return [prefix]
        inner = [key for name, value in node.items() for key in walk(value, f"{prefix}.{name}" if prefix else name)]
        return ([prefix] if prefix else []) + inner

    return walk(OmegaConf.to_container(tree, resolve=False), "")
