"""`python -m src.export checkpoint=PATH [out=FILE.pt2]`: a trained image encoder as a program that torch alone runs."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import torch

from src.assembly import restored_model
from src.config import compose_config, refuse_options_of_others, restore_config
from src.errors import ConfigError
from src.files.atomic_write import replacing
from src.models.backbones.image import ImageEncoder
from src.models.deploy.inference import prepare_for_inference
from src.reliability.checkpoints import read_checkpoint
from src.reliability.command import run_command
from src.structures.taxonomy import CAMERAS
from src.training.identity import digest_of_changes
from src.training.run_folder import make_writable, name_of_checkpoint

EXAMPLE_FRAMES = 2
"""One frame would be taken for a constant; the program takes any number."""
DESCRIPTION = "description.json"
"""What the program takes and gives, kept in the file."""


def main(overrides: list[str]) -> None:
    """Write the image encoder of a checkpoint, batch norms folded, in float32, into `out`.

    The command line may change its configuration, the size of the images for instance. Without `out` the file is named
    by the checkpoint, its run and what is changed, and lies in `paths.outputs`/exports.
    """
    command, _ = compose_config(overrides)
    refuse_options_of_others(command, "export")
    if command.checkpoint is None:
        raise ConfigError("give checkpoint=PATH of the trained model whose image encoder is to be exported")
    path = Path(command.checkpoint)
    name = f"{name_of_checkpoint(path)}{digest_of_changes(overrides)}.pt2"
    out = Path(command.out) if command.out else Path(command.paths.outputs) / "exports" / name
    if out.suffix != ".pt2" or out.is_dir():
        raise ConfigError(f"out={out}: must be a file that ends in .pt2")
    checkpoint = read_checkpoint(path)
    config = restore_config(checkpoint["horizon3d"]["config"], overrides)
    if config.image_size_px is None:
        raise ConfigError(f"checkpoint={path}: {config.model.name} with this configuration uses no images")
    if config.backbone.trim_padding:
        raise ConfigError(
            f"checkpoint={path}: backbone.trim_padding=true looks at each image to decide what to compute, which a "
            "fixed program cannot; train with backbone.trim_padding=false for an export"
        )
    encoder = prepare_for_inference(restored_model(config, checkpoint, path)).image_encoder
    make_writable(out.parent, "out")
    about = {
        "input": f"[B, {len(CAMERAS)}, 3, {', '.join(map(str, encoder.image_size_px))}] uint8 RGB",
        "cameras": list(CAMERAS),
        "outputs": {f"stride {stride}": f"[B, {len(CAMERAS)}, {encoder.channels}, h, w]" for stride in encoder.strides},
        "backbone": config.backbone.name.value,
        "checkpoint": path.name,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torch on its own archive: storages shared by views
        with replacing(out, "wb") as file:
            torch.export.save(export_encoder(encoder), file, extra_files={DESCRIPTION: json.dumps(about, indent=2)})
    print(f"written: {out}, {out.stat().st_size / 1e6:.1f} MB; torch.export.load({str(out)!r}).module()(images)")
    print(f"images {about['input']} -> " + ", ".join(f"{name} {shape}" for name, shape in about["outputs"].items()))


def export_encoder(encoder: ImageEncoder) -> torch.export.ExportedProgram:
    """The encoder as a program of the images [B, N, 3, H, W] uint8 for any B; returns one map per stride."""
    images = torch.zeros(EXAMPLE_FRAMES, len(CAMERAS), 3, *encoder.image_size_px, dtype=torch.uint8)
    frames = torch.export.Dim("frames", min=1)
    with torch.no_grad():
        return torch.export.export(encoder, (images,), dynamic_shapes=({0: frames},))


if __name__ == "__main__":
    run_command(main)
