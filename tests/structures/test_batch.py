import dataclasses

import pytest
import torch

from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from tests.ray_bundles import rays_to

STREAM = ("streams", "starts")


def batch(**changes):
    values = {
        "tokens": ["a", "b", "c"],
        "timestamps_s": torch.arange(3, dtype=torch.float64),
        "global_from_ego": torch.eye(4, dtype=torch.float64).repeat(3, 1, 1),
        "aug_from_ego": torch.eye(4).repeat(3, 1, 1),
        "radar_points": torch.arange(28.0).reshape(4, 7),
        "radar_batch": torch.tensor([0, 0, 2, 2]),
        "images": torch.zeros(3, 4, 3, 8, 16, dtype=torch.uint8),
        "image_valid": torch.ones(3, 4, dtype=torch.bool),
        "pix_from_aug": torch.eye(4).repeat(3, 4, 1, 1),
        "boxes": [Boxes3D.empty() for _ in range(3)],
    }
    return FrameBatch(**(values | changes))


LIDAR = {
    "lidar_points": torch.arange(25.0).reshape(5, 5),
    "lidar_batch": torch.tensor([0, 1, 1, 2, 2]),
    "lidar_origins": torch.arange(15.0).reshape(5, 3),
    "lidar_speeds": torch.tensor([1.0, -2.0, 4.0, 0.0, 3.0]),
}
NO_RADAR = {"radar_points": None, "radar_batch": None}
NO_CAMERA = {"images": None, "image_valid": None, "pix_from_aug": None}


def test_every_sensor_may_be_missing():
    alone = batch(**NO_RADAR, **NO_CAMERA, **LIDAR)
    assert len(alone) == 3 and alone.radar_points is None and alone.images is None and alone.device.type == "cpu"
    assert batch(**NO_RADAR).to("cpu").images is not None
    assert len(batch(**NO_RADAR, **NO_CAMERA)) == 3
    assert batch(**(LIDAR | {"lidar_origins": None, "lidar_speeds": None})).lidar_origins is None


def rays(owners):
    return rays_to([[1.0, 0.0, 0.0]] * len(owners), batch=owners)


def test_rays_and_past_frames_move_with_the_batch_and_fit_it():
    past = batch(**NO_RADAR, **NO_CAMERA, **LIDAR, boxes=None)
    present = batch(past=(past, past), rays=rays([0, 0, 2]))
    moved = present.to("meta")
    assert [frame.device.type for frame in moved.past] == ["meta", "meta"] and moved.rays.points.is_meta
    assert moved.past[1].lidar_points.is_meta and moved.past[1].lidar_origins.shape == (5, 3)
    assert present.past[0] is past and present.rays.points.tolist() == [[1, 0, 0]] * 3
    with pytest.raises(ValueError, match="FrameBatch.past must hold batches of 3, but got .3, 1."):
        one = batch(
            tokens=["a"], timestamps_s=torch.zeros(1, dtype=torch.float64), aug_from_ego=torch.eye(4)[None],
            global_from_ego=torch.eye(4, dtype=torch.float64)[None], boxes=None, **NO_RADAR, **NO_CAMERA,
        )  # fmt: skip
        batch(past=(past, one))
    for owners in ([0, 3], [2, 0]):
        with pytest.raises(ValueError, match="FrameBatch.rays.batch must ascend within 0..2"):
            batch(rays=rays(owners))
    with pytest.raises(ValueError, match=r"RayBundle.ranges must be \[3\] torch.float32, but got .*float64"):
        dataclasses.replace(rays([0, 1, 2]), ranges=torch.ones(3).double())


def test_annotations_stay_on_the_host():
    boxes = [Boxes3D.empty()] * 3
    moved = batch(boxes=boxes, past=(batch(boxes=boxes),)).to("meta")
    for frame in (moved, *moved.past):
        assert frame.timestamps_s.is_meta and frame.boxes[0].centers.device.type == "cpu"


def test_a_sample_may_lack_points_boxes_and_images():
    assert len(batch()) == 3
    bare = batch(images=None, image_valid=None, pix_from_aug=None, boxes=None)
    assert bare.images is None and bare.boxes is None and bare.skipped == {}
    nothing = batch(radar_points=torch.zeros(0, 7), radar_batch=torch.zeros(0, dtype=torch.int64))
    assert len(nothing) == 3


@pytest.mark.parametrize(
    "name, value",
    [
        ("timestamps_s", torch.arange(3.0)),  # float32 loses the fraction of a second
        ("global_from_ego", torch.eye(4).repeat(3, 1, 1)),  # and half a metre
        ("aug_from_ego", torch.eye(4).repeat(2, 1, 1)),
        ("radar_points", torch.zeros(4, 6)),
        ("radar_batch", torch.tensor([0, 0, 2])),
        ("radar_batch", torch.tensor([0, 2, 0, 2])),
        ("radar_batch", torch.tensor([0, 0, 2, 3])),
        ("radar_batch", torch.tensor([-1, 0, 0, 2])),
        ("radar_batch", None),
        ("radar_points", None),
        ("lidar_points", torch.zeros(5, 4)),
        ("lidar_points", torch.zeros(5, 5, dtype=torch.float64)),
        ("lidar_points", None),
        ("lidar_batch", None),
        ("lidar_batch", torch.tensor([0, 1, 0, 2, 2])),
        ("lidar_batch", torch.tensor([0, 1, 1, 2, 3])),
        ("lidar_origins", torch.zeros(4, 3)),
        ("lidar_origins", None),
        ("lidar_speeds", torch.zeros(4)),
        ("images", torch.zeros(3, 4, 3, 8, 16)),
        ("images", torch.zeros(2, 4, 3, 8, 16, dtype=torch.uint8)),
        ("image_valid", None),
        ("image_valid", torch.ones(3, 4)),
        ("pix_from_aug", torch.eye(4).repeat(3, 3, 1, 1)),
        ("boxes", [Boxes3D.empty()]),
        ("streams", torch.arange(2)),
        ("streams", torch.arange(3).int()),
        ("streams", torch.tensor([4, 0, 4])),
        ("starts", torch.zeros(3)),
        ("starts", torch.zeros(2, dtype=torch.bool)),
    ],
)
def test_what_does_not_fit_is_named(name, value):
    streamed = {"streams": torch.arange(3), "starts": torch.zeros(3, dtype=torch.bool)} if name in STREAM else {}
    lidar = LIDAR if name.startswith("lidar") else {}
    with pytest.raises(ValueError, match=f"FrameBatch.{name} must"):
        batch(**streamed | lidar | {name: value})


@pytest.mark.parametrize("given", STREAM)
def test_streams_and_starts_belong_together(given):
    assert batch().streams is None and batch().starts is None
    value = {"streams": torch.arange(3), "starts": torch.zeros(3, dtype=torch.bool)}[given]
    with pytest.raises(ValueError, match="streams and FrameBatch.starts must be given together"):
        batch(**{given: value})


def test_moving_keeps_every_value():
    original = batch(
        **LIDAR,
        skipped={"RADAR_LEFT_SIDE": 2},
        streams=torch.tensor([4, 0, 9]),
        starts=torch.tensor([True, False, True]),
    )
    same = original.to("cpu")
    assert same.tokens == original.tokens and same.skipped == original.skipped and len(same.boxes) == 3
    for field in dataclasses.fields(FrameBatch):
        value = getattr(original, field.name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(same, field.name), value)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_page_locked():
    pinned = batch(**LIDAR, rays=rays([0, 1])).pin_memory()
    assert pinned.radar_points.is_pinned() and pinned.boxes[0].centers.is_pinned()
    assert pinned.lidar_origins.is_pinned() and pinned.rays.ranges.is_pinned()
    assert torch.equal(pinned.to("cuda", non_blocking=True).radar_points.cpu(), batch().radar_points)
