import json

import torch

from src.structures.batch import FrameBatch
from src.structures.skipped import MAX_NAMES, SkippedFiles


def frame(skipped, bad_files):
    return FrameBatch(
        tokens=["a"],
        timestamps_s=torch.zeros(1, dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64)[None],
        aug_from_ego=torch.eye(4)[None],
        radar_points=torch.zeros(0, 7),
        radar_batch=torch.zeros(0, dtype=torch.int64),
        skipped=skipped,
        bad_files=bad_files,
    )


def test_counts_and_names_add_up_over_frames_and_ranks():
    first, second = SkippedFiles(), SkippedFiles()
    assert not first and first.state() == {"channels": {}, "files": {}}
    first.add(frame({"RADAR": 2}, ["r/1", "r/2"]))
    first.add(frame({"RADAR": 1, "CAMERA (not recorded)": 1}, ["r/1"]))
    second.add(frame({"CAMERA": 1}, ["c/9"]))
    total = SkippedFiles()
    total.restore(json.loads(json.dumps([first.state(), second.state()])))
    assert total.channels == {"RADAR": 3, "CAMERA (not recorded)": 1, "CAMERA": 1}
    assert total.files == {"r/1": 2, "r/2": 1, "c/9": 1} and total.names() == ["c/9", "r/1", "r/2"]
    text = "1 of CAMERA, 1 of CAMERA (not recorded), 3 of RADAR (3 unreadable files: c/9, r/1, r/2)"
    assert total and total.text() == text
    total.clear()
    assert not total and total.names() == []


def test_names_are_bounded_and_counts_are_not():
    over = SkippedFiles()
    names = [f"{at:05d}" for at in range(MAX_NAMES + 200)]
    over.add(frame({"RADAR": len(names)}, names))
    assert over.names() == names[:MAX_NAMES]
    assert over.text().endswith(f"00008, 00009 and {len(names) - 10} more)") and str(len(names)) in over.text()


def test_batches_keep_the_names_on_their_way():
    batch = frame({"RADAR": 1}, ["r/1"])
    assert batch.to("cpu").bad_files == ["r/1"] and frame({}, []).bad_files == []
