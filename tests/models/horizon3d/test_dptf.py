"""DPTF: which path recalls, aggregates and remembers what."""

import pytest
import torch

from src.errors import ConfigError
from src.models.horizon3d.bev_path import CellPrediction
from src.models.horizon3d.dptf import DPTF, DPTFOutput
from src.models.horizon3d.gaussian_path import VelocityFrom
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.horizon3d.splatting import GaussianSplat
from tests.gaussian_sets import gaussians_at
from tests.models.horizon3d.cells import GRID, C, bev_of
from tests.models.horizon3d.small_model import dptf_config
from tests.models.moving import bare_frame, bda, pose


@pytest.fixture
def make_parts():
    """Path switches and values -> DPTF, and a function that remembers one cell and one Gaussian of a stream."""

    def build(**changes):
        torch.manual_seed(0)
        dptf = DPTF(dptf_config(**changes), C, GRID)

        def remember(memory, batch):
            b = len(batch)
            cells = torch.stack([torch.arange(b), torch.full((b,), 40), torch.full((b,), 120)], 1)  # 47 m ahead
            fused, _ = bev_of(cells, GRID, batch_size=b)
            gaussians = gaussians_at(torch.tensor([47.0, 0.0]).expand(b, 1, 2), features=torch.zeros(b, 1, C))
            peaks = fused.sites.linear()[:, None]
            splat = GaussianSplat(None, None, peaks, torch.full((b, 1), 0.2))
            ocsf = OCSFOutput(gaussians, splat, fused, gaussians.velocities)
            velocities = torch.tensor([[0.0, -4.0]]).expand(b, 2)
            predicted = CellPrediction(torch.ones(b), velocities, velocities) if dptf.bev_path is not None else None
            past = dptf.recall(memory, batch).past
            return dptf.remember(past, batch, fused, DPTFOutput(None, None, predicted, fused), ocsf)

        return dptf, remember

    return build


def counts(warped_memory, stream):
    """(cells, Gaussians) that a stream recalls."""
    cells = int((warped_memory.warped.indices[:, 0] == stream).sum()) if warped_memory.warped is not None else None
    return cells, int(warped_memory.history.valid[stream].sum()) if warped_memory.history is not None else None


@pytest.mark.parametrize(
    ("changes", "expected", "parts", "num_frames"),
    [
        ({}, [(0, 0), (1, 1), (2, 2), (3, 2), (3, 2)], (True, True), 3),
        ({"gaussian_path": False}, [(0, None), (1, None), (2, None), (3, None), (3, None)], (True, False), 3),
        ({"bev_path": False}, [(None, 0), (None, 1), (None, 2), (None, 2), (None, 2)], (False, True), 2),
    ],
)
def test_each_path_recalls_its_own_frames_and_a_path_that_is_off_costs_nothing(
    make_parts, changes, expected, parts, num_frames
):
    dptf, remember = make_parts(**changes)
    assert dptf.config.num_frames == num_frames
    assert {name.split(".")[0] for name, _ in dptf.named_parameters()} == {
        name for name, on in zip(("bev_path", "gaussian_path"), parts, strict=True) if on
    }
    memory = None
    for step in range(5):
        batch = bare_frame(0.5 * step, [pose(2.0 * step)])
        found = dptf.recall(memory, batch)
        assert tuple(value or 0 for value in counts(found, 0)) == tuple(value or 0 for value in expected[step])
        if memory is not None:
            assert tuple(value is not None for value in counts(found, 0)) == parts
        memory = remember(memory, batch)
        assert memory.frames[0].present.all()
        assert (memory.frames[0].cells is not None, memory.frames[0].gaussians is not None) == parts
    assert len(memory.frames) == num_frames


def test_without_the_bev_path_the_head_reads_f_fuse(make_parts):
    dptf, _ = make_parts(bev_path=False)
    fused, _ = bev_of(torch.tensor([[0, 3, 3]]), GRID)
    output = dptf.aggregate(fused, dptf.recall(None, bare_frame(0.0, [pose()])))
    assert output.bev is fused and output.cells is None and output.warped is None and output.history is None


def test_what_contributes_too_little_is_not_remembered(make_parts):
    """The Gaussian of these frames contributes 0.2 to its cell."""
    for least, number in ((0.2, 1), (0.21, 0)):
        dptf, remember = make_parts(min_contribution=least)
        memory = remember(None, bare_frame(0.0, [pose()]))
        assert counts(dptf.recall(memory, bare_frame(0.5, [pose()])), 0) == (1, number)


def test_a_remembered_gaussian_may_move_as_the_cell_under_it(make_parts):
    """The cell where the Gaussian of these frames contributes most moves at (0, -4); a path alone has no such cell."""
    now = bare_frame(1.0, [pose()], [bda(torch.pi / 2)])  # the augmented axes are turned
    for changes, expected in (({}, [0.0, 0.0]), ({"velocity_from": VelocityFrom.cells}, [-4.0, 0.0])):
        stored = make_parts(**changes)[1](None, now).frames[0].gaussians
        torch.testing.assert_close(stored.velocities[stored.valid], torch.tensor([expected]), atol=1e-5, rtol=0)
    with pytest.raises(ConfigError, match="velocity_from=cells.*bev_path=null"):
        make_parts(bev_path=False, velocity_from=VelocityFrom.cells)


def test_a_frame_without_cells_remembers_what_it_has(make_parts):
    dptf, _ = make_parts(velocity_from=VelocityFrom.cells)
    fused, _ = bev_of(torch.zeros(0, 3, dtype=torch.int64), GRID)
    moving = torch.tensor([[[3.0, 1.0]]])
    gaussians = gaussians_at(torch.zeros(1, 1, 2), velocities=moving, features=torch.zeros(1, 1, C))
    ocsf = OCSFOutput(gaussians, GaussianSplat(None, None, torch.tensor([[-1]]), torch.zeros(1, 1)), fused, moving)
    cells = CellPrediction(torch.zeros(0), torch.zeros(0, 2), torch.zeros(0, 2))
    found, active = dptf.candidates(fused, DPTFOutput(None, None, cells, fused), ocsf)
    assert torch.equal(found.velocities, moving) and not active.any()


def test_neither_path_looks_past_the_age_limit(make_parts):
    dptf, remember = make_parts(max_age_s=0.55)
    memory = None
    for step in range(3):
        memory = remember(memory, bare_frame(0.5 * step, [pose()]))
    assert counts(dptf.recall(memory, bare_frame(1.5, [pose()])), 0) == (1, 1)
    assert counts(dptf.recall(memory, bare_frame(1.6, [pose()])), 0) == (0, 0)


def test_a_jump_of_the_pose_forgets_its_lane_for_good_and_no_other(make_parts):
    """The localisation is 55 m off from the third frame on: since the first frame that would be a possible drive."""
    dptf, remember = make_parts()
    places, memory = [0.0, 2.0, 59.0, 61.0, 63.0], None
    for step, place in enumerate(places):
        batch = bare_frame(0.5 * step, [pose(place), pose(2.0 * step)])
        found = dptf.recall(memory, batch)
        if step == 2:
            assert counts(found, 0) == (0, 0)
        elif step > 2:
            assert counts(found, 0) == (step - 2, step - 2)
        assert step == 0 or counts(found, 1) == (min(step, 3), min(step, 2))
        memory = remember(memory, batch)


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="min_contribution=1.0"):
        dptf_config(min_contribution=1.0)
    with pytest.raises(ConfigError, match="nothing to remember"):
        dptf_config(bev_path=False, gaussian_path=False)
    for age in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="max_age_s"):
            dptf_config(max_age_s=age)
    with pytest.raises(ConfigError, match="min_speed_mps=-1.0"):
        dptf_config(min_speed_mps=-1.0)
