"""Runs that have finished, as `src.train` leaves their folders and `src.report.results` reads them, made up."""

import json

import yaml

from src.report.metric_names import RANGES, SPEEDS
from src.report.results import RunResult

CURVES = "step,epoch,loss/total,val/mAP,lr\n4,0,5.5,,0.1\n4,0,,0.1,\n9,1,4.5,,0.1\n9,1,,0.2,\n"


def run_json(run_id, seed, root="world", **changes):
    """What run.json says; `root` is that of its data, `changes` are other fields."""
    return {
        "run_id": run_id, "overrides": [], "scale": "mini", "seed": seed, "commit": "0123456789abcdef",
        "data": {"name": "synthetic highway", "version": "v1.2-trainval", "train_split": "train", "split": "val",
                 "root": root},
        "initialized_from": None, "epochs": 6, "steps": 10, "parameters": 2_500_000, "resumed": False,
        "seconds": {"fit": 10.0, "all": 12.0}, "peak_memory_mib": {"process": 900, "largest_worker": 100},
        "skipped_files": {}, "device": "cpu", "processes": 1, "threads": 2, "versions": {"torch": "2"},
    } | changes  # fmt: skip


def metrics_json(value, ranges=RANGES, speeds=SPEEDS):
    """What metrics.json says of a detector whose every score is `value`; without speeds as older runs have it."""
    classes = {name: {"AP": value, "AVE": 2 - value, "num_gt": 10} for name in ("car", "truck")}
    part = {"mAP": value, "NDS": value, "mAP_present": value, "mAVE_present": 2 - value, "classes": classes}
    by_speed = part | {"classes": classes | {"car": classes["car"] | {"num_gt": 3}}}
    metrics = {
        "mAP": value, "NDS": value, "mAVE": 2 - value, "classes": classes, "ranges": dict.fromkeys(ranges, part),
        "tags": {"weather.rain": {"mAP": value}},
    }  # fmt: skip
    return metrics | ({"speeds": dict.fromkeys(speeds, by_speed)} if speeds else {})


def run_files(record, metrics, config, curves=CURVES):
    """Text by name of file."""
    return {
        "run.json": json.dumps(record), "metrics.json": json.dumps(metrics),
        "config.yaml": yaml.safe_dump(config, sort_keys=False), "metrics.csv": curves,
    }  # fmt: skip


def write_run(folder, *content):
    """The folder, with `run_files` of this content."""
    folder.mkdir(parents=True)
    for name, text in run_files(*content).items():
        (folder / name).write_text(text)
    return folder


def result(run_id, metrics, seed=0, **changes):
    """As `run_json`, with metrics by the names of src/report/metric_names.py."""
    more = {"model": "horizon3d", "phase": "phase1", "config": {}, "metrics": metrics, "curves": {}, "latency": None}
    return RunResult(**run_json(run_id, seed) | more | changes)
