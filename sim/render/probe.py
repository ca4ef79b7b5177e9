"""Trying out in another process what may end, hang or slow down this one."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

_TIMEOUT_S = 20.0
_MARK = "answer:"


@cache
def answer(script: str) -> str | None:
    """Return what a Python script says after ``answer:`` in a process of its own.

    None if it fails, does not say, or takes too long. What else is printed does not matter. Each
    script is run once.
    """
    # It finds the same modules as this process.
    paths = os.pathsep.join(path for path in sys.path if path)
    try:
        done = subprocess.run(
            [sys.executable, "-c", script],
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
            env={**os.environ, "PYTHONPATH": paths},
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    said = [line for line in done.stdout.splitlines() if line.startswith(_MARK)]
    return said[-1].removeprefix(_MARK).strip() if done.returncode == 0 and said else None


def works(script: str) -> bool:
    """Return whether a script answers ``works`` (see `answer`)."""
    return answer(script) == "works"
