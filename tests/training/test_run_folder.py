import json
import shutil

import pytest

from src.errors import CheckpointError, ConfigError, DataError
from src.reliability.checkpoints import AtomicCheckpointIO
from src.training.run_folder import Resume, RunFolder, make_writable, write_json


def finish(folder):
    write_json(folder.metrics_json, {"mAP": 0.5})
    write_json(folder.record, {"commit": "abc"})


def test_a_new_run_is_unfinished_and_a_finished_one_is_kept(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    assert not folder.finished and folder.newest_checkpoint() is None
    finish(folder)
    folder.close()
    (tmp_path / "run" / ".lock").unlink()
    again = RunFolder(tmp_path, "run")
    again.open(Resume.auto)
    assert not (tmp_path / "run" / ".lock").exists()  # it may lie where nothing can be written
    assert again.finished and again.read_result() == ({"commit": "abc"}, {"mAP": 0.5})


def test_never_refuses_and_restart_moves_the_old_folder_aside(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    finish(folder)
    folder.close()
    with pytest.raises(ConfigError, match="resume=never"):
        RunFolder(tmp_path, "run").open(Resume.never)
    fresh = RunFolder(tmp_path, "run")
    fresh.open(Resume.restart)
    assert not fresh.finished
    (old,) = tmp_path.glob("run.before-*")
    assert json.loads((old / "metrics.json").read_text()) == {"mAP": 0.5}


def test_two_trainings_of_one_run_do_not_mix(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    with pytest.raises(ConfigError, match="another process"):
        RunFolder(tmp_path, "run").open(Resume.auto)


def test_a_folder_that_cannot_be_written_is_named_before_training(tmp_path):
    (tmp_path / "outputs").write_text("a file where a folder should be")
    with pytest.raises(ConfigError, match="paths.outputs"):
        RunFolder(tmp_path / "outputs", "run").open(Resume.auto)


@pytest.mark.parametrize("name", ["run.json", "metrics.json"])
@pytest.mark.parametrize("content", ["{", "5"])
def test_a_broken_result_is_named(tmp_path, name, content):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    finish(folder)
    (folder.path / name).write_text(content)
    with pytest.raises(DataError, match=rf"{name}.*delete it"):
        folder.read_result()


def test_a_damaged_last_checkpoint_gives_way_to_the_best(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    last, best = (folder.checkpoints / f"{name}.ckpt" for name in ("last", "best"))
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}, "horizon3d": {"config": {}}}, best)
    last.write_bytes(best.read_bytes()[:-40])
    assert folder.newest_checkpoint().path == best
    best.write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"last\.ckpt.*best\.ckpt.*resume=restart"):
        folder.newest_checkpoint()


def test_a_folder_that_cannot_be_made_names_its_setting(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="out=FOLDER"):
        make_writable(tmp_path / "file", "out")


def test_json_with_nan_is_refused_rather_than_written(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "x.json", {"mAP": float("nan")})
    assert not (tmp_path / "x.json").exists()


def write_checkpoint(folder, name):
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}, "horizon3d": {"config": {}}}, folder.checkpoints / name)


def test_a_damaged_last_checkpoint_gives_way_to_the_one_before(tmp_path, caplog):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    for name in ("last.ckpt", "previous.ckpt", "best.ckpt"):
        write_checkpoint(folder, name)
    assert folder.newest_checkpoint().path.name == "last.ckpt" and not caplog.records
    (folder.checkpoints / "last.ckpt").write_bytes(b"")
    assert folder.newest_checkpoint().path.name == "previous.ckpt"
    (message,) = [record.getMessage() for record in caplog.records]
    assert "last.ckpt is truncated" in message
    assert f"resuming from {folder.checkpoints / 'previous.ckpt'} instead" in message


def test_what_a_killed_process_was_writing_goes_and_so_does_what_only_resuming_needs(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    folder.pictures.mkdir()
    for name in ("last.ckpt", "previous.ckpt", "best.ckpt"):
        write_checkpoint(folder, name)
    for name in (
        "last.ckpt.tmp",
        "previous.ckpt.tmp",
        ".probe-77",
        "../.submission.json.77.tmp",
        "../metrics.csv.tmp",
        "../pictures/.curves.png.77.tmp",
    ):
        (folder.checkpoints / name).write_bytes(b"half")
    folder.close()
    again = RunFolder(tmp_path, "run")
    again.open(Resume.auto)
    assert {path.name for path in folder.checkpoints.iterdir()} == {"last.ckpt", "previous.ckpt", "best.ckpt"}
    assert {path.name for path in folder.path.iterdir()} == {"checkpoints", "pictures", ".lock"}
    assert not list(folder.pictures.iterdir())
    write_json(again.metrics_json, {"mAP": 0.5})
    again.finish({"commit": "abc"})
    assert again.finished and {path.name for path in folder.checkpoints.iterdir()} == {"last.ckpt", "best.ckpt"}


def test_a_clock_that_says_the_same_time_again_costs_no_old_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("src.training.run_folder.time.strftime", lambda form: "19700101-000000")
    for number in range(4):
        folder = RunFolder(tmp_path, "run")
        folder.open(Resume.restart)
        folder.log.write_text(str(number))
        folder.close()
    assert {path.name: (path / "log.txt").read_text() for path in tmp_path.iterdir()} == {
        "run.before-19700101-000000": "0",
        "run.before-19700101-000000-2": "1",
        "run.before-19700101-000000-3": "2",
        "run": "3",
    }


def test_a_folder_that_was_deleted_and_made_anew_is_another(tmp_path):
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    folder.check_held()
    folder.path.rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError):
        folder.check_held()
    other = RunFolder(tmp_path, "run")
    other.open(Resume.auto)
    other.check_held()
    with pytest.raises(CheckpointError, match="made anew by another process"):
        folder.check_held()
    shutil.rmtree(folder.path)
    (tmp_path / "elsewhere").rename(folder.path)
    folder.check_held()
