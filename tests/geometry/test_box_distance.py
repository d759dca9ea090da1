"""Distances to rotated boxes and points inside them, by hand."""

import math

import torch

from src.geometry.box_distance import count_points_in_boxes, footprint_distances

BOXES = torch.tensor([[10.0, 0.0, 4.0, 2.0, 0.0], [0.0, 5.0, 4.0, 2.0, math.pi / 2]])


def test_distances_to_sides_and_corners():
    points = torch.tensor([[12.0, 1.0], [13.0, 0.0], [15.0, 5.0], [0.0, 8.0], [2.0, 5.0]])
    expected = torch.tensor([[0.0, math.hypot(11, 2)], [1.0, math.hypot(12, 3)], [5.0, 14.0], [math.hypot(8, 7), 1.0]])
    distances = footprint_distances(points, BOXES)
    torch.testing.assert_close(distances[:4], expected)
    torch.testing.assert_close(distances[4, 1], torch.tensor(1.0))
    assert footprint_distances(points, BOXES[:0]).shape == (5, 0)


def test_points_in_boxes_are_counted_by_height_too():
    heights = torch.tensor([[0.0, 2.0], [-1.0, 1.0]])
    points = torch.tensor([[10.0, 0.0, 0.0], [12.0, 1.0, 2.0], [10.0, 0.0, 2.1], [0.5, 6.5, 0.0], [1.1, 5.0, 0.0]])
    assert count_points_in_boxes(points, BOXES, heights).tolist() == [2, 1]
    assert count_points_in_boxes(points, BOXES, heights, chunk=2).tolist() == [2, 1]
    assert count_points_in_boxes(points[:0], BOXES, heights).tolist() == [0, 0]
