"""Records of sweeps as files: names, what an older one lacks, and everything that is not a record."""

import json

import pytest

from src.errors import DataError
from src.report.sweep_record import read_record, read_records, record_path, write_record
from src.report.table_builder import sweep_tables, write_sweep_tables


@pytest.fixture
def broken(make_record, tmp_path):
    """Writes a record with one value changed, and returns what reading it says."""

    def make(*names, value):
        path = record_path(tmp_path, "epsilon", "mini")
        write_record(path, make_record({"a": {"mAP": 1.0}, "b": {}}, seeds=1))
        content = node = json.loads(path.read_text())
        for name in names[:-1]:
            node = node[name]
        node[names[-1]] = value
        path.write_text(json.dumps(content))
        with pytest.raises(DataError) as caught:
            read_record(path)
        assert str(caught.value).startswith(f"{path}: ") and "delete it and give the sweep's command" in str(
            caught.value
        )
        assert list(read_records(tmp_path)[1]) == [path]
        return str(caught.value)

    return make


RUN = ("runs", "horizon3d-phase1-mini-a0")


@pytest.mark.parametrize(
    ("names", "value", "said"),
    [
        (("sweep", "tables", 0, "columns"), ["mAPP"], "mAPP is not a metric"),
        (("sweep", "rows", 0, "paper"), {"mAPP": 1.0}, "mAPP is not a metric"),
        (("sweep", "rows", 0, "x"), "3", "sweep.rows.0.x must be a valid number, but is '3'"),
        (("sweep", "rows", 0, "x"), float("nan"), "sweep.rows.0.x must be a finite number, but is nan"),
        (("sweep", "rows", 0, "label"), 3, "sweep.rows.0.label must be a valid string"),
        (("sweep", "rows", 0, "overrides"), "x=1", "sweep.rows.0.overrides must be a valid array"),
        (("sweep", "rows"), [], "either rows or space"),
        (("sweep", "titel"), "x", "sweep.titel is not a known key"),
        ((*RUN, "started"), "noon", f"{'.'.join(RUN)}.started must be a valid number, but is 'noon'"),
        ((*RUN, "ended"), True, "ended must be a valid number, but is True"),
        ((*RUN, "value"), 10**400, "value must be a finite number, but is 1000"),
        ((*RUN, "seed"), 1.5, "seed must be a valid integer, but is 1.5"),
        ((*RUN, "state"), "dead", "state must be 'waiting', 'running', 'done', 'failed' or 'pruned', but is 'dead'"),
        ((*RUN, "state"), None, "state must be 'waiting', "),
        ((*RUN, "log"), 3, "log must be a valid string"),
        ((*RUN, "reason"), ["x"], "reason must be a valid string"),
        ((*RUN, "overrides"), ["a=1", 2], "overrides.1 must be a valid string, but is 2"),
        ((*RUN, "run_id"), "other", "run_id is 'other'"),
        (("updated",), None, "updated must be a valid number, but is None"),
        (("seeds",), ["0"], "seeds.0 must be a valid integer, but is '0'"),
        (("rows", "a", "0"), "nowhere", "rows.a.0 is 'nowhere', which is not among runs"),
        (("rows", "a"), {"first": RUN[1]}, "rows.a.first must be a valid integer, unable to parse"),
        (("scale",), "debug", "it is the record of epsilon_debug, whose file is epsilon_debug.json"),
        (("changes",), ["optim.lr=1"], "it is the record of epsilon_mini-"),
        (("runs",), [], "runs must be an object, but is []"),
        (("format",), 2, "format must be less than or equal to 1, but is 2"),
    ],
)
def test_what_is_wrong_with_a_record_is_named(broken, names, value, said):
    assert said in broken(*names, value=value)


def test_a_record_nested_beyond_reading_is_named(tmp_path):
    path = record_path(tmp_path, "deep", "mini")
    path.parent.mkdir()
    path.write_text('{"a":' * 100_000)
    with pytest.raises(DataError, match=r"deep_mini\.json: not readable as JSON \(recursion limit"):
        read_record(path)


def test_a_record_without_changes_is_the_plain_sweeps(make_record, tmp_path):
    record = make_record({"a": {}})
    path = record_path(tmp_path, "epsilon", "mini")
    write_record(path, record)
    content = json.loads(path.read_text())
    del content["changes"]
    path.write_text(json.dumps(content))
    assert read_record(path) == record and path.stem == record.stem == "epsilon_mini"


def test_changes_are_part_of_the_name_of_every_file(make_record, tmp_path):
    record = make_record({"a": {}})
    plain = write_sweep_tables(tmp_path, record, {})
    record.changes = ["model.x=2", "optim.lr=0.01"]
    path = record_path(tmp_path, "epsilon", "mini", ["optim.lr=0.01", "model.x=2"])
    assert path.stem == record.stem and len(record.suffix) == 9
    write_record(path, record)
    assert read_record(path) == record
    changed = write_sweep_tables(tmp_path, record, {})
    assert [p.name.replace(record.suffix, "") for p in changed] == [p.name for p in plain]
    assert not {*plain} & {*changed}
    assert "scale mini; with model.x=2 optim.lr=0.01;" in sweep_tables(record, {})[0].caption
