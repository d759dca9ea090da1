"""From one phase to the next: which run a phase starts from, and its weights, strictly (`phase.init_from`)."""

from __future__ import annotations

import hashlib
import logging
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from src.errors import CheckpointError, ConfigError, DataError, DivergedError, HorizonError, InterruptedRunError
from src.models.detector import Detector
from src.reliability.checkpoints import LAST, OpenCheckpoint, load_model_weights, open_checkpoint
from src.reliability.command import handling_signals
from src.reliability.processes import die_with_parent
from src.training.identity import RUN_ID, TEMPORAL_DATA_KEYS, is_of, leaves, run_identity, train_command
from src.training.run_config import RunConfig
from src.training.run_folder import RunFolder

logger = logging.getLogger(__name__)

OF_THIS_RUN = ("phase", "resume")
"""Overrides that never concern the run whose weights are taken."""
OF_STREAMED_DATA = tuple(f"data.{key}" for key in TEMPORAL_DATA_KEYS)
"""Overrides that, like the model's `keys_of_temporal_phase`, do not concern that run where it is of single frames."""
INPUT_SETTINGS = (
    *("data.num_sweeps", "data.num_lidar_sweeps", "data.deskew_lidar", "data.timeline.radial_speeds"),
    *("data.min_distance_m", "data.propagate_points", "data.test_resize_offset"),
)
"""Keys of `data` that decide what inputs the weights have learnt to read."""

Compose = Callable[[list[str]], tuple[RunConfig, dict[str, Any]]]
"""Overrides to a run's configuration, as dataclasses and as plain values (`compose_config`)."""


@dataclass(frozen=True)
class WeightSource:
    """Where a run's first weights come from."""

    identity: str  # run id, or a digest of the file
    checkpoint: Path
    overrides: list[str] | None  # of the run that makes it; None for a given file or run
    folder: RunFolder | None

    @property
    def ready(self) -> bool:
        """Whether the weights are those of a finished run, or a given file."""
        return self.folder is None or (self.folder.finished and self.checkpoint.is_file())

    @property
    def command(self) -> str:
        """What makes it."""
        return train_command(self.overrides or [])


def find_source(
    config: RunConfig,  # as `compose` gives it
    overrides: list[str],
    compose: Compose,
    phases: Sequence[str],  # names that `phase.init_from` may have
) -> WeightSource | None:
    """The run or file that `phase.init_from` names, finished or not; None for fresh weights.

    A phase's name means the run of the same command in that phase, less the overrides of what only the later phase has;
    a run id that run, trained or not. Raises CheckpointError when a given file does not exist.
    """
    name = config.phase.init_from
    if name is None:
        return None
    if name not in phases:
        path = Path(name)
        if RUN_ID.fullmatch(name) and not path.is_file():
            folder = RunFolder(Path(config.paths.outputs), name)
            return WeightSource(name, folder.checkpoints / LAST, None, folder)
        if not path.is_file():
            raise CheckpointError(
                f"phase.init_from={name}: there is no such checkpoint, and no phase ({', '.join(phases)}) or run of "
                "that name"
            )
        return WeightSource(hashlib.sha256(path.read_bytes()).hexdigest()[:16], path, None, None)
    kept = [override for override in overrides if not is_of(override, OF_THIS_RUN)]
    wanted = [f"phase={name}", *kept]
    its_config, tree = compose(wanted)
    others = config.model.keys_of_later_phases if its_config.phase.init_from is None else ()
    if not its_config.phase.temporal:
        others = (*others, *OF_STREAMED_DATA, *config.model.keys_of_temporal_phase)
    if others:
        wanted = [override for override in wanted if not is_of(override, others)]
        its_config, tree = compose(wanted)
    its_source = find_source(its_config, wanted, compose, phases)  # what that run starts from is part of its identity
    identity = run_identity(tree, its_source.identity if its_source is not None else None)
    folder = RunFolder(Path(config.paths.outputs), identity)
    return WeightSource(folder.run_id, folder.checkpoints / LAST, wanted, folder)


def train_source(source: WeightSource, train_missing: bool, processes_exist: bool) -> None:
    """Train the run that a phase starts from, in a process of its own, which prints its progress here.

    `processes_exist` says that ranks are already running side by side, so none of them can start a training of all.
    Raises ConfigError when only its id is known, or it may not be trained here, the error of its exit code when it
    fails, and CheckpointError when it had finished before and has lost its weights since.
    """
    if source.overrides is None:
        raise ConfigError(
            f"phase.init_from={source.identity}: {source.folder.path} holds no finished run with its weights; train "
            "it first, or give the path of a checkpoint"
        )
    reason = None
    if not train_missing:
        reason = "phase.train_missing=false"
    elif processes_exist:
        reason = "the processes of this run were started from outside, and they cannot train another run first"
    if reason is not None:
        raise ConfigError(
            f"the run {source.identity} that phase.init_from names has not finished ({reason}); make it with\n"
            f"    {source.command}\nor give the path of a checkpoint as phase.init_from=PATH"
        )
    logger.info("no finished run %s to start from: training it first", source.identity)
    code = _run_command([sys.executable, "-m", "src.train", *source.overrides])
    if code != 0:
        kinds: dict[int, type[HorizonError]] = {
            kind.exit_code: kind for kind in (ConfigError, DataError, DivergedError, InterruptedRunError)
        }
        kinds |= dict.fromkeys((-signal.SIGINT, -signal.SIGTERM), InterruptedRunError)  # it was still starting
        raise kinds.get(code, HorizonError)(
            f"the run {source.identity} that comes first ended with exit code {code}, see above; {source.command}"
        )
    if not source.ready:
        raise CheckpointError(
            f"the run {source.identity} has finished, but {source.checkpoint} is gone; make it anew with\n"
            f"    {source.command} resume=restart"
        )


def open_source(source: WeightSource) -> OpenCheckpoint:
    """The source's checkpoint. Raises CheckpointError with the remedy when it is damaged."""
    try:
        return open_checkpoint(source.checkpoint)
    except CheckpointError as error:
        overrides = source.overrides
        if overrides is None and source.folder is not None:  # a run given by its id says what made it
            overrides = source.folder.read_result()[0].get("overrides")
        if overrides is None:
            raise
        remedy = f"{train_command(overrides)} resume=restart"
        raise CheckpointError(f"{error}; or make it anew with\n    {remedy}") from error


def hand_over(model: Detector, weights: OpenCheckpoint, tree: dict[str, Any]) -> None:
    """Take the earlier phase's `weights` into `model`; what the new phase adds keeps its own.

    Weights that are scored as they are may hold more layers of a stack, of which the last ones are taken, and in a
    temporal phase parts of it that this run switches off. These and settings that differ are logged. Raises
    CheckpointError naming every key that does not fit.
    """
    checkpoint = weights.take()
    added = re.compile(model.config.new_in_temporal_phase) if model.config.new_in_temporal_phase else None
    if tree["phase"]["epochs"] == 0:
        state, wanted = checkpoint["state_dict"], {f"model.{key}" for key in model.state_dict()}
        state = _last_layers(state, wanted, model.config.layer_stack, weights.path)
        off = [key for key in state if key not in wanted and added and added.match(key.removeprefix("model."))]
        if off and tree["phase"]["temporal"]:
            state = {key: value for key, value in state.items() if key not in off}
            logger.info("switched off: %d tensors of %s", len(off), weights.path)
        checkpoint["state_dict"] = state
    new = load_model_weights(model, checkpoint, weights.path, added)
    parts = sorted({key.partition(".")[0] for key in new})
    logger.info("weights from %s; new: %d tensors in %s", weights.path, len(new), ", ".join(parts) or "nothing")
    stored = checkpoint["horizon3d"]["config"]
    later = (*model.config.keys_of_temporal_phase, *model.config.keys_of_later_phases)
    for key, (old, now) in differing_settings(stored, tree, later).items():
        logger.warning("%s was %s in the run these weights come from and is %s now", key, old, now)


def _last_layers(state: dict[str, Tensor], wanted: set[str], stack: str, path: Path) -> dict[str, Tensor]:
    """The weights with no more layers of `stack` than are wanted, the last ones.

    Losses see what the last layer makes; what earlier ones make alone, the rest of the model has not learnt to read.
    """
    layer = re.compile(rf"(model\.{re.escape(stack)})\.(\d+)\.(.*)")
    stored, kept = (len({found[2] for key in keys if (found := layer.match(key))}) for keys in (state, wanted))
    over = stored - kept
    if over <= 0:
        return state
    logger.info("passed over: the first %d of %d layers of %s", over, stored, path)
    last = {}
    for key, value in state.items():
        found = layer.match(key)
        if found is None:
            last[key] = value
        elif int(found[2]) >= over:
            last[f"{found[1]}.{int(found[2]) - over}.{found[3]}"] = value
    return last


def norms_handed_over(model: Detector) -> list[nn.Module]:
    """The batch norms whose statistics an earlier phase has gathered."""
    added = model.config.new_in_temporal_phase
    return [
        module
        for name, module in model.named_modules()
        if isinstance(module, _BatchNorm) and not (added and re.match(added, f"{name}."))
    ]


def differing_settings(
    old: dict[str, Any],
    new: dict[str, Any],
    temporal: Iterable[str],  # dotted keys of the temporal phase alone
) -> dict[str, tuple[Any, Any]]:
    """Dotted keys of the model, the backbone, the grid and of what is read that both have and whose values differ.

    Loss weights and what is temporal are the new phase's own.
    """

    def settings(tree: dict[str, Any]) -> dict[str, Any]:
        whole = leaves({name: tree.get(name) for name in ("model", "backbone", "grid", "data")})
        return {key: value for key, value in whole.items() if not key.startswith("data.") or key in INPUT_SETTINGS}

    before, after = settings(old), settings(new)
    own = ("model.loss.", *(f"{key}." for key in temporal))
    return {
        key: (before[key], after[key])
        for key in before.keys() & after.keys()
        if before[key] != after[key] and not f"{key}.".startswith(own)
    }


def _run_command(command: list[str]) -> int:
    """Run a child to its end; a SIGTERM to this process goes to the child, whose exit code then tells the rest.

    When this process is killed, the child gets a SIGTERM too, and so ends after a checkpoint.
    """
    child = subprocess.Popen(command, preexec_fn=partial(die_with_parent, signal.SIGTERM))

    def forward(number: int, frame: FrameType | None) -> None:
        child.send_signal(number)

    with handling_signals(forward, signal.SIGTERM):
        try:
            return child.wait()
        except KeyboardInterrupt:  # the terminal gave it to the child as well, which ends after a checkpoint
            return child.wait()
