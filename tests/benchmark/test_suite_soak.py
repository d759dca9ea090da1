"""suite=soak: slopes by hand, leaks that are planted and found, clips that make one drive, and the command itself."""

import itertools
import json
import mmap
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from src.benchmark import suite_soak as soak
from src.benchmark.__main__ import main
from src.benchmark.suite_soak import CLIPS, DRIVE, TRAINING, Curve, growth_row, held, joined, robust_slope
from src.config import compose_config
from src.errors import ConfigError
from src.models.memory import FrameMemory, RememberedFrame
from src.structures.batch import FrameBatch

ON_LINUX = sys.platform.startswith("linux")


def test_a_slope_is_that_of_most_points():
    rows = [{"frames": place, "MiB": 7.0 + 0.02 * place} for place in range(0, 1000, 100)]
    pairs = list(itertools.combinations(rows, 2))
    assert robust_slope(pairs, "MiB") == pytest.approx(0.02)
    rows[3]["MiB"], rows[8]["MiB"] = 1e6, -1e6  # a burst of other work
    assert robust_slope(pairs, "MiB") == pytest.approx(0.02)


@pytest.mark.parametrize("leak", [0.0, 3.0])
def test_growth_in_training_is_that_from_epoch_to_epoch(leak):
    """Four epochs of 240 frames: memory fills in each, a loader starts after two; the leak is what an epoch adds."""
    rows = [
        {"frames": n, "ms": 1.0, "± ms": 0.0, "MiB": (n - 1) % 240 + leak * ((n - 1) // 240) + 50.0 * (n > 480)}
        for n in range(30, 961, 30)
    ]
    assert growth_row("training", rows, 240, 480)["MiB / 1000 frames"] == pytest.approx(1e3 * leak / 240)
    assert growth_row("training", rows)["MiB / 1000 frames"] > 50.0  # within epochs
    assert "MiB / 1000 frames" not in growth_row("training", rows[:16], 240, 240)  # one epoch shows nothing


def test_growth_is_that_behind_the_first_quarter():
    """Memory climbs by 100 MiB while it settles and by 5 MiB in a thousand frames then; the end takes twice as long."""
    rows = [
        {
            "frames": 100 * number,
            "ms": 20.0 if number > 30 else 10.0,
            "± ms": 1.0,
            "RSS MiB": 10.0 * number if number <= 10 else 100.0 + 0.5 * (number - 10),
            "threads": 4,
        }
        for number in range(1, 41)
    ]
    assert growth_row("some", rows) == {
        "pass": "some",
        "frames": 4000,
        "last / second quarter": 2.0,
        "RSS MiB / 1000 frames": pytest.approx(5.0),
        "threads / 1000 frames": 0.0,
    }


def test_what_a_system_reports_only_at_times_has_no_growth():
    """The workers of a loader can be between two epochs when a row is taken."""
    rows = [{"frames": n, "ms": 1.0, "± ms": 0.0} | ({"workers MiB": 5.0} if n % 2 else {}) for n in range(1, 17)]
    assert "workers MiB / 1000 frames" not in growth_row("some", rows)


@pytest.mark.slow
@pytest.mark.skipif(not ON_LINUX, reason="RSS and descriptors are read from /proc")
def test_planted_leaks_are_found(monkeypatch):
    """A detector that keeps every frame's mebibyte, forgets to close a file and takes longer from frame to frame."""
    kept, files, ticks = [], [], {"now": 0.0}
    monkeypatch.setattr(soak, "clock", lambda device: lambda: ticks["now"])
    curve = Curve(64, torch.device("cpu"), lambda: kept)
    curve.begin()
    try:
        for number in range(64):
            kept.append(torch.ones(2**18))
            files.append(open(os.devnull))  # noqa: SIM115
            ticks["now"] += 1e-3 * (100 + number)
            curve.passed(1)
    finally:
        for file in files:
            file.close()
    assert [row["frames"] for row in curve.rows] == list(range(2, 65, 2))
    growth = growth_row("leak", curve.rows)
    assert growth["remembered MiB / 1000 frames"] == pytest.approx(1000.0)
    if "heap MiB" in curve.rows[0]:
        assert growth["heap MiB / 1000 frames"] == pytest.approx(1000.0, rel=0.05)
    assert growth["descriptors / 1000 frames"] == pytest.approx(1000.0)
    assert growth["tensors / 1000 frames"] == pytest.approx(1000.0)
    assert growth["objects / 1000 frames"] >= 2000.0
    assert growth["last / second quarter"] == pytest.approx((100 + 55.5) / (100 + 23.5), rel=0.02)


@pytest.mark.slow
@pytest.mark.skipif(not ON_LINUX, reason="RSS is read from /proc")
def test_planted_pages_are_found():
    """A mebibyte a frame, mapped anew: what the heap hands out may be pages of earlier tests, held already."""
    kept = []
    curve = Curve(64, torch.device("cpu"), lambda: None)
    curve.begin()
    for _ in range(64):
        kept.append(mmap.mmap(-1, 2**20))
        kept[-1].write(b"x" * 2**20)
        curve.passed(1)
    assert 900 < growth_row("leak", curve.rows)["RSS MiB / 1000 frames"] < 1300


def test_a_small_view_counts_as_what_it_keeps():
    whole = torch.zeros(2**20)
    remembered = FrameMemory((RememberedFrame(whole[:1], whole[1:3], torch.ones(0, dtype=torch.bool)),))
    assert held(torch.device("cpu"), remembered)["remembered MiB"] == pytest.approx(4.0)
    assert held(torch.device("cpu"), None)["remembered MiB"] == 0.0


def test_times_leave_out_what_lies_between(monkeypatch):
    ticks = {"now": 0.0}
    monkeypatch.setattr(soak, "clock", lambda device: lambda: ticks["now"])
    monkeypatch.setattr(soak, "held", lambda device, memory: ticks.update(now=ticks["now"] + 50.0) or {})
    monkeypatch.setattr(soak, "POINTS", 2)
    curve = Curve(8, torch.device("cpu"), lambda: None)
    for _ in range(2):
        ticks["now"] += 100.0  # a validation
        curve.begin()
        for _ in range(2):
            ticks["now"] += 4.0
            curve.passed(2)  # a batch of two
    assert curve.rows == [{"frames": 4, "ms": 2000.0, "± ms": 0.0}, {"frames": 8, "ms": 2000.0, "± ms": 0.0}]


def pose(x, yaw):
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[0, 3] = x
    return torch.from_numpy(matrix)[None]


def frame(token, seconds, matrix, starts):
    return FrameBatch(
        tokens=[token],
        timestamps_s=torch.tensor([seconds], dtype=torch.float64),
        global_from_ego=matrix,
        aug_from_ego=torch.eye(4)[None],
        radar_points=torch.zeros(0, 7),
        radar_batch=torch.zeros(0, dtype=torch.int64),
        streams=torch.tensor([0]),
        starts=torch.tensor([starts]),
    )


def test_clips_make_one_drive_without_a_jump():
    """Two clips of different places, times, speeds and headings, twice each; the one frame of a third goes on too."""
    first = [frame("a", 100.0 + 0.5 * n, pose(5.0 * n, 0.1 * n), n == 0) for n in range(3)]
    second = [frame("b", 7.0 + 0.4 * n, pose(-900.0 + 8.0 * n, -0.05 * n), n == 0) for n in range(3)]
    single = [frame("c", 5000.0, pose(1e5, 1.0), True)]
    clips = [*first, *second, *single, *first, *second]
    drive = list(joined(iter(clips)))
    assert [bool(moved.starts) for moved in drive] == [True] + [False] * 12
    assert [moved.tokens for moved in drive] == [own.tokens for own in clips]
    gaps = np.diff([float(moved.timestamps_s) for moved in drive])
    np.testing.assert_allclose(gaps, [0.5] * 3 + [0.4] * 4 + [0.5] * 2 + [0.5] + [0.4] * 2, atol=1e-9)
    ways = [torch.linalg.inv(a.global_from_ego) @ b.global_from_ego for a, b in zip(drive, drive[1:], strict=False)]
    own = [torch.linalg.inv(a.global_from_ego) @ b.global_from_ego for a, b in zip(clips, clips[1:], strict=False)]
    for at, way in enumerate(ways):
        expected = ways[at - 1] if bool(clips[at + 1].starts) else own[at]  # a joint repeats the step before it
        torch.testing.assert_close(way, expected, atol=1e-9, rtol=0)
    for before, now in zip(drive, drive[1:], strict=False):
        past = RememberedFrame(before.timestamps_s, before.global_from_ego, torch.ones(1, dtype=torch.bool))
        assert bool(past.motion(now, 8.0).usable) and len(FrameMemory((past,)).before(now).frames) == 1
    jump = RememberedFrame(first[-1].timestamps_s, first[-1].global_from_ego, torch.ones(1, dtype=torch.bool))
    assert not bool(jump.motion(replace(second[0]), 8.0).usable)  # without joining


def test_a_drive_over_many_clips_stays_rigid():
    clip = [frame("a", 0.5 * n, pose(6e5 + 5.0 * n, 0.3 + 0.1 * n), n == 0) for n in range(3)]
    *_, last = joined(itertools.chain.from_iterable(itertools.repeat(clip, 200)))
    rotation = last.global_from_ego[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0)
    assert torch.isfinite(last.global_from_ego).all()


def test_soak_needs_a_memory():
    config, tree = compose_config(["scale=debug", "phase=phase1"])
    with pytest.raises(ConfigError, match="give phase=phase2"):
        soak.measure(config, tree)


@pytest.mark.slow
def test_the_command_shows_three_passes_with_full_memory(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(soak, "FRAMES", {"debug": 16})
    monkeypatch.setattr(soak, "POINTS", 8)
    command = ["suite=soak", "phase=phase2", "scale=debug", "trainer=cpu", "data.world.key_frames_per_scene=9"]
    main([*command, "phase.validate_every=2", f"paths.outputs={tmp_path / 'outputs'}", f"out={tmp_path / 'out'}"])
    (page,) = (tmp_path / "out").glob("soak*.json")
    assert page.with_suffix(".png").stat().st_size > 10_000
    assert list(json.loads(page.read_text())["result"])[2] == "growth"  # first of the tables
    result = json.loads(page.read_text())["result"]
    assert [row["pass"] for row in result["growth"]] == [DRIVE, CLIPS, TRAINING]
    assert [row["frames"] for row in result["growth"]] == [16, 16, 16]
    assert all(row["last / second quarter"] > 0 and len(result[row["pass"]]) == 8 for row in result["growth"])
    remembered = [row["remembered MiB"] for row in result[DRIVE]]
    assert len(set(remembered[1:])) == 1  # full after two frames, over the joints too
    # Clip by clip it holds the frame alone where the second clip starts, at frame 10: one of two.
    anew = [row["remembered MiB"] for row in result[CLIPS]]
    # Flags of both frames lie in one storage, of a byte each.
    assert anew[4] == pytest.approx(remembered[-1] / 2, rel=1e-3) and anew[3] == anew[5] == remembered[-1]
    assert all(row["remembered MiB"] > 0 and row["tensors"] > 0 for row in result[TRAINING])
    assert f"![soak]({page.stem}.png)" in capsys.readouterr().out
    assert not list((tmp_path / "outputs").glob("soak*"))  # the training's folder lay elsewhere and is gone
