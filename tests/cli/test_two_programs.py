"""The whole real path: one program emulates the robot, another drives it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.realtime
@pytest.mark.sim
@pytest.mark.parametrize("port", ["pty", "socket"])
def test_taught_emulated_and_driven_by_separate_programs(port: str, tmp_path: Path) -> None:
    """The benchmark's judgement, from near by and with a small picture."""
    command = [sys.executable, str(ROOT / "benchmarks" / "real_path.py")]
    options = [
        "--scheme",
        "trifocal",
        "--port",
        port,
        "--width",
        "400",
        "--start",
        "0.2",
        "-1.5",
        "8",
    ]
    done = subprocess.run(
        [*command, *options], cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True,
        timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
