"""An hour of simulated time on the mock with random faults: it ends well and stays small.

First one run of an hour: the pose scheme creeps 14 m to the target while the camera goes black,
freezes and drops frames at random. Then an hour of short runs of all schemes in the same
process, with those faults and a dead link besides, longer than a run can bear: each must end as
a run may end, and be reported. Memory, open files, threads and the size of what is written are
watched throughout.

    python benchmarks/soak.py [--hours H] [--seed N] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.runtime.config import scenario_from
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.session import run_session

HOUR_S = 3600.0
#: Bounds: growth of the resident memory in an hour (MiB), size of a run directory and of its
#: tables per tick (bytes).
MOST_GROWTH_MIB, MOST_BYTES, MOST_BYTES_PER_TICK = 8.0, 64e6, 1200.0
#: Ends that a run with these faults may come to.
ALLOWED = {"reached", "missed", "doubtful", "lost"}
ALLOWED_FAULTS = ("does not answer", "the camera has frozen")
SCHEMES = ("trifocal", "epipolar", "pose")
#: Mean time between faults, and how long they last (s).
_EVERY_S, _SHORT_S, _LONG_S = 30.0, (0.2, 2.0), (2.0, 8.0)
_DROPS = 0.02
_PAGE_MIB = os.sysconf("SC_PAGE_SIZE") / 2**20

Span = tuple[float, float]


def resident_mib() -> float:
    """Return the memory that this process holds (MiB)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_MIB


def open_files() -> int:
    """Return how many files this process has open."""
    return len(os.listdir("/proc/self/fd"))


@dataclass
class MemoryLog(Observer):
    """Notes the memory every minute of simulated time."""

    minutes: list[float] = field(default_factory=list)

    def on_tick(self, record: TickRecord) -> None:
        """Take a note when a minute is over."""
        if record.t >= 60.0 * len(self.minutes):
            self.minutes.append(resident_mib())

    def growth(self) -> float:
        """Return how much the last minutes hold above what a sixth of the run held (MiB)."""
        settled = len(self.minutes) // 6
        return max(self.minutes[-3:]) - self.minutes[settled]


def spells(rng: np.random.Generator, until: float, length: Span) -> list[Span]:
    """Return times at which something is out of order, at random, one after the other."""
    found: list[Span] = []
    t = rng.exponential(_EVERY_S)
    while t < until:
        end = t + rng.uniform(*length)
        found.append((float(t), float(end)))
        t = end + rng.exponential(_EVERY_S)
    return found


def plan_for(data: dict[str, Any]) -> Plan:
    """Return the plan of a scenario."""
    return make_plan(scenario_from(data, "soak", (), REGISTRIES.backends.names()))


def long_run(hours: float, seed: int) -> Plan:
    """Return a run that lasts as long as asked for, with faults that it must survive."""
    rng = np.random.default_rng(seed)
    duration = hours * HOUR_S
    faults = {
        "camera_black_s": spells(rng, duration, _SHORT_S),
        "camera_frozen_s": spells(rng, duration, _SHORT_S),
        "frame_drop_probability": _DROPS,
    }
    return plan_for(
        {
            "backend": "mock",
            "scheme": "pose",
            "camera": {"mount": "front"},
            "start": {"x_m": -8, "y_m": -12, "phi_deg": -20},
            "duration_s": duration + 60.0,
            "seed": seed,
            # The task's time stands still while nothing is seen, a twelfth of the hour.
            "controller": {"tau_s": 0.9 * duration - 10.0},
            "mock": {"ideal": True, "noise_px": 1, "faults": faults},
        }
    )


def short_runs(seed: int) -> Iterator[Plan]:
    """Yield runs of all schemes with faults, some of which no run can survive."""
    rng = np.random.default_rng([seed, 1])
    while True:
        scheme = str(rng.choice(SCHEMES))
        until = 40.0
        faults = {
            "camera_black_s": spells(rng, until, _LONG_S),
            "camera_frozen_s": spells(rng, until, _SHORT_S),
            "link_dead_s": spells(rng, until, _SHORT_S)[:1] if rng.random() < 0.2 else [],
            "frame_drop_probability": float(rng.uniform(0.0, 0.2)),
        }
        start = {"x_m": rng.uniform(-0.6, 0.6), "y_m": rng.uniform(-2.5, -1.3), "phi_deg": 0.0}
        mock = {"noise_px": float(rng.uniform(0.1, 1.0)), "faults": faults}
        data = {"backend": "mock", "scheme": scheme, "start": start, "mock": mock}
        yield plan_for({**data, "seed": int(rng.integers(2**31))})


def is_ordered(message: str) -> bool:
    """Return whether a message tells of a fault that was ordered."""
    return any(text in message for text in ALLOWED_FAULTS)


def soak_one(hours: float, seed: int, folder: Path) -> dict[str, Any]:
    """Make the long run; return what it came to."""
    memory = MemoryLog()
    outcome = run_session(
        long_run(hours, seed), RunDirectory(folder, overwrite=True), observers=[memory]
    )
    summary = outcome.summary
    sizes = {path.name: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
    tables = sizes["ticks.csv"] + sizes["trajectory.tum"]
    return {
        "status": summary["status"],
        "reason": summary["reason"],
        "simulated_s": summary["duration_s"],
        "real_time_factor": summary["real_time_factor"],
        "ticks": summary["ticks"],
        "growth_mib": memory.growth(),
        "bytes": sum(sizes.values()),
        "bytes_per_tick": tables / summary["ticks"],
        "sizes": sizes,
        "notes": list(outcome.notes),
        # In so much noise the picture may leave it in doubt; the truth does not.
        "arrived": summary["truth"]["within_tolerance"],
        "ok": summary["truth"]["within_tolerance"]
        and memory.growth() <= MOST_GROWTH_MIB
        and sum(sizes.values()) <= MOST_BYTES
        and tables / summary["ticks"] <= MOST_BYTES_PER_TICK,
    }


def soak_many(hours: float, seed: int, folder: Path) -> dict[str, Any]:
    """Make short runs until they add up; return what they came to."""
    simulated, runs, wrong = 0.0, 0, []
    ends: Counter[str] = Counter()
    settled: tuple[float, int, int] | None = None
    for plan in short_runs(seed):
        outcome = run_session(plan, RunDirectory(folder, overwrite=True))
        summary = outcome.summary
        simulated += summary["duration_s"]
        runs += 1
        ends[summary["status"]] += 1
        expected = summary["status"] in ALLOWED or is_ordered(summary["reason"])
        if not expected or not all(map(is_ordered, outcome.notes)):
            wrong.append(f"{summary['scheme']}: {summary['reason']} {outcome.notes}")
        if settled is None and simulated >= hours * HOUR_S / 6.0:
            settled = resident_mib(), open_files(), threading.active_count()
        if simulated >= hours * HOUR_S:
            break
    assert settled is not None
    growth = resident_mib() - settled[0]
    leaked = open_files() - settled[1], threading.active_count() - settled[2]
    return {
        "runs": runs,
        "simulated_s": simulated,
        "ends": dict(ends),
        "wrong": wrong,
        "growth_mib": growth,
        "files_left_open": leaked[0],
        "threads_left": leaked[1],
        "ok": not wrong and growth <= MOST_GROWTH_MIB and leaked == (0, 0),
    }


def main() -> int:
    """Soak and print; return 0 if everything stayed within its bounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0, help="simulated, of either part")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        for part, soak in (("one run", soak_one), ("many runs", soak_many)):
            began = time.perf_counter()
            found[part] = soak(chosen.hours, chosen.seed, Path(name))
            found[part]["took_s"] = time.perf_counter() - began
    if chosen.json:
        print(json.dumps(found, indent=2))
    else:
        for part, values in found.items():
            print(part)
            for key, value in values.items():
                print(
                    f"  {key:<18} {value:.2f}" if type(value) is float else f"  {key:<18} {value}"
                )
    return 0 if all(part["ok"] for part in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
