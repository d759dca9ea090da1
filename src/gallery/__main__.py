"""`python -m src.gallery runs=A,B`: what finished runs found and missed, chosen by rule, into `paths.reports`.

Frames by condition, the worst misses and the worst false positives of the last run, each as every run sees it, and
a film of the first frame's scene.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from src.assembly import build_datamodule, data_root
from src.config import Config, compose_config, refuse_options_of_others
from src.data.datamodule import DetectionDataModule
from src.errors import ConfigError, DataError
from src.files.atomic_write import write_whole
from src.geometry.transforms import pose_matrix
from src.metrics.detection import match_parts
from src.metrics.diagnostics import count_returns
from src.metrics.extremes import CONDITIONS, frames_by_condition, worst_false_positives, worst_misses
from src.metrics.protocol import OFFICIAL
from src.metrics.submission import load_submission, to_ego
from src.pictures.film import Film
from src.pictures.gallery import GalleryFrame, draw_boxes, draw_whole_frames
from src.reliability.command import run_command
from src.structures.batch import FrameBatch
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.evidence import Evidence
from src.structures.taxonomy import CLASSES
from src.training.identity import RUN_ID, key_of
from src.training.run_folder import RunFolder, make_writable
from src.training.snapshots import SHOWN_SCORE, boxes_of, scene_of, views_of

COUNT = 6
"""Frames by condition, misses and false positives each."""

PAGE = """# Gallery, scale {scale}

`{command}`: what the run `{last}` finds, beside {others}. Frames and boxes are chosen by rule, not by
taste; what is drawn has a score of at least {score}.

## By condition

Of the tags of weather, daytime and lighting, the rarest first, each gives the first scene that stands for none yet; of
that the middle key frame. Images show the boxes of `{last}`.

![Frames by condition](pictures/{conditions})

## Worst misses

Ground truth that the metric matches with no prediction of its class within {error_m:g} m, whatever the score: with the
most returns in the input, one of a class.

![What the sensors saw best and the run missed](pictures/{misses})

## Worst false positives

Predictions that the metric matches with no ground truth of their class within {far_m:g} m, second boxes of an object
among them: of the highest score, one of a class.

![What the run is surest of and matches nothing](pictures/{false_positives})

## A scene

![All key frames of the first scene above](pictures/{film})
"""


def main(overrides: list[str]) -> None:
    """Write the sheets, the film and the page. Raises ConfigError for runs that are not there, DataError for others'
    data."""
    named = [override.partition("=")[2] for override in overrides if key_of(override) == "runs"]
    runs = [name for name in named[-1].strip("[]").split(",") if name] if named else []
    if not runs:
        raise ConfigError("give runs=A,B: ids of finished runs of paths.outputs, the one that is looked at last")
    config, _ = compose_config([override for override in overrides if key_of(override) != "runs"])
    refuse_options_of_others(config, "gallery")
    reports = Path(config.paths.reports)
    outputs = Path(config.paths.outputs)
    folders = [finished_run(outputs, run, config.scale) for run in runs]  # before a world is written for them
    make_writable(reports, "paths.reports")
    datamodule = build_datamodule(config, data_root(config, write=False))
    gallery = Gallery(config, datamodule, {folder.run_id: read_boxes(folder, datamodule) for folder in folders})
    said = [override for override in overrides if key_of(override) not in ("paths.outputs", "paths.reports")]
    print(f"written: {gallery.write(reports, shlex.join(['python', '-m', 'src.gallery', *said]))}")


def finished_run(outputs: Path, run_id: str, scale: str) -> RunFolder:
    """The folder of a run with boxes. Raises ConfigError when there is none, or it is of another scale."""
    folder = RunFolder(outputs, run_id)
    if not folder.finished:
        raise ConfigError(f"runs={run_id}: {folder.path} holds no finished run; train it first")
    if not (folder.path / "submission.json").is_file():
        raise ConfigError(
            f"runs={run_id}: {folder.path} has no submission.json: the run learns no boxes, or none reached the score "
            "threshold; leave it out"
        )
    its_scale = folder.read_result()[0].get("scale")
    if its_scale != scale:
        raise ConfigError(f"runs={run_id}: it is of scale={its_scale}, this command of scale={scale}; give its scale")
    return folder


def read_boxes(folder: RunFolder, datamodule: DetectionDataModule) -> DetectionTable:
    """What a finished run detects. Raises DataError when its data are others."""
    record, _ = folder.read_result()
    if record.get("data") != datamodule.identity():
        raise DataError(
            f"runs={folder.run_id}: it was scored on {record.get('data')}, but this command reads "
            f"{datamodule.identity()}; give the scale and the data of the run"
        )
    return load_submission(folder.path / "submission.json", datamodule.evaluation_set().tokens)


def short_names(runs: list[str]) -> list[str]:
    """Model and phase of each run id, or the whole name where several have the same."""
    named = [RUN_ID.fullmatch(run) for run in runs]
    short = [f"{name['model']} {name['phase']}" if name else run for name, run in zip(named, runs, strict=True)]
    return [name if short.count(name) == 1 else run for name, run in zip(short, runs, strict=True)]


class Gallery:
    """The sheets of some runs on one split."""

    def __init__(self, config: Config, datamodule: DetectionDataModule, found: dict[str, DetectionTable]) -> None:
        self.config, self.datamodule, self.found = config, datamodule, found
        self.evaluation_set: EvaluationSet = datamodule.evaluation_set()

    def write(self, reports: Path, command: str) -> Path:
        """Pictures and film below `reports/pictures`, and the page that shows them; its path.

        Raises DataError for scenes without a tag to choose by.
        """
        parts = match_parts(self.evaluation_set, list(self.found.values())[-1], {}, by_range=False, by_speed=False)
        frames = frames_by_condition(self.evaluation_set, COUNT)
        if not frames:
            raise DataError(
                f"data.split={self.config.data.split}: none of its scenes has a tag of {', '.join(CONDITIONS)}, by "
                "which a gallery chooses its frames; choose another split"
            )
        truth, predictions = self.evaluation_set.ground_truth, parts.ranking.predictions
        returns = self._count_returns()
        misses, false = worst_misses(parts, returns, COUNT), worst_false_positives(parts, COUNT)
        false = false[predictions.scores[false] >= SHOWN_SCORE]  # the others are not drawn
        film = self._scene(next(iter(frames)))
        wanted = {*frames, *film, *truth.samples[misses].tolist(), *predictions.samples[false].tolist()}
        batches = self._read(wanted)
        scale = self.config.scale
        names = short_names(list(self.found))
        pictures, last = reports / "pictures", names[-1]
        sheets = {name: f"gallery_{name}_{scale}.png" for name in ("conditions", "misses", "false_positives")}
        whole = [self._frame(batches[sample], sample, tag) for sample, tag in frames.items()]
        draw_whole_frames(pictures / sheets["conditions"], "By condition", whole, names, SHOWN_SCORE)
        missed = [
            self._around(batches[int(truth.samples[row])], truth, row, f"{returns[row]} returns") for row in misses
        ]
        draw_boxes(pictures / sheets["misses"], f"Worst misses of {last}", missed, names, SHOWN_SCORE)
        wrong = [
            self._around(
                batches[int(predictions.samples[row])], predictions, row, f"score {predictions.scores[row]:.2f}"
            )
            for row in false
        ]
        draw_boxes(pictures / sheets["false_positives"], f"Worst false positives of {last}", wrong, names, SHOWN_SCORE)
        self._film(pictures / f"gallery_{scale}.gif", {sample: batches[sample] for sample in film}, names)
        path = reports / f"gallery_{scale}.md"
        write_whole(path, self._page(sheets, f"gallery_{scale}.gif", command))
        return path

    def _scene(self, sample: int) -> list[int]:
        """All samples of a sample's scene, in the order of time."""
        of_scene = np.flatnonzero(self.evaluation_set.scenes == self.evaluation_set.scenes[sample])
        return of_scene[np.argsort(self.evaluation_set.times_s[of_scene], kind="stable")].tolist()

    def _count_returns(self) -> np.ndarray:
        """Points of what the model reads inside each ground truth [k]."""
        truth = self.evaluation_set.ground_truth
        returns = np.zeros(len(truth), np.int64)
        for frame in self.datamodule.stream():
            sample = self.evaluation_set.index_of[frame.tokens[0]]
            rows = truth.samples == sample  # a frame whose own pose is wrong has no boxes, the annotations have
            returns[rows] = count_returns(frame, 0, to_ego(truth[rows], self._pose(sample)))
        return returns

    def _read(self, wanted: set[int]) -> dict[int, FrameBatch]:
        """The frames of these samples."""
        tokens = {self.evaluation_set.tokens[sample]: sample for sample in wanted}
        return {tokens[frame.tokens[0]]: frame for frame in self.datamodule.stream() if frame.tokens[0] in tokens}

    def _frame(self, batch: FrameBatch, sample: int, title: str) -> GalleryFrame:
        """A frame as every run sees it."""
        scenes = []
        for table in self.found.values():
            boxes = to_ego(table[table.samples == sample], self._pose(sample))
            scenes.append(scene_of(batch, boxes, Evidence(), self.config.grid.build()).drawable(SHOWN_SCORE))
        name = f"{title}, sample {batch.tokens[0][:12]}"
        return GalleryFrame(name, scenes, views_of(batch))

    def _around(self, batch: FrameBatch, table: DetectionTable, row: int, what: str) -> GalleryFrame:
        """The frame of one box, titled by it."""
        sample = int(table.samples[row])
        box = boxes_of(to_ego(table[[row]], self._pose(sample)))
        distance = float(np.linalg.norm(box.centers[0, :2]))
        title = f"{CLASSES[table.labels[row]].replace('_', ' ')} at {distance:.0f} m, {what}"
        return replace(self._frame(batch, sample, title), box=replace(box, scores=None))

    def _pose(self, sample: int) -> np.ndarray:
        """global_from_ego [4, 4] of a sample."""
        return pose_matrix(self.evaluation_set.ego_rotations[sample], self.evaluation_set.ego_centers[sample])

    def _film(self, path: Path, batches: dict[int, FrameBatch], names: list[str]) -> None:
        film = Film()
        for number, (sample, batch) in enumerate(batches.items(), start=1):
            frame = self._frame(batch, sample, f"frame {number}")
            draw = partial(draw_whole_frames, title="", frames=[frame], names=names, score=SHOWN_SCORE)
            film.add(draw, float(batch.timestamps_s))
        film.write_animation(path)

    def _page(self, sheets: dict[str, str], film: str, command: str) -> str:
        """The page, with the rules by which its frames were chosen."""
        *others, last = self.found
        return PAGE.format(
            scale=self.config.scale, last=last, others=", ".join(f"`{name}`" for name in others) or "no other run",
            command=command, error_m=OFFICIAL.error_threshold_m, far_m=OFFICIAL.thresholds_m[-1],
            score=SHOWN_SCORE, film=film, **sheets,
        )  # fmt: skip


if __name__ == "__main__":
    run_command(main)
