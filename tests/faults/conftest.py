"""For the fault tests of trainings: a tiny world, and runs that nothing happened to."""

import pytest

from tests.faults import killing


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """(overrides of a run of a phase, the run that nothing happened to), each trained once."""
    base = tmp_path_factory.mktemp("undisturbed")
    known = {}

    def of_phase(phase):
        if phase not in known:
            source = ("phase.init_from=null",) if phase == "phase2" else ()
            overrides = [f"phase={phase}", *source, *killing.TINY, f"data.root={base / 'world'}"]
            known[phase] = overrides, undisturbed(base / phase, overrides)
        return known[phase]

    return of_phase


def undisturbed(outputs, overrides):
    """The result of a run to its end, the size of its checkpoint, and the CPU seconds to its first step and its end."""
    log = outputs.with_name(f"{outputs.name}.log")
    process = killing.start([*overrides, f"paths.outputs={outputs}"], log)
    first = end = 0.0
    while (used := killing.cpu_seconds(process.pid)) is not None:
        end = used
        if not first and killing.rows(outputs):
            first = used
        process.join(0.02)
    assert killing.wait(process, log) == 0, log.read_text()[-3000:]
    last = killing.run_folder(outputs) / "checkpoints" / killing.LAST
    return {
        "outcome": killing.outcome(outputs),
        "size": last.stat().st_size,
        "steps": killing.read_checkpoint(last)["global_step"],
        "first step": first,
        "end": end,
    }
