"""Chapter 4 of the source: pose estimation and Cartesian control, made again.

Table 4.1 and the simulated figures run on the mock: an ideal robot whose motion scatters by
2 mm/s and 0.1 deg/s, features projected into images with 1 px noise, a scene of its own for
every run. The robot experiment runs on the simulator.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from typing import Any

import numpy as np

from visctrl.reproduce.cases import Start, Summary, errors, named, start_name
from visctrl.reproduce.chapter4_plots import plot_consistency, plot_errors
from visctrl.reproduce.chapter4_runs import (
    COLUMNS,
    Array,
    Averages,
    averages,
    ended,
    noisy,
    run_traced,
    spread,
    told_start,
)
from visctrl.reproduce.entry import Bench, Row, at_least, at_most
from visctrl.study import intervals
from visctrl.study.run_spec import RunSpec

#: Table 4.1: start (m, m, deg), magnitudes of the published means (cm, cm, deg).
TABLE_4_1: tuple[tuple[Start, tuple[float, float, float]], ...] = (
    ((2.0, -12.0, 45.0), (0.90, 0.54, 0.10)),
    ((-6.0, -16.0, -20.0), (0.90, 1.5, 0.05)),
    ((8.0, -8.0, 50.0), (6.4, 1.3, 1.0)),
    ((-6.0, -18.0, -70.0), (3.5, 17.0, 1.0)),
    ((-8.0, -12.0, -20.0), (3.4, 1.4, 0.5)),
)
RUNS = 100
#: What the source's deviations amount to with C1 exact, and what the better filter must reach
#: with the target view averaged over ten frames and with a single one (cm, cm, deg).
SOURCE_DEVIATION = (1.5, 1.5, 0.5)
MEAN, DEVIATION, DEVIATION_SINGLE = (0.5, 0.5, 0.3), (1.0, 1.0, 0.3), (2.5, 2.5, 0.3)
#: Starts from which NEES and NIS are judged step by step, and how many steps must be inside.
CONSISTENT_STARTS = (*(start for start, _ in TABLE_4_1[:3]), TABLE_4_1[4][0])
INSIDE_PCT = 90.0
#: A run that ends farther away than this (cm) has diverged.
DIVERGED_CM = 25.0

#: The source's filter: T111 over T121, the linear tensor, 2 Hz. Both fixed views are averages of
#: ten frames, as their noise, the same at every step, is what it cannot cope with. As published,
#: the images are all that is noisy: the motion does not scatter.
_SOURCE = (
    *("estimator.name=ekf", "rate_hz=2", "mock.features=60"),
    *("target.frames=10", "estimator.initial_frames=10"),
    *("mock.scatter.v_m_s=0", "mock.scatter.omega_deg_s=0"),
)
_BETTER = ("mock.features=20", "rate_hz=10")


def table_4_1(bench: Bench) -> list[Row]:
    """Return the three blocks of the table, and the better filter with a single target view."""
    rows = [*source_exact(bench), *source_initialised(bench), *better(bench)]
    return [*rows, *better_single(bench)]


def source_exact(bench: Bench) -> list[Row]:
    """Return the block of the source's filter with C1 exact."""
    rows = []
    for (start, published), group in zip(TABLE_4_1, _block(bench, "exact", exact), strict=True):
        found = spread(_errors(group))
        bounds = _both(np.add(published, found.half), np.array(SOURCE_DEVIATION))
        ours = _both(found.mean, found.deviation)
        rows.append(at_most(f"source's filter, C1 exact: {start_name(start)}", bounds, ours))
    return rows


def source_initialised(bench: Bench) -> list[Row]:
    """Return the block of the source's filter with C1 from its closed form: shown, not judged."""
    rows = []
    groups = _block(bench, "initialised", lambda start, seed: noisy(start, seed, *_SOURCE))
    for (start, _), group in zip(TABLE_4_1, groups, strict=True):
        found = spread(_errors(group))
        ours = {**_both(found.mean, found.deviation), "runs_ended": sum(map(ended, group))}
        rows.append(Row(f"source's filter, C1 found: {start_name(start)}", {}, ours, True))
    return rows


def better(bench: Bench) -> list[Row]:
    """Return the block of the consistent filter: errors, divergence, NEES and NIS."""
    job = _averaged_target
    groups = _block(bench, "better", job)
    rows = _better_rows("consistent filter", groups, DEVIATION)
    diverged = sum(not ended(s) or _distance(s) > DIVERGED_CM for group in groups for s in group)
    rows.append(at_most(f"diverged of {sum(map(len, groups))}", {"runs": 0}, {"runs": diverged}))
    judged = {
        start_name(start): averages([s["trace"] for s in group])
        for (start, _), group in zip(TABLE_4_1, groups, strict=True)
        if start in CONSISTENT_STARTS
    }
    plot_consistency(bench.out, judged)
    return [*rows, *(inside_row(f"NEES and NIS: {name}", a) for name, a in judged.items())]


def better_single(bench: Bench) -> list[Row]:
    """Return the block of the consistent filter with a single target view, at 2 Hz."""
    settings = (*_BETTER, "rate_hz=2", "target.frames=1")
    groups = _block(bench, "single", lambda start, seed: noisy(start, seed, *settings))
    return _better_rows("single target view", groups, DEVIATION_SINGLE)


def figure_4_2(bench: Bench) -> list[Row]:
    """Run a hundred times from one start: errors within 2σ, NEES and NIS.

    Steps of one run are far from independent: the errors of its start stay with it to the end. Of
    the steps, chance can therefore leave a large share outside; runs are independent, and a
    consistent filter's mean NEES of a run is 1 within the interval that they give.
    """
    start = CONSISTENT_STARTS[-1]
    summaries = bench.run([_averaged_target(start, 7000 + k) for k in range(RUNS)], run_traced)
    _write(bench, "fig-4.2", [start] * RUNS, summaries)
    traces = [summary["trace"] for summary in summaries]
    found = averages(traces)
    plot_errors(bench.out, traces, f"{RUNS} runs from {start_name(start)}: errors and 2σ")
    plot_consistency(bench.out, {start_name(start): found})
    return [
        nees_row(traces),
        Row("steps inside the bounds", {}, inside_shares(found), True),
        at_most("errors within 2σ", {"outside_pct": 10.0}, {"outside_pct": _outside(traces)}),
        at_most(
            "index (value over upper bound), mean",
            {"nees": 1.0, "nis": 1.0},
            {
                "nees": float(np.mean(found.nees / found.nees_bounds[:, 1])),
                "nis": float(np.mean(found.nis / found.nis_bounds[:, 1])),
            },
        ),
    ]


def exact(start: Start, seed: int) -> RunSpec:
    """Return a run of the source's filter that is told C1."""
    return noisy(start, seed, *_SOURCE, told_start(start))


def inside_row(case: str, found: Averages) -> Row:
    """Return a row that is ok if enough steps lie between the bounds, for NEES and for NIS."""
    return at_least(case, {"nees_pct": INSIDE_PCT, "nis_pct": INSIDE_PCT}, inside_shares(found))


def inside_shares(found: Averages) -> dict[str, float]:
    """Return how many steps lie between the bounds (%), and the means per degree of freedom."""
    return {
        "nees_pct": 100.0 * found.nees_inside,
        "nis_pct": 100.0 * found.nis_inside,
        "nees_mean": float(found.nees.mean()),
        "nis_mean": float(found.nis.mean()),
    }


def nees_row(traces: Sequence[Array]) -> Row:
    """Return a row that is ok if runs agree with a mean NEES of 1 per degree of freedom."""
    nees = COLUMNS.index("nees")
    value, low, high = intervals.mean(np.array([np.mean(t[:, nees]) / 3.0 for t in traces]))
    if low is None or high is None:
        raise ValueError("one run has no interval")
    ours = {"mean": value, "low": low, "high": high}
    return Row("mean NEES of a run: 1 is in its 95 % interval", {}, ours, low <= 1.0 <= high)


def _averaged_target(start: Start, seed: int) -> RunSpec:
    return noisy(start, seed, *_BETTER, "target.frames=10")


def _block(
    bench: Bench, name: str, job: Any, seeds: Sequence[int] = range(4000, 4000 + RUNS)
) -> list[list[dict[str, Any]]]:
    """Run a block of the table and return its runs, start by start."""
    starts = [start for start, _ in TABLE_4_1]
    jobs = [job(start, 1000 * k + seed) for k, start in enumerate(starts) for seed in seeds]
    summaries = bench.run(jobs, run_traced)
    _write(bench, name, [start for start in starts for _ in seeds], summaries)
    return [summaries[k : k + len(seeds)] for k in range(0, len(summaries), len(seeds))]


def _better_rows(
    name: str, groups: Sequence[Sequence[Summary]], deviation: tuple[float, float, float]
) -> list[Row]:
    rows = []
    for (start, _), group in zip(TABLE_4_1, groups, strict=True):
        found = spread(_errors(group))
        bounds = _both(np.array(MEAN), np.array(deviation))
        ours = _both(found.mean, found.deviation)
        rows.append(at_most(f"{name}: {start_name(start)}", bounds, ours))
    return rows


def _errors(summaries: Sequence[Summary]) -> Array:
    return np.array([list(errors(summary).values()) for summary in summaries])


def _distance(summary: Summary) -> float:
    x, y, _ = errors(summary).values()
    return float(np.hypot(x, y))


def _both(mean: Array, deviation: Array) -> dict[str, float]:
    means = {f"mean_{key}": value for key, value in named(*mean).items()}
    return means | {f"sd_{key}": value for key, value in named(*deviation).items()}


def _outside(traces: Sequence[Array]) -> float:
    """Return how many of the errors (%) exceed twice the filter's own deviation."""
    stack = np.concatenate(traces)
    return float(100.0 * np.mean(np.abs(stack[:, 1:4]) > 2.0 * stack[:, 4:7]))


def _write(bench: Bench, name: str, starts: Sequence[Start], summaries: Sequence[Summary]) -> None:
    """Write how every run ended as CSV."""
    with (bench.out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("start", "seed", "status", "x_cm", "y_cm", "phi_deg", "nees", "nis"))
        for start, summary in zip(starts, summaries, strict=True):
            judged = summary["consistency"] or {}
            means = [(judged.get(key) or {}).get("mean") for key in ("nees", "nis")]
            ends = errors(summary).values()
            rows.writerow((start_name(start), summary["seed"], summary["status"], *ends, *means))
