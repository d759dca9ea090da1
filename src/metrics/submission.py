"""The official submission file: read it with every fault named, write it whole or not at all."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path

import numpy as np

from src.errors import DataError
from src.geometry.transforms import matrix_to_quaternion
from src.metrics.checks import LARGEST, SMALLEST_ROTATION, check_predictions
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.structures.taxonomy import ATTRIBUTES, CLASSES, MAX_BOXES_PER_SAMPLE

META_FLAGS = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external", "use_future_frames", "use_tta")
META_TEXTS = ("method_name", "authors", "affiliation", "description", "code_url", "paper_url")

_LABELS = {name: row for row, name in enumerate(CLASSES)}
_ATTRIBUTES = {name: row for row, name in enumerate(ATTRIBUTES)} | {"": -1}
_WIDTHS = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2}
_NUMBERS = {int, float}

Array = np.ndarray


def load_submission(path: Path | str, tokens: Sequence[str]) -> DetectionTable:
    """Read a submission for the samples `tokens`; rows keep the file's order, which decides ties.

    Refused are all files that the official evaluator refuses, and some that it accepts by oversight, because their
    score would mean something else than their author believes or depend on what happens to match: numbers written as
    strings, infinities and numbers beyond 1e9, negative or missing scores, sizes that are not positive, a rotation of
    all zeros, and a `sample_token` that differs from the sample the box is listed under. A velocity may be NaN or null
    (unknown); scores above 1, attributes of another class and unknown extra fields are accepted, and a `num_pts` of 0
    drops the box, as officially.

    Raises DataError naming file, sample, box index and field, with what was found and what was expected.
    """
    results = _read_results(Path(path))
    _check_samples(Path(path), results, tokens)
    try:
        table = _columns(results, tokens)
    except (KeyError, TypeError, ValueError, OverflowError):
        table = None
    if table is not None:
        try:
            check_predictions(table, tokens)
            return table
        except DataError:
            pass  # said again below, with the box's place in the file
    for token, boxes in results.items():
        for index, box in enumerate(boxes):
            fault = _fault_of(token, box)
            if fault:
                raise DataError(f"{path}: sample {token}, box {index}: {fault}")
    raise DataError(f"{path}: the boxes are not in the submission format")


def _read_results(path: Path) -> dict[str, list[object]]:
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: must be an object with 'meta' and 'results', but got {_short(content)}")
    for name in ("results", "meta"):
        if not isinstance(content.get(name), dict):
            found = _short(content[name]) if name in content else "nothing"
            raise DataError(f"{path}: '{name}' must be an object, but got {found}")
    return content["results"]


def _check_samples(path: Path, results: dict[str, list[object]], tokens: Sequence[str]) -> None:
    missing = [token for token in tokens if token not in results]
    known = set(tokens)
    unknown = [token for token in results if token not in known]
    if missing or unknown:
        parts = [
            f"{len(names)} {kind} (the first is {names[0]!r})"
            for kind, names in (("missing", missing), ("not in the split", unknown))
            if names
        ]
        raise DataError(
            f"{path}: the samples must be exactly the {len(tokens)} of the split, but got {len(results)}: "
            f"{', '.join(parts)}"
        )
    for token, boxes in results.items():
        if not isinstance(boxes, list):
            raise DataError(f"{path}: sample {token}: must be a list of boxes, but got {_short(boxes)}")
        if len(boxes) > MAX_BOXES_PER_SAMPLE:
            raise DataError(
                f"{path}: sample {token}: at most {MAX_BOXES_PER_SAMPLE} boxes are allowed, but got {len(boxes)}"
            )
    if not any(results.values()):
        raise DataError(f"{path}: no sample has a box; the official evaluator refuses such a file")


def _columns(results: dict[str, list[dict]], tokens: Sequence[str]) -> DetectionTable | None:
    """All boxes at once, checked column by column; None, or the exception of a conversion, where one is wrong."""
    boxes = list(chain.from_iterable(results.values()))
    counts = [len(of_sample) for of_sample in results.values()]
    if list(map(itemgetter("sample_token"), boxes)) != list(
        chain.from_iterable([token] * count for token, count in zip(results, counts, strict=True))
    ):
        return None
    arrays = {}
    for name, width in _WIDTHS.items():
        values = list(map(itemgetter(name), boxes))
        flat = list(chain.from_iterable(values))
        allowed = _NUMBERS | {type(None)} if name == "velocity" else _NUMBERS
        if set(map(type, values)) != {list} or set(map(len, values)) != {width} or not set(map(type, flat)) <= allowed:
            return None
        arrays[name] = np.array(flat, dtype=np.float64).reshape(-1, width)  # None becomes NaN
    scores = list(map(itemgetter("detection_score"), boxes))
    points = [box.get("num_pts", -1) for box in boxes]
    if not set(map(type, scores)) <= _NUMBERS or not set(map(type, points)) <= _NUMBERS:
        return None
    index_of = {token: row for row, token in enumerate(tokens)}
    return DetectionTable(
        samples=np.repeat(np.array([index_of[token] for token in results]), counts),
        labels=np.array([_LABELS[box["detection_name"]] for box in boxes]),
        centers=arrays["translation"],
        sizes=arrays["size"],
        rotations=arrays["rotation"],
        velocities=arrays["velocity"],
        attributes=np.array([_ATTRIBUTES[box["attribute_name"]] for box in boxes]),
        scores=np.array(scores, dtype=np.float64),
        num_points=np.array([int(value) for value in points], dtype=np.int64),
    )


def _fault_of(token: str, box: object) -> str | None:
    """What is wrong with one box of the file, or None."""
    if not isinstance(box, dict):
        return f"must be an object, but got {_short(box)}"
    for name in ("sample_token", *_WIDTHS, "detection_name", "detection_score", "attribute_name"):
        if name not in box:
            return f"'{name}' is missing"
    if box["sample_token"] != token:
        return f"'sample_token' must be the sample it is listed under, but got {_short(box['sample_token'])}"
    for name, width in _WIDTHS.items():
        values = box[name]
        if not isinstance(values, list) or len(values) != width:
            return f"'{name}' must be a list of {width} numbers, but got {_short(values)}"
        for value in values:
            unknown = name == "velocity" and (value is None or _is_nan(value))
            if not unknown and not _is_finite(value):
                return f"'{name}' must hold finite numbers of at most {LARGEST:g} in size, but got {_short(value)}"
    if min(box["size"]) <= 0:
        return f"'size' must be positive, but got {_short(box['size'])}"
    if max(map(abs, box["rotation"])) < SMALLEST_ROTATION:
        return f"'rotation' must be a quaternion (w, x, y, z), but got {_short(box['rotation'])}"
    for name, known in (("detection_name", _LABELS), ("attribute_name", _ATTRIBUTES)):
        if not isinstance(box[name], str) or box[name] not in known:
            names = ", ".join(key or "'' (none)" for key in known)
            return f"'{name}' must be one of {names}, but got {_short(box[name])}"
    if not _is_finite(box["detection_score"]) or box["detection_score"] < 0:
        return f"'detection_score' must be a finite number of at least 0, but got {_short(box['detection_score'])}"
    if "num_pts" in box and not (_is_finite(box["num_pts"]) and abs(box["num_pts"]) < 2**63):
        return f"'num_pts' must be a number of points, but got {_short(box['num_pts'])}"
    return None


def _is_finite(value: object) -> bool:
    if type(value) not in _NUMBERS:
        return False
    return abs(value) <= LARGEST  # False for NaN; exact for integers beyond every float


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _short(value: object) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def write_submission(
    path: Path | str,
    tokens: Sequence[str],
    table: DetectionTable,
    meta: Mapping[str, bool | str],
) -> None:
    """Write predictions as a submission that the official evaluator accepts; numbers keep their full precision.

    `meta` may leave out entries: a flag is then False, a text empty. Samples stand in the order of `tokens`, one a
    line, boxes of a sample in the order of `table`. The file appears complete under its name or not at all.

    Raises DataError for predictions that `check_predictions` refuses, when there is no box at all, for an unknown or
    mistyped entry of `meta`, or when the file cannot be written.
    """
    check_predictions(table, tokens)
    if not len(table):
        raise DataError(f"{path}: no sample has a box; the official evaluator refuses such a submission")
    lines = (
        f"{json.dumps(token)}: {json.dumps(rows)}"
        for token, rows in zip(tokens, submission_rows(tokens, table), strict=True)
    )
    head = f'{{"meta": {json.dumps(_complete_meta(meta))},\n"results": {{\n'
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "w", encoding="utf-8") as file:
            file.write(head)
            for row, line in enumerate(lines):
                file.write((",\n" if row else "") + line)
            file.write("\n}}\n")
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise DataError(f"{path}: cannot be written ({error.strerror})") from error


def submission_rows(tokens: Sequence[str], table: DetectionTable) -> Iterator[list[dict[str, object]]]:
    """The boxes of each sample as the file states them, sample after sample in the order of `tokens`."""
    order = np.argsort(table.samples, kind="stable")
    bounds = np.searchsorted(table.samples[order], np.arange(len(tokens) + 1))
    names = (*_WIDTHS, "detection_name", "detection_score", "attribute_name")
    for sample, token in enumerate(tokens):
        boxes = table[order[bounds[sample] : bounds[sample + 1]]]
        columns = (
            boxes.centers.tolist(),
            boxes.sizes.tolist(),
            boxes.rotations.tolist(),
            boxes.velocities.tolist(),
            [CLASSES[label] for label in boxes.labels],
            boxes.scores.tolist(),
            [ATTRIBUTES[attribute] if attribute >= 0 else "" for attribute in boxes.attributes],
        )
        yield [{"sample_token": token} | dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def _complete_meta(meta: Mapping[str, bool | str]) -> dict[str, bool | str]:
    complete: dict[str, bool | str] = {name: False for name in META_FLAGS} | {name: "" for name in META_TEXTS}
    for name, value in meta.items():
        if name not in complete:
            raise DataError(f"meta: unknown entry {name!r}; it may hold {', '.join(complete)}")
        if type(value) is not type(complete[name]):
            raise DataError(f"meta.{name} must be {type(complete[name]).__name__}, but got {_short(value)}")
    return complete | dict(meta)


def to_global(
    boxes: Boxes3D,
    global_from_ego: Array,  # [4, 4] float64 rotation and translation
    sample: int,
) -> DetectionTable:
    """Boxes of one sample, given in its ego frame, as rows of a table in the global frame.

    All arithmetic is float64; a box keeps its heading within the ego's ground plane, tilted with the ego. Boxes
    without scores get 0, without point counts -1.
    """
    values = {name: getattr(boxes, name) for name in ("centers", "sizes", "yaws", "velocities", "scores", "num_points")}
    columns = {name: None if v is None else v.detach().cpu().double().numpy() for name, v in values.items()}
    rotation, position = global_from_ego[:3, :3].astype(np.float64), global_from_ego[:3, 3].astype(np.float64)
    n = len(boxes)
    cosine, sine = np.cos(columns["yaws"]), np.sin(columns["yaws"])
    turns = np.zeros((n, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = cosine
    turns[:, 0, 1], turns[:, 1, 0] = -sine, sine
    turns[:, 2, 2] = 1.0
    return DetectionTable(
        samples=np.full(n, sample, dtype=np.int64),
        labels=boxes.labels.cpu().numpy().astype(np.int64),
        centers=columns["centers"] @ rotation.T + position,
        sizes=columns["sizes"][:, [1, 0, 2]],
        rotations=matrix_to_quaternion(rotation @ turns),
        velocities=columns["velocities"] @ rotation[:2, :2].T,
        attributes=boxes.attributes.cpu().numpy().astype(np.int64),
        scores=np.zeros(n) if columns["scores"] is None else columns["scores"],
        num_points=np.full(n, -1, dtype=np.int64)
        if columns["num_points"] is None
        else columns["num_points"].astype(np.int64),
    )
