"""What the four cameras see of a scene: geometry, light, air and the camera's own faults."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.world import small_shapes, vehicle_shapes
from src.world.conditions import Conditions
from src.world.mesh import Colour, Mesh, MeshMaker
from src.world.placement import Actor
from src.world.raster import draw_quads
from src.world.rig import Mount
from src.world.scenery import Scenery
from src.world.simulate import Scene

Array = np.ndarray

VIEW_M = 250.0
HEADLIGHT_M = 45.0
SHADE: Colour = (34, 35, 38)


def actor_mesh(actor: Actor) -> Mesh:
    """The mesh of one actor, in its own axes above the middle of its box's underside."""
    maker, shapes = MeshMaker(), vars(small_shapes) | vars(vehicle_shapes)
    shapes[f"add_{actor.kind.shape}"](maker, actor, *(actor.size * [0.5, 0.5, 1.0]))
    return maker.mesh()


@dataclass(kw_only=True)
class Photo:
    """One image with what it shows of every actor."""

    rgb: Array  # [H, W, 3] uint8
    own_pixels: Array  # [N] pixels that each actor would fill alone
    seen_pixels: Array  # [N] pixels that it does fill


class Studio:
    """Renders one scene; meshes, the skyline and the film grain are prepared once."""

    def __init__(self, scene: Scene, scenery: Scenery, width: int, height: int, rng: np.random.Generator) -> None:
        self.scene, self.scenery, self.width, self.height = scene, scenery, width, height
        self.meshes = [actor_mesh(actor) for actor in scene.actors]
        self.floors = scene.floors
        bearing = np.linspace(-np.pi, np.pi, 1441)
        waves = sum(rng.uniform(0.2, 1.0) * np.sin(k * bearing + rng.uniform(0, 6.28)) / k for k in range(2, 9))
        trees = np.repeat(rng.uniform(-1, 1, 721), 2)[:1441]
        self.skyline = 0.012 + 0.010 * (waves - waves.min()) + 0.004 * trees
        self.grain = (scene.conditions.noise * rng.standard_normal((height + 64, width + 64, 3))).astype(np.float32)
        sun = np.array([np.cos(scene.conditions.sun_azimuth_rad), np.sin(scene.conditions.sun_azimuth_rad), 0.9])
        self.sun = sun / np.linalg.norm(sun)

    def _stage(self, time_s: float, ego_xyz: Array) -> tuple[Mesh, Array, Array]:
        """All quads within view in local coordinates, with their layers and the number of the actor (-1: scenery)."""
        positions, _, headings = self.scene.tracks.state(time_s)
        near = np.flatnonzero(np.hypot(*(positions - ego_xyz)[:, :2].T) < VIEW_M)
        ego_s = float(self.scene.ego.tracks.road_state(time_s)[0][0])
        kept = np.flatnonzero(np.abs(self.scenery.s - ego_s) < VIEW_M + 20)
        parts, layers, groups = [self.scenery.mesh[kept]], [self.scenery.layer[kept]], [np.full(len(kept), -1)]
        for n in near:
            placed = self.meshes[n].moved(positions[n] + [0.0, 0.0, self.floors[n]], float(headings[n]))
            parts.append(placed)
            layers.append(np.ones(len(placed)))
            groups.append(np.full(len(placed), n))
            if self.floors[n] == 0:
                parts.append(_shadow(self.scene.actors[n].size).moved(positions[n], float(headings[n])))
                layers.append(np.full(1, 1.012))
                groups.append(np.full(1, -1))
        return Mesh.join(parts), np.concatenate(layers), np.concatenate(groups)

    def photograph(self, mount: Mount, time_s: float, rng: np.random.Generator) -> Photo:
        """The image of one camera of the ego truck."""
        rotation, translation = self.scene.ego.pose(time_s)
        mesh, layer, group = self._stage(time_s, translation)
        local_from_cam = rotation @ mount.rotation
        origin = rotation @ mount.translation + translation
        corners = (mesh.corners - origin) @ local_from_cam
        drawn = draw_quads(corners, mesh.open, layer, group, len(self.meshes), mount.intrinsic, self.width, self.height)
        lit = self._light(mesh, corners, mount)
        background = self._sky(mount.intrinsic, local_from_cam)
        shown = np.flatnonzero(drawn.quad >= 0)
        conditions = self.scene.conditions
        haze = 1.0 - np.exp(-drawn.depth_m[shown].astype(np.float32) / np.float32(conditions.sight_m))
        haze *= np.where(mesh.glows[drawn.quad[shown]], 0.5, 1.0)
        air = np.array(conditions.sky_low, dtype=np.float32)
        colour = lit[drawn.quad[shown]]
        background[shown] = colour + haze[:, None].astype(np.float32) * (air - colour)
        image = self._develop(background.reshape(self.height, self.width, 3), conditions, rng)
        return Photo(rgb=image, own_pixels=drawn.own_pixels, seen_pixels=drawn.seen_pixels)

    def _light(self, mesh: Mesh, corners: Array, mount: Mount) -> Array:
        """Colour of every quad under this light, [Q, 3] float32."""
        conditions = self.scene.conditions
        normals = np.cross(mesh.corners[:, 2] - mesh.corners[:, 0], mesh.corners[:, 3] - mesh.corners[:, 1])
        length = np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
        facing = normals @ self.sun / length
        facing = np.where(mesh.open, np.abs(facing), np.maximum(facing, 0.0))
        light = conditions.ambient * (0.82 + 0.18 * np.abs(normals[:, 2]) / length) + conditions.sun * facing
        if conditions.night:
            middle = corners.mean(1)
            distance = np.linalg.norm(middle, axis=1)
            beam = 1.0 if "FRONT" in mount.channel else 0.18
            light = light + beam * 0.85 * np.exp(-distance / HEADLIGHT_M)
        light = np.where(mesh.glows, 1.0 if conditions.night or conditions.rain else 0.85, light)
        return np.minimum(mesh.colours * light[:, None], 255.0).astype(np.float32)

    def _sky(self, intrinsic: Array, local_from_cam: Array) -> Array:
        """Sky above the skyline, distant land below it, [H * W, 3] float32."""
        conditions = self.scene.conditions
        x = (np.arange(self.width) + 0.5 - intrinsic[0, 2]) / intrinsic[0, 0]
        y = (np.arange(self.height) + 0.5 - intrinsic[1, 2]) / intrinsic[1, 1]
        # Upward component of each pixel's ray over its length on the ground: the tangent of its elevation.
        across = local_from_cam[:2, 0:1] * x + local_from_cam[:2, 2:3]
        rise = (local_from_cam[2, 0] * x + local_from_cam[2, 2] + local_from_cam[2, 1] * y[:, None]) / np.linalg.norm(
            across, axis=0
        )
        rise = rise.astype(np.float32)
        height = np.clip(rise / np.float32(0.55), 0.0, 1.0)[..., None]
        low, high = (np.array(colour, dtype=np.float32) for colour in (conditions.sky_low, conditions.sky_high))
        sky = low + height * (high - low)
        bearing = np.arctan2(across[1], across[0])
        ridge = np.interp(bearing, np.linspace(-np.pi, np.pi, 1441), self.skyline)
        light = conditions.ambient + 0.3 * conditions.sun
        veil = np.float32(np.exp(-280.0 / conditions.sight_m))
        land = low + veil * (np.array([72, 92, 60], dtype=np.float32) * light - low)
        return np.where((rise < ridge)[..., None], land, sky).reshape(-1, 3)

    def _develop(self, image: Array, conditions: Conditions, rng: np.random.Generator) -> Array:
        """Exposure, rain and grain; back to bytes."""
        if conditions.rain:
            for x, y in zip(rng.integers(0, self.width, 90), rng.integers(0, self.height - 9, 90), strict=True):
                image[y : y + int(rng.integers(4, 9)), x] += 22.0
        dy, dx = rng.integers(0, 64, 2)
        image = image * np.float32(rng.uniform(0.93, 1.07)) + self.grain[dy : dy + self.height, dx : dx + self.width]
        return np.clip(image, 0, 255).astype(np.uint8)


def _shadow(size: Array) -> Mesh:
    half_l, half_w = 0.52 * size[0], 0.56 * size[1]
    maker = MeshMaker()
    maker.quad(
        [(-half_l, -half_w, 0.03), (half_l, -half_w, 0.03), (half_l, half_w, 0.03), (-half_l, half_w, 0.03)], SHADE
    )
    return maker.mesh()
