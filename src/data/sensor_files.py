"""Files of a frame's sensors: which they are, and what could be read of them."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import TypeVar

import numpy as np

from src.data.compensation import motion_known, reached
from src.data.pcd import LidarCloud, read_lidar_points, read_radar_points
from src.data.schema import CHANNELS, DatasetIndex
from src.errors import DataError
from src.structures.taxonomy import LIDARS, RADARS

Array = np.ndarray
T = TypeVar("T")

MAX_SCAN_S = 0.3
"""Points further in time from their sweep are of another clock; a LiDAR takes 0.1 s for a sweep."""

_log = logging.getLogger(__name__)


class OnBadFile(Enum):
    """What an unreadable sensor file, or one whose ego pose no truck can have, does."""

    error = "error"
    skip = "skip"  # counted; a radar or LiDAR file gives no points, an image a masked camera


@dataclass
class Skipped:
    """What a frame does without, and the sweeps that it has read."""

    sweeps: dict[int, Array | LidarCloud | None] = field(default_factory=dict)  # by row; what a frame reads shares them
    channels: Counter[str] = field(default_factory=Counter)
    files: list[str] = field(default_factory=list)
    lost: bool = False  # the key frame's own pose is wrong, so that no annotation is where it says


def sweeps_before(index: DatasetIndex, rows: Array, count: int) -> list[int]:
    """Of each sensor the rows of `count` files that end with the given one; -1 stands for none."""
    files = []
    for row in rows.tolist():
        for _ in range(count):
            if row < 0:
                break
            files.append(row)
            row = int(index.data_previous[row])
    return files


class SensorFiles:
    """Finds and reads the sensor files of one release."""

    def __init__(self, index: DatasetIndex, on_bad_file: OnBadFile, own_times: bool) -> None:
        """`own_times`: LiDAR points are of their own times, not of their sweep's."""
        self.index, self.on_bad_file, self.own_times = index, on_bad_file, own_times
        self._root = os.path.realpath(index.root)
        self._folders: dict[str, str] = {}  # where the folders of files lead to
        self._reported: set[str] = set()

    def of_frame(self, sample: int, channels: tuple[str, ...], count: int, skipped: Skipped) -> list[int]:
        """Rows of the key frame's files and the sweeps before it of each channel, fewer at a scene's start."""
        rows = self.index.key_data[sample, [CHANNELS.index(channel) for channel in channels]]
        for channel, row in zip(channels, rows, strict=True):
            if row < 0:
                skipped.channels[f"{channel} (not recorded)"] += 1
        return sweeps_before(self.index, rows, count)

    def radar_clouds(self, sample: int, files: list[int], skipped: Skipped) -> tuple[Array, list[Array]]:
        """Rows [S] of those files that could be read, and their points: S of [n, 7] in the order of RADAR_FIELDS."""
        return self._clouds(sample, files, lambda path, row: read_radar_points(path), skipped)

    def _clouds(
        self,
        sample: int,
        files: list[int],  # rows
        read: Callable[[str, int], T],  # of the path and the row of the file
        skipped: Skipped,
    ) -> tuple[Array, list[T]]:  # [S] int64 rows of the files
        """What could be read of these files of sensors of one kind.

        A file is read once in a frame, and if it is bad counts once.
        """
        fresh = np.array([row for row in files if row not in skipped.sweeps], np.int64)
        skipped.sweeps |= dict.fromkeys(fresh.tolist())
        owners = [CHANNELS[channel] for channel in self.index.data_channels[fresh]]
        for row, channel in zip(*self.with_known_poses(sample, fresh, owners, skipped), strict=True):
            skipped.sweeps[row] = self.guarded(sample, channel, row, partial(read, row=row), skipped)
        kept = [row for row in files if skipped.sweeps[row] is not None]
        return np.array(kept, np.int64), [skipped.sweeps[row] for row in kept]

    def lidar_clouds(self, sample: int, files: list[int], skipped: Skipped) -> tuple[Array, list[LidarCloud]]:
        """Rows [S] of those files that could be read, and their points, each with its own time."""
        return self._clouds(sample, files, self._lidar_cloud, skipped)

    def _lidar_cloud(self, path: str, row: int) -> LidarCloud:
        """One file, its points' times checked against the table's."""
        cloud = read_lidar_points(path)
        stamp = int(self.index.data_times_us[row])
        if not self.own_times:
            return LidarCloud(cloud.points, np.full_like(cloud.times_us, stamp))
        away = np.abs(cloud.times_us - stamp)
        if len(away) and away.max() > 1e6 * MAX_SCAN_S:
            at = int(np.argmax(away))
            raise DataError(
                f"{path}: point {at} was measured at {cloud.times_us[at]} us, more than {MAX_SCAN_S} s from its sweep, "
                f"{stamp} us; with data.deskew_lidar=false times of points are not used"
            )
        return cloud

    def guarded(self, sample: int, channel: str, row: int, read: Callable[[str], T], skipped: Skipped) -> T | None:
        """Read a sensor file; when it cannot be, raise or count and return None, as `on_bad_file` says."""
        name = self.index.filename(row)
        try:
            return read(self._inside(name))
        except DataError as error:
            if self.on_bad_file is OnBadFile.error:
                remedy = "restore the file, or skip and count such files with data.on_bad_file=skip"
                raise DataError(f"{error} (sample {self.index.sample_tokens[sample]}); {remedy}") from error
            self._skip(channel, name, str(error), skipped)
            return None

    def with_known_poses(
        self,
        sample: int,
        rows: Array,  # [S] int64, of files
        channels: list[str],  # S
        skipped: Skipped,
    ) -> tuple[list[int], list[str]]:
        """Files that the truck can have recorded where their poses say; for others raise or count, as `on_bad_file`."""
        index, poses = self.index, self.index.data_poses[rows]
        good = reached(index, poses, index.frame_poses[sample])
        if self.on_bad_file is OnBadFile.error:
            if not good.all():
                name = index.filename(int(rows[np.argmin(good)]))
                raise DataError(
                    f"{index.root / index.version}/ego_pose.json: from the pose of {name} a truck cannot have come to "
                    f"that of its key frame, sample {index.sample_tokens[sample]}, so the table is damaged there; "
                    "unpack the release again, or skip and count such files with data.on_bad_file=skip"
                )
            return rows.tolist(), channels  # where the poses around a sweep jump `ego_motion` says so
        if set(channels) <= set(RADARS):
            good &= motion_known(index, index.data_times_us[rows])
        elif set(channels) <= set(LIDARS) and self.own_times:
            good &= motion_known(index, index.pose_times_us[poses])
        for row, channel in zip(rows[~good].tolist(), np.array(channels)[~good].tolist(), strict=True):
            name = index.filename(row)
            reason = f"the ego pose of {name} is not one that a truck can have driven to"
            self._skip(f"{channel} (ego pose)", name, reason, skipped)
        return rows[good].tolist(), np.array(channels)[good].tolist()

    def _skip(self, channel: str, name: str, reason: str, skipped: Skipped) -> None:
        """Count a file that the frame does without; the reason is told once."""
        skipped.channels[channel] += 1
        skipped.files.append(name)
        if name not in self._reported:
            self._reported.add(name)
            _log.warning("skipped: %s", reason)

    def lost(self, sample: int) -> bool:
        """Whether none of a key frame's files was recorded where a truck could have come from its pose."""
        rows = self.index.key_data[sample]
        poses = self.index.data_poses[rows[rows >= 0]]
        poses = poses[poses != self.index.frame_poses[sample]]
        return len(poses) > 0 and not reached(self.index, poses, self.index.frame_poses[sample]).any()

    def _inside(self, name: str) -> str:
        """The file's path, refused when a symbolic link leads out of the data set.

        A folder is followed once: sixty files of a frame lie in a dozen folders.
        """
        folder, _, file = name.rpartition("/")
        if folder not in self._folders:
            self._folders[folder] = os.path.realpath(os.path.join(self._root, folder))
        path = f"{self._folders[folder]}/{file}"
        if os.path.islink(path):
            path = os.path.realpath(path)
        if not path.startswith(f"{self._root}/"):
            stated = os.path.join(self._root, name)
            raise DataError(f"{stated}: leads to {path}, which is outside the dataset folder")
        return path
