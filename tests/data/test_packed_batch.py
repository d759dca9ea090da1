"""A batch that a worker sends is the batch that arrives, in few pieces."""

import pickle
import warnings
from dataclasses import fields, replace

import pytest
from torch import Tensor

from src.data.datamodule import in_stream
from src.data.frame_loader import collate
from src.data.packed_batch import LARGE_BYTES, PackedBatch
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle
from tests.data.tiny_set import FIVE_HERTZ


@pytest.fixture
def batch(data_set):
    frames = [data_set.reader(image_size_px=(200, 400)).read(row, None) for row in (0, 1)]
    return collate([in_stream(frame, stream, stream == 1) for stream, frame in enumerate(frames)])


def pieces(value):
    for field in fields(value):
        item = getattr(value, field.name)
        for entry in item if isinstance(item, (list, tuple)) else [item]:
            yield from pieces(entry) if isinstance(entry, (Boxes3D, FrameBatch, RayBundle)) else [entry]


def assert_same(found, expected):
    for a, b in zip(pieces(found), pieces(expected), strict=True):
        if isinstance(b, Tensor):
            assert a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()
        else:
            assert a == b and type(a) is type(b)


def test_what_is_packed_is_unpacked(batch):
    without_images = replace(batch, images=None, image_valid=None, pix_from_aug=None, boxes=None, skipped={"a": 3})
    empty = replace(without_images, radar_points=batch.radar_points[:0], radar_batch=batch.radar_batch[:0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for one in (batch, without_images, empty):
            assert_same(PackedBatch.pack(one).unpack(), one)


def test_lidar_past_frames_and_rays_are_packed_too(lidar_set):
    reader = lidar_set.reader(
        image_size_px=None, num_sweeps=0, num_lidar_sweeps=2, lidar_origins=True, timeline=FIVE_HERTZ,
        num_future_frames=2,
    )  # fmt: skip
    one = collate([reader.read(row, None, history=[-2, -1], targets=[0, 3]) for row in (0, 1)])
    assert [len(frame.lidar_points) for frame in one.past] == [160, 160] and one.radar_points is None
    assert one.rays.batch.bincount().tolist() == [80, 40]
    assert_same(PackedBatch.pack(one).unpack(), one)
    points, owners = one.lidar_points.repeat(1000, 1), one.lidar_batch.repeat(1000).sort()[0]
    large = replace(one, lidar_points=points, lidar_batch=owners, lidar_origins=None)
    packed = PackedBatch.pack(large)
    assert packed.large[0] is large.lidar_points and len(packed.large) == 2
    assert_same(pickle.loads(pickle.dumps(packed)).unpack(), large)


def test_only_large_tensors_are_sent_one_by_one(batch):
    parcel = PackedBatch.pack(batch)
    assert parcel.large[0] is batch.images and len(parcel.large) == 1
    assert len(parcel.content) < LARGE_BYTES
    travelled = pickle.loads(pickle.dumps(parcel))
    assert_same(travelled.unpack(), batch)


def test_what_arrives_can_be_written_to_and_keeps_no_image_alive(batch):
    """Poses and boxes outlive their batch in a memory; images must not stay with them."""
    found = PackedBatch.pack(batch).unpack()
    found.radar_points += 1
    assert found.radar_points.untyped_storage().data_ptr() != batch.radar_points.untyped_storage().data_ptr()
    assert found.global_from_ego.untyped_storage().nbytes() == found.global_from_ego.nbytes
