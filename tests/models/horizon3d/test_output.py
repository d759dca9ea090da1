"""What measures and pictures read of a batch: whose cells these are, and what the head sees."""

import torch

from src.models.horizon3d.dptf import DPTFOutput
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.horizon3d.output import Horizon3DOutput
from src.models.horizon3d.splatting import splat_set
from tests.gaussian_sets import gaussians_at
from tests.models.horizon3d.cells import TINY, bev_of
from tests.models.horizon3d.small_model import dptf_config

CELLS = torch.tensor([[[0, 2], [4, 4]], [[3, 5], [1, 0]]])  # (row, col) of two Gaussians a sample
FUSED = torch.tensor([[0, 4, 1], [1, 2, 0]])
FOUND = torch.tensor([[0, 1, 3], [1, 0, 5], [1, 4, 2]])


def output_of(dptf=None):
    """Narrow Gaussians; the last of each sample is padding, or too faint to open its cell."""
    faint = torch.logit(torch.tensor([[0.9, 0.9], [0.9, 0.05]]))
    valid = torch.tensor([[True, False], [True, True]])
    gaussians = gaussians_at(
        TINY.centre_of(CELLS), scales=torch.full((2, 2, 2), 0.2), opacity_logits=faint, valid=valid
    )
    fused, _ = bev_of(FUSED, TINY, batch_size=2)
    ocsf = OCSFOutput(gaussians, splat_set(gaussians, TINY, 0.1, 100, 3.0), fused, gaussians.velocities)
    return Horizon3DOutput(fused, None, None, ocsf, fused, dptf, None)


def test_cells_of_the_splat_are_those_of_their_sample(make_config):
    found = output_of().evidence(make_config(), TINY)
    assert found.cells.grid == TINY and found.cells.indices.tolist() == [[0, 0, 2], [1, 1, 0], [1, 3, 5]]
    assert found.cells.occupied.tolist() == [True, False, True]
    torch.testing.assert_close(found.cells.occupancy, torch.tensor([0.9, 0.05, 0.9]))
    assert found.gaussians.valid.tolist() == [[True, False], [True, True]]


def test_the_head_sees_the_fused_map_and_with_a_memory_what_that_makes_of_it(make_config):
    single = output_of().evidence(make_config(), TINY)
    assert single.head_cells.grid == TINY and single.head_cells.indices.tolist() == FUSED.tolist()
    assert single.warped_gaussians is None and single.warped_cells is None
    out, _ = bev_of(FOUND, TINY, batch_size=2)
    temporal = output_of(DPTFOutput(None, None, None, out)).evidence(make_config(dptf=dptf_config()), TINY)
    assert temporal.head_cells.indices.tolist() == FOUND.tolist()
    assert temporal.cells.indices.tolist() == single.cells.indices.tolist()
    assert len(temporal.warped_gaussians.xy) == len(temporal.warped_cells.xy) == 0  # nothing is remembered yet
