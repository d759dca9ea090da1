"""Commands as people type them."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def command(module, *overrides, expect=0, timeout=480):
    """Run `python -m src.<module>` at the root; its output, once it has ended with the expected exit code."""
    result = subprocess.run(
        [sys.executable, "-m", f"src.{module}", *overrides], cwd=ROOT, capture_output=True, text=True, timeout=timeout
    )
    assert result.returncode == expect, result.stdout[-3000:] + result.stderr[-3000:]
    return result
