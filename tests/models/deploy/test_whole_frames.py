"""Frames in fixed shapes: the same boxes as without them, whatever a frame holds, and always the same launches."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from src.benchmark.simulated_device import DEVICE, simulated_device
from src.benchmark.simulated_kernels import simulated_kernels
from src.errors import ConfigError
from src.geometry.constants import constant
from src.models.deploy.whole_frames import PackedFrame, WholeFrames
from src.ops.fixed_shapes import Capacities
from src.streaming import StreamingDetector
from src.structures.taxonomy import CAMERAS
from tests.models.deploy.test_inference import distance
from tests.test_streaming import make_frame
from tests.untrained import write_checkpoint

ROOM = Capacities(points=200, voxels=12000, cells=12000, pairs=40000)
TINY = replace(ROOM, points=70)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder, made = tmp_path_factory.mktemp("checkpoints"), {}

    def write(*overrides):
        if overrides not in made:
            made[overrides] = write_checkpoint(folder / f"{len(made)}.ckpt", *overrides)
        return made[overrides]

    return write


def pair(path, capacities=ROOM):
    return StreamingDetector.load(path, capacities=capacities), StreamingDetector.load(path)


def assert_same(boxes, wanted):
    """Up to rounding, which may turn around boxes of nearly the same score."""
    assert len(boxes) == len(wanted)
    torch.testing.assert_close(boxes.scores, wanted.scores, rtol=1e-4, atol=1e-5)
    if len(boxes):
        assert float(torch.maximum(distance(boxes, wanted), distance(wanted, boxes)).max()) < 1e-3


def walk(fixed, plain, frames):
    found = 0
    for frame in frames:
        boxes, wanted = fixed.step(frame), plain.step(frame)
        assert_same(boxes, wanted)
        found += len(boxes)
    return found


VARIANTS = {
    "phase 1": ("phase=phase1",),
    "phase 2": ("phase=phase2",),
    "radar only": ("phase=phase2", "model.kggi=null", "model.ocsf=null", "model.dptf.gaussian_path=null"),
    "Gaussian path alone": ("phase=phase2", "model.dptf.bev_path=null"),
    "other choices": (
        "phase=phase2", "model.radar_encoder.conv_out=sparse", "model.radar_encoder.local_means=true",
        "model.radar_encoder.point_count_channel=true", "model.radar_encoder.pruning_ratio=0.5",
        "model.ocsf.gate_kernel_size=3", "model.head.attributes=learned", "model.head.nms=per_group",
        "model.kggi.num_radar_peaks=6", "model.kggi.num_radar_keypoints=12", "model.neck_channels=[16,24]",
        "model.dptf.gaussian_path.velocity_from=cells", "model.dptf.gaussian_path.num_frames=1",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_boxes_are_those_of_varying_shapes_whatever_frames_hold(checkpoints, name):
    fixed, plain = pair(checkpoints(*VARIANTS[name]))
    frames = [make_frame(plain, 0.5 * k, seed=k, num_points=points) for k, points in enumerate((60, 1, 150, 0, 90))]
    frames.append(make_frame(plain, 2.5, seed=9, cameras=()))  # all cameras missing
    assert walk(fixed, plain, frames) > 10
    assert (fixed.whole_frames.frames, fixed.whole_frames.refused) == (6, 0)


@pytest.mark.slow
def test_the_memory_follows_time_and_pose_as_without_fixed_shapes(checkpoints):
    fixed, plain = pair(checkpoints("phase=phase2"))
    steps = [  # time, place along x: driven, given again, the clock back, a jump of the pose, a gap, on
        (0.0, 0.0), (0.5, 10.0), (1.0, 20.0), (1.0, 20.0), (0.7, 14.0), (1.2, 500.0), (1.7, 510.0), (9.0, 520.0),
        (9.5, 530.0),
    ]  # fmt: skip
    frames = [make_frame(plain, time_s, seed=k, x_m=x_m) for k, (time_s, x_m) in enumerate(steps)]
    walk(fixed, plain, frames)
    mine, theirs = fixed.memory, plain.memory
    assert len(mine.frames) == len(theirs.frames) == 2
    for one, other in zip(mine.frames, theirs.frames, strict=True):
        assert torch.equal(one.timestamps_s, other.timestamps_s) and len(one.cells.rows) == len(other.cells.rows)
        torch.testing.assert_close(one.gaussians.means, other.gaussians.means, rtol=1e-4, atol=1e-4)
    following = make_frame(plain, 10.0, seed=20, x_m=540.0)
    begins = replace(following, streams=torch.zeros(1, dtype=torch.int64), starts=torch.ones(1, dtype=torch.bool))
    assert_same(fixed.step(begins), plain.step(begins))
    for detector in (fixed, plain):
        detector.reset()
    walk(fixed, plain, [following])


@pytest.mark.slow
@pytest.mark.parametrize(
    "room", [TINY, replace(ROOM, voxels=50), replace(ROOM, cells=300), replace(ROOM, pairs=500)],
    ids=["points", "voxels", "cells", "pairs"],
)  # fmt: skip
def test_a_frame_beyond_a_capacity_goes_without_fixed_shapes(checkpoints, room, caplog):
    fixed, plain = pair(checkpoints("phase=phase2"), room)
    with caplog.at_level("INFO"):
        walk(fixed, plain, [make_frame(plain, 0.5 * k, seed=k, num_points=n) for k, n in enumerate((60, 120, 60, 60))])
    assert fixed.whole_frames.frames == 4
    assert fixed.whole_frames.refused == caplog.text.count("exceeds a capacity") >= 1
    if room is TINY:  # the frames after it remember it, in fixed shapes
        assert fixed.whole_frames.refused == 1


@pytest.mark.slow
def test_more_voxels_than_the_model_takes_go_without_fixed_shapes(checkpoints):
    fixed, plain = pair(checkpoints("phase=phase1", "model.radar_encoder.max_voxels=40"))
    walk(fixed, plain, [make_frame(plain, 0.5 * k, seed=k, num_points=n) for k, n in enumerate((20, 150))])
    assert fixed.whole_frames.refused == 1


@pytest.mark.slow
def test_a_memory_that_was_read_stays_as_it_was(checkpoints):
    fixed, plain = pair(checkpoints("phase=phase2"))
    frames = [make_frame(plain, time_s, seed=k, x_m=20 * time_s) for k, time_s in enumerate((0.0, 5.0, 0.5))]
    for detector in (fixed, plain):
        detector.step(frames[0])
        kept = detector.memory
        detector.reset()
        detector.step(frames[1])  # another vehicle's
        detector.memory = kept
    assert fixed.memory.frames[0].timestamps_s.tolist() == frames[0].timestamps_s.tolist()
    assert_same(fixed.step(frames[2]), plain.step(frames[2]))
    two = plain.memory.select(torch.zeros(2, dtype=torch.int64), torch.tensor([True, False]))
    with pytest.raises(ValueError, match="the memory holds 2 streams"):
        fixed.memory = two


@pytest.mark.slow
def test_many_frames_of_varying_counts_stay_in_the_same_buffers_and_constants(checkpoints):
    detector = StreamingDetector.load(checkpoints("phase=phase2"), capacities=ROOM)
    counts = np.random.default_rng(0).integers(0, 200, 12)
    held = [tensor.data_ptr() for tensor in detector.whole_frames._memory]
    for k, count in enumerate(counts):
        detector.step(make_frame(detector, 0.5 * k, seed=k, num_points=int(count)))
        if k == 0:
            constants = constant.cache_info().currsize
    assert constant.cache_info().currsize == constants, "a frame's counts are no constants"
    assert [tensor.data_ptr() for tensor in detector.whole_frames._memory] == held
    assert detector.whole_frames.refused == 0


def test_models_without_a_form_of_fixed_shapes_say_so(checkpoints):
    for overrides in (("model=dense_bev", "phase=phase1"), ("phase=phase1", "backbone.trim_padding=true")):
        with pytest.raises(ConfigError, match="no form of fixed shapes"):
            StreamingDetector.load(checkpoints(*overrides), capacities=ROOM)
    with pytest.raises(ValueError, match="at least 1"):
        replace(ROOM, pairs=0)


def test_a_packed_frame_is_the_frame(checkpoints):
    detector = StreamingDetector.load(checkpoints("phase=phase1"))
    first, second = make_frame(detector, 0.0), make_frame(detector, 0.5, seed=1)
    packed = PackedFrame(first, torch.device("cpu"))
    for frame in (first, second):
        packed.load(frame)
        found = packed.frame
        assert all(torch.equal(mine, own) for mine, own in zip(found.tensors(), frame.tensors(), strict=True))


@pytest.mark.slow
def test_every_frame_launches_the_same_and_waits_for_its_result_alone(checkpoints):
    """What a CUDA graph can hold: nothing is waited for or uploaded between the frame and its boxes."""
    plain = StreamingDetector.load(checkpoints("phase=phase2"))
    frames = [make_frame(plain, 0.5 * k, seed=k, num_points=n) for k, n in enumerate((60, 150, 3))]
    frames.append(make_frame(plain, 1.5, seed=9, cameras=CAMERAS[:1]))
    sequences, boxes = [], []
    with simulated_device() as tally, simulated_kernels(), torch.no_grad():
        form = copy.deepcopy(plain.model).to(DEVICE).fixed_form(ROOM)
        whole = WholeFrames(form, torch.device(DEVICE), captured=False)
        whole.step(frames[0])  # uploads the constants
        whole.memory = None
        for frame in frames:
            tally.__init__()
            boxes.append(whole.step(frame))
            assert (tally.waits.total(), tally.uploads.total(), not tally.mixed) == (1, 1, True)
            sequences.append(list(tally.sequence))
    assert all(sequence == sequences[0] for sequence in sequences[1:])
    assert len({len(found) for found in boxes}) > 1
    for found, frame in zip(boxes, frames, strict=True):
        assert_same(found, plain.step(frame))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_a_captured_frame_gives_the_boxes_of_a_launched_one(checkpoints, phase):
    path = checkpoints(f"phase={phase}")
    fixed = StreamingDetector.load(path, device="cuda", cuda_graph=True, capacities=TINY)
    plain = StreamingDetector.load(path, device="cuda")
    walk(fixed, plain, [make_frame(plain, 0.5 * k, seed=k, num_points=n) for k, n in enumerate((60, 1, 120, 30, 60))])
    assert fixed.whole_frames.refused == 1
