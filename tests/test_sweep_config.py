"""The command line of src.sweep, and what its files may not say."""

import pytest

from src import sweep_config
from src.errors import ConfigError
from src.sweep_config import compose_sweep, load_sweep

GOOD = "title: t\nquestion: q\nrows: [{label: a}]\n"


@pytest.fixture
def sweeps(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_config, "SWEEPS", tmp_path)
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
        (["+sweep=good", "workers=0"], "workers must be at least 1, but got 0"),
        (["+sweep=good", "worker=2"], r"worker=2: did you mean workers\?"),
        (["+sweep=good", "dryrun=true"], r"did you mean dry_run\?"),
        (["+sweep=good", "dry_run=perhaps"], "perhaps"),
        (["+sweep=good", "storage="], "storage is empty"),
    ],
)
def test_bad_command_lines(sweeps, words, said):
    with pytest.raises(ConfigError, match=said):
        compose_sweep(words)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (GOOD + "titel: x\n", r"titel: Key 'titel' not in 'SweepConfig' \| did you mean title"),
        ("title: t\nquestion: q\nrows: [{label: a, overide: [x]}]\n", r"did you mean overrides"),
        ("title: t\nquestion: q\nrows: [{label: a}, {label: a}]\n", "label a stands more than once"),
        (
            "title: t\nquestion: q\nrows: [{label: a, paper: {mAPP: 3}}]\n",
            "row 'a', paper: mAPP is not a metric; did you",
        ),
        ("title: t\nquestion: q\nrows: [{label: a, paper: {mAP: .nan}}]\n", "mAP=nan is not a finite number"),
        ("title: t\nquestion: q\nrows: [{label: a, x: abc}]\n", "x: Value 'abc' of type 'str'"),
        ("title: t\nquestion: q\nrows: [{label: off}]\n", "YAML reads a label as False"),
        ("title: t\nquestion: q\nrows: []\n", "give either rows or space"),
        ("title: t\nquestion: q\nrows: [{label: a\n", "while parsing"),
        ("title: t\nquestion: q\nspace: {optim.lr: {low: 3, high: 2}}\n", "low must be below high"),
        ("title: t\nquestion: q\nspace: {optim.lr: {low: 1, high: 2}}\n", "trials must be at least 1"),
        ("", "title"),
        ("- a\n", "ListConfig"),
    ],
)
def test_bad_files_are_named(sweeps, content, said):
    (sweeps / "bad.yaml").write_text(content)
    with pytest.raises(ConfigError, match=said) as caught:
        load_sweep("bad")
    assert str(caught.value).startswith("sweeps/bad.yaml")
