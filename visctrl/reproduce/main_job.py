"""How reliably the main job ends on the target: many starts, every camera, both robots."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from visctrl.reproduce.entry import Bench, Row, at_least, within
from visctrl.studies.run_spec import RunSpec

SCENARIO = "default"
SEED = 48
COUNT = 48
#: Ranges of the start: x right (m), y forward (m), φ counter-clockwise (deg).
X, Y, PHI = (-1.2, 1.2), (-3.5, -1.2), (-35.0, 35.0)

Start = tuple[float, float, float]
Summary = Mapping[str, Any]

#: Starts from which each camera sees enough of the target's surroundings.
CAMERA_STARTS: tuple[tuple[str, str, Start], ...] = (
    ("p3dx", "hypercatadioptric", (-0.55, -1.35, -35.0)),
    ("p3dx", "paracatadioptric", (-0.55, -1.35, -35.0)),
    ("p3dx", "fisheye", (-0.55, -1.8, -20.0)),
    ("p3dx", "perspective", (-0.3, -1.8, -9.0)),
    ("p3at", "hypercatadioptric", (-0.55, -1.35, -35.0)),
)


def seeded_starts(count: int = COUNT, seed: int = SEED) -> list[Start]:
    """Return ``count`` starts (m, m, deg), drawn evenly from `X`, `Y` and `PHI`."""
    rng = np.random.default_rng(seed)
    low, high = np.transpose([X, Y, PHI])
    drawn = rng.uniform(low, high, (count, 3))
    return [(round(x, 3), round(y, 3), round(phi, 2)) for x, y, phi in drawn.tolist()]


def starts(bench: Bench) -> list[Row]:
    """Drive from `COUNT` seeded starts; return how many arrive and how near."""
    drawn = seeded_starts()
    jobs = [_job(start, seed=index) for index, start in enumerate(drawn)]
    summaries = bench.run(jobs)
    cases = [f"{x:+.2f} {y:+.2f} {phi:+.1f}" for x, y, phi in drawn]
    _write_tables(bench, cases, summaries)
    near = [_within(s, 0.02, 1.0) for s in summaries]
    errors = [final_error(s) for s in summaries]
    position = float(np.median([e[0] for e in errors]))
    heading = float(np.median([e[1] for e in errors]))
    touched = sum("touched" in s["reason"] for s in summaries)
    broken = sum(s["status"] == "fault" for s in summaries)
    share = 100.0 * sum(near) / len(near)
    return [
        at_least("within 2 cm and 1 deg", {"share_pct": 95.0}, {"share_pct": share}),
        within(
            "median error",
            {"position_cm": 0.5, "phi_deg": 0.3},
            {"position_cm": position, "phi_deg": heading},
        ),
        within("runs that touched something", {"runs": 0}, {"runs": touched}),
        within("runs that ended in a fault", {"runs": 0}, {"runs": broken}),
    ]


def cameras(bench: Bench) -> list[Row]:
    """Drive once with every camera, and with the skid-steer robot."""
    jobs = [
        _job(start, 0, f"robot={robot}", f"camera.name={camera}")
        for robot, camera, start in CAMERA_STARTS
    ]
    summaries = bench.run(jobs)
    cases = [f"{robot} {camera} {start}" for robot, camera, start in CAMERA_STARTS]
    _write_tables(bench, cases, summaries)
    return [
        within(
            case,
            {"position_cm": 2.0, "phi_deg": 1.0},
            dict(zip(("position_cm", "phi_deg"), final_error(summary), strict=True)),
        )
        for case, summary in zip(cases, summaries, strict=True)
    ]


def _job(start: Start, seed: int, *settings: str) -> RunSpec:
    x, y, phi = start
    where = (f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}", f"seed={seed}")
    return RunSpec(SCENARIO, (*where, *settings))


def final_error(summary: Summary) -> tuple[float, float]:
    """Return the final distance (cm) and absolute heading error (deg)."""
    error = summary["final_error"]
    if error is None:
        return math.inf, math.inf
    return 100.0 * math.hypot(error["x_m"], error["y_m"]), abs(error["phi_deg"])


def _within(summary: Summary, position_m: float, heading_deg: float) -> bool:
    position_cm, heading = final_error(summary)
    reached = summary["status"] == "reached"
    return reached and position_cm <= 100.0 * position_m and heading <= heading_deg


def _write_tables(bench: Bench, cases: Sequence[str], summaries: Sequence[Summary]) -> None:
    """Write what every run gave, as CSV and as a Markdown table."""
    columns = ("start", "status", "x_cm", "y_cm", "phi_deg", "path_m", "time_s", "features")
    rows = [_cells(case, s) for case, s in zip(cases, summaries, strict=True)]
    with (bench.out / "runs.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])
    lines = ["| " + " | ".join(cells) + " |" for cells in [columns, ["---"] * 8, *rows]]
    (bench.out / "runs.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cells(case: str, summary: Summary) -> list[str]:
    error = summary["final_error"] or {"x_m": math.nan, "y_m": math.nan, "phi_deg": math.nan}
    return [
        case,
        str(summary["status"]),
        f"{100 * error['x_m']:+.2f}",
        f"{100 * error['y_m']:+.2f}",
        f"{error['phi_deg']:+.2f}",
        f"{summary['path_length_m']:.2f}",
        f"{summary['duration_s']:.1f}",
        str(summary["features"]["min"]),
    ]
