"""What a Monte Carlo study costs, and what a second worker is worth.

The pose scheme drives an ideal robot from (−8 m, −12 m, −20°) to the target within 100 s at
10 Hz, 1 px noise, every run with a scene of its own. First `RUNS` runs with two workers: how
long they take. Then `ROUNDS` times a fifth as many with two workers and with one, in turn, so that
a machine that changes its speed changes it for both: the median ratio of the two times, start of
the workers included. All tables must be equal to the byte. Two processes that share nothing and
keep to arithmetic of the same kind measure what the machine itself allows.

    python benchmarks/bench_study.py [--runs N] [--rounds N] [--json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from two_cores import machine_ratio

from visctrl.runtime.config import to_yaml
from visctrl.runtime.interrupts import Interrupts
from visctrl.studies.loading import load_study
from visctrl.studies.log import StudyLog
from visctrl.studies.runner import run_study, table_rows
from visctrl.studies.table import write_table
from visctrl.studies.workers import LocalWorkers

RUNS, ROUNDS = 100, 3
SETTINGS = {
    "scheme": "pose",
    "camera": {"name": "hypercatadioptric", "mount": "front"},
    "start": {"x_m": -8, "y_m": -12, "phi_deg": -20},
    "duration_s": 120,
    "controller.tau_s": 95,
    "mock": {"ideal": True, "noise_px": 1},
}


def measure(study: Path, folder: Path, workers: int) -> tuple[float, list[dict[str, Any]], bytes]:
    """Run a study; return its time from start to table (s), its rows and the table."""
    loaded = load_study(str(study))
    began = time.perf_counter()
    loaded.check()
    with StudyLog(folder) as log, Interrupts() as interrupts:
        died = run_study(loaded, log, LocalWorkers(workers), interrupts)
        rows = table_rows(loaded, log, died)
        [table, *_] = write_table(rows, folder)
    return time.perf_counter() - began, rows, table.read_bytes()


def rounds(folder: Path, runs: int, count: int) -> tuple[list[float], bool]:
    """Return the ratio of two workers' time to one's, each round, and whether tables agree."""
    study = folder / "round.yaml"
    study.write_text(to_yaml({"settings": SETTINGS, "runs": runs}))
    ratios, tables = [], set()
    for number in range(count):
        two, _, table = measure(study, folder / f"two-{number}", 2)
        one, _, same = measure(study, folder / f"one-{number}", 1)
        ratios.append(two / one)
        tables |= {table, same}
    return ratios, len(tables) <= 1


def main() -> int:
    """Measure and print; return 0 if the tables are equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        study = Path(name) / "study.yaml"
        study.write_text(to_yaml({"settings": SETTINGS, "runs": chosen.runs}))
        took, rows, _ = measure(study, Path(name) / "all", 2)
        ratios, equal = rounds(Path(name), max(chosen.runs // 5, 4), chosen.rounds)
    simulated = sum(row["time_s"] for row in rows)
    found: dict[str, Any] = {
        "runs": chosen.runs,
        "reached": sum(row["status"] == "reached" for row in rows),
        "simulated_s": simulated,
        "two_workers_s": took,
        "real_time_factor": simulated / took,
        "rounds": [round(ratio, 3) for ratio in ratios],
        "two_over_one": statistics.median(ratios) if ratios else None,
        "machine_two_over_one": machine_ratio(),
        "tables_equal": equal,
    }
    if chosen.json:
        print(json.dumps(found, indent=2))
    else:
        for key, value in found.items():
            print(f"{key:<22} {value:.3f}" if isinstance(value, float) else f"{key:<22} {value}")
    return 0 if equal else 1


if __name__ == "__main__":
    sys.exit(main())
