"""Where queries start: peaks of the radar, keypoints of the cameras, learnt places."""

import pytest
import torch

from src.models.layers.views import CameraViews
from src.models.sparc.point_transformer import RadarPoints
from src.models.sparc.query_proposals import ProposalConfig, QueryProposals
from src.ops.sites import Sites
from src.structures.queries import UNKNOWN_LOGIT
from src.structures.sparse_bev import SparseBEV
from tests.models.frames import GRID, SIZE
from tests.models.surroundings import AXES, rigs

CELLS = ((0, 10, 10), (0, 10, 11), (0, 10, 30), (1, 20, 20))
"""Two neighbours and one apart in the first sample, one in the second."""


class Given(torch.nn.Module):
    """Stands in for the heat map."""

    def __init__(self, logits):
        super().__init__()
        self.logits = logits

    def forward(self, features):
        return self.logits


def make_scene(num_radar=3):
    torch.manual_seed(0)
    config = ProposalConfig(
        num_radar=num_radar, num_camera=4, num_learned=2, num_depth_bins=8, depth_range_m=[1.0, 20.0],
        keypoint_nms_cells=3,
    )  # fmt: skip
    proposals = QueryProposals(config, 8, 16, GRID)
    sites, _ = Sites.from_indices(torch.tensor(CELLS), (2, *GRID.cells))
    means = torch.arange(28.0).view(4, 7)
    radar = RadarPoints(SparseBEV(sites, torch.randn(4, 8)), means)
    matrices, valid = rigs(2, SIZE, AXES), torch.ones(2, 4, dtype=torch.bool)
    views = CameraViews([torch.randn(2, 4, 16, 8, 12)], matrices, valid, SIZE)
    return proposals, radar, views


def test_radar_queries_stand_at_the_peaks_and_know_what_is_measured():
    proposals, radar, views = make_scene()
    logits = torch.full((4, 12), -4.0)
    logits[0, 2], logits[1, 2], logits[2, 5], logits[3, 7] = 1.0, 0.5, 2.0, -1.0  # the second lies beside the first
    logits[1, 4] = -1.5  # a peak of another class, lower than what the first two have of theirs
    proposals.heatmap = Given(logits.requires_grad_())
    queries = proposals(radar, views).queries
    assert queries.valid[0, :3].all() and queries.valid[1, :3].tolist() == [True, False, False]
    rows = [2, 0, 1]  # best first
    assert torch.equal(queries.centers[0, :3], radar.means[rows, :3])
    assert torch.equal(queries.velocities[0, :3], radar.means[rows, 4:6])
    known = logits.detach().clone()
    known[0, 4] = known[1, 2] = UNKNOWN_LOGIT  # where the other is the better one
    assert torch.equal(queries.logits[0, :3], known[rows]) and not queries.logits.requires_grad
    torch.testing.assert_close(queries.features[0, :3], proposals.from_radar(radar.bev.features[rows]))
    assert torch.equal(queries.centers[1, 0], radar.means[3, :3])


def test_a_neighbour_of_a_peak_gives_no_query():
    proposals, radar, views = make_scene(num_radar=2)
    logits = torch.full((4, 12), -20.0)
    logits[0], logits[1], logits[2] = 1.0, 0.5, 0.0  # of all classes alike
    proposals.heatmap = Given(logits)
    queries = proposals(radar, views).queries
    assert torch.equal(queries.centers[0, :2], radar.means[[0, 2], :3])


def test_camera_and_learnt_queries_know_nothing_but_their_place():
    proposals, radar, views = make_scene()
    views.valid[1] = False
    found = proposals(radar, views)
    queries = found.queries
    assert len(queries) == 3 + 4 + 2
    assert (queries.logits[:, 3:] == UNKNOWN_LOGIT).all() and not queries.velocities[:, 3:].any()
    assert not queries.valid[1, 3:7].any() and not queries.centers[1, 3:7].any() and queries.valid[:, 7:].all()
    assert GRID.contains(queries.centers[0, 3:7][queries.valid[0, 3:7]][:, :2]).all()
    assert GRID.contains(queries.centers[:, 7:, :2]).all() and not torch.equal(*queries.centers[0, 7:, :2])


@pytest.mark.parametrize("sample", [0, 1])
def test_samples_without_radar(sample):
    proposals, radar, views = make_scene()
    rows = radar.bev.indices[:, 0] == sample
    sites, _ = Sites.from_indices(radar.bev.indices[rows], (2, *GRID.cells))
    queries = proposals(RadarPoints(SparseBEV(sites, radar.bev.features[rows]), radar.means[rows]), views).queries
    assert not queries.valid[1 - sample, :3].any() and queries.valid[sample, 0]
    assert queries.centers.isfinite().all() and queries.features.isfinite().all()
