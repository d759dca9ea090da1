"""Boxes, Gaussians and matching as the pictures see them."""

from __future__ import annotations

import numpy as np

from src.pictures.contents import CLASS_COLOURS, PictureBoxes, PictureGaussians, match_boxes
from src.structures.taxonomy import CLASSES


def boxes(xy: list[tuple[float, float]], labels: list[int], scores: list[float] | None = None) -> PictureBoxes:
    k = len(xy)
    return PictureBoxes(
        np.c_[np.reshape(xy, (k, 2)), np.zeros(k)], np.ones((k, 3)), np.zeros(k), np.zeros((k, 2)), labels, scores
    )


def test_every_class_has_its_own_colour() -> None:
    assert tuple(CLASS_COLOURS) == CLASSES
    assert len(set(CLASS_COLOURS.values())) == len(CLASSES)


def test_corners_of_a_turned_box() -> None:
    corners = PictureBoxes([(10, 20, 1)], [(4, 2, 2)], [np.pi / 2], [(0, 0)], [0]).corners()[0]
    # Heading +y: front left is at smaller x.
    assert np.allclose(corners[0], [9, 22, 0])
    assert np.allclose(corners[1], [11, 22, 0])
    assert np.allclose(corners[2], [11, 18, 0])
    assert np.allclose(corners[7], [9, 18, 2])


def test_ellipse_axes_follow_the_direction() -> None:
    outline = PictureGaussians([(1, 2)], [(3, 0.5)], [(0, 2)], [1.0], [0]).outlines()[0]  # along +y, not normalised
    assert np.allclose(np.ptp(outline, axis=0), [1, 6])
    assert np.allclose(outline.mean(axis=0), [1, 2])


def test_matching_is_greedy_by_score_within_class_and_two_metres() -> None:
    truth = boxes([(0, 0), (10, 0), (20, 0)], [0, 0, 1])
    predictions = boxes([(0.5, 0), (0.1, 0), (12, 0), (20, 0)], [0, 0, 0, 0], [0.9, 0.5, 0.8, 0.7])
    found, taken = match_boxes(predictions, truth)
    assert found.tolist() == [True, False, False, False]  # taken; second best; exactly 2 m; another class
    assert taken.tolist() == [True, False, False]
    assert match_boxes(PictureBoxes.empty(), truth)[1].sum() == 0
    assert match_boxes(predictions, PictureBoxes.empty())[0].sum() == 0


def test_drawable_sorts_weakest_first() -> None:
    kept = boxes([(0, 0), (1, 0), (2, 0)], [0, 1, 2], [0.9, 0.1, 0.5]).drawable(0.3)
    assert kept.labels.tolist() == [2, 0]
