"""Chapter 2 of the source: epipolar control, its tables and figures made again.

The tables and noise figures run on the mock: an ideal robot, features projected into images and
the epipoles estimated from them. The dynamic model and the robot run on the simulator. The smooth
law, which is the scheme's default, is judged; the source's own law is shown beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.reproduce.cases import (
    LAW_ALONE,
    Start,
    column,
    distances,
    errors,
    folder_name,
    named,
    start_at,
    start_name,
)
from visctrl.reproduce.chapter2_plots import plot_motion, plot_runs, plot_scatter, plot_sweeps
from visctrl.reproduce.entry import Bench, Row, against_source, at_least, within
from visctrl.studies.run_spec import RunSpec

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
WRONG_START: Start = (2.0, -7.0, 30.0)
NOISY_START: Start = (-6.0, -16.0, -10.0)
SEEDS = range(1000, 1020)
FEW_SEEDS = SEEDS[:5]
#: Bounds on rendered images: distance (cm) by camera, and heading (deg).
SIMULATED_CM = {
    "perspective": 5.0,
    "hypercatadioptric": 2.0,
    "paracatadioptric": 2.0,
    "fisheye": 2.0,
}
SIMULATED_DEG = 1.0
#: Fig. 2.11: what the tracking errors of both epipoles stay under (px²).
TRACKING_PX2 = 2.5
_TRACKED = ("e23_mse_px2", "e32_mse_px2")
#: |v| of the unprotected law at the singularity over that of the sliding mode, at least.
EXPLOSION = 10.0
SMOOTH, SOURCE = "smooth law", "source's law"


def table_2_1(bench: Bench) -> list[Row]:
    """Four starts with one set of parameters: the smooth law, and the source's beside it."""
    starts = [start for start, _ in TABLE_2_1]
    ours, source = (
        {start_name(s): _ideal(bench, s, law) for s in starts} for law in (SMOOTH, SOURCE)
    )
    summaries = bench.run([*ours.values(), *source.values()])
    plot_runs(bench.out, _both(ours, source), "Table 2.1")
    # At 10 Hz its chatter costs the source's law its published numbers.
    rows = [
        against_source(
            start_name(start),
            named(*published),
            errors(smooth),
            resolution=named(X_RESOLUTION_CM, 0.005, 0.005),
            source=errors(theirs),
        )
        for (start, published), smooth, theirs in zip(
            TABLE_2_1, summaries[: len(starts)], summaries[len(starts) :], strict=True
        )
    ]
    for case, job in ours.items():
        chatters = {"omega_variation_rad_s": chatter(source[case].out)}
        found = {"omega_variation_rad_s": chatter(job.out)}
        bound = {key: 0.1 * value for key, value in chatters.items()}
        rows.append(within(f"{case}: a tenth of the chatter", bound, found, source=chatters))
    return rows


def table_2_1_noise(bench: Bench) -> list[Row]:
    """Add half a pixel of noise to the four starts: mean and deviation over fresh seeds."""
    starts = [start for start, _ in TABLE_2_1]
    jobs = [
        _noisy(start, seed, 20.0, law)
        for law in (SMOOTH, SOURCE)
        for start in starts
        for seed in SEEDS
    ]
    found = [errors(summary) for summary in bench.run(jobs)]
    groups = [found[i : i + len(SEEDS)] for i in range(0, len(found), len(SEEDS))]
    ours = dict(zip(map(start_name, starts), groups, strict=False))
    plot_scatter(bench.out, ours, f"{len(SEEDS)} seeds, 0.5 px noise, {SMOOTH}")
    rows = []
    for (case, group), theirs in zip(ours.items(), groups[len(starts) :], strict=True):
        (mean, deviation), (their_mean, their_deviation) = _spread(group), _spread(theirs)
        rows.append(within(f"{case}, mean", named(1.0, 1.0, 0.1), mean, source=their_mean))
        bound = named(3.0, 3.0, 0.2)
        rows.append(within(f"{case}, st. dev.", bound, deviation, source=their_deviation))
    return rows


def figure_2_5(bench: Bench) -> list[Row]:
    """Paths, epipoles and image motion of the four starts, by both laws."""
    starts = [start for start, _ in TABLE_2_1]
    ours, source = (
        {start_name(s): _ideal(bench, s, law) for s in starts} for law in (SMOOTH, SOURCE)
    )
    summaries = bench.run([*ours.values(), *source.values()])
    plot_runs(bench.out, _both(ours, source), "epipolar control from four starts")
    plot_motion(bench.out, _both(ours, source), "motion of the features in the image")
    bound = named(X_RESOLUTION_CM, 5.0, 0.1)
    return [
        within(case, bound, errors(smooth), source=errors(theirs))
        for case, smooth, theirs in zip(
            ours, summaries[: len(starts)], summaries[len(starts) :], strict=True
        )
    ]


def figure_2_6(bench: Bench) -> list[Row]:
    """Through the singularity with and without the sliding mode, and by the smooth law."""
    start = TABLE_2_1[2][0]
    runs = {
        SMOOTH: _ideal(bench, start, SMOOTH),
        SOURCE: _ideal(bench, start, SOURCE),
        "without sliding mode": _ideal(bench, start, SOURCE, "controller.sliding=false"),
    }
    summaries = bench.run(list(runs.values()))
    plot_runs(bench.out, _recorded(runs), "through the singularity")
    smooth, sliding, plain = (
        _peaks(job.out) | errors(s) for job, s in zip(runs.values(), summaries, strict=True)
    )
    speed = _speed(sliding)
    exploded = {"v_peak_m_s": EXPLOSION * sliding["v_peak_m_s"]}
    return [
        Row(start_name(start), smooth, source=sliding),
        Row("without sliding mode", {}, source=plain),
        within("no faster than the source's", speed, _speed(smooth)),
        at_least("without sliding mode: explodes, at least", exploded, _speed(plain)),
    ]


def figure_2_8(bench: Bench) -> list[Row]:
    """One start with each omnidirectional camera, the last on the singularity."""
    ours, source = (
        {
            f"{start_name(s)} {camera}": _ideal(bench, s, law, camera=camera, duration=60.0)
            for s, camera in OMNIDIRECTIONAL
        }
        for law in (SMOOTH, SOURCE)
    )
    noisy = [
        _noisy(start, seed, 60.0, SMOOTH, camera=camera)
        for start, camera in OMNIDIRECTIONAL
        for seed in FEW_SEEDS
    ]
    summaries = bench.run([*ours.values(), *source.values(), *noisy])
    plot_runs(bench.out, _both(ours, source), "omnidirectional cameras")
    plot_motion(bench.out, _recorded(ours), "motion of the features in the image")
    rows = [
        within(case, named(1.0, 1.0, 0.5), errors(smooth), source=errors(theirs))
        for case, smooth, theirs in zip(
            ours, summaries[: len(ours)], summaries[len(ours) : 2 * len(ours)], strict=True
        )
    ]
    ends = [errors(summary) for summary in summaries[2 * len(ours) :]]
    for index, case in enumerate(ours):
        median = _median(ends[index * len(FEW_SEEDS) :][: len(FEW_SEEDS)])
        title = f"{case}, 0.5 px noise, median of {len(FEW_SEEDS)}"
        rows.append(within(title, named(1.0, 1.0, 0.5), median))
    return rows


def figure_2_11(bench: Bench) -> list[Row]:
    """Assume 6 mm for focal lengths of 2…10 mm, and centres off by up to 20 px."""
    focal = {float(f): f"camera_error.focal_scale={f / 6}" for f in range(2, 11)}
    off = (-20, -10, 0, 10, 20)
    sweeps = {
        "focal length (mm)": focal,
        "centre column off by (px)": {float(x): f"camera_error.cx_px={x}" for x in off},
        "centre row off by (px)": {float(x): f"camera_error.cy_px={x}" for x in off},
    }
    cases = [
        (law, parameter, value, _ideal(bench, WRONG_START, law, setting))
        for law in (SMOOTH, SOURCE)
        for parameter, settings in sweeps.items()
        for value, setting in settings.items()
    ]
    found = [errors(summary) for summary in bench.run([job for *_, job in cases])]
    ends: dict[str, dict[str, dict[float, dict[str, float]]]] = {name: {} for name in sweeps}
    for (law, parameter, value, _), ended in zip(cases, found, strict=True):
        ends[parameter].setdefault(law, {})[value] = ended
    published = named(10.0, 10.0, 0.1)
    half = len(cases) // 2
    rows = [
        against_source(f"{parameter} {value:g}", published, ours, source=source)
        for (_, parameter, value, _), ours, source in zip(
            cases[:half], found[:half], found[half:], strict=True
        )
    ]
    # The smooth law has no references of epipoles to track.
    rows += [
        Row(
            f"{parameter} {value:g}, tracking of the epipoles",
            {},
            dict.fromkeys(_TRACKED, TRACKING_PX2),
            _tracking(job.out),
        )
        for _, parameter, value, job in cases[half : half + len(focal)]
    ]
    plot_sweeps(bench.out, ends, f"final errors from {start_name(WRONG_START)}")
    shown = {f"{p} {v:g} {law}": job for law, p, v, job in cases if v in (2.0, 10.0)}
    plot_runs(bench.out, _recorded(shown), "wrong focal lengths and image centres")
    return rows


def figure_2_12(bench: Bench) -> list[Row]:
    """Half a pixel of noise from a far start: the median over fresh seeds."""
    first = {law: bench.out / folder_name(law) for law in (SMOOTH, SOURCE)}
    jobs = [
        _noisy(NOISY_START, seed, 40.0, law, first[law] if seed == SEEDS[0] else None)
        for law in (SMOOTH, SOURCE)
        for seed in SEEDS
    ]
    found = [errors(summary) for summary in bench.run(jobs)]
    plot_runs(bench.out, first, "0.5 px noise")
    plot_motion(bench.out, first, "motion of the features in the image, 0.5 px noise")
    ours, source = (_median(found[i : i + len(SEEDS)]) for i in (0, len(SEEDS)))
    case = f"{start_name(NOISY_START)}, median of {len(SEEDS)}"
    return [within(case, named(5.0, 5.0, 1.0), ours, source=source)]


def figure_2_13(bench: Bench) -> list[Row]:
    """Drive the dynamic model of a Pioneer: physics, rendered images, the robot's limits."""
    return _simulated(bench, (-1.0, -2.0, 0.0), 60.0, 0.8 * 60.0, {})


def robot_2_15(bench: Bench) -> list[Row]:
    """Repeat the robot experiment on the simulator."""
    return _simulated(bench, (-0.3, -1.3, 0.0), 30.0, 21.0, {"position_cm": 5.0})


def chatter(directory: Path | None) -> float:
    """Return the total variation of ω (rad/s) over the last quarter of a recorded run."""
    omega = column(directory, "omega_sent")
    return float(np.abs(np.diff(omega[3 * len(omega) // 4 :])).sum())


def _peaks(directory: Path | None) -> dict[str, float]:
    v, omega = (column(directory, name) for name in ("v_sent", "omega_sent"))
    return {
        "v_peak_m_s": float(np.abs(v).max()),
        "omega_peak_rad_s": float(np.abs(omega).max()),
    }


def _speed(found: Mapping[str, float]) -> dict[str, float]:
    return {"v_peak_m_s": found["v_peak_m_s"]}


def _simulated(
    bench: Bench, start: Start, duration: float, tau: float, published: Mapping[str, float]
) -> list[Row]:
    """Run the smooth law with every camera, and the source's with the perspective one.

    duration, tau : of the source's law as published, and of its first step (s); the smooth law
        takes what it needs.
    """
    where = ("backend=sim", "scheme=epipolar", LAW_ALONE, *start_at(start))
    runs = {
        camera: RunSpec("default", (*where, f"camera.name={camera}"), bench.out / camera)
        for camera in SIMULATED_CM
    }
    settings = (*where, "camera.name=perspective", f"duration_s={duration + 5.0}")
    robot = ("controller.distance_23_m=5", "controller.distance_12_m=5")
    law = (*settings, *_source_law(duration, tau), *robot)
    runs[f"perspective {SOURCE}"] = RunSpec("default", law, bench.out / "source")
    summaries = bench.run(list(runs.values()))
    plot_runs(bench.out, _recorded(runs), f"simulated robot from {start_name(start)}")
    plot_motion(bench.out, _recorded(runs), "motion of the features in the image")
    found = dict(zip(runs, map(distances, summaries), strict=True))
    theirs = found[f"perspective {SOURCE}"]
    rows = []
    for camera, bound_cm in SIMULATED_CM.items():
        bound = {"position_cm": bound_cm, "phi_deg": SIMULATED_DEG}
        same = camera == "perspective"  # as the source's
        rows.append(
            within(
                f"{start_name(start)} {camera}",
                bound,
                found[camera],
                published=published if same else {},
                source=theirs if same else {},
            )
        )
    return rows


def _ideal(
    bench: Bench,
    start: Start,
    law: str,
    *settings: str,
    camera: str = "perspective",
    duration: float = 20.0,
) -> RunSpec:
    """Return a recorded run of an ideal robot without noise."""
    name = folder_name(law, start_name(start), camera, *settings)
    used = (*_law(law, duration, camera, start), *settings)
    return RunSpec("default", used, bench.out / name)


def _noisy(
    start: Start,
    seed: int,
    duration: float,
    law: str,
    out: Path | None = None,
    camera: str = "perspective",
) -> RunSpec:
    settings = _law(law, duration, camera, start)
    used = (*settings, "mock.noise_px=0.5", f"seed={seed}")
    return RunSpec("default", used, out)


def _law(law: str, duration: float, camera: str, start: Start) -> tuple[str, ...]:
    settings = ("backend=mock", "scheme=epipolar", "mock.ideal=true", f"camera.name={camera}")
    whole = (*settings, LAW_ALONE, *start_at(start), f"duration_s={1.7 * duration}")
    if law == SMOOTH:
        return (*whole, f"controller.duration_s={duration}")
    return (*whole, *_source_law(duration))


def _source_law(duration: float, tau: float | None = None) -> tuple[str, ...]:
    """Return the settings of the source's law; its first step takes 80 % of the time or ``tau``."""
    tau = 0.8 * duration if tau is None else tau
    return (
        "controller.name=epipolar-smc",
        f"controller.duration_s={duration}",
        f"controller.align_fraction={tau / duration}",
        f"estimator.aligned_after_s={tau}",
    )


def _tracking(directory: Path | None) -> dict[str, float]:
    """Return how well the source's law follows its references (px²) in a recorded run."""
    pixels = load_camera("perspective").pixels_per_radian
    errors = (column(directory, f"epipolar-smc.{name}") for name in ("s_c", "s_t"))
    return {
        key: float(np.mean((pixels * error) ** 2))
        for key, error in zip(_TRACKED, errors, strict=True)
    }


def _spread(group: Sequence[Mapping[str, float]]) -> tuple[dict[str, float], dict[str, float]]:
    values = np.array([list(one.values()) for one in group])
    return named(*values.mean(axis=0)), named(*values.std(axis=0, ddof=1))


def _median(group: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return named(*np.median(np.abs([list(one.values()) for one in group]), axis=0))


def _recorded(runs: Mapping[str, RunSpec]) -> dict[str, Path | None]:
    return {case: job.out for case, job in runs.items()}


def _both(ours: Mapping[str, RunSpec], source: Mapping[str, RunSpec]) -> dict[str, Path | None]:
    return {
        f"{case}, {law}": job.out
        for law, jobs in ((SMOOTH, ours), (SOURCE, source))
        for case, job in jobs.items()
    }
