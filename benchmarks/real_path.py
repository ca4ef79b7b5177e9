"""The whole real path: a robot emulated by one program and driven by another, on the wall clock.

Teaches the target in simulation, then for every scheme and kind of port starts
``visctrl emulate-pioneer`` and ``visctrl run --backend pioneer``. Prints where the robot truly
ended, how late the ticks were, what the emulator says of the packets that it received, and how
much processor time a hypervisor has kept from this machine meanwhile, which no program can make
up for.

    python benchmarks/real_path.py [--scheme NAME]... [--port pty|socket]... [--width PX] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
VISCTRL = [sys.executable, "-m", "visctrl"]
SCHEMES, PORTS = ("trifocal", "epipolar", "pose"), ("pty", "socket")
#: Where the camera sits, and what else a scheme wants to be told.
MOUNTS = {"pose": "front"}
START = ("-0.55", "-1.35", "-35")
LIMIT_S = 150.0


def main() -> int:
    """Run what is asked for; the exit code is 1 if any robot is not where it should be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scheme", action="append", choices=SCHEMES)
    parser.add_argument("--port", action="append", choices=PORTS)
    parser.add_argument("--width", default="800", help="image width (px)")
    parser.add_argument("--start", nargs=3, default=START, metavar=("X", "Y", "PHI_DEG"))
    parser.add_argument("--keep", type=Path, help="where to leave the runs' files")
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        site = Site((wanted.keep or Path(scratch)).resolve(), wanted.width, wanted.start)
        rows = [
            site.drive(scheme, port)
            for scheme in wanted.scheme or SCHEMES
            for port in wanted.port or PORTS
        ]
    print(json.dumps(rows, indent=2) if wanted.json else _table(rows))
    return 0 if all(row["good"] for row in rows) else 1


class Site:
    """Where the programs run, with the target view of each mount once it is taken.

    Parameters
    ----------
    folder : Path
        Receives the files.
    width : str
        Image width (px).
    start : sequence of str
        Start of the camera: x, y (m), φ (deg).
    """

    def __init__(self, folder: Path, width: str, start: Sequence[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._width = width
        self._start = start
        self._environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}

    def drive(self, scheme: str, port: str) -> dict[str, Any]:
        """Let one program drive the robot of another; return what came of it."""
        mount = MOUNTS.get(scheme, "centre")
        options = ["--set", f"camera.mount={mount}", "--set", f"camera.width={self._width}"]
        target = self._folder / f"target-{mount}.npz"
        if not target.exists():
            self._call("teach", "--backend", "sim", "-o", str(target), *options)
        out = self._folder / f"{scheme}-{port}"
        kind = "socket:0" if port == "socket" else port
        with self._emulator(kind, mount, Path(f"{out}.log")) as (emulator, line, url):
            stolen = _stolen_s()
            self._call(
                *("run", "--backend", "pioneer", "--scheme", scheme, "--target", str(target)),
                *("--port", line, "--camera-url", url, "--out", str(out), "--json", "--quiet"),
                *options,
            )
            stolen = _stolen_s() - stolen
            emulator.terminate()
            _, messages = emulator.communicate(timeout=20)
        summary = json.loads((out / "summary.json").read_text())
        return {**_row(scheme, port, summary, messages), "stolen_s": round(stolen, 1)}

    @contextmanager
    def _emulator(
        self, kind: str, mount: str, log: Path
    ) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
        """Give the emulator's process, the robot's port and the camera's URL."""
        command = ["emulate-pioneer", "--port", kind, "--mount", mount, "--width", self._width]
        emulator = subprocess.Popen(
            [*VISCTRL, *command, "--start", *self._start, "--log", str(log)],
            env=self._environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert emulator.stdout is not None
            yield emulator, emulator.stdout.readline().strip(), emulator.stdout.readline().strip()
        finally:
            emulator.kill()
            emulator.wait()

    def _call(self, *arguments: str) -> None:
        done = subprocess.run(
            [*VISCTRL, *arguments], env=self._environment,
            capture_output=True, text=True, timeout=LIMIT_S, check=False,
        )  # fmt: skip
        if done.stderr:
            print(done.stderr, end="", file=sys.stderr)
        if done.returncode not in (0, 1) or "Traceback" in done.stderr:
            raise SystemExit(f"{' '.join(arguments)}: exit code {done.returncode}")


def _stolen_s() -> float:
    """Return the processor time (s) that a hypervisor has kept from this machine (Linux)."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    except OSError:
        return 0.0
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


def _row(scheme: str, port: str, summary: dict[str, Any], messages: str) -> dict[str, Any]:
    ended = json.loads(messages.splitlines()[-1])
    camera, lateness = ended["camera"], summary["lateness_ms"]
    distance = 100.0 * math.hypot(camera["x_m"], camera["y_m"])
    good = summary["status"] == "reached" and not ended["violations"]
    return {
        "scheme": scheme,
        "port": port,
        "status": summary["status"],
        "distance_cm": round(distance, 2),
        "phi_deg": round(camera["phi_deg"], 2),
        "seconds": round(summary["duration_s"], 1),
        "ticks": summary["ticks"],
        "missed": summary["missed_ticks"],
        "late_p99_ms": round(lateness["p99"], 1),
        "tick_p99_ms": round(summary["compute_ms"]["p99"], 1),
        "packets": ended["packets"],
        "violations": len(ended["violations"]),
        "good": good and distance <= 2.0 and abs(camera["phi_deg"]) <= 1.0,
    }


def _table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table in Markdown."""
    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([str(v) for v in row.values()] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
