"""Run folders: what is found, and that nothing outside is."""

import os

import pytest

from src.dashboard.folders import RunFolders
from src.report.run_curves import read_curves


@pytest.fixture
def folders(world):
    return RunFolders(world.outputs)


def test_runs_are_folders_with_a_configuration(world, folders):
    (world.outputs / "cache").mkdir()
    (world.outputs / "horizon3d-phase1-mini-0000000f").mkdir()
    moved = world.outputs / f"{world.run_id(0, 0)}.before-20260101-000000"
    moved.mkdir()
    (moved / "config.yaml").write_text("")
    assert folders.names() == sorted(
        [world.run_id(0, 0, "debug"), *(world.run_id(r, s) for r in range(3) for s in (0, 1) if (r, s) != (1, 1))]
    )
    assert RunFolders(None).names() == RunFolders(world.outputs / "nowhere").names() == []


def test_pictures_have_their_size_and_torn_ones_are_left_out(world, folders):
    folder = world.outputs / world.run_id(0, 0) / "pictures"
    whole = (folder / "frame_0_abc.png").read_bytes()
    (folder / "frame_1_torn.png").write_bytes(whole[:-20])
    (folder / "frame_2_text.png").write_text("no picture at all, but long enough to look into it")
    pictures = folders.pictures(world.run_id(0, 0))
    assert [(p.name, p.width, p.height) for p in pictures] == [("frame_0_abc.png", 320, 240), ("curves.png", 320, 240)]
    assert pictures[0].title == "Cameras and bird's-eye view, sample abc"
    for name in ("occupancy_0_abc", "film_0_abc", "horizons"):
        (folder / f"{name}.png").write_bytes(whole)
    pictures = folders.pictures(world.run_id(0, 0))
    assert [p.kind for p in pictures] == ["frame", "film", "occupancy", "curves", "horizons"]
    assert pictures[1].title == "Forecast and true points, moment by moment, sample abc"
    assert pictures[4].title == "Scores over time and distance"


def test_nothing_outside_the_folders_is_found(world, folders):
    run = world.run_id(0, 0)
    folder = world.outputs / run / "pictures"
    outside = world.outputs.parent / "outside.png"
    outside.write_bytes((folder / "frame_0_abc.png").read_bytes())
    (folder / "frame_9_link.png").symlink_to(outside)
    for name in ("../../../outside.png", "frame_9_link.png", "..", "", "/etc/passwd", "frame_0_abc.png/.."):
        assert folders.picture(run, name) is None
    for run_id in ("..", "../outputs/" + run, "sweeps", "", run + "/pictures"):
        assert folders.find(run_id) is None and folders.pictures(run_id) == []
    (world.outputs / "horizon3d-phase1-mini-0000abcd").symlink_to(world.outputs.parent / "elsewhere")
    assert folders.find("horizon3d-phase1-mini-0000abcd") is None
    secret = world.outputs / "link.txt"
    secret.symlink_to(world.outputs.parent / "secret.txt")
    for relative in ("../secret.txt", "link.txt", "/etc/hostname", f"{run}/run.json", "nowhere.txt"):
        assert folders.log_tail(relative) is None


def test_log_is_what_a_terminal_shows_without_the_machine(world, folders):
    run = world.run_id(0, 0)
    assert folders.log_tail(f"{run}/log.txt") == f"12:00 INFO run {run} in {run}\nepoch 2\n12:01 INFO finished"
    path = world.outputs / run / "log.txt"
    path.write_text("".join(f"line {n}\n" for n in range(10_000)))
    tail = folders.log_tail(f"{run}/log.txt").splitlines()
    assert tail[0] == "[the last lines of 98 kB]" and tail[-1] == "line 9999" and tail[1].startswith("line ")
    path.write_bytes(b"\xff\xfe broken \xff\nlast\n")
    assert folders.log_tail(f"{run}/log.txt").endswith("last")


def test_curves_of_a_file_that_is_being_written(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(
        "step,epoch,step/total,loss/box,val/mAP,lr\n2,0,9.5,,,1\n4,0,,8.5,nan,1\n9,1,,4.5,0.2,1\n,1,3\n12,1,2"
    )
    assert read_curves(path, live=True) == {
        "step/total": [(2, 9.5), (12, 2)], "loss/box": [(4, 8.5), (9, 4.5)], "val/mAP": [(9, 0.2)]
    }  # fmt: skip
    path.write_text("step,epoch,step/total\n" + "".join(f"{n},0,{n}\n" for n in range(1000)))
    assert len(read_curves(path, live=True)["step/total"]) == 200


def test_configuration_of_an_unfinished_run_says_nothing_of_the_machine(world, folders):
    run = world.run_id(0, 0)
    assert folders.config(run)["model"] == {"name": "horizon3d", "ocsf": {"margin_m": 0.8}}
    assert "paths" not in folders.config(run) and folders.config(run)["data"] == {"sensor_dropout": None}
    for text in ("model: [", "just words", ""):
        (world.outputs / run / "config.yaml").write_text(text)
        assert folders.config(run) == {}


def test_files_of_a_run_that_lead_out_are_as_good_as_none(world, folders):
    """A run folder from somebody else may name any file of this machine as its own."""
    run, outside = world.run_id(0, 0), world.outputs.parent
    folder = world.outputs / run
    (outside / "secret.yaml").write_text("password: s3cret\n")
    (outside / "secret.csv").write_text("step,loss/s3cret\n1,2\n")
    (outside / "log.txt").write_text("s3cret\n")
    for name, target in (("config.yaml", "secret.yaml"), ("metrics.csv", "secret.csv"), ("log.txt", "log.txt")):
        (folder / name).unlink()
        (folder / name).symlink_to(outside / target)
    assert folders.config(run) == {} and folders.curves(run) == {} and folders.log_tail(f"{run}/log.txt") is None
    (folder / "pictures").rename(outside / "moved")
    (folder / "pictures").symlink_to(outside / "moved")
    assert folders.pictures(run) == [] and folders.picture(run, "frame_0_abc.png") is None


def test_a_pipe_is_not_waited_for(world, folders):
    run = world.run_id(0, 0)
    folder = world.outputs / run
    for name in ("metrics.csv", "log.txt"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    os.mkfifo(folder / "pictures" / "frame_7_pipe.png")
    assert folders.curves(run) == {} and folders.log_tail(f"{run}/log.txt") is None
    assert len(folders.pictures(run)) == 2
    (folder / "config.yaml").unlink()
    os.mkfifo(folder / "config.yaml")
    assert run not in folders.names() and folders.config(run) == {}


@pytest.mark.parametrize(
    "text",
    ["a: &a [x, x]\n" + "".join(f"k{n}: &k{n} [*{f'k{n - 1}' if n else 'a'}, *a]\n" for n in range(60)),
     "a: " + "[" * 200_000 + "]" * 200_000, "a: !!python/object/apply:os.mkdir [executed]", "x: " + "y" * 2_000_000],
    ids=["aliases", "depth", "code", "size"],
)  # fmt: skip
def test_a_configuration_that_is_none_is_empty(world, folders, monkeypatch, text):
    monkeypatch.chdir(world.outputs)
    (world.outputs / world.run_id(0, 0) / "config.yaml").write_text(text)
    assert folders.config(world.run_id(0, 0)) == {}
    assert not (world.outputs / "executed").exists()
