"""What a Monte Carlo study costs, and what a second worker is worth.

The pose scheme drives an ideal robot from (−8 m, −12 m, −20°) to the target within 100 s at
10 Hz, 1 px noise, every run with a scene of its own: `RUNS` runs with one worker, then the same
with two. The tables must be equal; the ratio of the two wall-clock times is what counts, as the
machine is the same for both. Two processes that only count measure what the machine itself
allows: on shared cores even they do not take half the time.

    python benchmarks/bench_study.py [--runs N] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.config import to_yaml
from visctrl.experiments.study_log import StudyLog
from visctrl.experiments.study_runs import run_study, table_rows
from visctrl.experiments.study_table import write_table
from visctrl.experiments.trials import load_study
from visctrl.experiments.workers import LocalWorkers
from visctrl.runtime.interrupts import Interrupts

RUNS = 100
SETTINGS = {
    "scheme": "pose",
    "camera": {"name": "hypercatadioptric", "mount": "front"},
    "start": {"x_m": -8, "y_m": -12, "phi_deg": -20},
    "duration_s": 120,
    "controller.tau_s": 95,
    "mock": {"ideal": True, "noise_px": 1},
}
_COUNTS = 10_000_000


def count_up(number: int) -> int:
    """Keep a core busy for about as long as a run takes."""
    total = 0
    for value in range(_COUNTS):
        total += value ^ number
    return total


def machine_ratio() -> float:
    """Return the time of two workers over that of one, for work that shares nothing at all."""
    took = []
    for workers in (1, 2):
        each = LocalWorkers(workers).each(count_up, range(8))
        next(each)
        began = time.perf_counter()
        list(each)
        took.append(time.perf_counter() - began)
    return took[1] / took[0]


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


def main() -> int:
    """Measure and print; return 0 if the tables are equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        study = Path(name) / "study.yaml"
        study.write_text(to_yaml({"settings": SETTINGS, "runs": chosen.runs}))
        two, rows, table = measure(study, Path(name) / "two", 2)
        one, _, same = measure(study, Path(name) / "one", 1)
    simulated = sum(row["time_s"] for row in rows)
    found = {
        "runs": chosen.runs,
        "reached": sum(row["status"] == "reached" for row in rows),
        "simulated_s": simulated,
        "one_worker_s": one,
        "two_workers_s": two,
        "two_over_one": two / one,
        "machine_two_over_one": machine_ratio(),
        "real_time_factor_one": simulated / one,
        "real_time_factor_two": simulated / two,
        "tables_equal": table == same,
    }
    if chosen.json:
        print(json.dumps(found, indent=2))
    else:
        for key, value in found.items():
            print(f"{key:<22} {value:.3f}" if isinstance(value, float) else f"{key:<22} {value}")
    return 0 if found["tables_equal"] else 1


if __name__ == "__main__":
    sys.exit(main())
