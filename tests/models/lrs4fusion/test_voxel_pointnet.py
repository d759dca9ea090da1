import torch

from src.geometry.voxel_grid import VoxelGrid
from src.models.lrs4fusion.voxel_pointnet import VoxelPointNet
from tests.models.lrs4fusion.lrs_frames import cloud

GRID = VoxelGrid((-4.0, -2.0, -1.0), (4.0, 2.0, 1.0), (1.0, 0.5, 0.5), num_levels=1)


def features_of(points, speeds=None, batch=None):
    """The ten features, where a layer passes them on and a second copy of them with the other sign."""
    net = VoxelPointNet(20, GRID, eps=0.0, momentum=0.1).eval()
    net.linear.weight.data = torch.cat([torch.eye(10), -torch.eye(10)])
    batch = torch.zeros(len(points), dtype=torch.int64) if batch is None else batch
    out = net(points, batch, 2, speeds)
    return out, out.features[:, :10], -out.features[:, 10:]  # largest positive part, smallest negative part


def test_the_ten_features_by_hand():
    """Two points in the voxel (z, row, col) = (2, 4, 5): centre (1.5, 0.25, 0.25), mean (1.4, 0.2, 0.25)."""
    points = torch.tensor([[1.2, 0.1, 0.2, 40.0, 0.1], [1.6, 0.3, 0.3, 20.0, 0.0]])
    out, high, low = features_of(points, torch.tensor([5.0, torch.nan]))
    assert out.indices.tolist() == [[0, 2, 4, 5]]
    centre_1, centre_2 = [-0.3, -0.3, -0.1], [0.1, 0.1, 0.1]  # in voxels
    mean_2 = [0.2, 0.2, 0.1]
    torch.testing.assert_close(high, torch.tensor([[*centre_2, *mean_2, 0.4, 0.2, 0.25, 1.0]]))
    torch.testing.assert_close(low, torch.tensor([[*centre_1, *(-value for value in mean_2), 0, 0, 0, 0]]).float())


def test_points_outside_are_left_out_and_samples_do_not_mix():
    inside = torch.tensor([[0.5, 0.1, 0.1, 1.0, 0.0], [0.5, 0.1, 0.1, 9.0, 0.0]])
    outside = torch.tensor([[4.0, 0.0, 0.0, 80.0, 0.0], [0.5, 0.1, -1.01, 80.0, 0.0], [torch.nan, 0, 0, 80.0, 0]])
    out, high, _ = features_of(torch.cat([inside, outside]), batch=torch.tensor([0, 1, 0, 0, 1]))
    assert out.indices.tolist() == [[0, 2, 4, 4], [1, 2, 4, 4]]
    torch.testing.assert_close(high[:, 6], torch.tensor([0.01, 0.09]))


def test_any_number_of_points_in_any_order():
    net = VoxelPointNet(8, GRID, eps=1e-3, momentum=0.1).eval()
    points = cloud(400, spread_m=2.0)
    batch = torch.zeros(400, dtype=torch.int64)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(net(points, batch, 1).features, net(points[order], batch, 1).features)


def test_an_empty_cloud_keeps_its_parameters_in_the_graph():
    net = VoxelPointNet(8, GRID, eps=1e-3, momentum=0.1).train()
    out = net(torch.zeros(0, 5), torch.zeros(0, dtype=torch.int64), 2)
    assert out.features.shape == (0, 8) and out.sites.shape == (2, 4, 8, 8)
    out.features.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in net.parameters())
