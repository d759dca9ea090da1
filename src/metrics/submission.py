"""The official submission file: read it with every fault named, write it whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

import numpy as np
import torch
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from src.errors import DataError
from src.files.atomic_write import replacing
from src.geometry.transforms import invert_rigid, matrix_to_quaternion, quaternion_to_matrix, rotation_zyx, yaw_of
from src.metrics.checks import LARGEST, SMALLEST_ROTATION, check_predictions
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.structures.taxonomy import ATTRIBUTES, CLASSES, MAX_BOXES_PER_SAMPLE

EMPTY_META: dict[str, bool | str] = {
    **dict.fromkeys(("use_camera", "use_lidar", "use_radar", "use_map", "use_external", "use_future_frames"), False),
    "use_tta": False,
    **dict.fromkeys(("method_name", "authors", "affiliation", "description", "code_url", "paper_url"), ""),
}

_LABELS = {name: row for row, name in enumerate(CLASSES)}
_ATTRIBUTES = {name: row for row, name in enumerate(ATTRIBUTES)} | {"": -1}
MAX_FAULTS = 10_000
"""More wrong samples than these are only counted: naming them takes much memory."""
_WIDTHS = {"translation": 3, "size": 3, "rotation": 4, "velocity": 2}

Array = np.ndarray


def _not_all_zero(values: list[float]) -> list[float]:
    if max(map(abs, values)) < SMALLEST_ROTATION:
        raise ValueError
    return values


def _bounded_or_unknown(values: list[float | None]) -> list[float | None]:
    if any(value is not None and abs(value) > LARGEST for value in values):
        raise ValueError
    return values


_Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]  # refuses NaN too
_Length = Annotated[float, Field(gt=0, le=LARGEST)]


@with_config(ConfigDict(strict=True))
class _Box(TypedDict):
    """One box; further fields do not matter."""

    sample_token: str
    translation: Annotated[list[_Number], Field(min_length=3, max_length=3)]
    size: Annotated[list[_Length], Field(min_length=3, max_length=3)]
    rotation: Annotated[list[_Number], Field(min_length=4, max_length=4), AfterValidator(_not_all_zero)]
    velocity: Annotated[list[float | None], Field(min_length=2, max_length=2), AfterValidator(_bounded_or_unknown)]
    detection_name: Literal[CLASSES]
    detection_score: Annotated[float, Field(ge=0, le=LARGEST)]
    attribute_name: Literal[(*ATTRIBUTES, "")]
    num_pts: NotRequired[_Number]


@with_config(ConfigDict(strict=True))
class _Submission(TypedDict):
    meta: dict[str, Any]
    results: dict[str, Annotated[list[_Box], Field(max_length=MAX_BOXES_PER_SAMPLE, fail_fast=True)]]


_SUBMISSION = TypeAdapter(_Submission)
_EXPECTED = {
    "sample_token": "the sample it is listed under",
    "translation": f"a list of 3 finite numbers of at most {LARGEST:g} in size",
    "size": f"a list of 3 positive numbers of at most {LARGEST:g}",
    "rotation": f"a quaternion (w, x, y, z), not all 0, of finite numbers of at most {LARGEST:g} in size",
    "velocity": f"a list of 2 numbers of at most {LARGEST:g} in size, NaN or null where unknown",
    "detection_name": f"one of {', '.join(CLASSES)}",
    "detection_score": f"a finite number of at least 0 and at most {LARGEST:g}",
    "attribute_name": f"one of {', '.join(ATTRIBUTES)}, '' (none)",
    "num_pts": "a number of points",
}


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
    try:
        results = _SUBMISSION.validate_json(Path(path).read_bytes())["results"]
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise DataError(f"{path}: {_first_fault(error)}") from None
    _check_samples(Path(path), results, tokens)
    boxes = list(chain.from_iterable(results.values()))

    def column(name: str) -> list[Any]:
        return list(map(itemgetter(name), boxes))

    arrays = {  # None becomes NaN
        name: np.array(list(chain.from_iterable(column(name))), dtype=np.float64).reshape(-1, width)
        for name, width in _WIDTHS.items()
    }
    index_of = {token: row for row, token in enumerate(tokens)}
    return DetectionTable(
        samples=np.array([index_of[token] for token in column("sample_token")]),
        labels=np.array([_LABELS[name] for name in column("detection_name")]),
        centers=arrays["translation"],
        sizes=arrays["size"],
        rotations=arrays["rotation"],
        velocities=arrays["velocity"],
        attributes=np.array([_ATTRIBUTES[name] for name in column("attribute_name")]),
        scores=np.array(column("detection_score")),
        num_points=np.array([int(box.get("num_pts", -1)) for box in boxes]),
    )


def _first_fault(error: ValidationError) -> str:
    if error.error_count() > MAX_FAULTS:
        return f"{error.error_count()} samples are not lists of boxes"
    fault = error.errors(include_url=False, include_context=False)[0]
    part, token, box, field, *_ = (*fault["loc"], None, None, None, None)
    found = "nothing" if fault["type"] == "missing" else _short(fault["input"])
    if fault["type"] == "json_invalid":
        return f"not valid JSON: {fault['msg'].removeprefix('Invalid JSON: ')}"
    if part is None:
        return f"must be an object with 'meta' and 'results', but got {found}"
    if token is None:
        return f"'{part}' must be an object, but got {found}"
    if fault["type"] == "too_long" and box is None:
        most = f"at most {MAX_BOXES_PER_SAMPLE} boxes are allowed"
        return f"sample {token}: {most}, but got {len(fault['input'])}"
    if box is None:
        return f"sample {token}: must be a list of boxes, but got {found}"
    if field is None:
        return f"sample {token}, box {box}: must be an object, but got {found}"
    wrong = "is missing" if fault["type"] == "missing" else f"must be {_EXPECTED[field]}, but got {found}"
    return f"sample {token}, box {box}: '{field}' {wrong}"


def _check_samples(path: Path, results: dict[str, list[_Box]], tokens: Sequence[str]) -> None:
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
        for index, box in enumerate(boxes):
            if box["sample_token"] != token:
                wrong = f"must be {_EXPECTED['sample_token']}, but got {_short(box['sample_token'])}"
                raise DataError(f"{path}: sample {token}, box {index}: 'sample_token' {wrong}")
    if not any(results.values()):
        raise DataError(f"{path}: no sample has a box; the official evaluator refuses such a file")


def _short(value: object) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def write_submission(
    path: Path | str,
    tokens: Sequence[str],
    table: DetectionTable,
    meta: dict[str, bool | str],
) -> None:
    """Write predictions as a submission that the official evaluator accepts; numbers keep their full precision.

    `meta` may leave out entries of EMPTY_META. Samples stand in the order of `tokens`, one a
    line, boxes of a sample in the order of `table`. The file appears complete under its name or not at all.

    Raises DataError for predictions that `check_predictions` refuses, when there is no box at all, or when the file
    cannot be written.
    """
    check_predictions(table, tokens)
    if not len(table):
        raise DataError(f"{path}: no sample has a box; the official evaluator refuses such a submission")
    lines = (
        f"{json.dumps(token)}: {json.dumps(rows)}"
        for token, rows in zip(tokens, submission_rows(tokens, table), strict=True)
    )
    head = f'{{"meta": {json.dumps(EMPTY_META | meta)},\n"results": {{\n'
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, sync=True) as file:
            file.write(head)
            for row, line in enumerate(lines):
                file.write((",\n" if row else "") + line)
            file.write("\n}}\n")
    except OSError as error:
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
    turns = rotation_zyx(columns["yaws"], np.zeros(n), np.zeros(n))
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


def to_ego(
    table: DetectionTable,
    global_from_ego: Array,  # [4, 4] float64 rotation and translation
) -> Boxes3D:
    """Rows of a table, of one sample, in its ego frame: what `to_global` undoes, velocities along the ego's ground."""
    ego_from_global = invert_rigid(global_from_ego)
    rotation = ego_from_global[:3, :3]
    floats = {
        "centers": table.centers @ rotation.T + ego_from_global[:3, 3],
        "sizes": table.sizes[:, [1, 0, 2]],
        "yaws": yaw_of(rotation @ quaternion_to_matrix(table.rotations)),
        "velocities": table.velocities @ np.linalg.inv(global_from_ego[:2, :2]).T,
        "scores": table.scores,
    }
    integers = {"labels": table.labels, "attributes": table.attributes, "num_points": table.num_points}
    return Boxes3D(
        **{name: torch.from_numpy(values.astype(np.float32)) for name, values in floats.items()},
        **{name: torch.from_numpy(values) for name, values in integers.items()},
    )
