"""The graph: too few points, features worked by hand, and what moves with the scene."""

import math

import pytest
import torch

from src.models.radargnn.graph import GraphConfig, Invariance, build_graph, pair_features
from src.targets.heatmap import CODE_SIZE


def cloud(count=40):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(count, 7, generator=generator) * torch.tensor([20.0, 20.0, 1.0, 8.0, 6.0, 6.0, 0.1])


def graph_of(points, count=4, invariance=Invariance.rigid):
    sample = torch.zeros(len(points), dtype=torch.int64)
    return build_graph(GraphConfig(num_neighbours=count, invariance=invariance), points, sample, 3)


def moved(points, angle, shift):
    """The whole scene turned about the vertical, then shifted."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s], [s, c]])
    points = points.clone()
    points[:, :2] = points[:, :2] @ turn.T + torch.tensor(shift)
    points[:, 4:6] = points[:, 4:6] @ turn.T
    return points, turn


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_for_an_edge(count):
    graph = graph_of(cloud(count))
    assert graph.neighbours.shape == (count, 4) and not graph.present.any() and not graph.edges.any()
    assert graph.axes.tolist() == [[1.0, 0.0]] * count


def test_point_pair_features_by_hand():
    """Along x, 10 m apart; the hearing point moves ahead, the heard one to the left. Then one that stands."""
    velocities, heard = torch.tensor([[4.0, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, 3.0], [-5.0, 0.0]])
    found = pair_features(velocities, heard, torch.tensor([[10.0, 0.0], [3.0, 4.0]]))
    torch.testing.assert_close(found, torch.tensor([[2.0, 0.0, 1.0, 0.0, 0.25], [1.0, 0.0, 0.0, -0.6, 0.25]]))


def test_nodes_and_edges_by_hand():
    """Three points on a line at 0, 1 and 3 m, one neighbour each."""
    points = torch.zeros(3, 7)
    points[:, 0] = torch.tensor([0.0, 1.0, 3.0])
    points[0] = torch.tensor([0.0, 0.0, 2.5, 10.0, 12.0, 16.0, 0.25])
    graph = graph_of(points, count=1)
    assert graph.neighbours.flatten().tolist() == [1, 0, 1]
    torch.testing.assert_close(graph.nodes[0], torch.tensor([0.5, 0.5, 1.0, 0.5, 1.0]))
    assert graph.nodes[:, 4].tolist() == [1.0, 2.0, 0.0]  # how many hear it
    assert graph.axes.tolist() == [[1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]]
    graph = graph_of(points, count=1, invariance=Invariance.translation)
    torch.testing.assert_close(graph.nodes[0], torch.tensor([0.5, 0.5, 0.6, 0.8, 0.5, 1.0]))
    torch.testing.assert_close(graph.edges[:, 0], torch.tensor([[0.2, 0.0], [-0.2, 0.0], [-0.4, 0.0]]))
    assert graph.axes.tolist() == [[1.0, 0.0]] * 3


def test_the_axis_is_that_of_the_nearest_point_elsewhere():
    points = torch.zeros(3, 7)
    points[2, 1] = 2.0
    assert graph_of(points, count=2).axes.tolist() == [[0.0, 1.0], [0.0, 1.0], [0.0, -1.0]]


@pytest.mark.parametrize(("invariance", "angle"), [(Invariance.rigid, 2.0), (Invariance.translation, 0.0)])
def test_features_stay_when_the_scene_moves(invariance, angle):
    points = cloud()
    there, _ = moved(points, angle, (7.0, -3.0))
    before, after = (graph_of(one, invariance=invariance) for one in (points, there))
    assert torch.equal(before.neighbours, after.neighbours)
    torch.testing.assert_close(after.nodes, before.nodes, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(after.edges, before.edges, atol=1e-4, rtol=1e-4)


def test_relative_positions_turn_with_the_scene():
    points = cloud()
    there, turn = moved(points, 2.0, (0, 0))
    before, after = (graph_of(one, invariance=Invariance.translation) for one in (points, there))
    torch.testing.assert_close(after.edges, before.edges @ turn.T, atol=1e-4, rtol=1e-4)


def test_local_codes_stay_when_scene_and_boxes_move():
    points, rows = cloud(), torch.tensor([3, 3, 17])
    codes = torch.randn(3, CODE_SIZE, generator=torch.Generator().manual_seed(1))
    there, turn = moved(points, -1.2, (7.0, -3.0))
    gone = codes.clone()
    gone[:, :2] = codes[:, :2] @ turn.T + torch.tensor([7.0, -3.0])
    for first in (6, 8):
        gone[:, first : first + 2] = codes[:, first : first + 2] @ turn.T
    before, after = graph_of(points), graph_of(there)
    torch.testing.assert_close(after.to_local(gone, rows), before.to_local(codes, rows), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(after.to_frame(before.to_local(codes, rows), rows), gone, atol=1e-4, rtol=1e-4)


def test_a_local_code_by_hand():
    """The neighbour lies to the left, so that is ahead; the box is 3 m that way and drives there, faster than seen."""
    points = torch.zeros(2, 7)
    points[1, 1] = 1.0
    points[0, 5] = 4.0
    code = torch.tensor([[0.0, 3.0, 0.7, 1.0, 2.0, 3.0, 0.0, 1.0, 0.0, 6.0]])
    found = graph_of(points, count=1).to_local(code, torch.tensor([0]))
    torch.testing.assert_close(found, torch.tensor([[3.0, 0.0, 0.7, 1.0, 2.0, 3.0, 1.0, 0.0, 2.0, 0.0]]))
