"""Checkpoint files: written whole or not at all, read with a reason when they cannot be."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from src.errors import CheckpointError

_BROKEN = (RuntimeError, EOFError, OSError, KeyError, ValueError, pickle.UnpicklingError)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target, syncs, then renames: a crash or a full disk never costs the older checkpoint.

    Lightning's own writer goes through the system's temporary folder, which may be another file system, and there a
    rename becomes a copy that can stop half-way.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:
        """Write `checkpoint` to `path`. Raises CheckpointError with the free space when the disk refuses."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(target.name + ".tmp")
        try:
            with open(temporary, "wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except (OSError, RuntimeError) as error:
            temporary.unlink(missing_ok=True)
            free = shutil.disk_usage(target.parent).free / 2**20
            raise CheckpointError(f"{target} could not be written ({error}); {free:.0f} MiB are free there") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Load one of our checkpoints; tensors and plain values only, nothing in the file is executed.

    Raises CheckpointError when the file is missing, broken, or not written by this project.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist; runs keep theirs in outputs/<run_id>/checkpoints")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _BROKEN as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"checkpoint {path} is truncated, damaged or no plain checkpoint ({reason})") from error
    if not isinstance(content, dict) or "horizon3d" not in content or "state_dict" not in content:
        raise CheckpointError(f"checkpoint {path} is not of this project: it lacks 'horizon3d' or 'state_dict'")
    return content


def load_model_weights(model: nn.Module, checkpoint: dict[str, Any], path: Path) -> None:
    """Put a checkpoint's weights into `model`.

    Raises CheckpointError naming the keys that are missing, unexpected or of another shape; never loads a part.
    """
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in checkpoint["state_dict"].items() if key.startswith(prefix)}
    wanted = model.state_dict()
    problems = [f"missing {key}" for key in wanted if key not in state]
    problems += [f"unexpected {key}" for key in state if key not in wanted]
    problems += [
        f"{key} is {list(state[key].shape)}, the model has {list(wanted[key].shape)}"
        for key in wanted
        if key in state and state[key].shape != wanted[key].shape
    ]
    if problems:
        more = f" and {len(problems) - 6} more" if len(problems) > 6 else ""
        raise CheckpointError(f"checkpoint {path} is of another model: {'; '.join(problems[:6])}{more}")
    model.load_state_dict(state)
