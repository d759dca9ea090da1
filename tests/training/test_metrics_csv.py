import csv

from src.training.metrics_csv import MetricsCSV


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
