"""Chapter 2 of the source: epipolar control, its tables and figures made again.

The tables and noise figures run on the mock: an ideal robot, features projected into images and
the epipoles estimated from them. The dynamic model and the robot run on the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from visctrl.experiments.entry import Bench, Row, at_most
from visctrl.experiments.epipolar_plots import plot_runs
from visctrl.experiments.jobs import Job

Start = tuple[float, float, float]
Summary = Mapping[str, Any]

#: Table 2.1: starts (m, m, deg) and published final errors (cm, cm, deg).
TABLE_2_1: tuple[tuple[Start, tuple[float, float, float]], ...] = (
    ((4.0, -8.0, 40.0), (0.0, 0.53, 0.08)),
    ((3.0, -11.0, 15.26), (0.0, 0.16, 0.04)),
    ((-5.0, -13.0, 0.0), (0.0, 2.84, 0.01)),
    ((-7.0, -18.0, -10.0), (0.0, 4.10, 0.02)),
)
#: Published x is 0 to the printed digits; what counts as that (cm).
X_RESOLUTION_CM = 0.1
OMNIDIRECTIONAL: tuple[tuple[Start, str], ...] = (
    ((-5.0, -9.0, -50.0), "hypercatadioptric"),
    ((-4.0, -14.0, 0.0), "paracatadioptric"),
    ((8.0, -16.0, 10.0), "fisheye"),
    ((2.5, -12.0, 11.77), "hypercatadioptric"),
)
SEEDS = range(1000, 1020)
_IDEAL = ("backend=mock", "scheme=epipolar", "mock.ideal=true")
_SIM = ("backend=sim", "scheme=epipolar")


def table_2_1(bench: Bench) -> list[Row]:
    """Four starts with one set of parameters: the smooth law, and the source's beside it."""
    ours = [_ideal(bench, start, "smooth") for start, _ in TABLE_2_1]
    source = [_ideal(bench, start, "source") for start, _ in TABLE_2_1]
    summaries = bench.run([*ours, *source])
    plot_runs(bench.out, [job.out for job in ours], "smooth law")
    rows = []
    for (start, (_, y, phi)), summary in zip(TABLE_2_1, summaries, strict=False):
        published = {"x_cm": X_RESOLUTION_CM, "y_cm": y, "phi_deg": phi}
        rows.append(at_most(_case(start), published, _errors(summary)))
    for (start, _), summary in zip(TABLE_2_1, summaries[len(TABLE_2_1) :], strict=True):
        # Shown beside ours and not judged: at 10 Hz its chatter costs it its published numbers.
        rows.append(Row(f"{_case(start)} source's law", {}, _errors(summary), True))
    for mine, theirs, (start, _) in zip(ours, source, TABLE_2_1, strict=True):
        tenth = 0.1 * chatter(theirs.out)
        bound, found = {"omega_variation": tenth}, {"omega_variation": chatter(mine.out)}
        rows.append(at_most(f"{_case(start)} a tenth of the source's chatter", bound, found))
    return rows


def table_2_1_noise(bench: Bench) -> list[Row]:
    """Add half a pixel of noise to the four starts: mean and deviation over fresh seeds."""
    starts = [start for start, _ in TABLE_2_1]
    jobs = [_noisy(start, seed, 20.0) for start in starts for seed in SEEDS]
    errors = np.array([list(_errors(s).values()) for s in bench.run(jobs)])
    rows = []
    for start, group in zip(starts, errors.reshape(len(starts), len(SEEDS), 3), strict=True):
        mean, deviation = group.mean(axis=0), group.std(axis=0, ddof=1)
        rows.append(at_most(f"{_case(start)} mean", _named(1.0, 1.0, 0.1), _named(*mean)))
        bounds = _named(3.0, 3.0, 0.2)
        rows.append(at_most(f"{_case(start)} st. dev.", bounds, _named(*deviation)))
    return rows


def figure_2_5(bench: Bench) -> list[Row]:
    """Paths and epipoles of the four starts: both epipoles towards the target come to zero."""
    jobs = [_ideal(bench, start, "smooth") for start, _ in TABLE_2_1]
    summaries = bench.run(jobs)
    plot_runs(bench.out, [job.out for job in jobs], "paths and epipoles")
    bound = _named(X_RESOLUTION_CM, 5.0, 0.1)
    return [
        at_most(_case(start), bound, _errors(s))
        for (start, _), s in zip(TABLE_2_1, summaries, strict=True)
    ]


def figure_2_6(bench: Bench) -> list[Row]:
    """Through the singularity with and without the sliding mode, and by the smooth law."""
    start = (-5.0, -13.0, 0.0)
    plain = _ideal(bench, start, "unprotected", "controller.sliding=false")
    jobs = [_ideal(bench, start, "smooth"), _ideal(bench, start, "source"), plain]
    bench.run(jobs)
    plot_runs(bench.out, [job.out for job in jobs], "smooth, sliding mode, unprotected")
    smooth, sliding, unprotected = (peak_speed(job.out) for job in jobs)
    exploded = {"v_peak_m_s": unprotected}
    return [
        at_most("smooth law", {"v_peak_m_s": sliding}, {"v_peak_m_s": smooth}),
        Row("without sliding mode", {}, exploded, unprotected > 10.0 * sliding),
    ]


def figure_2_8(bench: Bench) -> list[Row]:
    """One start with each omnidirectional camera, the last on the singularity."""
    jobs = [_ideal(bench, s, "smooth", camera=c, duration=60.0) for s, c in OMNIDIRECTIONAL]
    summaries = bench.run(jobs)
    plot_runs(bench.out, [job.out for job in jobs], "omnidirectional cameras")
    return [
        at_most(f"{_case(start)} {camera}", _named(1.0, 1.0, 0.5), _errors(s))
        for (start, camera), s in zip(OMNIDIRECTIONAL, summaries, strict=True)
    ]


def figure_2_11(bench: Bench) -> list[Row]:
    """Assume 6 mm for focal lengths of 2…10 mm, and centres off by up to 20 px."""
    start = (2.0, -7.0, 30.0)
    focal = {f"f = {f} mm": f"camera_error.focal_scale={f / 6}" for f in range(2, 11)}
    centre = {f"x0 {x:+d} px": f"camera_error.cx_px={x}" for x in (-20, -10, 10, 20)}
    cases = {**focal, **centre}
    jobs = [_ideal(bench, start, "smooth", setting) for setting in cases.values()]
    summaries = bench.run(jobs)
    return [
        at_most(case, _named(10.0, 10.0, 0.5), _errors(s))
        for case, s in zip(cases, summaries, strict=True)
    ]


def figure_2_12(bench: Bench) -> list[Row]:
    """Half a pixel of noise from a far start: the median over fresh seeds."""
    start = (-6.0, -16.0, -10.0)
    summaries = bench.run([_noisy(start, seed, 40.0) for seed in SEEDS])
    errors = np.abs([list(_errors(s).values()) for s in summaries])
    return [at_most(_case(start), _named(5.0, 5.0, 1.0), _named(*np.median(errors, axis=0)))]


def figure_2_13(bench: Bench) -> list[Row]:
    """Drive the dynamic model of a Pioneer: physics, rendered images, the robot's limits."""
    return _simulated(bench, (-1.0, -2.0, 0.0), {"perspective": 5.0, "hypercatadioptric": 2.0})


def robot_2_15(bench: Bench) -> list[Row]:
    """Repeat the robot experiment on the simulator."""
    return _simulated(bench, (-0.3, -1.3, 0.0), {"perspective": 5.0, "hypercatadioptric": 2.0})


def chatter(directory: Path | None) -> float:
    """Return the total variation of ω (rad/s) over the last quarter of a recorded run."""
    omega = _column(directory, "omega_sent")
    return float(np.abs(np.diff(omega[3 * len(omega) // 4 :])).sum())


def peak_speed(directory: Path | None) -> float:
    """Return the largest |v| (m/s) of a recorded run."""
    return float(np.nanmax(np.abs(_column(directory, "v_sent"))))


def _simulated(bench: Bench, start: Start, bounds_cm: Mapping[str, float]) -> list[Row]:
    jobs = [
        Job(
            "default",
            (*_SIM, f"camera.name={camera}", *_at(start)),
            bench.out / f"{_case(start)}_{camera}".replace(" ", "_"),
        )
        for camera in bounds_cm
    ]
    summaries = bench.run(jobs)
    plot_runs(bench.out, [job.out for job in jobs], "simulated robot")
    rows = []
    for (camera, bound), summary in zip(bounds_cm.items(), summaries, strict=True):
        x, y, phi = _errors(summary).values()
        ours = {"position_cm": math.hypot(x, y), "phi_deg": phi}
        published = {"position_cm": bound, "phi_deg": 1.0}
        rows.append(at_most(f"{_case(start)} {camera}", published, ours))
    return rows


def _ideal(
    bench: Bench,
    start: Start,
    law: str,
    *settings: str,
    camera: str = "perspective",
    duration: float = 20.0,
) -> Job:
    """Return a recorded run of an ideal robot without noise."""
    slug = "_".join([law, _case(start), camera, *settings])
    name = "".join(c if c.isalnum() or c in "+-." else "_" for c in slug)
    return Job("default", (*_law(law, duration, camera, start), *settings), bench.out / name)


def _noisy(start: Start, seed: int, duration: float) -> Job:
    settings = _law("smooth", duration, "perspective", start)
    return Job("default", (*settings, "mock.noise_px=0.5", f"seed={seed}"))


def _law(law: str, duration: float, camera: str, start: Start) -> tuple[str, ...]:
    settings = (*_IDEAL, f"camera.name={camera}", *_at(start), f"duration_s={1.7 * duration}")
    timed = f"controller.duration_s={duration}"
    if law == "smooth":
        return (*settings, "controller.name=epipolar-smooth", timed)
    stored = f"estimator.aligned_after_s={0.8 * duration}"
    return (*settings, "controller.name=epipolar-smc", timed, stored)


def _at(start: Start) -> tuple[str, ...]:
    keys = ("x_m", "y_m", "phi_deg")
    return tuple(f"start.{key}={value}" for key, value in zip(keys, start, strict=True))


def _case(start: Start) -> str:
    return " ".join(f"{value:g}" for value in start)


def _named(x_cm: float, y_cm: float, phi_deg: float) -> dict[str, float]:
    return {"x_cm": float(x_cm), "y_cm": float(y_cm), "phi_deg": float(phi_deg)}


def _errors(summary: Summary) -> dict[str, float]:
    error = summary["final_error"]
    if error is None:
        return _named(math.inf, math.inf, math.inf)
    return _named(100.0 * error["x_m"], 100.0 * error["y_m"], error["phi_deg"])


def _column(directory: Path | None, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    from visctrl.report.ticks import read_ticks

    if directory is None:
        raise ValueError("the run was not recorded")
    numbers = read_ticks(directory / "ticks.csv").numbers[name]
    return np.asarray(numbers, dtype=np.float64)
