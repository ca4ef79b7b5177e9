"""The figures of chapter 4: wrong cameras, obstacles, kinds of cameras, and the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from visctrl.reproduce.cases import (
    Start,
    Summary,
    column,
    distances,
    errors,
    folder_name,
    named,
    start_name,
)
from visctrl.reproduce.chapter4_plots import plot_curves, plot_runs
from visctrl.reproduce.chapter4_runs import RATE, noisy, told_start
from visctrl.reproduce.entry import Bench, Row, against_source, within
from visctrl.robots import load_robot
from visctrl.studies.run_spec import RunSpec

Errors = tuple[float, float, float]
Settings = tuple[str, ...]

#: Fig. 4.3: what the mean errors of its two panels stay under (cm, cm, deg).
TILTED: Errors = (5.0, 8.0, 0.1)
MOVED: Errors = (3.0, 3.0, 0.04)
TILTS_DEG = (0, 2, 4, 6, 8, 10)
SHIFTS_PX = (0, 5, 10, 15, 20)
CAMERA_RUNS = 50
#: Fig. 4.4 (epipoles, an obstacle before the third start) and fig. 4.6.
FIGURE_4_4: tuple[Start, ...] = ((8.0, -8.0, 0.0), (2.0, -12.0, 45.0), (-6.0, -16.0, -20.0))
FIGURE_4_6: tuple[tuple[Start, str], ...] = (
    ((-8.0, -12.0, -20.0), "hypercatadioptric"),
    ((-6.0, -18.0, -70.0), "paracatadioptric"),
    ((0.0, -10.0, 0.0), "perspective"),
    ((8.0, -8.0, 50.0), "hypercatadioptric"),
)
ROBOT_START: Start = (-0.6, -1.8, 0.0)
#: "About 2 cm" by the robot's own odometry.
ROBOT_CM = 2.0
#: On the third start's path, noticed from 2.5 m: x, y, radius (m).
OBSTACLE = (-1.9, -9.0, 0.5)
#: Boxes in the simulated hall: name, start (m, m, deg), where they stand (m), what tells of them.
_LISTED = "{name: listed, discs: [{x_m: -0.05, y_m: -1.8, radius_m: 0.29, noticed_m: 1.5}]}"
_SONAR = "{name: sonar}"
BOXES: tuple[tuple[str, Start, tuple[tuple[float, float], ...], str], ...] = (
    ("listed box", (-0.3, -3.6, 0.0), ((-0.05, -1.8),), _LISTED),
    ("sonar, box ahead", (-0.3, -3.6, 0.0), ((-0.05, -1.8),), _SONAR),
    ("sonar, box on the left", (-0.8, -3.2, -20.0), ((-0.3, -1.7),), _SONAR),
    ("sonar, box on the right", (0.9, -3.0, 15.0), ((0.4, -1.5),), _SONAR),
    ("sonar, two boxes", (0.0, -3.5, 0.0), ((-0.3, -2.0), (0.3, -2.0)), _SONAR),
    ("sonar, no box", (-0.55, -1.35, -35.0), (), _SONAR),
)


def figure_4_3(bench: Bench) -> list[Row]:
    """Tilt the camera by 0…10 deg, move its centre 0…20 px in random directions: 50 runs each.

    The filter knows nothing of the wrong calibration.
    """
    start = (-8.0, -12.0, -20.0)
    directions = np.random.default_rng(43).uniform(0.0, 2.0 * np.pi, CAMERA_RUNS).tolist()
    panels: tuple[tuple[str, Errors, Sequence[int], Callable[[int, float], Settings]], ...] = (
        ("misalignment (deg)", TILTED, TILTS_DEG, lambda v, _: (f"camera_error.tilt_deg={v}",)),
        ("centre off by (px, any direction)", MOVED, SHIFTS_PX, _moved),
    )
    curves, rows = {}, []
    for label, published, values, error in panels:
        runs = [
            noisy(start, 8000 + k, RATE, *error(value, direction))
            for value in values
            for k, direction in enumerate(directions)
        ]
        found = np.array([list(errors(summary).values()) for summary in bench.run(runs)])
        groups = found.reshape(len(values), CAMERA_RUNS, 3)
        means, deviations = groups.mean(axis=1), groups.std(axis=1, ddof=1)
        curves[label] = np.array(values, dtype=np.float64), means, deviations
        for value, mean, group in zip(values, means, groups, strict=True):
            case = f"{label} {value}"
            rows.append(against_source(f"{case}, mean", named(*published), named(*mean)))
            worst = {"position_cm": float(np.hypot(group[:, 0], group[:, 1]).max())}
            rows.append(Row(f"{case}, worst of {CAMERA_RUNS}", worst))
    plot_curves(bench.out, curves, np.array(TILTED))
    return rows


def _moved(radius: int, direction: float) -> Settings:
    x, y = radius * np.cos(direction), radius * np.sin(direction)
    return f"camera_error.cx_px={x:.3f}", f"camera_error.cy_px={y:.3f}"


def figure_4_4(bench: Bench) -> list[Row]:
    """Drive from three starts in 120 s, past an obstacle from the third.

    The source's filter on epipoles, which is told C1, is shown beside ours and not judged.
    """
    x, y, radius = OBSTACLE
    listed = f"{{x_m: {x}, y_m: {y}, radius_m: {radius}, noticed_m: 2.5}}"
    obstacle = f"obstacles=[{{name: listed, discs: [{listed}]}}]"
    epipoles = (
        *("target.frames=10", "perception.noise_px=1", "estimator.name=ekf"),
        *("estimator.measurement=epipoles", "estimator.initial_frames=10"),
        "controller.goals=[{x_m: 0, y_m: -2, until_s: 100}]",
    )
    ours = [_recorded(bench, s, "consistent filter", obstacle) for s in FIGURE_4_4]
    source = [
        _recorded(bench, s, "epipoles", obstacle, *epipoles, told_start(s)) for s in FIGURE_4_4
    ]
    summaries = bench.run([*ours, *source])
    plot_runs(
        bench.out, _directories([*ours, *source]), "obstacle on the third path", [(*OBSTACLE, None)]
    )
    count = len(FIGURE_4_4)
    rows = [
        _reached(start_name(start), mine, source=distances(his))
        for start, mine, his in zip(FIGURE_4_4, summaries[:count], summaries[count:], strict=True)
    ]
    gap, their_gap = ({"gap_cm": _gap(runs[-1].out)} for runs in (ours, source))
    # Below 0 it has touched the obstacle.
    clear = gap["gap_cm"] > 0.0
    return [*rows, Row("from the obstacle", gap, {}, their_gap, {"gap_cm": 0.0}, ok=clear)]


def figure_4_4_sim(bench: Bench) -> list[Row]:
    """Drive past boxes on rendered images: no contact, on the target.

    Once with a list of obstacles, then with sonar alone, and once with sonar and no box.
    """
    jobs = [
        RunSpec(
            "default",
            (
                *("backend=sim", "scheme=pose", "controller.tau_s=30", "duration_s=150"),
                f"sim.boxes=[{', '.join(f'{{x_m: {x}, y_m: {y}}}' for x, y in boxes)}]",
                f"obstacles=[{provider}]",
                *(f"start.{k}={v}" for k, v in zip(("x_m", "y_m", "phi_deg"), start, strict=True)),
            ),
            bench.out / folder_name(name),
        )
        for name, start, boxes, provider in BOXES
    ]
    summaries = bench.run(jobs)
    circles = [(x, y, 0.28, k) for k, (_, _, boxes, _) in enumerate(BOXES) for x, y in boxes]
    plot_runs(bench.out, _directories(jobs), "boxes on the path", circles)
    rows = []
    for (name, *_), summary in zip(BOXES, summaries, strict=True):
        rows.append(_reached(name, summary))
        touched = float("touched" in summary["reason"])
        rows.append(within(f"{name}: touched", {"contacts": 0.0}, {"contacts": touched}))
    return rows


def figure_4_6(bench: Bench) -> list[Row]:
    """Drive once with every kind of camera."""
    jobs = [
        _recorded(bench, start, camera, f"camera.name={camera}", tau_s=100.0)
        for start, camera in FIGURE_4_6
    ]
    summaries = bench.run(jobs)
    plot_runs(bench.out, _directories(jobs), "one start for each camera")
    return [
        _reached(f"{start_name(start)} {camera}", summary)
        for (start, camera), summary in zip(FIGURE_4_6, summaries, strict=True)
    ]


def robot_4_8(bench: Bench) -> list[Row]:
    """Repeat the robot experiment on the simulator, and with 2 s without images in the middle."""
    x, y, phi = ROBOT_START
    common = ("backend=sim", "scheme=pose", "robot=p3at")
    where = (f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}")
    blind = "sim.faults.camera_black_s=[20, 22]"
    jobs = [
        RunSpec("default", (*common, *where), bench.out / "seen"),
        RunSpec("default", (*common, *where, blind), bench.out / "2_s_blind"),
    ]
    summaries = bench.run(jobs)
    plot_runs(bench.out, _directories(jobs), "the robot experiment, simulated")
    bound = {"position_cm": 1.0, "phi_deg": 0.5}
    return [
        within("P3-AT", bound, distances(summaries[0]), published={"position_cm": ROBOT_CM}),
        within("P3-AT, 2 s without images", bound, distances(summaries[1])),
    ]


def _recorded(
    bench: Bench, start: Start, name: str, *settings: str, tau_s: float = 120.0
) -> RunSpec:
    job = noisy(start, 9000, RATE, *settings, tau_s=tau_s)
    return RunSpec(job.scenario, job.settings, bench.out / folder_name(start_name(start), name))


def _reached(case: str, summary: Summary, source: Mapping[str, float] | None = None) -> Row:
    return within(case, {"position_cm": 2.0, "phi_deg": 1.0}, distances(summary), source=source)


def _gap(directory: Path | None) -> float:
    """Return how near (cm) the robot's circle came to the obstacle."""
    x, y, radius = OBSTACLE
    robot = load_robot("p3dx")
    ahead = robot.mount("front").forward_m
    x_true, y_true, phi = (column(directory, f"{name}_true") for name in ("x", "y", "phi"))
    axle_x, axle_y = x_true + ahead * np.sin(phi), y_true - ahead * np.cos(phi)
    away = float(np.hypot(axle_x - x, axle_y - y).min())
    return 100.0 * (away - radius - robot.body.radius_m)


def _directories(jobs: list[RunSpec]) -> list[Path]:
    return [job.out for job in jobs if job.out is not None]
