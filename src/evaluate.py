"""`python -m src.evaluate checkpoint=PATH | predictions=FILE [data.root=DIR data.version=V data.split=S] [out=DIR]`.

`oracle=velocity|motion` tells the memory of a checkpoint how everything really moves, see `Oracle`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from src.assembly import build_datamodule, build_module, data_root, restored_model, save_submission
from src.config import compose_config, refuse_options_of_others, restore_config
from src.data.cache import load_index
from src.data.evaluation_set import evaluation_set
from src.errors import ConfigError, DataError
from src.metrics.bootstrap import score_report
from src.metrics.detection import score_detections
from src.metrics.score_text import format_scores
from src.metrics.submission import load_submission
from src.reliability.checkpoints import read_checkpoint
from src.reliability.command import run_command
from src.reliability.cpu import tune_cpu
from src.training.fit import build_evaluation_trainer
from src.training.identity import digest_of_changes
from src.training.module import TrainingModule
from src.training.run_folder import check_no_run, make_writable, name_of_checkpoint, name_of_predictions, write_json
from src.training.temporal_module import TemporalModule
from src.training.true_motion import Oracle, TrueMotion


def main(overrides: list[str]) -> None:
    """Score a checkpoint, or a submission file, and write metrics.json (and submission.json) into `out`."""
    config, _ = compose_config(overrides)
    refuse_options_of_others(config, "evaluate")
    if (config.checkpoint is None) == (config.predictions is None):
        raise ConfigError("give either checkpoint=PATH or predictions=FILE.json")
    if config.oracle is not Oracle.none and config.predictions is not None:
        raise ConfigError(f"oracle={config.oracle.value}: a file of boxes has no memory; give checkpoint=PATH")
    source = Path(config.checkpoint or config.predictions)
    if config.predictions and not source.is_file():  # before a world is written for it
        raise DataError(f"predictions={source}: there is no such file")
    name = name_of_checkpoint(source) if config.checkpoint else name_of_predictions(source)
    name += digest_of_changes(overrides)
    out = Path(config.out) if config.out else Path(config.paths.outputs) / "evaluations" / name
    check_no_run(out)
    make_writable(out, "out")
    written, write_more = ["metrics.json"], None
    if config.checkpoint:
        module, write_more = score_checkpoint(source, overrides)
        metrics = module.evaluator.as_dict()
        text = module.evaluator.describe(metrics)
        if module.skipped:
            text += f"\nskipped sensor files: {module.skipped.text()}"
    else:
        # Annotations alone, so that boxes can be scored by the protocol of a model whose sensors the data lack.
        index = load_index(data_root(config, write=False), config.data.version, Path(config.paths.outputs) / "cache")
        truth = evaluation_set(index, config.data.split)
        boxes = load_submission(source, truth.tokens)
        scores = score_detections(truth, boxes)
        metrics = score_report(truth, boxes, scores, config.phase.long_range)
        text = format_scores(metrics)
    write_json(out / "metrics.json", metrics)  # before anything is printed, which a closed pipe ends
    if write_more is not None:
        written += write_more(out)
    print(f"{text}\n\nwritten into {out}: {', '.join(written)}")


def score_checkpoint(path: Path, overrides: list[str]) -> tuple[TrainingModule, Callable[[Path], list[str]]]:
    """Rebuild the checkpoint's own model, run it over the split and score it; the command line may change its data.

    The module with its evaluator, and what leaves further files in a folder and names them: a submission where there
    was any box.
    """
    tune_cpu()
    checkpoint = read_checkpoint(path)
    tree = checkpoint["horizon3d"]["config"]
    config = restore_config(tree, overrides)
    config.trainer.device()  # or an error, before data are made
    datamodule = build_datamodule(config, data_root(config, write=False))
    module = build_module(config, tree, datamodule, restored_model(config, checkpoint, path))
    if config.oracle is not Oracle.none:
        if not isinstance(module, TemporalModule):
            raise ConfigError(f"oracle={config.oracle.value}: this checkpoint is of single frames and has no memory")
        if not config.model.moves_memory:
            raise ConfigError(
                f"oracle={config.oracle.value}: this checkpoint moves nothing of its memory by velocities, so "
                "true ones would move nothing either; give one with velocity_compensation=true"
            )
        if datamodule.brings_past:
            raise ConfigError(
                f"oracle={config.oracle.value}: moves the memory of streams, but with data.past_window_s="
                f"{config.data.past_window_s}, data.past_frames={config.data.past_frames} each frame brings its past "
                "along; give data.past_window_s=null data.past_frames=0"
            )
        module.oracle = TrueMotion(datamodule.evaluation_set(), config.oracle)
    build_evaluation_trainer(config.precision, config.trainer.accelerator.value).validate(
        module, datamodule=datamodule, verbose=False
    )
    return module, partial(module.evaluator.write, save=partial(save_submission, config))


if __name__ == "__main__":
    run_command(main)
