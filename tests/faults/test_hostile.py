"""Files and words of strangers: checkpoints, tables, configurations, submissions; none of them is executed."""

import ast
import io
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from src import evaluate, export, predict, train
from src.config import CONF, compose_config, restore_config
from src.data import cache
from src.errors import CheckpointError, ConfigError, DataError
from src.metrics.submission import load_submission
from src.models.backbones.weights import BackboneName, load_backbone_weights
from src.reliability.checkpoints import AtomicCheckpointIO, read_checkpoint
from src.reliability.untrusted import fault_of_tree
from src.report import plain_yaml
from src.report.results import publish_result, read_result
from src.report.sweep_record import read_record
from src.streaming import StreamingDetector
from src.sweep.sweep_files import load_sweep

SRC = Path(train.__file__).parent
SECRET = "wk-5ecret-0123456789"


class Canary:
    """Pickled, it makes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.fixture
def canary(tmp_path):
    path = tmp_path / "executed"
    yield Canary(path)
    assert not path.exists(), "code of the file was executed"


@pytest.fixture
def secret(monkeypatch):
    monkeypatch.setenv("WANDB_API_KEY", SECRET)


# ---------------------------------------------------------------- the code itself

FORBIDDEN_CALLS = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen", "joblib.load", "shelve.open", "marshal.load",
    "marshal.loads", "pickle.load", "pickle.loads", "pickle.Unpickler", "yaml.unsafe_load", "yaml.full_load",
    "yaml.load_all", "yaml.unsafe_load_all", "hydra.utils.instantiate", "instantiate", "hydra.utils.get_class",
    "torch.hub.load", "torch.jit.load", "subprocess.getoutput", "subprocess.getstatusoutput",
    "cloudpickle.load", "dill.load", "OmegaConf.register_new_resolver",
}  # fmt: skip
FORBIDDEN_MODULES = {"joblib", "shelve", "marshal", "dill", "cloudpickle", "hydra.utils", "torch.hub", "xmlrpc"}
SAFE_LOADERS = {"_LOADER", "yaml.SafeLoader", "yaml.CSafeLoader"}
PACKED = "data/packed_batch.py"
"""Bytes between the processes of one training, through memory: multiprocessing itself pickles there."""


def offences(source, name):
    """Calls in a file by which content could be executed."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
            found += [module for module in modules if module in FORBIDDEN_MODULES]
            if isinstance(node, ast.ImportFrom) and node.module == "pickle":
                found.append("from pickle import")
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "pickle.Unpickler":
            found.append("pickle.Unpickler")
        if not isinstance(node, ast.Call):
            continue
        called, keywords = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
        if called in FORBIDDEN_CALLS and not called.startswith("re."):
            found.append(called)
        if called == "torch.load" and keywords.get("weights_only") != "True":
            found.append("torch.load without weights_only=True")
        if called.endswith(".fit") and "ckpt_path" in keywords and keywords.get("weights_only") != "True":
            found.append("Trainer.fit from a checkpoint without weights_only=True")
        if called in ("np.load", "numpy.load") and keywords.get("allow_pickle") != "False":
            found.append("np.load without allow_pickle=False")
        if called == "yaml.load" and keywords.get("Loader") not in SAFE_LOADERS:
            found.append("yaml.load with another loader")
        if keywords.get("shell", "False") != "False":
            found.append("a shell")
    return [] if name == PACKED and set(found) == {"pickle.Unpickler"} else found


@pytest.mark.parametrize(
    "line",
    ["pickle.loads(b'')", "from pickle import loads", "torch.load(p)", "torch.load(p, weights_only=False)",
     "np.load(p)",
     "np.load(p, allow_pickle=True)", "yaml.load(t, Loader=yaml.Loader)", "yaml.load(t, yaml.Loader)", "eval(t)",
     "exec(t)", "os.system(t)", "subprocess.run(t, shell=True)", "import joblib", "from hydra.utils import instantiate",
     "hydra.utils.instantiate(c)", "class U(pickle.Unpickler): pass", "trainer.fit(m, ckpt_path=p)"],
)  # fmt: skip
def test_the_search_finds_what_it_looks_for(line):
    assert offences(line, "x.py")


def test_nothing_that_is_read_is_executed():
    names = {str(path.relative_to(SRC)): path.read_text() for path in SRC.rglob("*.py")}
    found = {name: offences(source, name) for name, source in names.items()}
    assert len(found) > 150 and {name: what for name, what in found.items() if what} == {}
    loader = yaml.CSafeLoader if hasattr(yaml, "CSafeLoader") else yaml.SafeLoader
    assert plain_yaml._LOADER is loader


def test_the_configuration_names_no_code():
    for folder in (CONF, CONF.parent / "sweeps"):
        for path in folder.rglob("*.yaml"):
            assert "_target_" not in path.read_text() and "!!python" not in path.read_text(), path


# ---------------------------------------------------------------- checkpoints


@pytest.fixture(scope="module")
def tree():
    return compose_config(["scale=debug", "phase=phase1", "data.root=x"])[1]


def content(config):
    return {"state_dict": {"model.w": torch.zeros(3)}, "horizon3d": {"config": config}, "optimizer_states": []}


def planted(where, thing, config):
    """A checkpoint with `thing` somewhere in it."""
    whole = content(dict(config))
    if where == "state_dict":
        whole["state_dict"] = thing
    elif where == "a weight":
        whole["state_dict"]["model.x"] = thing
    elif where == "the configuration":
        whole["horizon3d"]["config"]["data"] = thing
    elif where == "a key":
        whole[("a", thing)] = 1
    else:
        whole[where] = [{"state": {0: {"exp_avg": thing}}}]
    return whole


@pytest.mark.parametrize("layout", ["torch", "old torch", "plain pickle"])
@pytest.mark.parametrize(
    "where", ["state_dict", "a weight", "the configuration", "a key", "optimizer_states", "callbacks", "loops"]
)
def test_code_anywhere_in_a_checkpoint_is_not_executed(tmp_path, canary, tree, where, layout):
    path = tmp_path / "x.ckpt"
    whole = planted(where, canary, tree)
    if layout == "plain pickle":
        path.write_bytes(pickle.dumps(whole))
    else:
        torch.save(whole, path, _use_new_zipfile_serialization=layout == "torch")
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        read_checkpoint(path)
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        load_backbone_weights(torch.nn.Linear(2, 2), path, BackboneName.resnet50)


def test_code_in_a_checkpoint_whose_digest_is_right_is_not_executed(tmp_path, canary, tree):
    """The digest says that a file is whole, not who wrote it."""
    path = tmp_path / "x.ckpt"
    torch.save(planted("a weight", canary, tree), path)
    good = tmp_path / "good.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(tree), good)
    rewritten(good, path, lambda name, data: pickle.dumps(canary, 2) if name.endswith("data.pkl") else data)
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        read_checkpoint(path)


@pytest.mark.parametrize(
    "command",
    [
        lambda path: evaluate.main(["scale=debug", f"checkpoint={path}", f"out={path.parent / 'out'}"]),
        lambda path: predict.main(["scale=debug", f"checkpoint={path}", f"out={path.parent / 'out'}"]),
        lambda path: export.main(["scale=debug", f"checkpoint={path}", f"out={path.parent / 'out.pt2'}"]),
        lambda path: StreamingDetector.load(path),
        lambda path: train.main(
            ["scale=debug", "phase=phase2", f"phase.init_from={path}", f"paths.outputs={path.parent / 'out'}"]
        ),
    ],
    ids=["evaluate", "predict", "export", "streaming", "train"],
)
def test_no_command_executes_a_checkpoint(tmp_path, canary, tree, command):
    path = tmp_path / "x.ckpt"
    torch.save(planted("optimizer_states", canary, tree), path)
    with pytest.raises(CheckpointError, match="nothing in it was executed"):
        command(path)


def rewritten(source, target, change=lambda name, data: data, more=(), method=zipfile.ZIP_STORED):
    """A copy of an archive with entries changed, added or compressed."""
    with zipfile.ZipFile(source) as old:
        entries = [(entry.filename, old.read(entry)) for entry in old.infolist()]
    with zipfile.ZipFile(target, "w", method) as new:
        for name, data in [*((name, change(name, data)) for name, data in entries), *more]:
            new.writestr(name, data)


BYTEARRAY = b"\x80\x02cbuiltins\nbytearray\nJ" + struct.pack("<i", 2**31 - 1) + b"\x85R."
"""A pickle that asks for two gigabytes and that torch allows."""


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("attack", "said"),
    [
        ("compressed", "compressed"),
        ("bytearray", "bytearray"),
        ("traversal", "leads out"),
        ("absolute", "leads out"),
        ("two pickles", "one data.pkl"),
        ("twice", "two entries of one name"),
        ("overlapping", "claim to be larger"),
        ("script", "compressed|one data.pkl"),
        ("no pickle", "builds objects|truncated or damaged"),
    ],
)
def test_archives_that_torch_never_wrote_are_refused(tmp_path, canary, tree, attack, said):
    good, path = tmp_path / "g.ckpt", tmp_path / "x.ckpt"
    whole = content(tree)
    whole["state_dict"] |= {"model.b": torch.zeros(40_000), "model.c": torch.zeros(40_000)}
    torch.save(whole, good)
    assert read_checkpoint(good)["state_dict"].keys() == whole["state_dict"].keys()
    evil = pickle.dumps(canary, 2)
    if attack == "compressed":  # zeros
        rewritten(good, path, more=[("g/data/9", bytes(2**26))], method=zipfile.ZIP_DEFLATED)
        assert path.stat().st_size < 2**19
    elif attack == "bytearray":
        rewritten(good, path, lambda name, data: BYTEARRAY if name.endswith("data.pkl") else data)
    elif attack == "traversal":
        rewritten(good, path, more=[("g/../../escaped", b"x")])
    elif attack == "absolute":
        rewritten(good, path, more=[("/tmp/escaped", b"x")])
    elif attack == "two pickles":
        rewritten(good, path, more=[("g/evil/data.pkl", evil)])
    elif attack == "twice":
        rewritten(good, path, more=[("g/data.pkl", evil)])
    elif attack == "overlapping":
        rewritten(good, path)
        counted_again(path)
    elif attack == "script":
        torch.jit.script(torch.nn.Linear(2, 2)).save(str(path))
    elif attack == "no pickle":
        rewritten(good, path, lambda name, data: b"hello" if name.endswith("data.pkl") else data)
    with pytest.raises(CheckpointError, match=said):
        read_checkpoint(path)


def counted_again(path):
    """Name the largest entry fifty times more in the directory, each time under another name."""
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
        entries = archive.infolist() + [largest] * 50
    end = data.rindex(b"PK\x05\x06")
    start = struct.unpack_from("<L", data, end + 16)[0]
    directory = b""
    for number, entry in enumerate(entries):
        name = f"g/data/{number + 100}".encode() if number >= len(entries) - 50 else entry.filename.encode()
        directory += struct.pack(
            "<4sHHHHHHLLLHHHHHLL", b"PK\x01\x02", 20, 20, 0, 0, 0, 33, entry.CRC, entry.compress_size, entry.file_size,
            len(name), 0, 0, 0, 0, 0, entry.header_offset,
        ) + name  # fmt: skip
    tail = struct.pack("<4sHHHHLLH", b"PK\x05\x06", 0, 0, len(entries), len(entries), len(directory), start, 0)
    path.write_bytes(data[:start] + directory + tail)


# ---------------------------------------------------------------- configurations


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("data.root", "${oc.env:WANDB_API_KEY}"),
        ("data.split", "${oc.env:WANDB_API_KEY}"),
        ("backbone.weights", "${oc.env:WANDB_API_KEY}"),
        ("optim.lr", "${oc.env:WANDB_API_KEY}"),
        ("scale", "${oc.env:WANDB_API_KEY}"),
        ("model.name", "${oc.env:WANDB_API_KEY}"),
        ("seed", "${oc.decode:'7'}"),
        ("out", "${oc.create:{a:1}}"),
        ("out", "${${scale}}"),
        ("${oc.env:WANDB_API_KEY}", 1),
        ("_target_", "os.system"),
        ("model._target_", "os.system"),
        ("model.kggi._target_", "os.system"),
        ("data.world._target_", "os.system"),
        ("hydra", {"run": {"dir": "/tmp"}}),
        ("scale", "../../../../tmp/evil"),
        ("model.name", "../evil"),
        ("phase.name", "../evil"),
        ("seed", [1, 2]),
    ],
)
def test_a_stored_configuration_is_values_and_nothing_else(tree, secret, key, value):
    stored = yaml.safe_load(yaml.safe_dump(tree))
    part, names = stored, [key] if key.startswith("$") else key.split(".")
    for name in names[:-1]:
        part = part[name]
    part[names[-1]] = value
    with pytest.raises((CheckpointError, ConfigError)) as caught:
        restore_config(stored, [])
    assert SECRET not in str(caught.value)


@pytest.mark.slow
def test_a_stored_configuration_says_no_place_to_write_to(tree, tmp_path):
    own = dict(tree) | {"paths": {"outputs": str(tmp_path / "home"), "reports": str(tmp_path / "etc")}}
    paths = restore_config(own, []).paths
    assert (paths.outputs, paths.reports) == ("outputs", "reports")
    assert restore_config(own, ["paths.outputs=mine"]).paths.outputs == "mine"


def test_a_stored_configuration_that_unfolds_without_end_is_refused(tree):
    part = ["x"]
    for _ in range(20):
        part = [part, part]
    stored = dict(tree) | {"out": part}
    with pytest.raises(CheckpointError, match="stands in two places"):
        restore_config(stored, [])
    part = {}
    part["itself"] = part
    assert "two places" in fault_of_tree(part)
    assert fault_of_tree(tree) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "override",
    [
        "out=${oc.env:WANDB_API_KEY}", "scene='${oc.env:WANDB_API_KEY}'", "data.root=${oc.env:WANDB_API_KEY,x}",
        "seed=${oc.decode:'7'}", "model.channels=${seed}", "out=${${scale}:HOME}",
        "+_target_=os.system", "model._target_=os.system", "+model._target_=os.system", "+model.kggi._target_=x",
        "hydra.searchpath=[file:///tmp]", "+hydra.searchpath=[file:///tmp]", "++hydra.searchpath=[pkg://os]",
        "hydra/job_logging=none", "hydra.run.dir=/tmp", "--config-dir=/tmp", "-cd=/tmp", "~model", "scale=../../x",
        "model=../../../../tmp/evil", "+x@_global_=../../x", "model@_global_=horizon3d",
        "optim.lr=!!python/name:os.system", "db=mysql://me:wk-5ecret-0123456789@h",
        "logger.wandb.project=x storage=postgresql://me:wk-5ecret-0123456789@h/db",
        "+wandb_api_key=wk-5ecret-0123456789", "logger.wandb.api_key=wk-5ecret-0123456789",
        "storage=postgresql://me:wk-5ecret-0123456789@h/db", "out=https://me:wk-5ecret-0123456789@h/x",
        "scene='host=h password=wk-5ecret-0123456789'",
    ],
)  # fmt: skip
def test_an_override_brings_in_nothing_but_values(secret, override):
    with pytest.raises(ConfigError) as caught:
        compose_config(["scale=debug", "data.root=x", override])
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        "title: ${oc.env:WANDB_API_KEY}\nquestion: q\nrows: [{label: a}]\n",
        "title: t\nquestion: q\nrows: [{label: a, overrides: ['optim.lr=${oc.decode:1}']}]\n",
        "title: t\nquestion: q\nrows: [{label: '${oc.env:WANDB_API_KEY}'}]\n",
        "title: t\nquestion: q\nrows: [{label: a, paper: {'${oc.env:WANDB_API_KEY}': 1}}]\n",
        "title: t\nquestion: q\nspace: {optim.lr: {choices: ['${oc.env:WANDB_API_KEY}', 1]}}\ntrials: 3\n",
        "title: t\nquestion: q\nrows: [{label: a}]\n_target_: os.system\n",
        "title: t\nquestion: q\nrows: [{label: a, _target_: os.system}]\n",
        "title: !!python/object/apply:os.mkdir [executed]\nquestion: q\nrows: [{label: a}]\n",
        "title: !!python/name:os.system\nquestion: q\nrows: [{label: a}]\n",
    ],
)
def test_a_sweep_file_brings_in_nothing_but_values(tmp_path, monkeypatch, secret, content):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("src.sweep.sweep_files.SWEEPS", tmp_path)
    (tmp_path / "bad.yaml").write_text(content)
    with pytest.raises(ConfigError, match="sweeps/bad.yaml") as caught:
        load_sweep("bad")
    assert SECRET not in str(caught.value) and not (tmp_path / "executed").exists()


# ---------------------------------------------------------------- tables, submissions, results


def test_a_cached_table_is_numbers_and_nothing_else(tmp_path, monkeypatch, caplog, canary):
    """One with objects in it is not read but built again."""
    folder = tmp_path / "root" / "v1"
    folder.mkdir(parents=True)
    built = object()
    monkeypatch.setattr(cache, "build_index", lambda root, version, labels: built)
    monkeypatch.setattr(cache, "_write", lambda path, index: None)
    path = tmp_path / "cache" / f"tables-v1-{cache._digest(folder)}.npz"
    path.parent.mkdir()
    names = [field.name for field in cache.fields(cache.DatasetIndex) if field.name not in ("root", "version")]
    with path.open("wb") as file:
        np.savez(file, **{name: np.array([canary], dtype=object) for name in names})
    assert cache.load_index(tmp_path / "root", "v1", tmp_path / "cache") is built
    assert "broken" in caplog.text


@pytest.mark.parametrize("version", ["..", "../root/v1", "/etc", "", ".", "v1/../../x", "v1\0"])
def test_a_release_lies_inside_the_data_folder(tmp_path, version):
    (tmp_path / "root" / "v1").mkdir(parents=True)
    (tmp_path / "root" / "v1" / "scene.json").write_text("[]")
    with pytest.raises((DataError, ValueError), match="no such folder of tables|null"):
        cache.load_index(tmp_path / "root", version, tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    "content",
    [b"", b"\x80\x04\x95", b"[" * 200_000, b'{"meta": {}, "results": ' + b'{"a":' * 100_000, b"!!python/name:os.system",
     b'{"meta": {}, "results": {"../../etc/passwd": []}}', b'{"meta": {}, "results": {"t": [{"sample_token": "t"}]}}',
     b'{"meta": {}, "results": {"t": ["__import__(\'os\')"]}}',
     b'{"meta": {}, "results": {"t": ' + b"9" * 9999 + b"}}"],
    ids=["empty", "pickle", "deep list", "deep object", "yaml", "path", "no box", "code", "long number"],
)  # fmt: skip
def test_a_submission_is_boxes_and_nothing_else(tmp_path, canary, content):
    path = tmp_path / "x.json"
    path.write_bytes(pickle.dumps(canary) if content.startswith(b"\x80") else content)
    with pytest.raises(DataError, match=r"x\.json"):
        load_submission(path, ["t"])


@pytest.mark.parametrize(
    "content", [b"", b"[" * 200_000, b'{"a":' * 100_000, b"\x80\x04\x95", b'{"format": 1}', b"\xff"]
)
def test_results_and_records_are_json_and_nothing_else(tmp_path, canary, content):
    path = tmp_path / "x.json"
    path.write_bytes(pickle.dumps(canary) if content.startswith(b"\x80") else content)
    for read in (read_result, read_record):
        with pytest.raises(DataError, match=r"x\.json"):
            read(path)


@pytest.mark.parametrize("run_id", ["../../escaped", "/tmp/escaped", "..", "", "a/b", "a\nb"])
def test_a_run_folder_says_no_place_to_write_to(tmp_path, world_of_runs, run_id):
    folder, reports = world_of_runs, tmp_path / "deep" / "down" / "reports"
    text = (folder / "run.json").read_text()
    (folder / "run.json").write_text(text.replace(f'"run_id": "{folder.name}"', f'"run_id": {yaml_quoted(run_id)}'))
    with pytest.raises(DataError, match="run_id must be the name of a folder"):
        publish_result(folder, reports)
    assert not list(tmp_path.rglob("*escaped*"))


def yaml_quoted(text):
    return '"' + text.replace("\n", "\\n") + '"'


@pytest.fixture
def world_of_runs(tmp_path, monkeypatch):
    """The folder of a finished run, as the dashboard's tests make it up."""
    from tests.dashboard.experiments import write_run

    folder = write_run(tmp_path / "outputs", "horizon3d-phase1-mini-0000000a", 0, 0.4, 4.8)
    assert publish_result(folder, tmp_path / "reports").is_file()
    return folder


LETTERS = "abcdefghijklmnopqrstuvwxyz"
BOMBS = {
    "aliases": "a: &a [x, x]\n"
    + "".join(f"{n}: &{n} [*{o}, *{o}]\n" for o, n in zip(LETTERS, LETTERS[1:], strict=False)),
    "depth": "a: " + "[" * 200_000 + "]" * 200_000,
    "tag": "model: !!python/object/apply:os.mkdir [executed]\n",
}  # fmt: skip


@pytest.mark.parametrize("bomb", BOMBS)
def test_the_configuration_of_a_run_folder_is_values_and_nothing_else(tmp_path, monkeypatch, world_of_runs, bomb):
    monkeypatch.chdir(tmp_path)
    text = (world_of_runs / "config.yaml").read_text()
    (world_of_runs / "config.yaml").write_text(text + BOMBS[bomb])
    with pytest.raises(DataError, match=r"config\.yaml: not a run's configuration"):
        publish_result(world_of_runs, tmp_path / "reports")
    assert not (tmp_path / "executed").exists()


def test_pickles_of_torchs_own_kinds_pass(tmp_path):
    """Whatever a run keeps: tensors of every type, ordered dictionaries, sizes, random states."""
    whole = content({"a": 1})
    types = ("float64", "float32", "float16", "bfloat16", "int64", "int32", "uint8", "bool")
    whole["more"] = [torch.zeros(2, dtype=getattr(torch, name)) for name in types] + [torch.Size([1, 2]), torch.float32]
    whole["parameter"] = torch.nn.Parameter(torch.zeros(2))
    whole["random"] = torch.get_rng_state()
    stream = io.BytesIO()
    torch.save(whole, stream)
    path = tmp_path / "x.ckpt"
    path.write_bytes(stream.getvalue())
    assert len(read_checkpoint(path)["more"]) == 10
