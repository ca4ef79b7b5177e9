"""Chapter 3 of the source: 1D trifocal tensor control, its table and figures made again.

The table and the simulated figures run on the mock: an ideal robot, features projected into
images and the tensor estimated from them. The robot experiment runs on the simulator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from visctrl.reproduce.cases import (
    Start,
    column,
    distances,
    errors,
    folder_name,
    named,
    start_at,
    start_name,
)
from visctrl.reproduce.chapter3_plots import plot_motion, plot_states, plot_tensors
from visctrl.reproduce.entry import Bench, Row, at_most
from visctrl.study.run_spec import RunSpec

Errors = tuple[float, float, float]

#: Table 3.1: start (m, m, deg), published errors (cm, cm, deg) with φ1 known and set to 0.
TABLE_3_1: tuple[tuple[Start, Errors, Errors], ...] = (
    ((5.0, -5.0, 45.0), (0.28, 0.59, 0.10), (0.51, 0.86, 0.11)),
    ((-5.0, -12.0, -30.0), (0.85, 0.71, 0.02), (0.77, 0.39, 0.01)),
    ((0.0, -8.0, 0.0), (0.0, 0.11, 0.0), (0.0, 0.11, 0.0)),
    ((1.0, -14.0, -6.0), (0.91, 0.47, 0.08), (0.98, 0.25, 0.07)),
)
#: The table prints two digits after the point: a published 0 is anything that rounds to it.
RESOLUTION = 0.005
#: Mean squared error with which the outputs follow their references, as published.
TRACKING = 1e-5
OMNIDIRECTIONAL: tuple[tuple[Start, str, Errors], ...] = (
    ((-5.0, -12.0, -30.0), "hypercatadioptric", (0.85, 0.71, 0.02)),
    ((1.0, -14.0, -6.0), "paracatadioptric", (0.91, 0.47, 0.08)),
    ((0.0, -8.0, 0.0), "fisheye", (0.0, 0.11, 0.0)),
)
NOISY_START: Start = (5.0, -10.0, 35.0)
ROBOT_START: Start = (-0.55, -1.35, -35.0)
SEEDS = range(2000, 2020)


def table_3_1(bench: Bench) -> list[Row]:
    """Four starts with φ1 known and set to 0, then one with a pixel of noise."""
    known = [_simulated(bench, start, phi_1=str(start[2])) for start, _, _ in TABLE_3_1]
    zero = [_simulated(bench, start, phi_1="zero") for start, _, _ in TABLE_3_1]
    estimated = [_simulated(bench, start) for start, _, _ in TABLE_3_1]
    source = [_simulated(bench, start, law="published") for start, _, _ in TABLE_3_1]
    noisy = [_noisy(seed) for seed in SEEDS]
    summaries = iter(bench.run([*known, *zero, *estimated, *source, *noisy]))
    plot_states(bench.out, _recorded(known), "Table 3.1, φ1 known")
    rows = []
    for start, published, _ in TABLE_3_1:
        rows.append(_judged(f"{start_name(start)} φ1 known", published, errors(next(summaries))))
    for start, _, published in TABLE_3_1:
        rows.append(_judged(f"{start_name(start)} φ1 = 0", published, errors(next(summaries))))
    for start, published, _ in TABLE_3_1:
        found = errors(next(summaries))
        rows.append(_judged(f"{start_name(start)} φ1 estimated", published, found))
    for start, _, _ in TABLE_3_1:
        # Shown beside ours and not judged: its chatter of ±1 cm decides where it stands still.
        case = f"{start_name(start)} source's law"
        rows.append(Row(case, {}, errors(next(summaries)), True))
    ends = np.array([list(distances(summary).values()) for summary in summaries])
    return [*rows, *_noise_rows(ends)]


def figure_3_3(bench: Bench) -> list[Row]:
    """Paths, states, tensors and inputs of the four starts: outputs follow their references."""
    jobs = [_simulated(bench, start) for start, _, _ in TABLE_3_1]
    summaries = bench.run(jobs)
    directories = _recorded(jobs)
    plot_states(bench.out, directories, "1D trifocal tensor control")
    plot_tensors(bench.out, directories, "normalised tensor elements")
    plot_motion(bench.out, directories, "motion of the features in the image")
    rows = []
    for (start, published, _), summary, directory in zip(
        TABLE_3_1, summaries, directories, strict=True
    ):
        rows.append(_judged(start_name(start), published, errors(summary)))
        following = {f"{s}_mse": _mean_square(directory, s) for s in ("s1", "s2")}
        case = f"{start_name(start)} tracking"
        rows.append(at_most(case, dict.fromkeys(following, TRACKING), following))
    return rows


def figure_3_6(bench: Bench) -> list[Row]:
    """One start with each omnidirectional camera: how the features move in the image."""
    jobs = [_simulated(bench, start, camera=camera) for start, camera, _ in OMNIDIRECTIONAL]
    summaries = bench.run(jobs)
    plot_motion(bench.out, _recorded(jobs), "motion of the features in the image")
    plot_states(bench.out, _recorded(jobs), "omnidirectional cameras")
    return [
        _judged(f"{start_name(start)} {camera}", published, errors(summary))
        for (start, camera, published), summary in zip(OMNIDIRECTIONAL, summaries, strict=True)
    ]


def figure_3_7(bench: Bench) -> list[Row]:
    """One pixel of noise: states, tensor, inputs and image motion of a run; twenty seeds."""
    shown = bench.out / "seed_2000"
    jobs = [_noisy(seed, shown if seed == SEEDS[0] else None) for seed in SEEDS]
    ends = np.array([list(distances(summary).values()) for summary in bench.run(jobs)])
    plot_states(bench.out, [shown], "1 px noise")
    plot_tensors(bench.out, [shown], "normalised tensor elements, 1 px noise")
    plot_motion(bench.out, [shown], "motion of the features in the image, 1 px noise")
    return _noise_rows(ends)


def earlier_scheme(bench: Bench) -> list[Row]:
    """Run the scheme on the 2D tensor that came before, and ours on the same noisy images."""
    starts = [start for start, _, _ in TABLE_3_1]
    sequence = [_earlier(bench, start, "sequence") for start in starts]
    direct = [_earlier(bench, start, "direct") for start in starts]
    noise = [("mock.noise_px=1", "perception.noise_px=1", f"seed={s}") for s in SEEDS[:8]]
    theirs = [
        RunSpec("default", (*_earlier(bench, NOISY_START).settings, *extra)) for extra in noise
    ]
    ours = [_noisy(seed) for seed in SEEDS[:8]]
    summaries = bench.run([*sequence, *direct, *theirs, *ours])
    plot_states(bench.out, _recorded(sequence), "2D tensor, references that can be followed")
    count, rows = len(starts), []
    for start, summary in zip(starts, summaries, strict=False):
        rows.append(at_most(f"{start_name(start)} 2D", named(1.0, 1.0, 0.2), errors(summary)))
    for start, summary in zip(starts, summaries[count:], strict=False):
        # Shown, not judged: the local minima that the source warns of.
        rows.append(Row(f"{start_name(start)} 2D, direct", {}, errors(summary), True))
    ends = [list(distances(summary).values()) for summary in summaries[2 * count :]]
    medians = np.median(np.reshape(ends, (2, len(noise), 2)), axis=1)
    theirs_median, ours_median = (
        dict(zip(("position_cm", "phi_deg"), median.tolist(), strict=True)) for median in medians
    )
    case = f"{start_name(NOISY_START)} 1 px noise, median of {len(noise)}"
    rows.append(Row(f"{case}: 2D", {}, theirs_median, True))
    bound = {"position_cm": theirs_median["position_cm"]}
    rows.append(at_most(f"{case}: 1D against 2D", bound, ours_median))
    return rows


def robot_3_14(bench: Bench) -> list[Row]:
    """Repeat the robot experiment on the simulator: P3-AT, rendered images."""
    job = RunSpec("default", ("robot=p3at", *start_at(ROBOT_START)), bench.out / "p3at")
    summary = bench.run([job])[0]
    plot_states(bench.out, _recorded([job]), "P3-AT, rendered images")
    plot_tensors(bench.out, _recorded([job]), "normalised tensor elements")
    plot_motion(bench.out, _recorded([job]), "motion of the features in the image")
    bound = {"position_cm": 1.0, "phi_deg": 0.5}
    return [at_most(start_name(ROBOT_START), bound, distances(summary))]


def _simulated(
    bench: Bench,
    start: Start,
    *,
    phi_1: str = "estimated",
    law: str = "practical",
    camera: str = "hypercatadioptric",
) -> RunSpec:
    """Return a recorded run as the source makes its own: ideal robot, 100 s and 20 s.

    phi_1 : ``estimated``, ``zero``, or its value in degrees.
    """
    settings = [*_ideal(start, camera), "controller.tau_s=100", f"controller.law={law}"]
    # Images without noise, and a robot that knows it: a tenth of a pixel.
    settings += ["duration_s=125", "controller.finish=time", "perception.noise_px=0.1"]
    if law == "published":
        settings.append("controller.advance_m=0")
    else:
        # Step 2 lasts to 120 s, as in the source; the straight leg takes one.
        settings.append("controller.orientation_s=19")
    if phi_1 in ("estimated", "zero"):
        settings.append(f"estimator.phi_1={phi_1}")
    else:
        settings += ["estimator.phi_1=given", f"estimator.phi_1_deg={phi_1}"]
    usual = {"hypercatadioptric": "", "estimated": "", "practical": ""}
    special = [usual.get(word, word) for word in (camera, phi_1, law)]
    name = folder_name(start_name(start), *(word for word in special if word))
    return RunSpec("default", tuple(settings), bench.out / name)


def _noisy(seed: int, out: Path | None = None) -> RunSpec:
    """Return a run with a pixel of noise: step 1 takes 60 s, the whole 75 s."""
    settings = (
        *_ideal(NOISY_START, "hypercatadioptric"),
        *("mock.noise_px=1", "perception.noise_px=1", f"seed={seed}", "duration_s=80"),
        *("controller.tau_s=60", "controller.finish=time", "controller.orientation_s=14"),
    )
    return RunSpec("default", settings, out)


def _earlier(bench: Bench, start: Start, references: str = "sequence") -> RunSpec:
    """Return a recorded run of the scheme on the 2D tensor, 120 s as ours."""
    settings = [
        setting for setting in _ideal(start, "hypercatadioptric") if "scheme" not in setting
    ]
    settings += ["scheme=trifocal2d", f"controller.references={references}", "duration_s=130"]
    settings += ["controller.tau_s=85", "controller.turn_s=12"]
    return RunSpec(
        "default", tuple(settings), bench.out / folder_name(start_name(start), references)
    )


def _ideal(start: Start, camera: str) -> tuple[str, ...]:
    return (
        *("backend=mock", "scheme=trifocal", "mock.ideal=true", "approach.enabled=false"),
        *(f"camera.name={camera}", "camera.width=1024", "camera.height=768"),
        *start_at(start),
    )


def _judged(case: str, published: Errors, found: dict[str, float]) -> Row:
    return at_most(case, named(*(max(error, RESOLUTION) for error in published)), found)


def _noise_rows(ends: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> list[Row]:
    """Return the rows of noisy runs, each a distance (cm) and heading (deg)."""
    case = f"{start_name(NOISY_START)} 1 px noise"
    keys = ("position_cm", "phi_deg")
    median = dict(zip(keys, np.median(ends, axis=0).tolist(), strict=True))
    worst = dict(zip(keys, ends.max(axis=0).tolist(), strict=True))
    return [
        at_most(f"{case}, median of {len(ends)}", {"position_cm": 2.0, "phi_deg": 0.5}, median),
        Row(f"{case}, worst of {len(ends)}", {}, worst, True),
    ]


def _mean_square(directory: Path, signal: str) -> float:
    return float(np.mean(column(directory, f"trifocal-smc.{signal}") ** 2))


def _recorded(jobs: list[RunSpec]) -> list[Path]:
    return [job.out for job in jobs if job.out is not None]
