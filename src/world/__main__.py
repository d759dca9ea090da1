"""`python -m src.world [preview=true] [compare=true] [data.world.*=...]`: the synthetic highway, seen and counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from src.assembly import data_root
from src.config import Config, compose_config, refuse_options_of_others
from src.data.cache import load_index
from src.data.reader import FrameReader
from src.errors import ConfigError
from src.pictures.contents import PictureBoxes
from src.pictures.frame import draw_frame
from src.reliability.command import run_command
from src.structures.evidence import Evidence
from src.training.run_folder import make_writable
from src.training.snapshots import scene_of, views_of
from src.world.dataset_statistics import count_dataset
from src.world.real_comparison import compare
from src.world.statistics_page import table_lines, verdict, write_page

PREVIEW_SWEEPS = 3  # of each radar


def main(overrides: list[str]) -> None:
    """Write the configured world unless it is there.

    With preview=true draw one picture per scene into out=DIR; with compare=true print its figures beside those of MAN
    TruckScenes and write them as a page into out=DIR (default: world_<scale> of paths.reports). The comparison also
    takes recorded data.
    """
    config, _ = compose_config(overrides)
    refuse_options_of_others(config, "world")
    if config.data.world is None and (config.preview or not config.compare):
        raise ConfigError(
            "data.world is null: this configuration reads recorded data, there is no world to write or to preview"
        )
    root = data_root(config)
    print(f"world: {root}")
    if config.compare:
        folder = Path(config.out) if config.out else Path(config.paths.reports) / f"world_{config.scale}"
        make_writable(folder, "out")
        compare_with_real(config, root, folder, overrides)
    if config.preview:
        folder = Path(config.out) if config.out else Path(config.paths.outputs) / "previews" / root.name
        make_writable(folder, "out")
        draw_previews(config, root, folder)


def compare_with_real(config: Config, root: Path, folder: Path, overrides: list[str]) -> None:
    """Count the data at `root` and show it beside the real figures, here and as a page."""
    index = load_index(root, config.data.version, None)
    tables = compare(count_dataset(index, config.data.num_sweeps), config.data.num_sweeps)
    for table in tables:
        print("\n".join(["", table.title, *table_lines(table)]))
    print("\n".join(["", *verdict(tables)]))
    command = " ".join(["python -m src.world", *(text for text in overrides if not text.startswith("paths."))])
    what = f"{len(index.scene_names)} scenes of {len(index) / len(index.scene_names):g} key frames"
    print(f"page: {write_page(folder, tables, what, command)}")


def draw_previews(config: Config, root: Path, folder: Path) -> None:
    """A picture of the frame in the middle of every scene, with images at the size in which they are stored."""
    world = config.data.world
    index = load_index(root, config.data.version, None)
    settings = config.data.reader_settings(("radar", "camera"), (world.image_height_px, world.image_width_px))
    reader = FrameReader(index, replace(settings, num_sweeps=PREVIEW_SWEEPS, test_resize_offset=0.0))
    for number, (name, tags) in enumerate(zip(index.scene_names, index.scene_descriptions, strict=True)):
        samples = index.samples_of({name})
        samples = samples[np.argsort(index.frame_times_us[samples])]
        frame = reader.read(int(samples[round(0.5 * (len(samples) - 1))]), None)
        title = f"{name[:14]}…  " + "  ".join(tag.split(".")[1] for tag in tags.split(";"))
        path = folder / f"scene_{number:03d}.png"
        scene = scene_of(frame, frame.boxes[0], Evidence(), config.grid.build())
        draw_frame(path, replace(scene, ground_truth=PictureBoxes.empty()), views_of(frame), title)
        print(f"picture: {path}")


if __name__ == "__main__":
    run_command(main)
