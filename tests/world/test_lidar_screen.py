"""The ray-cast lidars."""

from dataclasses import replace

import numpy as np
import pytest

from src.world.lidar import Lidars
from src.world.scene_writer import SceneWriter


def test_the_screen_on_the_median_hides_what_is_far_on_the_other_side(make_config, tmp_path):
    config = make_config(screened_fraction=1.0, lidar=True, lidar_step_deg=0.4)
    writer = SceneWriter(config, 0, tmp_path)
    mount, scene = writer.rig["LIDAR_LEFT"], writer.scene
    rotation, translation = scene.ego.pose(0.0)
    line, heading = scene.road.xy, scene.road.heading_rad

    def across_and_ahead(screen_m):
        """Where the points lie by the nearest metre of the centre line, and how far from the truck along it."""
        scanned = replace(scene, road=replace(scene.road, screen_m=screen_m))
        cloud = Lidars(config, scanned, [mount], np.random.default_rng(0)).sweep(0.0, 0)["LIDAR_LEFT"]
        points = np.stack([cloud["x"], cloud["y"], cloud["z"]], 1)
        local = (points @ mount.rotation.T + mount.translation) @ rotation.T + translation
        offset = local[:, None, :2] - line[None, 600:1200]
        nearest = np.argmin((offset**2).sum(-1), 1)
        aside = offset[np.arange(len(local)), nearest]
        yaw = heading[600 + nearest]
        ahead = np.hypot(*(local - translation)[:, :2].T)
        return np.cos(yaw) * aside[:, 1] - np.sin(yaw) * aside[:, 0], ahead

    own = float(scene.ego.tracks.road_state(0.0)[2][0])
    (across, ahead), (bare_across, bare_ahead) = across_and_ahead(3.5), across_and_ahead(0.0)

    def beyond(least, most):
        """Points beyond the median without and with the screen, by the slant of their rays (along over across)."""
        return [
            ((d > 3.0) & (x > least * (d - own)) & (x < most * (d - own))).sum()
            for d, x in ((bare_across, bare_ahead), (across, ahead))
        ]

    slanting_bare, slanting = beyond(6.0, np.inf)  # a slat of 0.36 m every 2 m shuts out slants above 5.6
    straight_bare, straight = beyond(0.0, 1.5)
    assert slanting_bare > 30 and slanting < 0.2 * slanting_bare
    assert straight_bare > 100 and straight > 0.7 * straight_bare
    assert (across < -1.0).sum() == pytest.approx((bare_across < -1.0).sum(), rel=0.01)
