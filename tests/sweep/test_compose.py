"""The command line of src.sweep, and what its files may not say."""

import pytest

from src.errors import ConfigError
from src.sweep import sweep_files
from src.sweep.compose import compose_sweep
from src.sweep.sweep_files import load_sweep

GOOD = "title: t\nquestion: q\nrows: [{label: a}]\n"


@pytest.fixture
def sweeps(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_files, "SWEEPS", tmp_path)
    (tmp_path / "good.yaml").write_text(GOOD)
    return tmp_path


def test_the_command_line_is_split(sweeps):
    rest = ["scale=debug", "optim.lr=1e-3", "seed=4"]
    command, others = compose_sweep(["+sweep=good", "seeds=3", rest[0], "workers=2", *rest[1:], "dry_run=true"])
    assert (command.sweep.name, command.seeds, command.workers, command.dry_run) == ("good", 3, 2, True)
    assert others == rest and command.storage is None
    assert compose_sweep(["sweep=good"])[0].seeds == 1


@pytest.mark.parametrize("quote", ["", "'", '"'])
def test_the_address_of_a_database_is_taken_as_it_is(sweeps, quote):
    url = "postgresql+psycopg://u:p=1@h:1/n?sslmode=require"
    assert compose_sweep(["+sweep=good", f"storage={quote}{url}{quote}"])[0].storage == url


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], r"give one \+sweep=NAME of good; got none"),
        (["+sweep=good", "+sweep=good"], "got good good"),
        (["+sweep=god"], r"no sweeps/god.yaml; did you mean good\? there are good"),
        (["+sweep=good", "workers=x"], "'x' of type 'str' could not be converted to Integer$"),
        (["+sweep=good", "seeds=1.5"], "1.5"),
        (["+sweep=good", "workers=-1"], "workers must be at least 0, but got -1"),
        (["+sweep=good", "worker=2"], r"worker: did you mean workers\?"),
        (["+sweep=good", "dryrun=true"], r"did you mean dry_run\?"),
        (["+sweep=good", "dry_run=perhaps"], "perhaps"),
        (["+sweep=good", "storage="], "storage is empty"),
        (["+sweep="], r"give one \+sweep=NAME of good; got none"),
        (["+sweep=good", "seeds=1001"], "seeds must be at most 1000, but got 1001"),
    ],
)
def test_bad_command_lines(sweeps, words, said):
    with pytest.raises(ConfigError, match=said):
        compose_sweep(words)


@pytest.mark.parametrize(
    "override",
    [
        "storge=postgresql://me:s3cret@host/db",
        "storge=me:s3cret",
        "~storage=s3cret",
        "STORAGE=s3cret",
        "database=postgresql://me:s3cret@host/db",
        "optim.lr=postgresql://me:s3cret@host/db",
        "seeds=postgresql://me:s3cret@host/db",
        "sweep=postgresql://me:s3cret@host/db",
        "db=host password='a s3cret'",
        "postgresql://me:s3cret@host/db",
        "postgresql://me:s3cret@host/db?a=b",
        "storage=postgresql://me:s3@s3cret@host/db",
    ],
)
def test_a_misplaced_password_is_refused_and_not_shown(sweeps, override):
    with pytest.raises(ConfigError) as caught:
        compose_sweep(["+sweep=good", override])
    assert "s3" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (GOOD + "titel: x\n", r"titel is not a known key; did you mean title\?"),
        ("title: t\nquestion: q\nrows: [{label: a, overide: [x]}]\n", r"did you mean overrides"),
        ("title: t\nquestion: q\nrows: [{label: a}, {label: a}]\n", "label a stands more than once"),
        (
            "title: t\nquestion: q\nrows: [{label: a, paper: {mAPP: 3}}]\n",
            "row 'a', paper: mAPP is not a metric; did you",
        ),
        (
            "title: t\nquestion: q\nrows: [{label: a, paper: {mAP: .nan}}]\n",
            r"rows\.0\.paper\.mAP must be a finite number, but is nan",
        ),
        ("title: t\nquestion: q\nrows: [{label: a, x: abc}]\n", r"rows\.0\.x must be a valid number, but is 'abc'"),
        (
            "title: t\nquestion: q\nrows: [{label: off}]\n",
            r"rows\.0\.label must be a valid string, but is False; write on, off, yes and no in quotes",
        ),
        (GOOD.replace("label: a", "label: a, scales: [papr]"), "no scale papr; there are debug, mini, paper"),
        (GOOD.replace("label: a", "label: a, overrides: [seed=3]"), "seed=... is no part of a sweep"),
        (GOOD + "overrides: [+seed=3]\n", "seed=... is no part of a sweep"),
        (GOOD.replace("label: a", "label: ' '"), "a label is empty"),
        (GOOD + "tables: [{name: t, title: T, columns: []}]\n", "table t: columns is empty"),
        (GOOD + "tables: [{name: a/b, title: T, columns: [mAP]}]\n", "name 'a/b' must be of letters"),
        (GOOD + "tables: [{name: ../b, title: T, columns: [mAP]}]\n", "name '../b' must be of letters"),
        (GOOD.replace("label: a", "label: '${title}'"), r"rows.0.label: must not hold \$\{"),
        ("title: t ${x}\nquestion: q\nrows: [{label: a}]\n", r"title: must not hold \$\{"),
        ("title: t\nquestion: q\nrows: []\n", "give either rows or space"),
        ("title: t\nquestion: q\nrows: [{label: a\n", "while parsing"),
        ("title: t\nquestion: q\nspace: {optim.lr: {low: 3, high: 2}}\n", "low must be below high"),
        ("title: t\nquestion: q\nspace: {optim.lr: {low: 1, high: 2}}\n", "trials must be at least 1"),
        (GOOD + "tables: [{name: t, title: T, columns: [IoU]}]\n", "table t, columns: IoU is not a metric"),
        (GOOD + "task: segmentation\n", "give tables with the columns of task segmentation"),
        (
            "title: t\nquestion: q\ntask: segmentation\ntrials: 2\nspace: {optim.lr: {low: 1, high: 2}}\n",
            "give the objective of task segmentation",
        ),
        ("", "title"),
        ("- a\n", r"the file must be an object, but is \['a'\]"),
    ],
)
def test_bad_files_are_named(sweeps, content, said):
    (sweeps / "bad.yaml").write_text(content)
    with pytest.raises(ConfigError, match=said) as caught:
        load_sweep("bad")
    assert str(caught.value).startswith("sweeps/bad.yaml")


def test_a_sweep_of_another_task_names_its_own_numbers(sweeps):
    (sweeps / "other.yaml").write_text(
        GOOD.replace("label: a", "label: a, paper: {IoU: 3}") + "task: segmentation\n"
        "tables: [{name: t, title: T, columns: [IoU, latency.total]}]\nplots: [{metric: IoU, label: x}]\n"
    )
    assert load_sweep("other").task == "segmentation" and load_sweep("good").task == "detection"


def test_a_files_name_is_the_sweeps(sweeps):
    (sweeps / "b d.yaml").write_text(GOOD)
    with pytest.raises(ConfigError, match="name 'b d' must be of letters"):
        load_sweep("b d")


def test_trials_of_a_search_are_chosen_on_the_command_line():
    command, _ = compose_sweep(["+sweep=tune", "trials=3"])
    assert command.sweep.trials == 3
    assert compose_sweep(["+sweep=tune"])[0].sweep.trials > 3
    with pytest.raises(ConfigError, match="trials=3 is for searches"):
        compose_sweep(["+sweep=epsilon", "trials=3"])
    with pytest.raises(ConfigError, match="trials must be at least 1"):
        compose_sweep(["+sweep=tune", "trials=0"])
