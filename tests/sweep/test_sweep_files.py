"""The files of sweeps/: the paper's numbers as reported, rows that compose and differ, and every mistake named."""

import json
import re
from dataclasses import replace
from functools import cache

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from src.config import CONF, GROUPS, build_config, compose_config, compose_tree
from src.errors import ConfigError
from src.report.metric_names import METRICS
from src.sweep import sweep_files
from src.sweep.compose import compose_sweep
from src.sweep.sweep_files import load_sweep

SCALES = sorted(path.stem for path in (CONF / "scale").glob("*.yaml"))
FILES = list(sweep_files.sweep_files())
QUESTIONS = [name for name in FILES if not load_sweep(name).is_search]
REPORTED = CONF.parent.parent / "shared" / "spec" / "reported_numbers.json"
LRS, LRS_REPORTED = "LRS4Fusion, ", REPORTED.with_name("lrs4fusion_reported.json")
"""Sources of the second paper begin so."""

METRIC_OF = {"latency_ms": "latency.gaussian_encoder", "FPS": "latency.fps", "mem_gb": "latency.memory_gb"}
"""Names of the reported numbers that are not the metric's own."""

# What of a configuration names its row in the reported table; the phase of a single-phase table is checked besides.
ROW_OF = {
    "table2": lambda c: {
        "kggi": c.model.kggi is not None and c.model.kggi.initialization.value == "both",
        "ocsf": c.model.ocsf is not None,
        "dptf": c.model.dptf is not None,
        "phase": int(c.phase.name[-1]),
    },
    "table3": lambda c: {"initialization": c.model.kggi.initialization.value},
    "table4": lambda c: {"margin_m": c.model.ocsf.margin_m},
    "table5": lambda c: {"bev": c.model.dptf.bev_path is not None, "gaussian": c.model.dptf.gaussian_path is not None},
    "table6": lambda c: {
        "path": "bev" if c.model.dptf.gaussian_path is None else "gaussian",
        "velocity_compensation": (c.model.dptf.bev_path or c.model.dptf.gaussian_path).velocity_compensation,
    },
    "table7": lambda c: {"sampling": c.model.dptf.gaussian_path.sampling.value},
    "table12": lambda c: {"margin_m": c.model.ocsf.margin_m},
    "table13": lambda c: {"temporal_self_attention": c.model.dptf.gaussian_path.self_attention is not None},
    "table14": lambda c: {"num_layers": c.model.ocsf.num_layers},
}
OTHER_METHODS = "comparison"
ALL_TABLES = {*(int(name[5:]) for name in ROW_OF), 1, 8, 9, 11, 15}


@cache
def base(scale, choices):
    """conf/ composed with group choices only; Hydra takes long for that, and rows share it."""
    return compose_tree([f"scale={scale}", "data.root=x", *choices])


def tree_of(scale, overrides):
    """As `compose_config`, with values set on a shared tree the way Hydra sets them, so that all rows take seconds."""
    choices = {override.split("=")[0]: override for override in overrides if override.split("=")[0] in GROUPS}
    tree = base(scale, tuple(choices.values())).copy()
    for change in OverridesParser.create().parse_overrides([o for o in overrides if o.split("=")[0] not in GROUPS]):
        OmegaConf.update(tree, change.key_or_group, change.value(), merge=True)
    return tree


def overrides_of(sweep, row):
    return [*sweep.overrides, *row.overrides]


def reported(path):
    if not path.is_file():
        pytest.skip(f"{path} is absent: nothing to compare the paper's numbers with")
    return json.loads(path.read_text())


def reported_tables(source):
    tables = reported(REPORTED)["tables"]
    return {f"table{number}": tables[f"table{number}"] for number in re.findall(r"\d+", source or "")}


def numbers_of(entry):
    """The results of a reported row by the names of our metrics."""
    numbers = {}
    for key, value in entry.items():
        if key == "ranges":
            numbers |= {f"ranges.{r}.{name}": number for r, both in value.items() for name, number in both.items()}
        elif key == "AP":
            numbers |= {f"classes.{name}.AP": number for name, number in value.items()}
        elif isinstance(value, bool):  # whether a part is there, not its latency
            continue
        elif METRIC_OF.get(key, key) in METRICS:
            numbers[METRIC_OF.get(key, key)] = value
        elif f"latency.{key}" in METRICS:
            numbers[f"latency.{key}"] = value
    return numbers


# ---------------------------------------------------------------- the paper's numbers


def test_every_table_of_results_has_its_sweep_and_only_one():
    names = [source for source in (load_sweep(name).source or "" for name in FILES) if not source.startswith(LRS)]
    sources = [int(number) for name in names for number in re.findall(r"\d+", name)]
    assert sorted(sources) == sorted(ALL_TABLES)


@pytest.mark.parametrize("name", [name for name in QUESTIONS if name != OTHER_METHODS and not name.startswith("lrs_")])
def test_paper_numbers_are_those_reported_for_the_rows_configuration(name):
    """The reported row is found by what the row configures, not by its label."""
    sweep = load_sweep(name)
    tables = reported_tables(sweep.source)
    assert tables or not any(row.paper for row in sweep.rows), "paper numbers need a source"
    assert not sweep.paper_rows
    for key, table in tables.items():
        found = []
        for row in sweep.rows:
            config = build_config(tree_of("paper", overrides_of(sweep, row)))
            if not row.paper:  # ours, beside the paper's
                trained = config.phase.init_from == "phase1" and config.phase.name == "phase1_further"
                assert trained or row.weights, row.label
                continue
            wanted = ROW_OF[key](config)
            (entry,) = [e for e in table["rows"] if wanted.items() <= e.items()]
            assert row.paper == numbers_of(entry), row.label
            assert table["phase"] == "mixed" or config.phase.name == f"phase{table['phase']}"
            assert config.backbone.name.value == "resnet50"
            found.append(table["rows"].index(entry))
        assert sorted(found) == list(range(len(table["rows"])))


def test_numbers_of_the_second_paper_are_those_reported():
    tables = reported(LRS_REPORTED)
    history, pretraining = (load_sweep(f"lrs_{name}") for name in ("history", "pretraining"))
    assert (history.source, pretraining.source) == (f"{LRS}Table 3", f"{LRS}Table 5")
    areas = {"Short": "51.2 m around", "Full": "-100 to 250 m"}
    wanted = {
        f"ViDAR, {row['history_s']} s, {areas[row['range']]}": {key: row[key] for key in ("cd_1s", "cd_3s")}
        for row in tables["table3_vidar_roi"]["rows"]
    }
    assert {row.label: row.paper for row in history.paper_rows} == wanted and not any(r.paper for r in history.rows)
    ours = [row for row in tables["table5_longrange_detection"]["rows"] if row["method"].startswith("LRS4Fusion")]
    assert ["w/o pre-train" in row["method"] for row in ours] == [True, False]
    names = {"": "mAP_full", "ranges.0-50.": "mAP_SR", "ranges.50-150.": "mAP_MR", "ranges.150-250.": "mAP_LR"}
    assert [row.paper for row in pretraining.rows] == [
        {f"long_range.{path}mAP": row[key] for path, key in names.items()} for row in ours
    ]
    configs = [build_config(tree_of("paper", overrides_of(pretraining, row))) for row in pretraining.rows]
    assert [config.phase.init_from for config in configs] == [None, "lrs_occupancy"]


def test_numbers_of_all_methods_are_those_reported():
    sweep = load_sweep(OTHER_METHODS)
    wanted = {}
    for key, table in reported_tables(sweep.source).items():
        for entry in table["rows"]:
            if entry.get("split", "val") == "val":
                backbone = entry.get("backbone", table.get("backbone"))
                numbers = wanted.setdefault((entry["method"], backbone == "V2-99"), {})
                for metric, value in numbers_of(entry).items():
                    assert numbers.setdefault(metric, value) == value, (key, entry["method"], metric)
    rows = [row for row in [*sweep.rows, *sweep.paper_rows] if row.paper]
    found = {(row.label.split(",")[0], "V2-99" in row.label): row.paper for row in rows}
    assert found == wanted


@pytest.mark.slow
@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("BEVFusion", "dense_bev"),
        ("CRT-Fusion", "crt_fusion"),
        ("HyDRa", "hydra"),
        ("SpaRC", "sparc"),
        ("PETR", "petr"),
        ("Far3D", "far3d"),
        ("RCTrans", "rctrans"),
    ],  # fmt: skip
)
def test_another_method_is_trained_as_ours(label, name):
    """Same phase, data and backbone as the row it is compared with, and the same settings of a head of its kind; only
    the model differs."""
    sweep = load_sweep(OTHER_METHODS)
    (row,) = [row for row in sweep.rows if row.label == label]
    (ours,) = [row for row in sweep.rows if row.label == sweep.baseline]
    for scale in SCALES:
        baseline, own = (build_config(tree_of(scale, overrides_of(sweep, one))) for one in (row, ours))
        assert (baseline.model.name, own.model.name) == (name, "horizon3d")
        for part in ("data", "backbone", "phase", "optim", "grid", "precision", "seed"):
            assert getattr(baseline, part) == getattr(own, part), (scale, part)
        dense = name in ("dense_bev", "crt_fusion", "hydra")  # others have a head of queries
        for key in ("nms", "score_threshold", "max_boxes", "attributes") if dense else ():
            assert getattr(baseline.model.head, key) == getattr(own.model.head, key)
        for key in ("heatmap_weight", "box_weight") if dense or name == "sparc" else ("box_weight",):
            assert getattr(baseline.model.loss, key) == getattr(own.model.loss, key)
        assert baseline.model.memory_max_age_s == own.model.memory_max_age_s and baseline.model.memory_frames > 0


def test_tables_show_every_number_of_the_paper_that_a_file_has():
    for name in QUESTIONS:
        sweep = load_sweep(name)
        columns = {column for table in sweep.tables for column in table.columns}
        assert {metric for row in [*sweep.rows, *sweep.paper_rows] for metric in row.paper} <= columns, name


# ---------------------------------------------------------------- rows


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
def test_every_row_composes_and_differs_from_the_others(scale):
    for name in QUESTIONS:
        sweep = load_sweep(name).at_scale(scale)
        trees = {}
        for row in sweep.rows:
            tree = tree_of(scale, overrides_of(sweep, row))
            build_config(tree)
            trees[row.label] = row.weights, OmegaConf.to_container(tree, resolve=True, enum_to_str=True)
        same = [(a, b) for a in trees for b in trees if a < b and trees[a] == trees[b]]
        assert not same, f"sweeps/{name}.yaml at scale={scale}: rows {same} train the same"


@pytest.mark.slow
def test_rows_compose_as_on_the_command_line():
    """The short cut of `tree_of` gives what the command gives."""
    for overrides in {tuple(overrides_of(sweep, sweep.rows[0])) for sweep in map(load_sweep, QUESTIONS)}:
        _, wanted = compose_config(["scale=debug", "data.root=x", *overrides])
        found = OmegaConf.to_container(tree_of("debug", overrides), resolve=True, enum_to_str=True)
        assert found == wanted, overrides


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_place_on_the_axis_is_the_value_trained(name):
    sweep = load_sweep(name)
    for row in sweep.rows:
        if row.x is not None:
            (override,) = row.overrides
            assert float(override.split("=")[1]) == row.x
            assert row.x == 0 or f"{row.x:g} " in row.label.replace("on, ", "")


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_row_has_something_to_be_compared_with(name):
    sweep = load_sweep(name)
    for row in sweep.rows:
        assert sweep.baseline_of(row.label) is not None
        assert set(row.scales or SCALES) <= set(SCALES)
    assert sweep.tables and sweep.plots and sweep.question.endswith("?")
    needs_latency = any(column.startswith("latency.") for table in sweep.tables for column in table.columns)
    assert sweep.latency == needs_latency


def test_tables_have_names_of_their_own():
    names = [table.name for name in FILES for table in load_sweep(name).tables]
    assert len(set(names)) == len(names)


def test_a_row_for_one_scale_is_the_papers_alone_at_others():
    sweep = load_sweep(OTHER_METHODS)
    small, full = sweep.at_scale("mini"), sweep.at_scale("paper")
    ours = ["Horizon3D", "Horizon3D, neck (ours)", "Horizon3D, velocities as regressed"]
    others = ["BEVFusion", "CRT-Fusion", "HyDRa", "RadarGNN", "SpaRC", "PETR", "Far3D", "RCTrans"]
    assert [row.label for row in small.rows] == [*ours, *others] and len(full.rows) == 14
    for paper_row, row in zip(small.paper_rows, full.rows[11:], strict=False):
        assert paper_row.label == row.label and paper_row.paper == row.paper and "V2-99" in row.label
    assert full.rows == [replace(row, scale_overrides={}) for row in sweep.rows] and small.baseline == "Horizon3D"


def test_overrides_of_a_scale_hold_at_that_scale_alone():
    sweep = load_sweep("lidar")
    small, full = sweep.at_scale("mini"), sweep.at_scale("paper")
    assert small.overrides == [*sweep.overrides, "data.world.lidar=true"] and full.overrides == sweep.overrides
    assert small.at_scale("mini") == small  # as a record keeps it
    cycles = load_sweep("cycles")
    small, full = ({row.label: row.overrides for row in cycles.at_scale(scale).rows} for scale in ("mini", "paper"))
    cycle = ["optim.lr=2.0e-4", "optim.rise_fraction=0.4", "optim.final_lr_ratio=1.0e-4"]
    assert small["memory, two cycles"] == ["phase=phase2", *cycle] and "memory, two cycles" not in full
    assert full["no memory, one cycle at once"] == ["phase=phase1", "phase.epochs=48"]


@pytest.mark.parametrize("scale", SCALES)
def test_what_a_search_may_try_can_be_trained(scale):
    sweep = load_sweep("tune")
    for key, dimension in sweep.space.items():
        for value in dimension.choices or [dimension.low, dimension.high]:
            config = build_config(tree_of(scale, [*sweep.overrides, f"{key}={value}"]))
            assert config.phase.validate_every == 1  # what a trial reports along the way


# ---------------------------------------------------------------- mistakes

GOOD = {
    "title": "A title",
    "question": "Which?",
    "baseline": "a",
    "tables": [{"name": "t", "title": "T", "columns": ["mAP"]}],
    "rows": [{"label": "a"}, {"label": "b", "overrides": ["optim.lr=1"]}],
}
SPACE = {key: value for key, value in GOOD.items() if key not in ("rows", "baseline")} | {
    "space": {"optim.lr": {"low": 1e-4, "high": 1e-3}},
    "trials": 3,
}


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Writes a file into a folder of sweeps that takes the place of ours."""
    monkeypatch.setattr(sweep_files, "SWEEPS", tmp_path)

    def write(content):
        text = content if isinstance(content, str) else json.dumps(content)  # JSON is YAML
        (tmp_path / "bad.yaml").write_text(text)

    return write


def test_what_the_mistakes_are_made_from_is_right(written):
    for content in (GOOD, SPACE):
        written(content)
        assert load_sweep("bad").name == "bad"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (GOOD | {"rows": [{"label": "a", "paper": {"mAPP": 1.0}}]}, "row 'a', paper: mAPP is not.*did you mean mAP"),
        (GOOD | {"tables": [{"name": "t", "title": "T", "columns": ["mAP", "latency.fsp"]}]}, "table t.*latency.fps"),
        (GOOD | {"plots": [{"metric": "NSD", "label": "x"}]}, "plots: NSD is not a metric"),
        (GOOD | {"rows": [{"label": "a"}, {"label": "a"}]}, "label a stands more than once"),
        (GOOD | {"paper_rows": [{"label": "b", "paper": {}}]}, "label b stands more than once"),
        (GOOD | {"titel": "x"}, "titel"),
        (GOOD | {"rows": [{"label": "a", "override": []}]}, "override"),
        (GOOD | {"rows": [{"overrides": []}]}, "label"),
        (GOOD | {"rows": [{"label": "a", "paper": {"mAP": "much"}}]}, "much"),
        (GOOD | {"rows": [{"label": "a", "paper": {"mAP": float("nan")}}]}, "mAP must be a valid number, but is 'NaN'"),
        (GOOD | {"baseline": "c"}, r"baseline 'c' is not the label of a row \(a, b\)"),
        (GOOD | {"rows": [{"label": "a"}, {"label": "b", "baseline": "c"}]}, "baseline 'c' is not the label"),
        (GOOD | {"rows": [{"label": "a"}, {"label": "b", "weights": "c"}]}, r"row 'b': weights 'c' must be.* \(a\)"),
        (
            GOOD | {"rows": [{"label": "a"}, {"label": "b", "weights": "a", "overrides": ["phase.epochs=3"]}]},
            "row 'b': phase.epochs=3 changes nothing of weights 'a'",
        ),
        (
            GOOD | {"rows": [{"label": "a", "weights": "b"}, {"label": "b", "weights": "a"}]},
            r"row 'a': weights 'b' must be the label of a row that is trained at every scale \(there is none\)",
        ),
        (GOOD | {"rows": [{"label": "a", "scales": ["paper"]}]}, "baseline 'a' must be for every scale"),
        (GOOD | {"tables": [{"name": "t", "title": "T", "columns": ["mAP"], "rows": ["z"]}]}, "t: there is no row z"),
        (GOOD | {"tables": GOOD["tables"] * 2}, r"two tables have one name \(t, t\)"),
        (GOOD | {"overrides": ["paths.outputs=/tmp/x"]}, "paths.outputs=/tmp/x is of a single call"),
        (GOOD | {"rows": [{"label": "a", "overrides": ["checkpoint=x"]}]}, "checkpoint=x is of a single call"),
        (GOOD | {"name": "other"}, "name=other: a sweep has its file's name"),
        (GOOD | {"scale_overrides": {"minni": []}}, "scale_overrides: there is no scale minni; there are .*mini"),
        (GOOD | {"rows": [{"label": "a", "scale_overrides": {"x": []}}]}, "scale_overrides: there is no scale x"),
        (GOOD | {"rows": [{"label": "a"}, {"label": "b", "scales": []}]}, "row 'b': scales is empty"),
        (
            GOOD | {"tables": [{"name": "t", "title": "T", "columns": ["mAP", "NDS", "mAP"]}]},
            "table t: columns names mAP more than once",
        ),
        (
            GOOD | {"tables": [{"name": "t", "title": "T", "columns": ["mAP"], "rows": ["a", "a"]}]},
            "table t: rows names a more than once",
        ),
        (GOOD | {"rows": []}, "either rows or space"),
        (SPACE | {"rows": GOOD["rows"]}, "either rows or space"),
        (SPACE | {"space": {"optim.lr": {"low": 1e-3, "high": 1e-4}}}, "space, optim.lr: low must be below high"),
        (SPACE | {"space": {"optim.lr": {"low": 0, "high": 1, "log": True}}}, "starts above 0"),
        (SPACE | {"space": {"optim.lr": {"low": 1}}}, "either low and high or choices"),
        (SPACE | {"space": {"optim.lr": {"choices": [1]}}}, "at least two"),
        (SPACE | {"trials": 0}, "trials must be at least 1"),
        (SPACE | {"objective": "NSD"}, "objective: NSD is not a metric"),
        (SPACE | {"objective": "mAVE"}, "objective: less of mAVE is better, but a search takes the largest"),
        (SPACE | {"objective": "latency.total"}, "objective: latency.total is no score of a validation"),
        ("title: [", ""),
        ("", ""),
        ("- a\n- b\n", ""),
    ],
    ids=lambda value: value if isinstance(value, str) and value else "",
)  # fmt: skip
def test_mistakes_in_a_file_are_named_with_it(written, content, message):
    written(content)
    with pytest.raises(ConfigError, match=rf"(?s)sweeps/bad\.yaml.*{message}"):
        compose_sweep(["+sweep=bad"])


def test_a_sweep_that_is_not_there_is_named_with_those_that_are(tmp_path):
    assert not (tmp_path / "epsilo.yaml").exists()
    with pytest.raises(ConfigError, match="no sweeps/epsilo.yaml; did you mean epsilon.*here are .*velocity"):
        compose_sweep(["+sweep=epsilo"])
    with pytest.raises(ConfigError, match="give one .sweep=NAME of .*epsilon.*got none"):
        compose_sweep(["scale=debug"])


def test_the_runs_part_of_a_command_line_is_kept_apart():
    command, rest = compose_sweep(["+sweep=paths", "seeds=3", "scale=debug", "optim.lr=1e-3"])
    assert (command.sweep.name, command.seeds, command.workers, rest) == (
        "paths",
        3,
        1,
        ["scale=debug", "optim.lr=1e-3"],
    )
    with pytest.raises(ConfigError, match="seeds must be at least 1"):
        compose_sweep(["+sweep=paths", "seeds=0"])
