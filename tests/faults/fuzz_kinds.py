"""Every kind of file that the project reads: whole examples, and a reader that also checks what came out of it."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import nn

import src.config
import src.sweep.sweep_files
from src.config import compose_config, restore_config
from src.dashboard.folders import Picture, RunFolders
from src.dashboard.single_file import _data_address
from src.data import jpeg
from src.data.cache import load_index
from src.data.evaluation_set import evaluation_set
from src.data.images import read_image, width_fit
from src.data.pcd import RADAR_FIELDS, read_lidar_points, read_radar_points
from src.data.reader import FrameReader
from src.data.schema import CHANNELS, TABLES, DatasetIndex, build_index
from src.data.sensor_files import OnBadFile
from src.data.splits import split_samples
from src.errors import CheckpointError, DataError, HorizonError
from src.metrics.submission import load_submission
from src.models.backbones.weights import BackboneName, load_backbone_weights
from src.reliability.checkpoints import load_model_weights, read_checkpoint
from src.reliability.metrics_csv import MetricsCSV
from src.report.results import publish_result, read_result
from src.report.sweep_file import RowConfig, SweepConfig, TableConfig
from src.report.sweep_record import RunState, SweepRecord, read_record, write_record
from src.sweep.run_status import read_score, read_validations
from src.sweep.sweep_files import load_sweep
from src.training.run_folder import RunFolder
from src.world.pcd_writer import LIDAR_TYPE, lidar_pcd
from src.world.write import _read_stored
from tests import finished_runs
from tests.data.tiny_set import VERSION, lidar_bytes, pcd_bytes, reader_settings, write_data_set
from tests.faults.fuzzing import Kind
from tests.faults.mutations import archive, changed_csv, changed_json, changed_yaml, damaged, either

Array = np.ndarray

SOURCE_PX = (48, 96)
FURTHEST_M = 1e5
"""Beyond it no radar sees; oracle of its own, far wider than what the reader allows."""
LARGEST = 1e9
RUN = "horizon3d-phase1-mini-0123abcd"


def check_finite(array: Array, most: float, what: str) -> None:
    assert not np.isinf(array).any() and not (np.abs(array) > most).any(), f"{what} holds {array}"


def check_text(content: Any) -> None:
    """Pages are written of it, as UTF-8."""
    json.dumps(content, ensure_ascii=False, default=str).encode()


# -------------------------------------------------------------------- images


def picture(mode: str = "RGB") -> Image.Image:
    image = Image.new("RGB", SOURCE_PX[::-1], (90, 120, 160))
    ImageDraw.Draw(image).polygon([(5, 40), (60, 4), (90, 44)], fill=(200, 60, 20))
    noise = np.random.default_rng(0).integers(0, 30, (*SOURCE_PX, 3))
    return Image.fromarray((np.asarray(image) // 2 + noise).astype(np.uint8)).convert(mode)


def jpeg_examples() -> list[bytes]:
    exif = Image.Exif()
    exif[0x010E] = "a picture"
    options: list[tuple[str, dict[str, Any]]] = [
        ("RGB", {}), ("RGB", {"quality": 95, "subsampling": 0}), ("RGB", {"progressive": True}), ("L", {}),
        ("CMYK", {}), ("RGB", {"optimize": True, "exif": exif, "icc_profile": b"p" * 400, "comment": b"c" * 90}),
        ("RGB", {"restart_marker_rows": 1}),
    ]  # fmt: skip
    examples = []
    for mode, named in options:
        buffer = io.BytesIO()
        picture(mode).save(buffer, "JPEG", **named)
        examples.append(buffer.getvalue())
    buffer = io.BytesIO()
    picture().save(buffer, "MPO", save_all=True, append_images=[picture()])
    return [*examples, buffer.getvalue()]


def read_jpeg(path: Path, chosen: list[Callable] = [jpeg._checked_decoder]) -> None:  # noqa: B006
    """By both decoders in turns, at full and at reduced size."""
    both = {True: chosen[0], False: lambda: None}
    jpeg._checked_decoder = both[path.stat().st_size % 2 == 0]
    for size_px in ((48, 96), (10, 20)):
        image = read_image(path, SOURCE_PX, width_fit(SOURCE_PX, size_px))
        assert image.shape == (3, *size_px) and image.dtype == np.uint8


# -------------------------------------------------------------------- radar


def radar_examples() -> list[bytes]:
    points = np.random.default_rng(0).normal(0, 20, (30, 7)).astype(np.float32)
    doubles = pcd_bytes(points).replace(b"SIZE" + b" 4" * 7, b"SIZE" + b" 8" * 7)
    doubles = doubles[: doubles.index(b"DATA binary\n") + 12] + points.astype("<f8").tobytes()
    order = [6, 2, 0, 1, 5, 4, 3]
    return [
        pcd_bytes(points), pcd_bytes(points, data="ascii"), pcd_bytes(points[:0]), doubles,
        pcd_bytes(points[:, order], fields=" ".join(RADAR_FIELDS[at] for at in order)),
    ]  # fmt: skip


def read_radar(path: Path) -> None:
    points = read_radar_points(path)
    assert points.shape[1:] == (7,) and points.dtype == np.float32 and len(points) <= 1_000_000
    assert not np.isnan(points).any()
    check_finite(points, FURTHEST_M, "a point")


def lidar_examples() -> list[bytes]:
    """Compressed by a compressor, in runs of literals as the synthetic world's, and not at all."""
    points = np.random.default_rng(0).normal(0, 20, (30, 4)).round().astype(np.float32)
    times = 1_695_473_000_000_000 + np.arange(30)
    table = np.rec.fromarrays([*points.T, times.astype(np.uint64)], dtype=LIDAR_TYPE)
    plain = lidar_pcd(table).partition(b"_compressed\n")[0] + b"\n" + table.tobytes()
    return [lidar_bytes(points, times), lidar_pcd(table), lidar_pcd(table[:0]), plain]


def read_lidar(path: Path) -> None:
    points, times = read_lidar_points(path)
    assert points.shape[1:] == (4,) and points.dtype == np.float32 and len(points) == len(times) <= 1_000_000
    assert times.dtype == np.int64 and ((times > 0) & (times < 1e17)).all()
    check_finite(points, 20 * FURTHEST_M, "a point")


# -------------------------------------------------------------------- tables


@functools.cache
def tiny_root() -> Path:
    """The hand-made data set; tables that are slow to read are cut to what one scene of one radar needs."""
    root = Path(tempfile.mkdtemp(prefix="tiny"))
    write_data_set(root)
    return root


def check_index(index: DatasetIndex) -> None:
    """Whether every number of the tables can be, and every link leads somewhere."""
    rows = {"sample_scenes": len(index.scene_names), "frame_poses": len(index.pose_times_us),
            "data_poses": len(index.pose_times_us), "data_calibrations": len(index.ego_from_sensor)}  # fmt: skip
    for name, count in rows.items():
        column = getattr(index, name)
        assert ((column >= 0) & (column < count)).all(), f"{name} leads nowhere"
    for name in ("key_data", "data_previous"):
        assert ((getattr(index, name) >= -1) & (getattr(index, name) < len(index.data_times_us))).all(), name
    assert ((index.data_channels >= -1) & (index.data_channels < len(CHANNELS))).all()
    for name in ("frame_times_us", "data_times_us", "pose_times_us"):
        column = getattr(index, name)
        assert ((column > 0) & (column < 1e17)).all(), f"{name} holds {column}"
    for name in ("ego_from_sensor", "pose_translations", "pose_rotations", "box_centers", "box_sizes"):
        assert not np.isnan(getattr(index, name)).any(), f"{name} holds NaN"
        check_finite(getattr(index, name), LARGEST, name)
    check_finite(index.intrinsics, LARGEST, "intrinsics")
    check_finite(index.box_velocities, 1e4, "box_velocities")
    assert (index.box_sizes > 0).all() and (np.abs(index.box_points) < 1e9).all()
    assert (index.box_points >= -2).all(), f"box_points holds {index.box_points}"
    assert index.box_starts[-1] == len(index.box_labels) and (np.diff(index.box_starts) >= 0).all()
    for name in ("sample_tokens", "scene_names", "scene_descriptions"):
        assert getattr(index, name).nbytes < 1e6, f"{name} takes {getattr(index, name).nbytes} bytes"
        "".join(getattr(index, name)).encode()
    assert index.data_filenames.nbytes < 4e6
    assert all(".." not in index.filename(row).split("/") for row in range(len(index.data_filenames)))


def use_index(index: DatasetIndex) -> None:
    """Annotations and one frame without files, as a training would read them."""
    check_index(index)
    try:
        truth = evaluation_set(index, "val").ground_truth
        frame = FrameReader(index, reader_settings(on_bad_file=OnBadFile.skip, num_sweeps=2)).read(0, None)
    except DataError as error:
        raise DataError(f"{index.root / index.version}: {error}") from error
    check_finite(truth.centers, LARGEST, "ground truth")
    for boxes in frame.boxes or ():
        assert torch.isfinite(boxes.centers).all() and torch.isfinite(boxes.yaws).all(), boxes
    assert torch.isfinite(frame.global_from_ego).all() and torch.isfinite(frame.pix_from_aug).all()


def copy_tables(folder: Path) -> None:
    shutil.copytree(tiny_root() / VERSION, folder / VERSION, dirs_exist_ok=True)
    shutil.copy(tiny_root() / "splits.json", folder)


def read_tables(path: Path) -> None:
    use_index(build_index(path.parents[1], VERSION))


def table_kind(name: str) -> Kind:
    return Kind(
        name=f"table {name}", examples=[(tiny_root() / VERSION / f"{name}.json").read_bytes()],
        mutate=either(changed_json), read=read_tables, place=f"{VERSION}/{name}.json", prepare=copy_tables,
    )  # fmt: skip


def read_splits(path: Path) -> None:
    index = build_index_once(path.parent)
    assert set(split_samples(index, "train").tolist()) <= {0, 1, 2, 3, 4, 5}


@functools.cache
def build_index_once(folder: Path) -> DatasetIndex:
    return build_index(folder, VERSION)


def read_world(path: Path) -> None:
    assert isinstance(_read_stored(path.parent), dict)


def prepare_world(folder: Path) -> None:
    copy_tables(folder)
    for name in TABLES:
        (folder / VERSION / f"{name}.json").touch()


@functools.cache
def cache_file() -> tuple[str, bytes]:
    """Name and content of the table cache of a data set at one fixed place."""
    with tempfile.TemporaryDirectory() as folder:
        load_index(tiny_root(), VERSION, folder)
        (path,) = Path(folder).glob("*.npz")
        return path.name, path.read_bytes()


def read_cache(path: Path) -> None:
    """Broken caches are built again, so nothing is ever refused; what comes out is the data set either way."""
    index = load_index(tiny_root(), VERSION, path.parent)
    check_index(index)
    assert index.root == tiny_root() and len(index) == 6
    with suppress(DataError):  # poses that move too fast, and the like: another fault than those of files
        frame = FrameReader(index, reader_settings(on_bad_file=OnBadFile.skip, num_sweeps=2)).read(0, None)
        assert torch.isfinite(frame.radar_points).all()


# -------------------------------------------------------------------- checkpoints


class Toy(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv, self.norm = nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4)


@functools.cache
def plain_tree() -> dict[str, Any]:
    return compose_config(["scale=debug"])[1]


def checkpoint_content() -> dict[str, Any]:
    torch.manual_seed(0)
    state = {f"model.{name}": value for name, value in Toy().state_dict().items()}
    about = {"config": plain_tree(), "ranks": [{"means": {"loss/total": [1.0, 2.0]}}]}
    return {"epoch": 1, "global_step": 8, "pytorch-lightning_version": "2.6.6", "state_dict": state,
            "loops": {"fit_loop": {"state_dict": {}}}, "horizon3d": about}  # fmt: skip


def saved(content: Any, **options: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


def check_weights(module: nn.Module) -> None:
    """Any finite number can be a weight: a foreign one looks like any other."""
    for name, value in module.state_dict().items():
        assert torch.isfinite(value).all(), f"{name} is not finite"


def read_weights(path: Path) -> None:
    content = read_checkpoint(path)
    module = Toy()
    load_model_weights(module, content, path)
    check_weights(module)


def read_backbone(path: Path) -> None:
    module = nn.ModuleDict({"stem": nn.Conv2d(3, 4, 3), "layer1": nn.BatchNorm2d(4)})
    load_backbone_weights(module, path, BackboneName.small)
    check_weights(module)


def backbone_examples() -> list[bytes]:
    torch.manual_seed(0)
    module = nn.ModuleDict({"stem": nn.Conv2d(3, 4, 3), "layer1": nn.BatchNorm2d(4)})
    state = dict(module.state_dict())
    return [saved(state), saved({"state_dict": state}), saved(state, _use_new_zipfile_serialization=False)]


def compose_once() -> None:
    """Composing conf/ takes a third of a second; the same choices always give the same tree."""
    plain = src.config.compose_tree
    known: dict[tuple[str, ...], Any] = {}
    src.config.compose_tree = lambda overrides: (
        known.setdefault(tuple(overrides), plain(overrides))
        if tuple(overrides) not in known
        else known[tuple(overrides)]
    )


def restore(path: Path) -> None:
    """The configuration of a checkpoint, here as the JSON that stands for its plain values."""
    try:
        stored = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    if not isinstance(stored, dict):  # read_checkpoint has refused these
        raise CheckpointError(f"{path}: no configuration")
    try:
        config = restore_config(stored, [])
    except HorizonError as error:
        raise CheckpointError(f"{path}: {error}") from error
    assert config.seed >= 0 and config.data.batch_size >= 1


# -------------------------------------------------------------------- submissions

TOKENS = [f"{at:032x}" for at in range(6)]


def submission_example() -> bytes:
    box = {"translation": [10.0, 2.0, 1.0], "size": [1.9, 4.6, 1.6], "rotation": [1.0, 0.0, 0.0, 0.1],
           "velocity": [3.0, None], "detection_name": "car", "detection_score": 0.5,
           "attribute_name": "vehicle.moving", "num_pts": 3}  # fmt: skip
    results = {token: [{"sample_token": token} | box] * (at % 3) for at, token in enumerate(TOKENS)}
    return json.dumps({"meta": {"use_camera": True}, "results": results}).encode()


def read_submission(path: Path) -> None:
    table = load_submission(path, TOKENS)
    assert len(table) and (table.sizes > 0).all() and np.isfinite(table.scores).all()
    for name in ("centers", "sizes", "rotations", "velocities"):
        check_finite(getattr(table, name), LARGEST, name)


# -------------------------------------------------------------------- runs and their results


def run_files() -> dict[str, bytes]:
    record = finished_runs.run_json(
        RUN, 0, overrides=["scale=mini", "phase=phase1"], skipped_files={"RADAR_LEFT_FRONT": 3},
        skipped_names={"samples/a.pcd": 3},
    )  # fmt: skip
    metrics = finished_runs.metrics_json(0.5, ranges=["50-100"], speeds=["0-0.5"])
    config = {"model": {"name": "horizon3d", "ocsf": {"margin_m": 4.8}}, "phase": {"name": "phase1"}, "seed": 0,
              "data": {"root": "/data", "version": "v1"}, "paths": {"outputs": "o"}, "out": None}  # fmt: skip
    latency = {"ms": {"whole": 12.0}, "fps": 80.0, "memory_gb": 0.1, "spread_ms": {"whole": 0.1}, "load": 0.2}
    texts = finished_runs.run_files(record, metrics, config) | {"latency.json": json.dumps(latency)}
    return {name: text.encode() for name, text in texts.items()}


RUN_FILES = run_files()


def write_run(folder: Path) -> None:
    (folder / RUN).mkdir(exist_ok=True)
    for name, content in RUN_FILES.items():
        (folder / RUN / name).write_bytes(content)


def read_run(path: Path) -> None:
    """As the report, the sweep runner, the dashboard and a resumed training read a run's folder."""
    folder, outputs = path.parent, path.parents[1]
    for name in ("mAP", "NDS", "classes.car.AP", "ranges.50-100.mAP"):
        score = read_score(folder, name)
        assert score is None or np.isfinite(score)
    assert all(np.isfinite(value) for value in read_validations(folder, "mAP").values())
    folders = RunFolders(outputs)
    assert isinstance(folders.config(RUN), dict)
    assert all(np.isfinite(points).all() for points in folders.curves(RUN).values())
    refused: list[HorizonError] = []
    readers: list[Callable[[], Any]] = [
        RunFolder(outputs, RUN).read_result,
        lambda: MetricsCSV(folder / "metrics.csv", resume_step=5).rows,
        lambda: read_result(publish_result(folder, outputs / "reports")),
    ]
    for reader in readers:
        try:
            result = reader()
        except HorizonError as error:
            refused.append(error)
    if refused:
        raise refused[-1]
    assert all(value is None or abs(value) <= 1e16 for value in result.metrics.values())


def run_kind(name: str, change: Callable) -> Kind:
    return Kind(name=name, examples=[RUN_FILES[name]], mutate=either(change), read=read_run,
                place=f"{RUN}/{name}", prepare=write_run)  # fmt: skip


@functools.cache
def result_example() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_run(Path(folder))
        return publish_result(Path(folder) / RUN, Path(folder)).read_bytes()


def read_published(path: Path) -> None:
    result = read_result(path)
    assert all(value is None or abs(value) <= 1e16 for value in result.metrics.values())
    for points in result.curves.values():
        assert not points or np.abs(np.array(points, dtype=float)).max() <= 1e16
    assert len(result.settings) <= len(result.overrides) and isinstance(result.dataset, str)
    check_text(vars(result))


# -------------------------------------------------------------------- sweeps


@functools.cache
def record_example() -> bytes:
    rows = [RowConfig(label="a", paper={"mAP": 20.0}), RowConfig(label="b", overrides=["model.ocsf.margin_m=1"], x=1.0)]
    sweep = SweepConfig(title="t", question="q", name="epsilon", rows=rows, baseline="a",
                        tables=[TableConfig(name="table12", title="T", columns=["mAP", "NDS"])])  # fmt: skip
    names = {row: f"horizon3d-phase1-mini-{row}" for row in "ab"}
    state = {"overrides": ["seed=0"], "seed": 0, "state": "done", "started": 1e9, "ended": 1.1e9}
    runs = {name: RunState(run_id=name, label=row, **state) for row, name in names.items()}
    rows_of = {row: {0: name} for row, name in names.items()}
    record = SweepRecord(sweep=sweep, scale="mini", command="c", seeds=[0], study="s", storage="sqlite:///x.db",
                         rows=rows_of, runs=runs, updated=1e9)  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "epsilon_mini.json"
        write_record(path, record)
        return path.read_bytes()


def read_sweep_record(path: Path) -> None:
    record = read_record(path)
    assert record.stem == path.stem and 0 <= record.planned < 1e9
    check_text(dataclasses.asdict(record))
    for moment in (record.updated, *(run.started for run in record.runs.values())):
        assert moment is None or time.localtime(moment)


def sweep_examples() -> list[bytes]:
    folder = Path(__file__).resolve().parents[2] / "sweeps"
    return [(folder / f"{name}.yaml").read_bytes() for name in ("epsilon", "components", "tune")]


def use_sweeps_of(folder: Path) -> None:
    src.sweep.sweep_files.SWEEPS = folder


def read_sweep_file(path: Path) -> None:
    sweep = load_sweep(path.stem)
    assert sweep.name == path.stem and bool(sweep.rows) != bool(sweep.space)
    assert all(np.isfinite(value) for row in sweep.rows for value in row.paper.values())
    assert all(isinstance(override, str) for row in sweep.rows for override in row.overrides)


# -------------------------------------------------------------------- pictures of the dashboard


def png_example() -> bytes:
    buffer = io.BytesIO()
    picture().save(buffer, "PNG")
    return buffer.getvalue()


def prepare_pictures(folder: Path) -> None:
    write_run(folder)
    (folder / RUN / "pictures").mkdir(exist_ok=True)


def read_pictures(path: Path) -> None:
    for found in RunFolders(path.parents[2]).pictures(RUN):
        assert isinstance(found, Picture) and 0 <= found.width < 2**32
        address = _data_address(found)
        assert address is None or address.startswith("data:image/jpeg;base64,")


# -------------------------------------------------------------------- all of them


def kinds() -> list[Kind]:
    """Every kind, with its whole examples."""
    name, cache = cache_file()
    plain = [
        Kind(name="JPEG image", examples=jpeg_examples(), mutate=damaged, read=read_jpeg, place="image.jpg"),
        Kind(name="radar PCD", examples=radar_examples(), mutate=damaged, read=read_radar, place="radar.pcd"),
        Kind(name="lidar PCD", examples=lidar_examples(), mutate=damaged, read=read_lidar, place="lidar.pcd"),
        *(table_kind(table) for table in TABLES),
        Kind(
            name="splits.json", examples=[(tiny_root() / "splits.json").read_bytes()], mutate=either(changed_json),
            read=read_splits, place="splits.json", prepare=copy_tables,
        ),
        Kind(
            name="world.json", examples=[json.dumps(plain_tree()["data"]["world"]).encode()],
            mutate=either(changed_json), read=read_world, place="world.json", prepare=prepare_world,
        ),
        Kind(name="table cache", examples=[cache], mutate=archive, read=read_cache, place=name),
        Kind(
            name="checkpoint", examples=[saved(checkpoint_content())], mutate=archive, read=read_weights,
            place="last.ckpt",
        ),
        Kind(
            name="checkpoint's configuration", examples=[json.dumps(plain_tree()).encode()],
            mutate=either(changed_json), read=restore, place="tree.json",
            prepare=lambda _: compose_once(),
        ),
        Kind(
            name="backbone weights", examples=backbone_examples(),
            mutate=lambda rng, content, others: (archive if content[:2] == b"PK" else damaged)(rng, content, others),
            read=read_backbone, place="backbone.pth",
        ),
        Kind(
            name="submission", examples=[submission_example()], mutate=either(changed_json), read=read_submission,
            place="submission.json",
        ),
        run_kind("run.json", changed_json), run_kind("metrics.json", changed_json),
        run_kind("latency.json", changed_json), run_kind("config.yaml", changed_yaml),
        run_kind("metrics.csv", changed_csv),
        Kind(
            name="result", examples=[result_example()], mutate=either(changed_json), read=read_published,
            place=f"{RUN}.json",
        ),
        Kind(
            name="sweep record", examples=[record_example()], mutate=either(changed_json), read=read_sweep_record,
            place="epsilon_mini.json",
        ),
        Kind(
            name="sweep file", examples=sweep_examples(), mutate=either(changed_yaml), read=read_sweep_file,
            place="mine.yaml", prepare=use_sweeps_of,
        ),
        Kind(
            name="dashboard picture", examples=[png_example()], mutate=damaged, read=read_pictures,
            place=f"{RUN}/pictures/frame_0.png", prepare=prepare_pictures,
        ),
    ]  # fmt: skip
    return plain


def strangers(of: list[Kind]) -> list[bytes]:
    """A file of every kind."""
    return [kind.examples[0] for kind in of]
