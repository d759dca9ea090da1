"""`python -m src.predict checkpoint=PATH [scene=NAME] [data.root=DIR data.version=V data.split=S] [out=DIR]`."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from src.assembly import build_datamodule, data_root, save_submission
from src.config import Config, compose_config, refuse_options_of_others, restore_config
from src.data.splits import split_samples
from src.errors import ConfigError
from src.metrics.submission import to_global
from src.pictures.film import Film
from src.pictures.frame import draw_frame
from src.reliability.checkpoints import read_checkpoint
from src.reliability.command import run_command
from src.reliability.cpu import tune_cpu
from src.streaming import StreamingDetector
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.structures.skipped import SkippedFiles
from src.training.identity import digest_of_changes
from src.training.run_folder import check_no_run, make_writable, name_of_checkpoint
from src.training.snapshots import SHOWN_SCORE, scene_of, views_of

# The boxes of one frame and its global_from_ego.
Prediction = tuple[Boxes3D, np.ndarray]


def main(overrides: list[str]) -> None:
    """Run scenes frame by frame with memory; write submission.json, and pictures of the first scene, into `out`.

    `trainer.num_pictures` is the number of frames in the strip, and 0 leaves pictures out, which take most of the time.
    """
    command, _ = compose_config(overrides)
    if command.checkpoint is None or command.predictions is not None:
        raise ConfigError("give checkpoint=PATH (predictions=FILE.json is scored by python -m src.evaluate)")
    refuse_options_of_others(command, "predict")
    tune_cpu()
    path = Path(command.checkpoint)
    checkpoint = read_checkpoint(path)
    # A run trained or scored with sensor dropout still sees whole frames here, unless the command says otherwise.
    config = restore_config(checkpoint["horizon3d"]["config"], ["data.sensor_dropout=0.0", *overrides])
    detector = StreamingDetector.restore(config, checkpoint, path, config.trainer.device())
    datamodule = build_datamodule(config, data_root(config, write=False))
    frames = datamodule.stream(None if command.scene is None else [command.scene])
    out = output_folder(path, command, config, overrides)  # named by the scene, which is known by now
    check_no_run(out)
    make_writable(out, "out")
    index, split = datamodule.index, split_samples(datamodule.index, config.data.split)
    wanted = split if command.scene is None else index.samples_of({command.scene})
    tokens = [str(token) for token in index.sample_tokens[wanted]]

    film = Film()
    bar = tqdm(frames, total=len(tokens), desc="predicting", unit="frame")
    found, skipped = predict(detector, bar, film if command.trainer.num_pictures else None)
    table = DetectionTable.concatenate([to_global(*found[token], row) for row, token in enumerate(tokens)])
    written = save_submission(config, out / "submission.json", tokens, table)
    for name in ("strip.png", "scene.gif"):  # of an earlier command, whose boxes these are not
        (out / name).unlink(missing_ok=True)
    if film:  # after the boxes, which are worth more
        film.write_strip(out / "strip.png", command.trainer.num_pictures)
        film.write_animation(out / "scene.gif")
    print(f"{len(tokens)} frames, {sum(len(boxes) for boxes, _ in found.values())} boxes, written into {out}: ", end="")
    print(", ".join(["submission.json"] * written + ["scene.gif", "strip.png"] * bool(film)))
    if skipped:
        print(f"skipped sensor files: {skipped.text()}")
    if command.scene is not None:
        print(
            f"submission.json holds {command.scene} only; an evaluation wants all {len(split)} samples of the split "
            f"{config.data.split!r}: leave scene= out for that"
        )


def output_folder(checkpoint: Path, command: Config, config: Config, overrides: list[str]) -> Path:
    """`out`, or a folder named by the checkpoint and its run, by what is predicted and by what is changed."""
    if command.out is not None:
        return Path(command.out)
    name = name_of_checkpoint(checkpoint) + digest_of_changes(overrides)
    return Path(command.paths.outputs) / "predictions" / name / (command.scene or config.data.split)


def predict(
    detector: StreamingDetector, frames: Iterable[FrameBatch], film: Film | None
) -> tuple[dict[str, Prediction], SkippedFiles]:
    """What is detected in each frame by token, and the skipped sensor files; the first scene goes into the film."""
    found: dict[str, Prediction] = {}
    skipped = SkippedFiles()
    scenes = 0
    for frame in frames:
        scenes += bool(frame.starts[0])
        boxes, output = detector.run(frame)
        found[frame.tokens[0]] = boxes.to("cpu"), frame.global_from_ego[0].numpy()
        skipped.add(frame)
        if film is not None and scenes == 1 and not film.full:
            shown = frame.to(detector.device)
            title = f"Frame {len(film) + 1}, sample {frame.tokens[0][:12]}"
            scene = scene_of(shown, boxes, detector.model.evidence(output), detector.grid)
            draw = partial(draw_frame, scene=scene, views=views_of(shown), title=title, score_threshold=SHOWN_SCORE)
            film.add(draw, float(frame.timestamps_s))
    return found, skipped


if __name__ == "__main__":
    run_command(main)
