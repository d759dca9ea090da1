"""Stands for `python -m src.train`: no torch, some tenths of a second, the files and exit codes of a real run.

Knobs: fake.seconds, fake.exit (once per line left in <outputs>/faults/<run id>), fake.score, fake.epochs.
"""

import fcntl
import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path

from src.sweep.plan import RunIdentity, split_machine
from src.training.identity import is_of

SOURCE = ("phase", "model.dptf")


def identify(overrides):
    """Like src.sweep.Identifier: phase2 starts from the same command in phase1, less model.dptf."""
    known = ("phase", "scale", "seed", "optim.lr", "model", "data", "fake", "paths", "trainer", "resume", "logger")
    for override in overrides:
        if not is_of(override, known):
            from src.errors import ConfigError

            raise ConfigError(f"{override.split('=')[0]} is not a configuration key")
    what, _ = split_machine(overrides)
    keys = dict(override.split("=", 1) for override in what)
    phase, scale = keys.get("phase", "phase1"), keys.get("scale", "debug")
    told = sorted(override for override in what if not (phase == "phase1" and override.startswith("model.dptf")))
    digest = hashlib.sha256(json.dumps(told).encode()).hexdigest()[:8]
    source = None
    if phase == "phase2":
        source = ["phase=phase1", *[override for override in overrides if not is_of(override, SOURCE)]]
    return RunIdentity(f"fake-{phase}-{scale}-{digest}", scale, source, keys.get("phase.task", "detection"))


def main(overrides):
    run_id = identify(overrides).run_id
    keys = dict(override.split("=", 1) for override in overrides)
    outputs = Path(keys["paths.outputs"])
    folder = outputs / run_id
    folder.mkdir(parents=True, exist_ok=True)

    def note(what):
        with (outputs / "trained.txt").open("a") as file:
            file.write(f"{what} {run_id} {os.getpid()}\n")

    lock = (folder / ".lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        print(f"BusyError: {folder} is being trained by another process; wait for it or end it", file=sys.stderr)
        sys.exit(3)
    if (folder / "run.json").exists():
        print("shown again")
        return
    signal.signal(signal.SIGTERM, lambda *_: (note("interrupted"), sys.exit(6)))  # before a test can know it has begun
    note("begin")
    print("environment", os.environ.get("OMP_NUM_THREADS"), os.environ.get("CUDA_VISIBLE_DEVICES"))
    source = identify(overrides).source
    assert source is None or (outputs / identify(source).run_id / "run.json").is_file(), "started before its source"
    score = float(keys.get("fake.score", 0.25))
    epochs = int(keys.get("fake.epochs", 1))
    rows = ["step,epoch,val/mAP,val/NDS"]
    for epoch in range(epochs):
        time.sleep(float(keys.get("fake.seconds", 0.05)) / epochs)
        rows.append(f"{epoch},{epoch},{score},{score}")
        (folder / "metrics.csv").write_text("\n".join(rows) + "\n")
    faults = outputs / "faults" / run_id
    if faults.exists():
        code, *rest = faults.read_text().splitlines()
        faults.write_text("\n".join(rest)) if rest else faults.unlink()
        if code == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        print("Epoch 0: 50%\rEpoch 0: 100%\n\nDivergedError: the loss is nan at step 3\n")
        sys.exit(int(code))
    metrics = {"mAP": None if score != score else score, "NDS": None if score != score else score}
    record = {"run_id": run_id, "seconds": {"fit": 1.0, "all": 2.0}}
    if keys.get("phase.task", "detection") != "detection":
        metrics, record["headline"] = {"IoU": metrics["mAP"]}, "IoU"
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a result and its note belong together
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "run.json").write_text(json.dumps(record))
    note("end")


if __name__ == "__main__":
    main(sys.argv[1:])
