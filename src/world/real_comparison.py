"""A data set's figures beside those known of MAN TruckScenes: one table for each of `real_statistics.yaml`, and one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from src.metrics.diagnostics import FAST_MPS, SEEN_POINTS, SEEN_S, seen_before
from src.structures.taxonomy import CLASS_RANGE_M, RADARS
from src.world.dataset_statistics import DatasetCounts

Array = np.ndarray
Cell = tuple[float, int | None]
"""A figure, and the number of boxes that it rests on where that is known."""
Rows = dict[str, dict[str, Cell]]

REAL_STATISTICS = Path(__file__).with_name("real_statistics.yaml")
FEWEST_BOXES = 50
"""A real figure that rests on fewer boxes says little."""
HEAVY = ("truck", "bus", "trailer")


@dataclass(kw_only=True)
class FigureTable:
    """One table: rows of figures of the world and, where there are any, of the real data."""

    name: str
    title: str
    unit: str
    sources: list[str]
    trust: str
    world: Rows
    real: Rows
    allowed: float | None = None
    allowed_heavy: float | None = None

    def groups(self) -> list[str]:
        """Names of the rows, those of the real data first."""
        return list(dict.fromkeys([*self.real, *self.world]))

    def columns(self) -> list[str]:
        """Names of the columns in order of distance or as they first appear."""
        found = dict.fromkeys(name for rows in (self.real, self.world) for row in rows.values() for name in row)
        return sorted(found, key=_first_number)

    def allowed_for(self, group: str) -> float | None:
        """By how much the world may differ from the real data in this row; None for no limit."""
        return self.allowed_heavy if group in HEAVY and self.allowed_heavy is not None else self.allowed

    def compared(self) -> int:
        """How many cells rest on 50 real boxes or more."""
        return sum(
            (cell[1] or 0) >= FEWEST_BOXES and column in self.world.get(group, {})
            for group, row in self.real.items()
            for column, cell in row.items()
        )

    def beyond(self) -> list[tuple[str, str, float, float]]:
        """Row, column, world and real of the cells on 50 real boxes or more that differ by more than is allowed."""
        return [
            (group, column, self.world[group][column][0], cell[0])
            for group, row in self.real.items()
            for column, cell in row.items()
            if self.allowed_for(group) is not None
            and (cell[1] or 0) >= FEWEST_BOXES
            and column in self.world.get(group, {})
            and abs(self.world[group][column][0] - cell[0]) > self.allowed_for(group)
        ]


def _first_number(name: str) -> float:
    head = name.split("-")[0].rstrip("+")
    return float(head) if head.isdigit() else -1.0


def compare(counts: DatasetCounts, num_sweeps: int) -> list[FigureTable]:
    """Every table of the real data beside the same of this data set, then those that only it has."""
    known = yaml.safe_load(REAL_STATISTICS.read_text(encoding="utf-8"))
    ours = _Tables(counts, num_sweeps)
    tables = []
    for name, table in known.items():
        real = {group: {column: _cell(cell) for column, cell in row.items()} for group, row in table["rows"].items()}
        bands = list(dict.fromkeys(column for row in real.values() for column in row))
        tables.append(
            FigureTable(
                name=name,
                title=table["title"],
                unit=table["unit"],
                sources=table["source"],
                trust=table["trust"],
                world=ours.rows(name, list(real), bands),
                real=real,
                allowed=table.get("allowed"),
                allowed_heavy=table.get("allowed_heavy"),
            )
        )
    return [*tables, ours.remembered()]


def _cell(value: float | list[float]) -> Cell:
    return (float(value[0]), int(value[1])) if isinstance(value, list) else (float(value), None)


@dataclass
class _Tables:
    """The tables of one data set. One that is no plain share of boxes is a method of its name, which takes the real
    rows' and columns' names."""

    counts: DatasetCounts
    num_sweeps: int
    everything: str = field(default="this data set", init=False)

    def rows(self, name: str, groups: list[str], columns: list[str]) -> Rows:
        """A table, with the rows and columns that the real data have."""
        radar, grown, levels = self.counts.radar, self.counts.radar_grown, self.counts.levels
        shares: dict[str, tuple[Array, Array | bool]] = {  # which boxes are counted, and among which
            "support": (radar >= 1, True),
            "support_of_three": (radar >= 3, True),
            "support_grown": (grown >= 1, True),
            "hidden": (levels == 1, True),
            "clear": (levels == 4, True),
            "support_of_hidden": (radar >= 1, levels == 1),
            "support_of_clear": (radar >= 1, levels == 4),
            "highway": (radar >= 1, True),
        }
        if name in shares:
            hit, among = shares[name]
            return self._shares(hit, groups, columns, among)
        return getattr(self, name)(groups, columns)

    # ---------------------------------------------------------------- shares of boxes by class and distance

    def areas(self, groups: list[str], bands: list[str]) -> Rows:
        return {self.everything: self._shares(self.counts.radar >= 1, ["all"], bands)["all"]}

    def weather(self, groups: list[str], bands: list[str]) -> Rows:
        tags = self.counts.descriptions[self.counts.frames]
        rows = {}
        for group in groups:
            name, weather = group.split(", ")
            among = np.array([f"weather.{weather}" in tag for tag in tags], bool)
            rows |= {group: self._shares(self.counts.radar >= 1, [name], bands, among)[name]}
        return rows

    def beyond_150(self, groups: list[str], columns: list[str]) -> Rows:
        halves = {"front half": self.counts.ahead, "rear half": ~self.counts.ahead}
        far, hit = self._band("150+"), self.counts.radar >= 1
        return {name: {"share": _share(hit[far & half])} for name, half in halves.items() if (far & half).any()}

    def lidar_support(self, groups: list[str], columns: list[str]) -> Rows:
        return {"all": {"share": _share(self.counts.lidar >= 1)}}

    def _shares(self, hit: Array, groups: list[str], bands: list[str], among: Array | bool = True) -> Rows:
        """Percentage of boxes that are hit by class and distance, where there is a box."""
        chosen = {(group, band): self._of(group) & self._band(band) & among for group in groups for band in bands}
        return {
            group: {band: _share(hit[chosen[group, band]]) for band in bands if chosen[group, band].any()}
            for group in groups
        }

    def _of(self, group: str) -> Array:
        return np.full(len(self.counts.classes), True) if group == "all" else self.counts.classes == group

    def _band(self, name: str) -> Array:
        return _between(self.counts.distance_m, name)

    # ---------------------------------------------------------------- points

    def points_per_box(self, groups: list[str], columns: list[str]) -> Rows:
        return {band: self._spread(self.counts.radar[self._band(band)]) for band in groups}

    def points_per_grown_box(self, groups: list[str], columns: list[str]) -> Rows:
        return {band: self._spread(self.counts.radar_grown[self._band(band)]) for band in groups}

    def points_per_far_box(self, groups: list[str], columns: list[str]) -> Rows:
        rows = {}
        for group in groups:
            name, band = group.split(", ")
            row = self._spread(self.counts.radar[self._of(name) & self._band(band)])
            rows[group] = {column: cell for column, cell in row.items() if column in columns}
        return rows

    @staticmethod
    def _spread(points: Array) -> dict[str, Cell]:
        if not len(points):
            return {}
        row = _quantiles(points, (25, 50, 75, 90))
        shares = {f">={least} %": (100.0 * float(np.mean(points >= least)), None) for least in (1, 3, 5)}
        return row | shares | {"boxes": (float(len(points)), None)}

    def points_per_frame(self, groups: list[str], columns: list[str]) -> Rows:
        points = self.counts.points
        rest = {"mean": (float(points.mean()), None), "frames": (float(len(points)), None)}
        return {self.everything: _quantiles(points, (5, 25, 50, 75, 95)) | rest}

    def points_per_sweep(self, groups: list[str], columns: list[str]) -> Rows:
        return {name: self._of_radar(name) for name in groups}

    def _of_radar(self, name: str) -> dict[str, Cell]:
        span = self.counts.range_m if name == "all six" else self.counts.range_m[self._points_of(name)]
        if not len(span):
            return {}
        bands = ("0-25", "25-50", "50-100", "100-150", "150-190")
        row = {"points": (len(span) / len(self.counts.points), None)}
        row |= {f"{band} m %": (100.0 * float(_between(span, band).mean()), None) for band in bands}
        return row | {"farthest m": (float(span.max()), None)}

    def _points_of(self, radar: str) -> Array:
        return self.counts.channels == RADARS.index(radar)

    def ranges(self, groups: list[str], columns: list[str]) -> Rows:
        edges = np.append(np.array(columns, dtype=float), float(columns[-1]) + 5.0)
        found, _ = np.histogram(self.counts.range_m, edges)
        shares = 100.0 * found / max(1, len(self.counts.range_m))
        return {"all six": {column: (float(share), None) for column, share in zip(columns, shares, strict=True)}}

    def points_by_range(self, groups: list[str], columns: list[str]) -> Rows:
        planar = self.counts.planar_m
        return {"all": {band: (100.0 * float(_between(planar, band).mean()), None) for band in columns}}

    def points_on_boxes(self, groups: list[str], columns: list[str]) -> Rows:
        share = 100.0 * float(self.counts.radar.sum()) / max(1, int(self.counts.points.sum()))
        return {"all": {"share": (share, None)}}

    def lidar(self, groups: list[str], columns: list[str]) -> Rows:
        rows: Rows = {}
        for group in groups:
            chosen = {band: self._of(group) & self._band(band) for band in columns}
            rows[group] = {
                band: (float(np.median(self.counts.lidar[of])), int(of.sum()))
                for band, of in chosen.items()
                if of.any()
            }
        return rows

    def one_sweep(self, groups: list[str], columns: list[str]) -> Rows:
        first = self._points_of("RADAR_LEFT_FRONT")
        values = {"range m": self.counts.range_m, "RCS dB": self.counts.rcs_db}
        values |= {"elevation deg": np.degrees(self.counts.elevation_rad)}
        return {name: _quantiles(values[name][first], (10, 50, 90)) for name in groups if first.any()}

    # ---------------------------------------------------------------- boxes, tracks, the truck

    def boxes(self, groups: list[str], columns: list[str]) -> Rows:
        distance, frames = self.counts.distance_m, len(self.counts.points)
        row = {"per frame": (len(distance) / frames, None)}
        for column in columns:
            if column.endswith(" %"):
                row[column] = (100.0 * float(_between(distance, column.removesuffix(" %")).mean()), None)
        return {self.everything: row}

    def tracks(self, groups: list[str], columns: list[str]) -> Rows:
        per_instance = len(self.counts.instances) / max(1, len(np.unique(self.counts.instances)))
        per_scene = len(self.counts.scenes) / len(np.unique(self.counts.scenes))
        return {self.everything: {"per instance": (per_instance, None), "per scene": (per_scene, None)}}

    def runs(self, groups: list[str], columns: list[str]) -> Rows:
        points = {"": self.counts.radar, ", grown": self.counts.radar_grown}
        tests = {f"radar >= {least}{name}": of >= least for name, of in points.items() for least in (1, 3)}
        return {name: self._runs(tests[name]) for name in groups}

    def _runs(self, hit: Array) -> dict[str, Cell]:
        """Mean length of runs of key frames without a gap in which a box is hit; tracks with a run of three."""
        order = np.lexsort((self.counts.frames, self.counts.instances))
        owner, frame, hit = self.counts.instances[order], self.counts.frames[order], hit[order]
        goes_on = np.append(False, (np.diff(owner) == 0) & (np.diff(frame) == 1) & hit[1:] & hit[:-1])
        run = np.cumsum(hit & ~goes_on)[hit] - 1
        if not len(run):
            return {}
        lengths = np.bincount(run)
        long = np.unique(owner[hit][lengths[run] >= 3])
        share = 100.0 * len(long) / len(np.unique(owner))
        return {"mean run": (float(lengths.mean()), None), "tracks with three in a row %": (share, None)}

    def ego(self, groups: list[str], columns: list[str]) -> Rows:
        speed = 3.6 * self.counts.ego_speed_mps[np.isfinite(self.counts.ego_speed_mps)]
        clock = self.counts.times_s + 1e6 * self.counts.scenes  # scenes one after the other
        steps = np.minimum(np.searchsorted(clock, clock + 2.99), len(clock) - 1)
        within = (self.counts.scenes[steps] == self.counts.scenes) & (
            np.abs(self.counts.times_s[steps] - self.counts.times_s - 3.0) < 0.1
        )
        turn = self.counts.ego_yaw_rad[steps] - self.counts.ego_yaw_rad
        turn = np.degrees(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))[within]
        rows: Rows = {}
        if len(speed):
            rows["speed"] = {"p50": (float(np.median(speed)), None), "mean": (float(speed.mean()), None)}
        if len(turn):
            rows["change of heading in 3 s"] = _quantiles(turn, (50, 90))
        return rows

    def authors_frames(self, groups: list[str], columns: list[str]) -> Rows:
        """Distances, speeds and number of boxes, of the classes that the authors' frames hold."""
        of = np.isin(self.counts.classes, ("car", "truck", "trailer", "traffic_sign", "animal"))
        speed, distance = self.counts.speed_mps[of], self.counts.distance_m[of]
        cars = self.counts.speed_mps[self.counts.classes == "car"]
        return {
            "distance of boxes m": _quantiles(distance, (25, 50, 75)),
            "speed of boxes m/s": _quantiles(speed, (25, 50, 75)) | {"max": (float(speed.max(initial=0)), None)},
            "speed of cars m/s": _quantiles(cars, (25, 50, 75)),
            "boxes": {"per frame": (len(speed) / len(self.counts.points), None)},
            "boxes above 10 m/s": {"share %": (100.0 * float(np.mean(speed > FAST_MPS)), None)},
        }

    def remembered(self) -> FigureTable:
        """Moving boxes within their class's range that the accumulated radar hardly or no longer shows."""
        limit = np.array([CLASS_RANGE_M.get(name, 0.0) for name in self.counts.classes])
        movers = (self.counts.speed_mps > FAST_MPS) & (self.counts.distance_m < limit)
        points = self.counts.accumulated
        rows: Rows = {}
        for least in (SEEN_POINTS, 1):
            few = points < least
            seen = seen_before(points >= least, self.counts.instances, self.counts.times_s[self.counts.frames])
            rows[f"fewer than {least} points"] = {
                "now %": _share(few[movers]),
                f"seen with {least} in the last {SEEN_S:.0f} s %": _share((few & seen)[movers]),
            }
        return FigureTable(
            name="remembered",
            title=f"Boxes above {FAST_MPS:g} m/s by their radar points in {self.num_sweeps} sweeps",
            unit="percent of those boxes",
            sources=[],
            trust="",
            world=rows,
            real={},
        )


def _between(values: Array, band: str) -> Array:
    """Which values lie in "low-high" or "low+", the lower bound included."""
    low, _, high = band.rstrip("+").partition("-")
    return (values >= float(low)) & (values < (float(high) if high else np.inf))


def _share(hit: Array) -> Cell:
    return (100.0 * float(np.mean(hit)) if len(hit) else 0.0, len(hit))


def _quantiles(values: Array, percents: tuple[int, ...]) -> dict[str, Cell]:
    found = np.percentile(values, percents) if len(values) else np.full(len(percents), np.nan)
    return {f"p{percent}": (float(value), None) for percent, value in zip(percents, found, strict=True)}
