"""Queries of the past: places by velocity, ego motion and augmentation, what is usable, streams, in a model."""

import io
import re

import pytest
import torch
from torch import nn

from src.errors import CheckpointError, ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction
from src.models.query_memory import MotionNorm, QueryMemory, QueryMemoryConfig, QueryPropagation
from src.models.sparc.model import SpaRCConfig
from tests.models.frames import drive, fill, pose
from tests.models.moving import bare_frame, bda
from tests.models.query_frames import small_model

WIDE = BEVGrid(cells=(200, 200), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
ADDED = re.compile(SpaRCConfig.new_in_temporal_phase)
C = 4


def make_propagation(num_frames=3, max_age_s=6.0, queries_per_frame=2, min_speed_mps=0.0):
    torch.manual_seed(0)
    sizes = {"num_frames": num_frames, "max_age_s": max_age_s, "queries_per_frame": queries_per_frame}
    return QueryPropagation(QueryMemoryConfig(**sizes, min_speed_mps=min_speed_mps), C, WIDE)


def remember(propagation, memory, batch, *queries):
    """(x, y, vx, vy, logit) of every stream alike; the features of the k-th are k + 1, k, 0 and 0."""
    b, n = len(batch), len(queries)
    codes, logits = torch.zeros(b, n, 10), torch.full((b, n, 12), -9.0)
    features = torch.zeros(b, n, C)
    for number, (x, y, vx, vy, logit) in enumerate(queries):
        codes[:, number, :3], codes[:, number, 8:] = torch.tensor([x, y, 1.0]), torch.tensor([vx, vy])
        logits[:, number, number % 12] = logit
        features[:, number, :2] = torch.tensor([number + 1.0, number])
    prediction = QueryPrediction(logits, codes, torch.ones(b, n, dtype=torch.bool))
    past = propagation.recall(memory, batch).past
    return propagation.remember(past, batch, features.requires_grad_(), prediction)


def seen(recalled, sample=0):
    """(x, y, vx, vy) of what is remembered, newest frame first."""
    queries, valid = recalled.queries, recalled.queries.valid[sample]
    rows = torch.cat([queries.centers[sample, :, :2], queries.velocities[sample]], 1)[valid]
    return [tuple(round(value, 3) + 0.0 for value in row) for row in rows.tolist()]


def test_the_best_queries_move_by_their_velocity():
    propagation = make_propagation()
    first = bare_frame(0.0, [pose()])
    memory = remember(propagation, None, first, (1, 2, 16, -4, 0.0), (5, 5, 0, 0, -2.0), (9, 9, 0, 0.5, 3.0))
    recalled = propagation.recall(memory, bare_frame(0.5, [pose()]))
    assert seen(recalled) == [(9, 9.25, 0, 0.5), (9, 0, 16, -4)]  # the best first
    assert recalled.elapsed_s[0].tolist() == [0.5, 0.5, 0, 0, 0, 0]
    assert recalled.usable.tolist() == [[True, False, False]]
    assert len(recalled.newest) == 2 and len(recalled.older) == 4
    assert recalled.queries.logits[0, 0].tolist() == pytest.approx([*[-4.6] * 2, 0.0, *[-4.6] * 9])  # 3.0 at most as 0
    assert recalled.queries.logits[0, 1, 0] == 0.0
    assert not memory.frames[0].features.requires_grad
    slow = make_propagation(min_speed_mps=1.0)
    assert seen(slow.recall(memory, bare_frame(0.5, [pose()])))[0] == (9, 9, 0, 0.5)


def test_the_vehicle_drives_and_turns():
    """8 m on, what was 20 m ahead is 12 m ahead; after a quarter turn to the left it is to the right."""
    propagation = make_propagation()
    memory = remember(propagation, None, bare_frame(0.0, [pose()]), (20, 0, 0, 0, 0.0), (20, 4, 10, 0, -1.0))
    assert seen(propagation.recall(memory, bare_frame(0.5, [pose(8.0)]))) == [(12, 0, 0, 0), (17, 4, 10, 0)]
    turned = propagation.recall(memory, bare_frame(0.5, [pose(0.0, 0.0, torch.pi / 2)]))
    assert seen(turned) == [(0, -20, 0, 0), (4, -25, 0, -10)]


@pytest.mark.parametrize(
    ("then", "now"), [(bda(), bda()), (bda(flip_y=True), bda(flip_y=True)), (bda(flip_x=True), bda(flip_y=True))]
)
def test_augmentations_are_taken_back(then, now):
    propagation = make_propagation()
    sign, after = (aug.diagonal()[:2].tolist() for aug in (then, now))
    query = (sign[0] * 10, sign[1] * 3, sign[0] * 8, sign[1] * 2, 0.0)
    memory = remember(propagation, None, bare_frame(0.0, [pose()], [then]), query)
    found = seen(propagation.recall(memory, bare_frame(0.5, [pose()], [now])))
    assert found == [(after[0] * 14, after[1] * 4, after[0] * 8, after[1] * 2)]


def test_frames_stand_behind_one_another_and_leave_at_the_end():
    propagation, memory = make_propagation(num_frames=2), None
    for step in range(3):
        memory = remember(propagation, memory, bare_frame(0.5 * step, [pose()]), (step, 0, 0, 0, 0.0))
    recalled = propagation.recall(memory, bare_frame(1.5, [pose()]))
    assert seen(recalled) == [(2, 0, 0, 0), (1, 0, 0, 0)] and recalled.usable.all()
    assert recalled.queries.valid.tolist() == [[True, False, True, False]]  # one query a frame, two places


@pytest.mark.parametrize(("elapsed_s", "metres"), [(0.0, 0.0), (-0.5, 5.0), (6.5, 5.0), (0.5, 80.0)])
def test_what_is_not_a_usable_past_is_padding_and_only_in_its_stream(elapsed_s, metres):
    propagation = make_propagation()
    memory = remember(propagation, None, bare_frame(10.0, [pose(), pose()]), (5, 5, 0, 0, 0.0))
    recalled = propagation.recall(memory, bare_frame([10.0 + elapsed_s, 10.5], [pose(metres), pose()]))
    assert recalled.usable[:, 0].tolist() == [False, True]
    assert seen(recalled, 0) == [] and seen(recalled, 1) == [(5, 5, 0, 0)]


def test_the_rule_of_half_a_second_and_what_has_left_the_grid():
    propagation, memory = make_propagation(max_age_s=0.55), None
    for step in range(2):
        frame = bare_frame(0.5 * step, [pose()])
        memory = remember(propagation, memory, frame, (0, step, 0, 0, 1.0), (79, 0, 40, 0, 0.0))
    recalled = propagation.recall(memory, bare_frame(1.0, [pose()]))
    assert seen(recalled) == [(0, 1, 0, 0)] and recalled.usable.tolist() == [[True, False, False]]


def test_streams_come_and_go_a_checkpoint_keeps_them_and_an_oracle_tells_velocities():
    propagation = make_propagation()
    memory = remember(propagation, None, bare_frame(0.0, [pose(), pose(3.0)]), (5, 5, 8, 0, 0.0))
    buffer = io.BytesIO()
    torch.save(memory.to("cpu").state(), buffer)
    buffer.seek(0)
    memory = QueryMemory.from_state(torch.load(buffer, weights_only=True))
    now = bare_frame(0.5, [pose(), pose()])
    recalled = propagation.recall(memory.select(torch.tensor([1, 0]), torch.tensor([True, False])), now)
    assert seen(recalled, 0) == [(12, 5, 8, 0)] and seen(recalled, 1) == []
    assert memory.select(torch.tensor([0, 1]), torch.tensor([False, False])).frames == ()
    told = memory.mapped(lambda frame: frame.with_velocities(lambda row, xy, v: v * 0 + row + xy.sum(1, keepdim=True)))
    recalled = propagation.recall(told, bare_frame(0.5, [pose(), pose(3.0)]))
    assert seen(recalled, 0) == [(10, 10, 10, 10)] and seen(recalled, 1) == [(10.5, 10.5, 11, 11)]


def test_a_memory_that_other_code_has_written_is_refused_by_name():
    propagation = make_propagation()
    state = remember(propagation, None, bare_frame(0.0, [pose()]), (5, 5, 8, 0, 0.0)).state()
    del state[0]["logits"]
    with pytest.raises(CheckpointError, match=r"remembers \(QueryFrame\) differs from this code's in logits.*restart"):
        QueryMemory.from_state(state)


def test_untrained_motion_is_a_plain_norm_and_trained_it_tells_ages_apart():
    torch.manual_seed(0)
    norm, x = MotionNorm(C), torch.randn(2, 3, C)
    motion = torch.randn(2, 3, 7)
    torch.testing.assert_close(norm(x, motion), nn.functional.layer_norm(x, (C,)))
    nn.init.normal_(norm.scale_shift.weight)
    scale, shift = norm.scale_shift(norm.motion(motion).relu()).chunk(2, -1)
    torch.testing.assert_close(norm(x, motion), scale * nn.functional.layer_norm(x, (C,)) + shift)
    propagation = make_propagation()
    nn.init.normal_(propagation.norm.scale_shift.weight)
    memory = remember(propagation, None, bare_frame(0.0, [pose()]), (0, 0, 0, 0, 0.0))
    soon, later = (propagation.recall(memory, bare_frame(t, [pose()])).queries.features[0, 0] for t in (0.5, 2.0))
    assert not torch.allclose(soon, later)


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="num_frames=0.*model.temporal=null"):
        make_propagation(num_frames=0)
    with pytest.raises(ConfigError, match="queries_per_frame=0"):
        make_propagation(queries_per_frame=0)
    with pytest.raises(ConfigError, match="min_speed_mps=-1"):
        make_propagation(min_speed_mps=-1.0)


# ---------------------------------------------------------------- in the model


@pytest.fixture
def pair():
    """A phase-1 model and the phase-2 model that took its weights."""
    first, second = small_model("sparc", seed=1), small_model("sparc", phase="phase2", seed=3)
    new = second.load_state_dict(first.state_dict(), strict=False)
    assert new.missing_keys and all(ADDED.match(key) for key in new.missing_keys) and not new.unexpected_keys
    return first, second


@pytest.mark.parametrize("training", [False, True])
def test_a_memory_of_nothing_leaves_phase_1(pair, training):
    first, second = (model.train(training) for model in pair)
    batch = drive(0)
    one, (two, memory) = first(batch)[0], second(batch)
    queries = one.head.logits.shape[1]
    for name in ("logits", "codes"):
        left, right = getattr(two.head, name)[:, :queries], getattr(one.head, name)
        torch.testing.assert_close(left, right, atol=1e-5, rtol=1e-5)
    assert not two.head.valid[:, queries:].any() and len(memory.frames) == 1
    terms = [model.loss(output, batch).terms["class"] for model, output in ((first, one), (second, two))]
    torch.testing.assert_close(*terms, atol=1e-4, rtol=1e-4)


def test_what_is_recalled_can_be_shown(pair):
    model = pair[1].eval()
    with torch.no_grad():
        output, _ = model(drive(3), fill(model, 3))
    shown = model.evidence(output).warped_queries
    assert len(shown.xy) == output.recalled.queries.valid[0].sum() > 0 and shown.compensated
