import csv

import pytest

from src.reliability.metrics_csv import MetricsCSV


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_new_columns_and_values(tmp_path):
    log = MetricsCSV(tmp_path / "m.csv", resume_step=-1)
    log.log_metrics({"step/total": 2.5, "epoch": 0}, step=1)
    log.log_metrics({"step/total": 2.25, "epoch": 0}, step=2)
    log.log_metrics({"val/mAP": 0.5, "epoch": 0}, step=2)
    found = rows(tmp_path / "m.csv")
    assert [row["step"] for row in found] == ["1", "2", "2"]
    assert found[1]["step/total"] == "2.25" and found[1]["val/mAP"] == ""
    assert found[2]["val/mAP"] == "0.5"


def test_a_resumed_run_keeps_the_rows_up_to_its_checkpoint(tmp_path):
    log = MetricsCSV(tmp_path / "m.csv", resume_step=-1)
    for step in range(5):
        log.log_metrics({"loss": float(step), "epoch": 0}, step=step)
    resumed = MetricsCSV(tmp_path / "m.csv", resume_step=3)  # the checkpoint after steps 0, 1 and 2
    resumed.log_metrics({"loss": 30.0, "epoch": 1}, step=3)
    assert [(row["step"], row["loss"]) for row in rows(tmp_path / "m.csv")] == [
        ("0", "0"), ("1", "1"), ("2", "2"), ("3", "30"),
    ]  # fmt: skip


def test_a_fresh_run_in_a_used_folder_starts_empty(tmp_path):
    MetricsCSV(tmp_path / "m.csv", resume_step=-1).log_metrics({"loss": 1.0}, step=9)
    MetricsCSV(tmp_path / "m.csv", resume_step=-1).log_metrics({"loss": 2.0}, step=1)
    assert [row["loss"] for row in rows(tmp_path / "m.csv")] == ["2"]


def test_rows_that_a_disk_refuses_are_written_later(tmp_path, caplog):
    folder = tmp_path / "run"
    folder.mkdir()
    log = MetricsCSV(folder / "metrics.csv", resume_step=-1)
    log.log_metrics({"a": 1.0}, 0)
    folder.rename(tmp_path / "away")
    for step in (1, 2):
        log.log_metrics({"a": 2.0}, step)
    with pytest.raises(OSError):
        log.finalize("success")  # not finished without its log
    log.finalize("failed")
    (tmp_path / "away").rename(folder)
    log.finalize("success")
    assert (folder / "metrics.csv").read_text().split() == ["step,epoch,a", "0,,1", "1,,2", "2,,2"]
    assert len(caplog.records) == 1
    log.log_metrics({"a": 3.0}, 3)
    assert (folder / "metrics.csv").read_text().split()[1:] == ["0,,1", "1,,2", "2,,2", "3,,3"]


def test_a_repeated_row_is_logged_once(tmp_path):
    path = tmp_path / "metrics.csv"
    log = MetricsCSV(path, resume_step=-1)
    log.log_metrics({"a": 1.0}, 0)
    log.log_metrics({"a": 2.0}, 1)
    log.log_metrics({"val/b": 3.0}, 1)
    before = path.read_text()
    again = MetricsCSV(path, resume_step=2)  # from before the validation, whose row is there
    again.log_metrics({"val/b": 3.0}, 1)
    assert path.read_text() == before
    again.log_metrics({"val/b": 4.0}, 1)
    assert path.read_text() == before.replace("3", "4")
    again.log_metrics({"val/b": 3.0}, 2)
    assert len(rows(path)) == 4


@pytest.mark.parametrize(
    "damage", [b"\xff\xfe\xfa,1\n", b"x" * 200_000 + b"\n", b"9" * 5000 + b",0,1\n", b"2,0,1.2.3\n"]
)
def test_a_damaged_log_is_resumed_from_the_rows_before(tmp_path, caplog, damage):
    path = tmp_path / "m.csv"
    path.write_bytes(b"step,epoch,loss\n0,0,1\n1,0,2\n" + damage + b"2,0,3\n")
    log = MetricsCSV(path, resume_step=3)
    assert [row["loss"] for row in log.rows] in (["1", "2"], [])  # what cannot be decoded spoils the whole of a file
    assert "m.csv: damaged" in caplog.text
    log.log_metrics({"loss": 4.0, "epoch": 0}, step=3)
    assert rows(path)[-1]["loss"] == "4"


def test_rows_without_a_step_are_left_out(tmp_path):
    (tmp_path / "m.csv").write_text("step,epoch,loss\n²,0,1\n,0,2\n-1,0,3\n1.5,0,4\n1,0,5\n\n2,0,6,7,8\n")
    assert [row["loss"] for row in MetricsCSV(tmp_path / "m.csv", resume_step=3).rows] == ["5", "6"]
