"""Which numbers have names, and what is said of one that has none."""

import pytest

from src.errors import ConfigError
from src.report.metric_names import DETECTION, WORLD_TASKS, find_metric
from src.training.phases import EVALUATORS


@pytest.mark.parametrize(
    ("name", "task", "near"), [("cd_gian_3s", "forecasting", "cd_gain_3s"), ("NSD", "detection", "NDS")]
)
def test_a_misspelt_number_is_refused_with_its_neighbours(name, task, near):
    with pytest.raises(ConfigError, match=f"a.yaml: {name} is not a metric; did you mean .*{near}"):
        find_metric(name, "a.yaml", task)


def test_numbers_know_their_unit_and_which_way_is_better():
    distance = find_metric("cd@3.0s", "a.yaml", "forecasting")
    assert (distance.unit, distance.higher_is_better) == ("m^2", False)
    assert find_metric("cd_gain_3s", "a.yaml", "forecasting").higher_is_better
    assert find_metric("cost.training", "a.yaml", "occupancy").unit == "min"


def test_a_task_without_names_has_plain_numbers():
    assert find_metric("frames", "a.yaml", "frames").title == "frames"


def test_the_tasks_with_names_are_those_that_phases_have():
    assert {DETECTION, *WORLD_TASKS} == set(EVALUATORS)
