"""Checkpoint files: written whole or not at all, read with a reason when they cannot be."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from src.errors import CheckpointError

_BROKEN = (RuntimeError, EOFError, OSError, KeyError, ValueError)


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
        what = "is a folder" if path.is_dir() else "does not exist"
        raise CheckpointError(f"checkpoint {path} {what}; runs keep theirs in outputs/<run_id>/checkpoints/last.ckpt")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # torch itself loads flipped bits without a word
        if damaged is not None:
            raise CheckpointError(f"checkpoint {path} is damaged: the checksum of {damaged} in it is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"checkpoint {path} is truncated, or no checkpoint at all ({error})") from error
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"checkpoint {path} holds more than tensors and plain values, so it is not of this project; "
            "nothing in it was executed"
        ) from error
    except _BROKEN as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"checkpoint {path} is truncated or damaged ({reason})") from error
    if not _is_ours(content):
        raise CheckpointError(
            f"checkpoint {path} is not of this project: it lacks 'state_dict' (tensors by name) or the configuration "
            "in 'horizon3d'"
        )
    return content


def _is_ours(content: object) -> bool:
    """Whether a file holds what `DetectionModule` and Lightning write: weights by name and the run's configuration."""
    if not isinstance(content, dict):
        return False
    about, state = content.get("horizon3d"), content.get("state_dict")
    return (
        isinstance(about, dict)
        and isinstance(about.get("config"), dict)
        and isinstance(state, dict)
        and all(isinstance(key, str) and isinstance(value, torch.Tensor) for key, value in state.items())
    )


def load_model_weights(
    model: nn.Module, checkpoint: dict[str, Any], path: Path, may_be_new: re.Pattern[str] | None = None
) -> list[str]:
    """Put a checkpoint's weights into `model`; keys that match `may_be_new` may be missing and keep their values.

    Returns those keys. Raises CheckpointError naming the keys that are missing, unexpected, of another shape or not
    finite; never loads a part.
    """
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in checkpoint["state_dict"].items() if key.startswith(prefix)}
    wanted = model.state_dict()
    new = [key for key in wanted if key not in state and may_be_new is not None and may_be_new.match(key)]
    problems = [f"missing {key}" for key in wanted if key not in state and key not in new]
    problems += [f"unexpected {key}" for key in state if key not in wanted]
    problems += [
        f"{key} is {list(state[key].shape)}, the model has {list(wanted[key].shape)}"
        for key in wanted
        if key in state and state[key].shape != wanted[key].shape
    ]
    if problems:
        more = f" and {len(problems) - 6} more" if len(problems) > 6 else ""
        raise CheckpointError(f"checkpoint {path} is of another model: {'; '.join(problems[:6])}{more}")
    broken = [key for key, value in state.items() if not torch.isfinite(value).all()]
    if broken:
        raise CheckpointError(f"checkpoint {path} holds weights that are not finite, {broken[0]} for one")
    model.load_state_dict({key: wanted[key] for key in new} | state)
    return new
