"""The paper's claims: the file itself, its mistakes, and what made runs say of a claim."""

import json
import logging
from pathlib import Path

import pytest

from src.errors import ConfigError
from src.report.claims import Verdict, judge, load_claims, verdict_of
from src.report.sweep_file import RowConfig, SweepConfig
from src.report.sweep_record import read_records
from src.sweep.sweep_files import load_sweep

COMPARISON = {"sweep": "margin", "row": "large", "over": "small", "metrics": ["mAP"]}
PAPER = {"large": {"mAP": 20.3, "mAVE": 0.5}, "small": {"mAP": 18.6, "mAVE": 0.7}, "silent": {}}


def sweep_of(name, scales=None):
    if name != "margin":
        raise ConfigError(f"there is no sweeps/{name}.yaml")
    rows = [RowConfig(label=label, overrides=[f"x={label}"], paper=paper) for label, paper in PAPER.items()]
    return SweepConfig(
        title="t", question="q", name=name, rows=[*rows, RowConfig(label="huge", scales=["paper"])], baseline="small"
    )


@pytest.fixture
def claims_of(tmp_path):
    """The claims of a file with these comparisons, each `COMPARISON` with changes."""

    def load(*changes, **file):
        claim = {"name": "margin", "sentence": "Larger is better", "source": "Table 1"}
        claim["comparisons"] = [COMPARISON | change for change in changes]
        path = tmp_path / "claims.yaml"
        path.write_text(json.dumps({"half_width": 0.5, "claims": [claim]} | file))
        return load_claims(sweep_of, path)

    return load


def test_the_ten_claims_and_the_effects_that_the_paper_gives_them():
    claims = load_claims(load_sweep)
    assert [claim.config.name for claim in claims] == [
        "cameras", "keypoints", "enlargement", "layers", "paths", "memory", "compensation", "sampling", "attention",
        "lead",
    ]  # fmt: skip
    deciding = {claim.config.name: [m.paper for m in claim.measures if m.decides] for claim in claims}
    assert deciding["cameras"] == [7.5] and deciding["keypoints"] == [1.5, 2.6]  # 20.3 - 12.8; 19.2, 20.3 - 17.7
    assert deciding["enlargement"] == [3.1, 1.7, 0.7] and deciding["layers"] == [1.1]
    assert deciding["paths"] == [None, None, 1.1, 2.3] and deciding["memory"] == [None] * 4
    assert deciding["lead"] == [7.7, 6.5, 5.3, 1.5, None, None]
    beside = {m.metric.name: m.paper for m in claims[6].measures if m.comparison.row == "BEV path, compensated"}
    assert beside["mAP"] == 1.4 and beside["measures.moving_AP"] is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sweep": "marge"}, "there is no sweeps/marge.yaml"),
        ({"row": "larger"}, r"'larger' is not a row of sweeps/margin.yaml \(large, small, silent, huge\)"),
        ({"row": "huge"}, "row 'huge' of sweeps/margin.yaml must be for every scale"),
        ({"over": "large"}, "a row is compared with itself"),
        ({"metrics": ["mAPP"]}, "mAPP is not a metric; did you mean mAP"),
        ({"metrics": []}, "metrics is empty"),
        ({"beside": ["measures.moving"]}, "did you mean measures.moving_AP"),
        ({"beside": ["mAVE"]}, "mAVE is in m/s; give the half_width"),
        ({"half_width": 0.0}, "half_width must be above 0, but is 0"),
        ({"row": "small", "over": "large"}, "the paper's mAP is 18.6 against 20.3, so it does not claim that"),
        ({"row": "small", "over": "large", "metrics": ["mAVE"], "half_width": 0.1}, "mAVE is 0.7 against 0.5"),
        ({"asks": " "}, "asks is empty; say what the rows answer"),
        ({"asks": "why?", "beside": ["NDS"]}, "what asks has metrics alone"),
        ({"asks": "why?", "half_width": 0.1}, "what asks has metrics alone"),
    ],
)
def test_a_mistake_is_named_with_its_claim(claims_of, change, message):
    with pytest.raises(ConfigError, match=rf"claims.yaml, claim margin, \w+ over \w+: .*{message}"):
        claims_of(change)


def test_a_file_without_claims_is_refused(tmp_path):
    path = tmp_path / "claims.yaml"
    path.write_text("{half_width: 0.5, claims: []}")
    with pytest.raises(ConfigError, match="claims.yaml: claims is empty"):
        load_claims(load_sweep, path)


def test_a_file_that_is_none_is_named(claims_of, tmp_path):
    words = {"name": "a", "sentence": "s", "source": "t", "comparisons": [COMPARISON]}
    for file, message in (
        ({"half_widht": 1.0}, "half_widht is not a known key; did you mean half_width"),
        ({"half_width": "wide"}, "half_width must be a valid number"),
        ({"claims": [words | {"because": "So it is."}]}, "claim a: because and the verdict that it is of go together"),
        ({"claims": [words | {"verdict": "shown", "because": "So."}]}, "verdict"),
        ({"claims": [{"name": "a", "sentence": "s", "source": "t", "comparisons": []}]}, "claim a: comparisons is em"),
        ({"claims": [{"name": "a", "sentence": "s", "source": "t", "comparisons": []}] * 2}, "claim a stands more"),
    ):
        with pytest.raises(ConfigError, match=f"claims.yaml.*{message}"):
            claims_of({}, **file)
    with pytest.raises(ConfigError, match="nothing.yaml"):
        load_claims(sweep_of, tmp_path / "nothing.yaml")


@pytest.fixture
def judged(claims_of, make_record, make_result):
    """The findings of a claim on runs with these values by row; a seed whose value is None has no result."""

    def judge_runs(values, *changes, states=None, overrides=()):
        (claim,) = claims_of(*(changes or [{}]))
        record = make_record(dict.fromkeys(values, {}), seeds=max(map(len, values.values())), states=states)
        record.sweep.overrides = list(overrides)
        results = {}
        for label, numbers in values.items():
            for seed, value in enumerate(numbers):
                run_id = record.rows[label][seed]
                if value is not None:
                    results[run_id] = make_result(run_id, {"mAP": value / 100, "mAVE": value / 100}, seed)
        return judge(claim, {"margin": record}, results)

    return judge_runs


def test_verdicts(judged):
    def verdict(large, small, *changes):
        (finding,) = judged({"large": large, "small": small}, *changes)
        return finding.verdict, finding.is_open

    zero = [10.0] * 12
    assert verdict([12.0, 12.1, 11.9], zero) == (Verdict.SHOWS, False)
    assert verdict([8.0, 8.1, 7.9], zero) == (Verdict.NOT, False)  # the other way round
    assert verdict([10.0, 10.1, 9.9], zero) == (Verdict.NOT, False)  # 0.44 to each side of zero: precise
    assert verdict([10.41, 10.5, 10.62], zero) == (Verdict.SHOWS, False)  # precise as well, but from 0.045 to 0.975
    assert verdict([10.0, 10.1, 9.9], zero, {"half_width": 0.4}) == (Verdict.UNDECIDED, True)
    assert verdict([15.0, 10.0, 20.0], zero) == (Verdict.UNDECIDED, True)
    assert verdict([15.0, 5.0] * 6, zero) == (Verdict.UNDECIDED, False)  # twelve are the most
    assert verdict([90.0, 90.0], zero) == (Verdict.UNDECIDED, True)  # never before the first look
    assert verdict([None] * 3, zero) == (Verdict.NOT_RUN, True)


def test_where_less_is_better_the_papers_sign_is_negative(judged):
    less = {"metrics": ["mAVE"], "half_width": 0.05}
    (finding,) = judged({"large": [50.0, 51.0, 49.0], "small": [70.0, 70.0, 70.0]}, less)
    assert finding.measure.paper == -0.2 and finding.found.numbers == "-0.20 [-0.24, -0.16]"
    assert finding.verdict is Verdict.SHOWS
    (finding,) = judged({"large": [70.0, 71.0, 69.0], "small": [50.0, 50.0, 50.0]}, less)
    assert finding.found.mean == pytest.approx(0.2) and finding.verdict is Verdict.NOT


def test_a_claim_holds_where_all_that_decides_does(judged):
    values = {"large": [12.0, 12.1, 11.9], "small": [10.0] * 3, "silent": [12.0, 12.1, 11.9]}
    other = {"over": "silent"}
    first, second = judged(values, {}, other)
    assert [first.verdict, second.verdict] == [Verdict.SHOWS, Verdict.NOT] and second.measure.paper is None
    assert verdict_of([first, second]) is Verdict.NOT and verdict_of([first]) is Verdict.SHOWS
    first, second = judged(values | {"silent": [9.0, 15.0, 1.0]}, {}, other)
    assert verdict_of([first, second]) is Verdict.UNDECIDED
    first, second = judged(values | {"silent": [None] * 3}, {}, other)
    assert verdict_of([first, second]) is Verdict.UNDECIDED and verdict_of([second]) is Verdict.NOT_RUN
    beside = {"metrics": ["mAP"], "beside": ["mAVE"], "half_width": 0.05}
    first, second = judged(values, beside)  # by mAVE it is the other way round, which decides nothing
    assert second.verdict is Verdict.NOT and not second.is_open and verdict_of([first, second]) is Verdict.SHOWS


def test_what_asks_why_decides_nothing(judged, claims_of):
    """Nor does it claim what the paper's numbers must agree with, or want a width that is precise enough."""
    values = {"large": [12.0, 12.1, 11.9], "small": [10.0] * 3}
    asks = {"row": "small", "over": "large", "metrics": ["mAP", "mAVE"], "asks": "Where is it lost?"}
    first, *answers = judged(values, {}, asks)
    assert [one.verdict for one in answers] == [Verdict.NOT, Verdict.SHOWS] and verdict_of([first, *answers]) == "shows"
    _, answer = judged({"large": [10.0, 10.1, 9.9] * 2, "small": [10.0] * 6}, {}, {"asks": "Is it so?"})
    assert answer.found.pairs == 6, "no interval is precise enough"
    first, *answers = judged({"large": [12.0, 10.0, 14.0], "small": [10.0] * 3}, {}, asks)
    assert first.is_open and not any(one.is_open for one in answers)
    with pytest.raises(ConfigError, match="claim margin: all of comparisons ask why; name one that decides"):
        claims_of(asks)


def test_pairs_are_of_finished_runs_of_one_seed(judged):
    values = {"large": [12.0, 12.1, 11.9, 12.0], "small": [10.0, None, 10.0, 10.0]}
    (finding,) = judged(values)
    assert finding.common_seeds == finding.found.pairs == 3
    assert [(one.seed, other.seed) for one, other in finding.runs] == [
        (0, 0),
        (2, 2),
        (3, 3),
    ]
    (finding,) = judged(values, states={"a3": {"state": "running"}})  # its result is of an earlier training
    assert finding.common_seeds == 2 and finding.verdict is Verdict.UNDECIDED


def test_a_record_that_does_not_know_a_claims_row_is_named(judged, caplog):
    """As after a row is called something else: its runs would seem not to be there."""
    with caplog.at_level(logging.WARNING):
        (found,) = judged({"large": [30.0, 31.0, 32.0], "huge": [1.0, 2.0, 3.0]})
    assert found.verdict is Verdict.NOT_RUN and "of sweep epsilon, scale mini, has no row 'small'" in caplog.text
    assert "`python -m src.study scale=mini workers=0 published=true`" in caplog.text


@pytest.mark.parametrize(("override", "same"), [("y=1", False), ("x=huge", True)])
def test_runs_of_a_row_as_its_file_said_it_before_do_not_count(judged, caplog, override, same):
    """The rows' own x comes later than the file's."""
    values = {"large": [12.0, 12.1, 11.9], "small": [10.0] * 3}
    (found,) = judged(values, overrides=[override])
    assert found.verdict is (Verdict.SHOWS if same else Verdict.NOT_RUN)
    assert ("has no row 'large' as sweeps/ defines it" in caplog.text) != same


def test_finished_runs_without_the_number_are_named(judged):
    (finding,) = judged({"large": [12.0, 12.1, 11.9], "small": [10.0] * 3}, {"metrics": ["measures.moving_AP"]})
    assert finding.verdict is Verdict.NOT_RUN and len(finding.lacking) == 6
    (finding,) = judged({"large": [12.0, 12.1, 11.9], "small": [10.0, None, 10.0]})
    assert finding.lacking == []  # what has not run lacks nothing


def test_committed_records_know_every_row_that_the_claims_name(caplog):
    records, damaged = read_records(Path(__file__).parents[2] / "reports")
    assert records and not damaged
    for claim in load_claims(load_sweep):
        judge(claim, {record.name: record for record in records}, {})
    assert not caplog.text
