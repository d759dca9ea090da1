"""LRS4Fusion as a whole: what it reads, remembers, answers and learns."""

import io
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from src.benchmark.scenes import ROADS
from src.benchmark.scenes import lidar_frame as made_frame
from src.errors import ConfigError
from src.models.deploy.inference import prepare_for_inference
from src.models.lrs4fusion.model import warn_without_speeds
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from src.targets.occupancy_rays import sample_queries
from tests.models.learning import gradients_are_finite, train_step
from tests.models.lrs4fusion.lrs_frames import cloud, lidar_frame, lrs_config, lrs_model
from tests.models.moving import bda, pose, tensors_of
from tests.ray_bundles import rays_to

pytestmark = pytest.mark.slow

SENSOR = torch.tensor([3.0, 1.0, 2.0])
OCCUPANCY, FORECAST = "phase.options.stage=occupancy", "phase.options.stage=forecast"


def box(x, y):
    return Boxes3D(
        centers=torch.tensor([[x, y, 0.5]]), sizes=torch.tensor([[1.9, 4.5, 1.7]]), yaws=torch.tensor([0.3]),
        velocities=torch.tensor([[8.0, 0.0]]), labels=torch.tensor([0]), attributes=torch.tensor([-1]),
        num_points=torch.tensor([9]),
    )  # fmt: skip


def frame(counts=(400, 300), time_s=0.0, seed=0):
    clouds = [cloud(count, seed + number) for number, count in enumerate(counts)]
    boxes = [box(4.0, -3.0), box(-5.0, 6.0)][: len(counts)]
    return lidar_frame(clouds, time_s, [pose(20 * time_s)] * len(counts), boxes=boxes)


def some_queries(count, batch_size=2):
    unit = torch.rand(count, 4, generator=torch.Generator().manual_seed(0))
    return (unit - 0.5) * torch.tensor([60.0, 60.0, 8.0, 6.0]), torch.arange(count) % batch_size


def some_rays():
    directions = F.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    ends = 20.0 * directions + torch.tensor([1.0, 0.0, 2.0])
    times, owners = torch.linspace(0, 3, 6), torch.arange(6) // 3
    return rays_to(ends, origin=(1.0, 0.0, 2.0), times_s=times, steps=torch.arange(6), batch=owners)


@pytest.mark.parametrize(
    "clouds",
    [[cloud(0), cloud(0)], [cloud(0), cloud(200)], [cloud(50) + torch.tensor([500.0, 0, 0, 0, 0]), cloud(200)]],
    ids=["no returns", "one without returns", "one beyond the region"],
)
@pytest.mark.parametrize(("options", "term"), [(OCCUPANCY, "occupancy"), (FORECAST, "range")])
def test_frames_without_points_inside_teach_finite_steps_and_are_remembered_as_nothing(clouds, options, term):
    model = lrs_model(options).train()
    rays = some_rays()
    output, memory = model(replace(lidar_frame(clouds), rays=rays))
    assert sum(row == 0 for row in memory.frames[0].voxels.rows.tolist()) == 0
    later, _ = model(replace(lidar_frame([cloud(100), cloud(100)], 0.5), rays=rays), memory)
    for out in (output, later):
        terms = model.loss(out, replace(lidar_frame(clouds), rays=rays)).terms
        assert term in terms and terms["total"].isfinite()
    terms["total"].backward()
    learning = [p.grad for p in model.parameters() if p.grad is not None]
    assert learning and all(grad.isfinite().all() for grad in learning)
    probability, _ = model.look_up(later, *some_queries(50))
    assert probability.isfinite().all()


def test_sensors_and_stages_that_there_are():
    assert lrs_config().model.sensors == ["lidar"] and lrs_config().model.memory_frames == 1
    still = ("model.temporal.velocity_compensation=false", "model.temporal=null")  # nothing for an oracle to replace
    assert lrs_config().model.moves_memory and not any(lrs_config(one).model.moves_memory for one in still)
    with pytest.raises(ConfigError, match=r"model.sensors=\['lidar', 'camera'\]: must be \['lidar'\]"):
        lrs_config("model.sensors=[lidar,camera]")
    with pytest.raises(ConfigError, match="stage=dreams: must be one of occupancy, forecast, detection"):
        lrs_config("phase.options.stage=dreams")
    with pytest.raises(ConfigError, match="velocity_compensation=true needs model.decoders.velocity=true"):
        lrs_config("model.decoders.velocity=false")
    with pytest.raises(ConfigError, match="heatmap_weight and box_weight are both null.*stage detection"):
        lrs_model("phase.options.stage=detection", "model.loss.heatmap_weight=null", "model.loss.box_weight=null")
    with pytest.raises(ConfigError, match="reads LiDAR, which this world lacks"):
        lrs_config("data.world.lidar=false")
    with pytest.raises(ValueError, match="FrameBatch.lidar_points is None, but this model uses LiDAR"):
        lrs_model()(replace(frame(), lidar_points=None, lidar_batch=None))


def test_boxes_are_found_beyond_the_official_range_of_their_class(monkeypatch):
    """As `phase.long_range` counts them."""
    monkeypatch.setattr("src.models.heads.decode.RANGES_M", (5.0,) * len(CLASSES))
    model = lrs_model().eval()
    with torch.no_grad():
        output, _ = model(frame())
    output.head.logits.zero_()  # boxes everywhere
    assert all((boxes.centers[:, :2].norm(dim=1) > 5.0).any() for boxes in model.decode(output))


@pytest.mark.parametrize("counts", [(400, 300), (60, 0), (0, 0)])
def test_detection_trains_all_but_the_decoders(counts):
    model, batch = lrs_model().train(), frame(counts)
    _, terms = train_step(model, batch)
    assert set(terms) == {"heatmap", "box", "total"} and terms["total"].isfinite()
    frozen = {name for name, p in model.named_parameters() if not p.requires_grad}
    assert frozen == {name for name, _ in model.named_parameters() if name.startswith("decoders.")}
    model.decoders.requires_grad_(True).zero_grad()
    del model.decoders
    assert gradients_are_finite(model)


def test_occupancy_trains_everything_and_has_no_boxes():
    model, batch = lrs_model(OCCUPANCY).train(), frame()
    q, owner = some_queries(200)
    output, memory = model(batch)
    later, _ = model(frame(time_s=0.5), memory)
    logits, speeds = model.decoders(later.volumes, q, owner)
    assert torch.equal(model.decoders.occupancy_logits(later.volumes, q, owner), logits)
    assert torch.equal(model.decoders.velocities(later.volumes, q, owner), speeds)
    (logits.square().sum() + (speeds - 1).square().sum()).backward()
    zero = {name for name, p in model.named_parameters() if p.grad is None}
    assert zero == set() and model.head is None and model.ray_head is None
    with pytest.raises(ConfigError, match="boxes need the stage detection"):
        model.decode(output)
    with pytest.raises(ConfigError, match="ranges of rays need the stage forecast"):
        model.forecast(output, some_rays())


def test_forecasts_train_the_ray_head_alone(monkeypatch):
    model = lrs_model(FORECAST).train()
    before = {name: value.clone() for name, value in model.named_buffers()}
    output = model(frame())[0]
    assert all(torch.equal(value, before[name]) for name, value in model.named_buffers())
    rays, volumes = some_rays(), output.volumes
    ranges = model.forecast(output, rays)
    assert ranges.shape == (6,)
    ranges.sum().backward()
    assert {name.partition(".")[0] for name, p in model.named_parameters() if p.grad is not None} == {"ray_head"}
    occupancy = model.ray_occupancy(volumes, rays)
    away = model.ray_head.samples_m[:, None]
    samples = torch.cat([rays.origins[4] + away * rays.directions[4], rays.times_s[4].expand_as(away)], 1)
    expected = model.decoders.occupancy_logits(volumes, samples, rays.batch[4].expand(len(away))).sigmoid()
    torch.testing.assert_close(occupancy[4], expected)
    monkeypatch.setattr("src.models.lrs4fusion.model.QUERIES_AT_ONCE", 100)
    torch.testing.assert_close(model.ray_occupancy(volumes, rays), occupancy)
    assert model.forecast(output, rays[:0]).shape == (0,)


def test_without_gradients_a_few_rays_at_a_time_are_forecast(monkeypatch):
    """The same ranges as at once, which is how it learns; the second piece holds rays of both samples."""
    model, rays, pieces = lrs_model(FORECAST, "model.measured_motion=true").eval(), some_rays(), []
    speeds = torch.full((700,), 20.0)
    output = model(replace(frame(), lidar_origins=torch.zeros(700, 3), lidar_speeds=speeds))[0]
    model.ray_head.register_forward_pre_hook(lambda _, inputs: pieces.append(len(inputs[0])))
    whole = model.forecast(output, rays)
    monkeypatch.setattr("src.models.lrs4fusion.model.RAYS_AT_ONCE", 2)
    with torch.no_grad():
        torch.testing.assert_close(model.forecast(output, rays), whole)
        assert model.forecast(output, rays[:0]).shape == (0,)
    model.forecast(output, rays).sum().backward()
    assert pieces == [6, 2, 2, 2, 0, 6] and whole.std() > 0


def test_the_memory_changes_features_and_no_site():
    model = lrs_model(OCCUPANCY).eval()
    _, memory = model(frame())
    assert not any(value.requires_grad for value in tensors_of(memory))
    now = frame(time_s=0.5, seed=4)
    alone, remembering = model(now)[0].volumes, model(now, memory)[0].volumes
    for scale, (a, b) in enumerate(zip(alone.scales, remembering.scales, strict=True)):
        assert torch.equal(a.sites.keys, b.sites.keys)
        assert torch.equal(a.features, b.features) is (scale == 0)
    file = io.BytesIO()
    torch.save(memory.state(), file)
    file.seek(0)
    restored = model.restore_memory(torch.load(file, weights_only=True))
    assert torch.equal(model(now, restored)[0].volumes.scales[3].features, remembering.scales[3].features)


def test_measured_speeds_move_the_volume_and_what_is_remembered(caplog):
    """All returns go 5 m/s along their rays from a mast, the ego 20 m/s along x, in a turned and larger aug frame."""
    augment = bda(0.4, scale=1.05)
    model = lrs_model(OCCUPANCY, "model.measured_motion=true").eval()

    def seen(time_s, measured=True):
        speeds, origins = (torch.full((400,), 5.0), SENSOR.expand(400, 3)) if measured else (None, None)
        own = replace(frame((400,), time_s), lidar_origins=origins, lidar_speeds=speeds)
        return replace(own, aug_from_ego=augment[None])

    output, memory = model(seen(0.0))
    assert len(output.volumes.measured.xyz) > 100 and output.volumes.measured.ego_mps.isnan().all()
    later = model.encode(seen(0.5), memory)
    torch.testing.assert_close(later.measured.ego_mps, (augment[:3, :3] @ torch.tensor([20.0, 0, 0]))[None])
    single = lrs_model(OCCUPANCY, "model.measured_motion=true", "model.temporal=null").eval()
    assert single.encode(seen(0.5)).measured.ego_mps.isnan().all()
    warn_without_speeds.cache_clear()
    assert not caplog.text and model.encode(seen(0.5, measured=False), memory).measured is None
    assert "model.measured_motion=true, but no return has a measured speed" in caplog.text
    voxels = memory.frames[0].voxels  # in the ego frame, where the heading is x
    in_ego = SENSOR @ augment[:3, :3].inverse().T
    cosine = F.normalize(voxels.xyz - in_ego, dim=1)[:, 0]
    ahead = (cosine.abs() > 0.6) & voxels.velocities.any(1)
    aside = voxels.velocities[ahead, 1:].abs().amax(1)
    assert (aside < 1e-4).float().mean() > 0.99  # a voxel's points may be abeam where its centre is not
    radial = 1.05 * voxels.velocities[ahead, 0] * cosine[ahead]
    assert ahead.sum() > 50 and float(radial.median()) == pytest.approx(5.0, abs=0.2)


def test_without_speeds_a_decoder_that_has_learned_none_is_not_asked_what_moves(monkeypatch):
    """The next frame is the same to the bit as if it had been; one that has learned some is asked."""
    model, asked = lrs_model(OCCUPANCY).eval(), []
    ask = model.decoders.velocities
    monkeypatch.setattr(model.decoders, "velocities", lambda *query: asked.append(0) or ask(*query))

    def later():
        return model.encode(frame(time_s=0.5, seed=4), model(frame())[1]).scales

    def same(a, b):
        return all(torch.equal(one.features, other.features) for one, other in zip(a, b, strict=True))

    assert model.decoders.at_rest
    unasked, times = later(), len(asked)
    with monkeypatch.context() as patch:
        patch.setattr(type(model.decoders), "at_rest", False)
        assert same(later(), unasked) and times == 0 < len(asked)
    asked.clear()
    torch.nn.init.ones_(model.decoders.velocity.output.bias)
    assert not same(later(), unasked) and asked and not model.decoders.at_rest


def test_returns_of_another_time_give_the_voxels_of_the_key_time():
    """All drive 20 m/s along the heading, which is nearly their ray from a sensor far behind."""
    model, points = lrs_model(OCCUPANCY, "model.measured_motion=true").eval(), cloud(400)
    points[:, 4] = torch.linspace(-0.1, 0.1, 400)
    earlier = points - points[:, 4:] * torch.tensor([20.0, 0, 0, 0, 0])
    motion = {
        "lidar_origins": torch.tensor([[-1e4, 0.0, 0.0]]).expand(400, 3),
        "lidar_speeds": torch.full((400,), 20.0),
    }
    still = {"lidar_origins": motion["lidar_origins"], "lidar_speeds": torch.zeros(400)}
    cells = []
    for clouds, own in ((earlier, motion), (points, still), (earlier, still)):
        volume = model.encode(replace(lidar_frame([clouds]), **own)).scales[0]
        cells.append(set(volume.sites.keys.tolist()))
    moved, there, smeared = cells
    assert len(moved & there) / len(moved | there) > 0.98 > 0.9 > len(smeared & there) / len(smeared | there)


def test_boxes_begin_with_measured_motion():
    """What is known of a cell is an input of the head too; without speeds nothing is known."""
    model = lrs_model("model.measured_motion=true").eval()
    batch = replace(frame(), lidar_origins=torch.zeros(700, 3), lidar_speeds=torch.full((700,), 20.0))
    output, unknown = model(batch)[0], model(replace(batch, lidar_speeds=None))[0]
    known = output.head.base_velocities.norm(dim=1) > 15
    assert known.sum() > 20 and not unknown.head.base_velocities.any()
    assert (output.head.bev.features - unknown.head.bev.features).abs().amax(1)[known].min() > 0
    model.head.loss(output.head, batch.boxes, 1.0, 0.25).terms["box"].backward()
    assert model.head.shared[0].conv.weight.grad[:, -2:].any()


def test_the_last_transition_carries_a_gradient_where_it_is_asked_for():
    model = lrs_model(OCCUPANCY).train()
    batch = frame()
    volumes = model.encode(batch)
    later = model.encode(frame(time_s=0.5), model.remember(volumes, batch))
    grad = torch.autograd.grad(later.scales[1].features.square().sum(), volumes.scales[1].features, allow_unused=True)
    assert grad[0] is not None and grad[0].any()


def test_single_frames_have_no_memory():
    model = lrs_model("model.temporal=null").eval()
    output, memory = model(frame())
    assert memory is None and model.temporal is None and len(model.decode(output)) == 2


def test_single_frames_are_not_encoded_to_remember_nothing(monkeypatch):
    model = lrs_model("model.temporal=null")
    monkeypatch.setattr(model, "encode", lambda *_: pytest.fail("encoded"))
    assert model.transition(frame(), None) is None


def test_points_outside_the_region_and_other_samples_change_nothing():
    model = lrs_model().eval()
    first = cloud(300)
    outside = torch.tensor([[200.0, 0, 0, 1, 0], [0, 0, 9.0, 1, 0], [float("nan"), 0, 0, 1, 0]])
    one = model(lidar_frame([first]))[0].volumes
    both = model(lidar_frame([torch.cat([first, outside]), cloud(200, seed=7)]))[0].volumes
    for a, b in zip(one.scales, both.scales, strict=True):
        own = b.indices[:, 0] == 0
        assert torch.equal(a.indices, b.indices[own])
        torch.testing.assert_close(a.features, b.features[own], rtol=1e-4, atol=1e-5)
    assert model(lidar_frame([outside]))[0].volumes.scales[0].features.shape[0] == 0


def test_sites_are_counted():
    model = lrs_model("model.late_encoder.max_sites=[300,300,300,300]").eval()
    values = model.diagnostics(model(frame())[0])
    assert values["sites_1"] == 300 and values["dropped_sites_1"] > 0
    assert set(values) == {f"{name}_{scale}" for name in ("sites", "dropped_sites") for scale in range(1, 5)}


def test_prepared_for_inference_it_gives_the_same():
    model = lrs_model()
    model.train()(frame())  # statistics that are not 0 and 1
    model.eval()
    prepared = prepare_for_inference(model)
    memories = [part(frame())[1] for part in (model, prepared)]
    now = frame(time_s=0.5)
    a, b = (part(now, memory)[0] for part, memory in zip((model, prepared), memories, strict=True))
    torch.testing.assert_close(a.volumes.scales[3].features, b.volumes.scales[3].features, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(a.head.logits, b.head.logits, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_occupancy_of_one_scene_is_learnt():
    """By the phase's own loss from rays alone, asked at other places along them: IoU at a threshold of a half."""
    model = lrs_model(OCCUPANCY, "model.temporal=null", "model.loss.sampling.num_queries=1024").train()
    batch = made_frame(replace(ROADS["debug"], reach_m=40.0))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 70)
    for _ in range(70):
        model.loss(model(batch)[0], batch).terms["total"].backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    asked = sample_queries(batch.rays, model.bounds, model.config.loss.sampling, torch.Generator().manual_seed(1))
    queries = torch.cat([asked.points, asked.times_s[:, None]], dim=1)
    found = model.look_up(model(batch)[0], queries, asked.batch)[0] > 0.5
    assert (found & asked.occupied).sum() / (found | asked.occupied).sum() > 0.9


def test_measured_speeds_are_an_input():
    """Unknown ones are none at all."""
    model, batch = lrs_model(OCCUPANCY, "model.temporal=null").eval(), frame((300,))
    speeds, batch = torch.full((300,), torch.nan), replace(batch, lidar_origins=torch.zeros(300, 3))
    some = torch.where(torch.arange(300) % 2 == 0, 9.0, torch.nan)
    without, unknown, known = (
        model.encode(replace(batch, lidar_speeds=value)).scales[0].features for value in (None, speeds, some)
    )
    assert torch.equal(without, unknown) and not torch.equal(without, known)
