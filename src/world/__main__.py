"""`python -m src.world [preview=true] [data.world.*=...]`: write the synthetic highway, or pictures of it."""

from __future__ import annotations

import logging
from pathlib import Path

from src.assembly import data_root
from src.config import compose_config
from src.errors import ConfigError
from src.pictures.cameras import PictureViews
from src.pictures.contents import PictureBoxes
from src.pictures.scene_preview import draw_scene_preview
from src.reliability.command import run_command
from src.structures.taxonomy import CAMERAS
from src.training.run_folder import make_writable
from src.world.preview import WorldPreview

logger = logging.getLogger(__name__)


def main(overrides: list[str]) -> None:
    """Write the configured world unless it is there; with preview=true draw one picture per scene into out=DIR."""
    config, _ = compose_config(overrides)
    if config.data.world is None:
        raise ConfigError("data.world is null: this configuration reads recorded data, there is no world to write")
    root = data_root(config)
    print(f"world: {root}")
    if config.preview:
        folder = Path(config.out) if config.out else Path(config.paths.outputs) / "previews" / root.name
        make_writable(folder, "out")
        for number, (_, frame) in enumerate(WorldPreview(root).frames()):
            path = folder / f"scene_{number:03d}.png"
            draw_scene_preview(
                path,
                PictureViews(frame.images, frame.pix_from_ego, CAMERAS),
                PictureBoxes(frame.centers, frame.sizes, frame.yaws, frame.velocities, frame.labels),
                frame.radar_points,
                frame.title,
            )
            print(f"picture: {path}")


if __name__ == "__main__":
    run_command(main)
