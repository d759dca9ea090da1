"""`python -m src.world [preview=true] [data.world.*=...]`: write the synthetic highway, or pictures of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from src.assembly import data_root
from src.config import Config, compose_config
from src.data.cache import load_index
from src.data.reader import FrameReader
from src.errors import ConfigError
from src.pictures.contents import PictureBoxes
from src.pictures.frame import draw_frame
from src.reliability.command import run_command
from src.structures.evidence import Evidence
from src.training.run_folder import make_writable
from src.training.snapshots import scene_of, views_of

PREVIEW_SWEEPS = 3  # of each radar


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
        draw_previews(config, root, folder)


def draw_previews(config: Config, root: Path, folder: Path) -> None:
    """A picture of the frame in the middle of every scene, with images at the size in which they are stored."""
    world = config.data.world
    index = load_index(root, config.data.version, None)
    settings = config.data.reader_settings(("radar", "camera"), (world.image_height_px, world.image_width_px))
    reader = FrameReader(index, replace(settings, num_sweeps=PREVIEW_SWEEPS, test_resize_offset=0.0))
    for number, (name, tags) in enumerate(zip(index.scene_names, index.scene_descriptions, strict=True)):
        samples = index.samples_of({name})
        frame = reader.read(int(samples[round(0.5 * (len(samples) - 1))]), None)
        title = f"{name[:14]}…  " + "  ".join(tag.split(".")[1] for tag in tags.split(";"))
        path = folder / f"scene_{number:03d}.png"
        scene = scene_of(frame, frame.boxes[0], Evidence(), config.grid.build())
        draw_frame(path, replace(scene, ground_truth=PictureBoxes.empty()), views_of(frame), title)
        print(f"picture: {path}")


if __name__ == "__main__":
    run_command(main)
