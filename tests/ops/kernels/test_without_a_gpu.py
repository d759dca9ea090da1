"""The kernels where there is no GPU: their tests through Triton's interpreter, and their machine code for GPUs."""

import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[3]
pytestmark = [
    pytest.mark.skipif(find_spec("triton") is None, reason="Triton is not installed"),
    pytest.mark.skipif(os.environ.get("TRITON_INTERPRET") == "1", reason="this is the process of the interpreter"),
]


def python(*arguments, **variables):
    """Another process, because Triton decides when a kernel is defined whether it is interpreted."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment | {"OMP_NUM_THREADS": "1"} | variables,
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.mark.slow
def test_the_interpreter_passes_the_tests_of_the_kernels():
    done = python(
        *("-m", "pytest", "-q", "-p", "no:cacheprovider"),
        *("tests/ops/kernels", "tests/ops/test_farthest_point.py"),
        TRITON_INTERPRET="1",
        HORIZON3D_OPS="triton",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed and int(passed[1]) > 60, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("capability", "shared_bytes"),
    [
        ("86", 99 * 1024),  # the least shared memory
        *(pytest.param(name, kib * 1024, marks=pytest.mark.exhaustive) for name, kib in (("80", 163), ("90", 227))),
    ],
)
def test_the_compiler_takes_the_kernels(capability, shared_bytes, tmp_path):
    """The interpreter forgives what the compiler does not; Triton compiles for a GPU without having one."""
    done = python(
        *("tests/ops/kernels/compile_kernels.py", capability),
        TRITON_CACHE_DIR=str(tmp_path),
        TRITON_DUMP_PTXAS_LOG="1",
    )
    assert done.returncode == 0, done.stderr
    kernels = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len({kernel["kernel"] for kernel in kernels}) == 37, done.stdout
    assert max(kernel["shared"] for kernel in kernels) <= shared_bytes
    multiply = {kernel["kernel"] for kernel in kernels if kernel["tensor_cores"]}
    assert multiply == {"_gather_product", "_span_product"}
    spilled = re.findall(r"(\d+) bytes spill stores", done.stdout)
    assert len(spilled) >= 37 and set(spilled) == {"0"}, done.stdout


@pytest.mark.slow
def test_a_machine_without_cuda_never_imports_triton():
    if torch.cuda.is_available():
        pytest.skip("here is a CUDA device")
    code = (
        "import sys, torch; from src.ops import backend; from src.ops.farthest_point import farthest_points;"
        "farthest_points(torch.rand(1, 4, 2), torch.ones(1, 4).bool(), torch.zeros(1).long(), 2);"
        "print(backend.chosen(), 'triton' in sys.modules)"
    )
    done = python("-c", code)
    assert done.stdout.split("\n")[0] == "reference False", done.stdout + done.stderr
