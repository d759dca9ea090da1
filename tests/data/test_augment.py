from dataclasses import replace

import numpy as np
import pytest

from src.data.augment import (
    BevAugmentationConfig,
    ImageAugmentationConfig,
    draw_bev_transform,
    draw_crop,
    frame_generator,
)
from src.errors import ConfigError

PAPER_IMAGE = ImageAugmentationConfig(resize=[-0.06, 0.11], rotation_deg=5.4, flip_probability=0.5)
PAPER_BEV = BevAugmentationConfig(scale=[0.95, 1.05], rotation_rad=0.3925, flip_probability=0.5)


def test_image_draws_fill_the_papers_ranges():
    rng = np.random.default_rng(0)
    crops = [draw_crop(PAPER_IMAGE, rng, (943, 1980), (256, 864)) for _ in range(2000)]
    resize = np.array([crop.resize for crop in crops])
    assert 0.376 < resize.min() < 0.38 and 0.54 < resize.max() < 0.547  # method 9
    turns = np.rad2deg([crop.rotation_rad for crop in crops])
    assert -5.4 <= turns.min() < -5.2 and 5.2 < turns.max() <= 5.4
    assert 0.45 < np.mean([crop.flip for crop in crops]) < 0.55
    for crop in crops:
        x, y = crop.offset_px
        assert 0 <= x <= max(0, 1980 * crop.resize - 864)
        assert abs(y + 256 - 943 * crop.resize) < 1  # bottom aligned


def test_bev_is_scale_times_rotation_times_flip():
    rng = np.random.default_rng(0)
    linear = np.array([draw_bev_transform(PAPER_BEV, rng) for _ in range(2000)])[:, :3, :3]
    scale = np.cbrt(np.abs(np.linalg.det(linear)))
    assert 0.95 <= scale.min() < 0.952 and 1.048 < scale.max() <= 1.05
    unit = linear / scale[:, None, None]
    np.testing.assert_allclose(unit @ np.swapaxes(unit, 1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(unit[:, 2], np.tile([0, 0, 1], (2000, 1)), atol=1e-12)
    mirrored = np.linalg.det(linear) < 0
    assert 0.45 < mirrored.mean() < 0.55  # one of two flips
    heading = np.arctan2(unit[:, 1, 0], unit[:, 0, 0])
    turned = np.minimum(np.abs(heading), np.pi - np.abs(heading))
    assert 0.39 < turned.max() <= 0.3925


def test_flips_come_before_the_rotation():
    config = BevAugmentationConfig(scale=[1.0, 1.0], rotation_rad=0.3, flip_probability=1.0)
    matrix = draw_bev_transform(config, np.random.default_rng(1))
    angle = np.arctan2(-matrix[1, 0], -matrix[0, 0])  # both flips are half a turn
    assert 0 < abs(angle) <= 0.3


def test_each_axis_may_have_a_probability_of_its_own():
    """The same draws as with one for both."""
    both, each, y_alone = (
        np.array(
            [
                draw_bev_transform(replace(PAPER_BEV, flip_probability=chance), frame_generator(0, 0, str(frame)))
                for frame in range(100)
            ]
        )
        for chance in (0.5, [0.5, 0.5], [0.0, 0.5])
    )
    assert np.array_equal(both, each)
    mirrored = y_alone[:, :3, :3] @ np.diag([1.0, -1.0, 1.0])
    kept = np.linalg.det(y_alone[:, :3, :3]) > 0
    unmirrored = np.where(kept[:, None, None], y_alone[:, :3, :3], mirrored)
    assert 30 < kept.sum() < 70 and (unmirrored[:, 0, 0] > 0.8).all()  # x still points ahead
    x_kept = both[:, 0, 0] > 0
    assert np.array_equal(both[x_kept], y_alone[x_kept]) and 30 < x_kept.sum() < 70


def test_generator_is_known_by_its_three_names():
    draws = {key: frame_generator(*key).integers(2**60) for key in ((0, 0, "a"), (0, 1, "a"), (1, 0, "a"), (0, 0, "b"))}
    assert len(set(draws.values())) == 4
    assert frame_generator(0, 0, "a").integers(2**60) == draws[0, 0, "a"]


@pytest.mark.parametrize(
    "make",
    [
        lambda: ImageAugmentationConfig(resize=[0.1, -0.1], rotation_deg=1, flip_probability=0),
        lambda: ImageAugmentationConfig(resize=[0.1], rotation_deg=1, flip_probability=0),
        lambda: ImageAugmentationConfig(resize=[0, 0], rotation_deg=float("nan"), flip_probability=0),
        lambda: ImageAugmentationConfig(resize=[0, 0], rotation_deg=1, flip_probability=1.5),
        lambda: BevAugmentationConfig(scale=[0.0, 1.0], rotation_rad=0, flip_probability=0),
        lambda: BevAugmentationConfig(scale=[1.0, float("nan")], rotation_rad=0, flip_probability=0),
        lambda: BevAugmentationConfig(scale=[1.0, float("inf")], rotation_rad=0, flip_probability=0),
        lambda: ImageAugmentationConfig(resize=[0, 0], rotation_deg=float("inf"), flip_probability=0),
        lambda: BevAugmentationConfig(scale=[1.0, 1.0], rotation_rad=0, flip_probability=[0.5]),
        lambda: BevAugmentationConfig(scale=[1.0, 1.0], rotation_rad=0, flip_probability=[0.0, 1.5]),
        lambda: BevAugmentationConfig(scale=[1.0, 1.0], rotation_rad=0, flip_probability="often"),
    ],
)
def test_impossible_ranges(make):
    with pytest.raises(ConfigError, match="data.augmentation"):
        make()
