"""One frame at a time with memory: what each kind of frame may remember, bounded size, and the example of the guide."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from src.data.frame_loader import collate
from src.data.sensors import Camera, RadarSweep
from src.errors import CheckpointError, ConfigError
from src.streaming import StreamingDetector
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CAMERAS, RADARS
from tests.models.moving import tensors_of
from tests.untrained import write_checkpoint

GUIDE = Path(__file__).resolve().parent.parent / "docs" / "streaming.md"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    return {phase: write_checkpoint(folder / f"{phase}.ckpt", f"phase={phase}") for phase in ("phase1", "phase2")}


@pytest.fixture
def phase2(checkpoints):
    return StreamingDetector.load(checkpoints["phase2"])


def make_frame(detector, time_s, seed=0, x_m=None, cameras=CAMERAS, num_points=60):
    """A frame of a truck that drives along x at 20 m/s, with random returns and images."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[0, 3] = 20.0 * time_s if x_m is None else x_m
    points = np.concatenate([rng.uniform([8, -20, -1], [90, 20, 2], (num_points, 3)), np.zeros((num_points, 4))], 1)
    sweep = RadarSweep(
        points=points, ego_from_sensor=np.eye(4), timestamp_s=time_s, ego_velocity_mps=np.array([20.0, 0.0, 0.0])
    )
    looks = np.array([[0.0, 0, 1, 2], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]])
    image = rng.integers(0, 255, (60, 120, 3), dtype=np.uint8)
    view = Camera(image=image, intrinsics=np.array([[60.0, 0, 60], [0, 60, 30], [0, 0, 1]]), ego_from_camera=looks)
    return detector.frame(time_s, pose, dict.fromkeys(cameras, view), {RADARS[0]: [sweep]})


def same(first, second):
    return all(torch.equal(getattr(first, f.name), getattr(second, f.name))
               for f in fields(Boxes3D) if getattr(first, f.name) is not None)  # fmt: skip


def alone(detector, frame):
    """Boxes of a detector that has seen nothing before."""
    return StreamingDetector(detector.model, detector.grid, detector.settings).step(frame)


def walk(detector, *times_s):
    for time_s in times_s:
        detector.step(make_frame(detector, time_s, seed=int(10 * time_s)))


@pytest.mark.slow
def test_boxes_come_best_first_with_scores_in_a_valid_form(phase2):
    boxes = phase2.step(make_frame(phase2, 0.0))
    assert len(boxes) > 5 and boxes.centers.device.type == "cpu"
    assert (boxes.scores.diff() <= 0).all() and torch.isfinite(boxes.centers).all()


@pytest.mark.slow
def test_the_second_frame_remembers_the_first(phase2):
    frames = [make_frame(phase2, 0.5 * k, seed=k) for k in range(4)]
    stepped = [phase2.step(frame) for frame in frames]
    assert same(stepped[0], alone(phase2, frames[0]))
    assert not any(same(boxes, alone(phase2, frame)) for boxes, frame in zip(stepped[1:], frames[1:], strict=True))
    memory = None
    with torch.inference_mode():  # the same by hand
        for boxes, frame in zip(stepped, frames, strict=True):
            output, memory = phase2.model(frame, memory)
            assert same(boxes, phase2.model.decode(output)[0])


def test_a_single_frame_model_has_no_memory(checkpoints):
    detector = StreamingDetector.load(checkpoints["phase1"])
    walk(detector, 0.0, 0.5)
    frame = make_frame(detector, 1.0)
    assert same(detector.step(frame), alone(detector, frame)) and detector.memory is None


@pytest.mark.slow
def test_reset_and_a_marked_start_begin_anew(phase2):
    walk(phase2, 0.0, 0.5)
    frame = make_frame(phase2, 1.0, seed=7)
    phase2.reset()
    assert same(phase2.step(frame), alone(phase2, frame))
    marked = replace(frame, streams=torch.zeros(1, dtype=torch.int64), starts=torch.ones(1, dtype=torch.bool))
    assert same(phase2.step(marked), alone(phase2, frame))
    following = make_frame(phase2, 1.5)
    unmarked = replace(following, streams=marked.streams, starts=~marked.starts)
    assert not same(phase2.step(unmarked), alone(phase2, following))


@pytest.mark.slow
def test_frames_that_are_not_in_the_past_are_not_used(phase2):
    walk(phase2, 10.0)
    again = make_frame(phase2, 10.0, seed=1)
    assert same(phase2.step(again), alone(phase2, again))  # the same time
    back = make_frame(phase2, 9.9, seed=2)
    assert same(phase2.step(back), alone(phase2, back))  # the clock jumps back
    later = make_frame(phase2, 10.1, seed=3)
    other = StreamingDetector(phase2.model, phase2.grid, phase2.settings)
    other.step(back)
    assert same(phase2.step(later), other.step(later))  # nothing is left of what came before the jump


def test_a_frame_given_again_is_detected_as_the_first_time(phase2):
    walk(phase2, 10.0)
    frame = make_frame(phase2, 10.5, seed=1)
    first, memory = phase2.step(frame), tensors_of(phase2.memory)
    assert same(phase2.step(frame), first) and not same(first, alone(phase2, frame))
    assert all(torch.equal(*pair) for pair in zip(tensors_of(phase2.memory), memory, strict=True))


@pytest.mark.slow
def test_a_gap_beyond_the_age_limit_is_as_a_first_frame(phase2):
    limit = phase2.model.config.dptf.max_age_s
    for gap, forgotten in ((limit - 0.01, False), (limit + 0.01, True)):
        phase2.reset()
        walk(phase2, 0.0)
        frame = make_frame(phase2, gap, seed=5, x_m=30.0)  # crawled, so that what was seen is still on the grid
        assert same(phase2.step(frame), alone(phase2, frame)) == forgotten


@pytest.mark.slow
def test_a_jump_of_the_pose_is_as_a_first_frame(phase2):
    for distance, forgotten in ((49.0, False), (51.0, True)):  # within 0.5 s
        phase2.reset()
        walk(phase2, 0.0)
        frame = make_frame(phase2, 0.5, seed=5, x_m=distance)
        assert same(phase2.step(frame), alone(phase2, frame)) == forgotten


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_frames_without_radar_points_or_cameras_are_detected_and_remembered(checkpoints, phase):
    detector = StreamingDetector.load(checkpoints[phase])
    blind = [{"num_points": 0}, {"cameras": CAMERAS[:1]}, {"cameras": ()}, {"num_points": 0, "cameras": ()}]
    for k, missing in enumerate([*blind, {}, *reversed(blind)]):
        boxes = detector.step(make_frame(detector, 0.5 * k, seed=k, **missing))
        assert torch.isfinite(boxes.centers).all() and torch.isfinite(boxes.scores).all()


@pytest.mark.slow
def test_memory_stays_within_its_bounds(phase2):
    config, sizes = phase2.model.config.dptf, []
    for k in range(30):
        phase2.step(make_frame(phase2, 0.5 * k, seed=k))
        assert not any(tensor.requires_grad for tensor in tensors_of(phase2.memory))
        sizes.append(sum(tensor.numel() for tensor in tensors_of(phase2.memory)))
    assert len(phase2.memory.frames) == max(config.bev_path.num_frames, config.gaussian_path.num_frames)
    for frame in phase2.memory.frames:
        assert 0 < len(frame.cells.xy) <= config.bev_path.max_cells_per_frame
        assert 0 < frame.gaussians.means.shape[1] <= config.gaussian_path.gaussians_per_frame
    assert max(sizes[20:]) < 1.5 * max(sizes[2:10])


@pytest.mark.slow
def test_two_vehicles_can_share_a_model(phase2):
    """The memory is the detector's: nothing passes through the model."""
    frames = [make_frame(phase2, 0.5 * k, seed=k) for k in range(3)]
    expected = [phase2.step(frame) for frame in frames]
    first = StreamingDetector(phase2.model, phase2.grid, phase2.settings)
    second = StreamingDetector(phase2.model, phase2.grid, phase2.settings)
    for k, frame in enumerate(frames):
        assert same(first.step(frame), expected[k])
        second.step(make_frame(phase2, 0.5 * k, seed=100 + k))


def test_a_trained_model_is_left_as_it_is(checkpoints):
    """A detector made in the middle of a training must not stop its batch norms and dropout."""
    plain = StreamingDetector.load(checkpoints["phase1"], plain=True)
    model = plain.model.train()
    model.image_encoder.eval()  # frozen, as some trainings have it
    modes = [module.training for module in model.modules()]
    detector = StreamingDetector(model, plain.grid, plain.settings)
    assert [module.training for module in model.modules()] == modes and not detector.model.training
    assert len(detector.step(make_frame(detector, 0.0))) > 0


def test_a_shared_model_stays_on_its_device_and_as_it_was_prepared(phase2):
    parts = (phase2.grid, phase2.settings)
    for switch in ("plain", "compiled", "cuda_graph"):
        with pytest.raises(ConfigError, match="that of another detector"):
            StreamingDetector(phase2.model, *parts, **{switch: True})
    elsewhere = phase2.model.to("meta")
    second = StreamingDetector(elsewhere, *parts)
    assert second.model is elsewhere and second.device.type == "meta"
    assert all(parameter.is_meta for parameter in elsewhere.parameters())


def test_what_is_not_one_plain_frame_is_refused_and_costs_no_memory(phase2):
    good = make_frame(phase2, 0.0)
    wrong = {
        "must hold 1 frame, but got 2": collate([good, good]),
        "images must be .*but got .1, 3, ": replace(
            good, images=good.images[:, :3], image_valid=good.image_valid[:, :3], pix_from_aug=good.pix_from_aug[:, :3]
        ),
        "images must be .*but got None": replace(good, images=None, image_valid=None, pix_from_aug=None),
        **{
            f"{name} must be finite": replace(good, **{name: getattr(good, name) * float("nan")})
            for name in ("timestamps_s", "radar_points", "pix_from_aug")
        },
        "aug_from_ego must be the identity": replace(good, aug_from_ego=2 * good.aug_from_ego),
    }
    phase2.step(good)
    before = phase2.memory
    for message, frame in wrong.items():
        with pytest.raises(ValueError, match=message):
            phase2.step(frame)
    assert phase2.memory is before


def test_a_radar_only_model_looks_at_no_image(tmp_path):
    path = write_checkpoint(
        tmp_path / "radar.ckpt", "phase=phase2", "model.kggi=null", "model.ocsf=null", "model.dptf.gaussian_path=null"
    )
    detector = StreamingDetector.load(path)
    frame = make_frame(detector, 0.0)
    assert frame.images is None and len(detector.step(frame)) > 0
    following = make_frame(detector, 0.5, seed=1)
    assert not same(detector.step(following), alone(detector, following))


@pytest.mark.slow  # a ResNet-50 on disk
def test_loading_needs_the_checkpoint_alone(tmp_path):
    """The backbone's pretrained file, which training began from, need not be on this machine."""
    path = write_checkpoint(
        tmp_path / "a.ckpt", "phase=phase1", "backbone=resnet50", "backbone.weights=/nowhere/weights.pth"
    )
    assert StreamingDetector.load(path).settings.image_size_px == (256, 864)


def test_loading_says_what_is_wrong(checkpoints, tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        StreamingDetector.load(tmp_path / "nothing.ckpt")
    half = tmp_path / "half.ckpt"
    half.write_bytes(checkpoints["phase2"].read_bytes()[:4000])
    with pytest.raises(CheckpointError, match="half.ckpt is truncated"):
        StreamingDetector.load(half)
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="device=cuda: torch sees no GPU"):
            StreamingDetector.load(checkpoints["phase1"], device="cuda")


@pytest.mark.slow
def test_bf16_runs_in_autocast(tmp_path):
    path = write_checkpoint(tmp_path / "bf16.ckpt", "phase=phase2", "precision=bf16-mixed")
    detector = StreamingDetector.load(path)
    frame = make_frame(detector, 0.0)
    boxes = detector.step(frame)
    assert detector.precision == "bf16-mixed" and torch.isfinite(boxes.centers).all()
    assert same(alone(detector, frame), boxes)  # a second vehicle's detector takes the precision over
    plain = StreamingDetector.load(path, plain=True)
    full = StreamingDetector(plain.model, plain.grid, plain.settings, precision="32-true")
    assert not same(full.step(frame), boxes)
    with pytest.raises(ValueError, match="prepared for precision=bf16-mixed, but 32-true"):
        StreamingDetector(detector.model, detector.grid, detector.settings, precision="32-true")


def test_the_example_of_the_guide_runs(checkpoints, tmp_path, monkeypatch, capsys):
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), flags=re.DOTALL)
    (example,) = [block for block in blocks if "StreamingDetector" in block]
    assert len(example.splitlines()) <= 30
    (tmp_path / "model.ckpt").write_bytes(checkpoints["phase2"].read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(compile(example, str(GUIDE), "exec"), {})
    printed = capsys.readouterr().out
    assert re.search(r"car|truck|bus|pedestrian|traffic_sign", printed) and " m/s" in printed
