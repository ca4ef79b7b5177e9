"""Run every benchmark and write the table of ``docs/benchmarks.md``.

    python benchmarks/table.py [--write] [PYTEST OPTIONS...]

Without ``--write`` the table is only printed. Times are processor time.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from visctrl.threads import LINEAR_ALGEBRA

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- benchmarks -->", "<!-- end of benchmarks -->"


def run(options: list[str]) -> dict[str, Any]:
    """Run the benchmarks and return what pytest-benchmark wrote."""
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "benchmarks.json"
        command = [
            *(sys.executable, "-m", "pytest", str(ROOT / "benchmarks")),
            *("-o", "python_files=perf_*.py", "-o", "pythonpath=. benchmarks"),
            *("--benchmark-timer=time.process_time", "--benchmark-disable-gc"),
            *(f"--benchmark-json={out}", "--benchmark-columns=median", *options),
        ]
        code = subprocess.run(
            command, cwd=ROOT, env={**os.environ, **LINEAR_ALGEBRA}, check=False
        ).returncode
        if not out.exists():
            raise SystemExit(code or 1)
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        return found


def machine() -> str:
    """Return the processor, its number of cores, and the versions that matter."""
    import cv2
    import numpy as np

    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        model = next(named, model)
    return (
        f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, "
        f"numpy {np.__version__}, OpenCV {cv2.__version__}"
    )


def table(found: dict[str, Any]) -> str:
    """Return the results as Markdown."""
    lines = [
        f"Machine: {machine()}. One thread; processor time.",
        "",
        "| benchmark | median | reference in the same run | ratio | aim | |",
        "|---|---|---|---|---|---|",
    ]
    for each in found["benchmarks"]:
        info = each["extra_info"]
        name = each["name"].removeprefix("test_").replace("_", " ")
        notes = ", ".join(f"{key} {value}" for key, value in info["notes"].items())
        reference = f"{info['against']}: {info['reference_ms']:.1f} ms"
        median = f"{info.get('ms', 1e3 * each['stats']['median']):.1f} ms"
        lines.append(
            f"| {name} | {median} | {reference} | {info['ratio']:.2f} | {info['bound']} | {notes} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Run, print, and write if asked to."""
    options = [option for option in sys.argv[1:] if option != "--write"]
    text = table(run(options))
    print(text)
    if "--write" in sys.argv[1:]:
        page = PAGE.read_text(encoding="utf-8")
        head, rest = page.split(BEGIN)
        _, tail = rest.split(END)
        PAGE.write_text(f"{head}{BEGIN}\n{text}\n{END}{tail}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
