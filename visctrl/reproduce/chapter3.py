"""Chapter 3 of the source: 1D trifocal tensor control, its table and figures made again.

The table and the simulated figures run on the mock: an ideal robot, features projected into
images and the tensor estimated from them. The robot experiment runs on the simulator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
from visctrl.reproduce.chapter3_plots import plot_motion, plot_states, plot_tensors
from visctrl.reproduce.entry import Bench, Row, against_source, told, within
from visctrl.studies.run_spec import RunSpec

Errors = tuple[float, float, float]

#: Table 3.1: start (m, m, deg), published errors (cm, cm, deg) with φ1 known and set to 0.
TABLE_3_1: tuple[tuple[Start, Errors, Errors], ...] = (
    ((5.0, -5.0, 45.0), (0.28, 0.59, 0.10), (0.51, 0.86, 0.11)),
    ((-5.0, -12.0, -30.0), (0.85, 0.71, 0.02), (0.77, 0.39, 0.01)),
    ((0.0, -8.0, 0.0), (0.0, 0.11, 0.0), (0.0, 0.11, 0.0)),
    ((1.0, -14.0, -6.0), (0.91, 0.47, 0.08), (0.98, 0.25, 0.07)),
)
#: Half of the last digit that the table prints.
RESOLUTION = 0.005
#: Mean squared error with which the outputs follow their references, as published.
TRACKING = 1e-5
OMNIDIRECTIONAL: tuple[tuple[Start, str, Errors], ...] = (
    ((-5.0, -12.0, -30.0), "hypercatadioptric", (0.85, 0.71, 0.02)),
    ((1.0, -14.0, -6.0), "paracatadioptric", (0.91, 0.47, 0.08)),
    ((0.0, -8.0, 0.0), "fisheye", (0.0, 0.11, 0.0)),
)
NOISY_START: Start = (5.0, -10.0, 35.0)
#: What the median of noisy runs is judged by, the source having only a picture.
NOISE_BOUND = {"position_cm": 2.0, "phi_deg": 0.5}
#: Values at which φ1 is fixed (deg), and how near a robot must end (cm): as the source's law.
PHI_1_DEG = range(-30, 31, 10)
PHI_1_CM = 1.5
ROBOT_START: Start = (-0.55, -1.35, -35.0)
#: "About 2 cm" by the robot's own odometry.
ROBOT_CM = 2.0
SEEDS = range(2000, 2020)


def table_3_1(bench: Bench) -> list[Row]:
    """Four starts with φ1 known, set to 0 and estimated, then one with a pixel of noise."""
    starts = [start for start, _, _ in TABLE_3_1]
    known = [_simulated(bench, start, phi_1=str(start[2])) for start in starts]
    zero = [_simulated(bench, start, phi_1="zero") for start in starts]
    estimated = [_simulated(bench, start) for start in starts]
    source = [_simulated(bench, start, phi_1=str(start[2]), law="published") for start in starts]
    source_zero = [_simulated(bench, start, phi_1="zero", law="published") for start in starts]
    blocks = [known, zero, estimated, source, source_zero]
    found = [errors(s) for s in bench.run([run for block in blocks for run in block])]
    ends = [found[k : k + len(starts)] for k in range(0, len(found), len(starts))]
    plot_states(bench.out, _recorded(known), "Table 3.1, φ1 known")
    rows = []
    # Where the source's law stands still is decided by its chatter of ±1 cm.
    for title, column_, ours, theirs in (
        ("φ1 known", 1, ends[0], ends[3]),
        ("φ1 = 0", 2, ends[1], ends[4]),
        ("φ1 estimated", 1, ends[2], ends[3]),
    ):
        for case, mine, his in zip(TABLE_3_1, ours, theirs, strict=True):
            published = (case[1], case[2])[column_ - 1]
            rows.append(_judged(f"{start_name(case[0])} {title}", published, mine, his))
    return [*rows, *_noise_rows(bench)]


def figure_phi_1(bench: Bench) -> list[Row]:
    """Fix φ1 anywhere from −30 to 30 deg (p. 60): the worst of the starts, for every law."""
    laws = {
        "trifocal-smc": _law_settings("practical"),
        "trifocal-smooth": ("controller.name=trifocal-smooth", "duration_s=200"),
        "trifocal-super-twisting": ("controller.name=trifocal-super-twisting", "duration_s=200"),
    }
    source = _law_settings("published")
    cases = [(law, phi) for law in (*laws, "") for phi in PHI_1_DEG]
    runs = [
        RunSpec(
            "default",
            (
                *_ideal(start, "hypercatadioptric"),
                *("estimator.phi_1=given", f"estimator.phi_1_deg={phi}"),
                *laws.get(law, source),
            ),
        )
        for law, phi in cases
        for start, _, _ in TABLE_3_1
    ]
    ends = np.array([list(distances(s).values()) for s in bench.run(runs)])
    worst = ends.reshape(len(cases), len(TABLE_3_1), 2).max(axis=1)
    found = {
        case: dict(zip(("position_cm", "phi_deg"), end.tolist(), strict=True))
        for case, end in zip(cases, worst, strict=True)
    }
    return [
        within(
            f"φ1 fixed at {phi} deg, {law}, worst of {len(TABLE_3_1)} starts",
            {"position_cm": PHI_1_CM, "phi_deg": 0.1},
            found[law, phi],
            source=found["", phi],
        )
        for law in laws
        for phi in PHI_1_DEG
    ]


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
        rows.append(against_source(case, dict.fromkeys(following, TRACKING), following))
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
    rows = _noise_rows(bench)
    shown = bench.out / folder_name("plain", str(SEEDS[0]))
    plot_states(bench.out, [shown], "1 px noise")
    plot_tensors(bench.out, [shown], "normalised tensor elements, 1 px noise")
    plot_motion(bench.out, [shown], "motion of the features in the image, 1 px noise")
    return rows


def earlier_scheme(bench: Bench) -> list[Row]:
    """Run the scheme on the 2D tensor that came before, and ours on the same noisy images."""
    starts = [start for start, _, _ in TABLE_3_1]
    sequence = [_earlier(bench, start, "sequence") for start in starts]
    direct = [_earlier(bench, start, "direct") for start in starts]
    base = _earlier(bench, NOISY_START).settings
    noise = [("mock.noise_px=1", f"seed={seed}") for seed in SEEDS[:8]]
    theirs = [RunSpec("default", (*base, *extra)) for extra in noise]
    practical = _law_settings("practical", 60.0)
    ours = [_noisy(bench, "1D", seed, practical) for seed in SEEDS[:8]]
    summaries = bench.run([*sequence, *direct, *theirs, *ours])
    plot_states(bench.out, _recorded(sequence), "2D tensor, references that can be followed")
    count, rows = len(starts), []
    for start, run, summary in zip(starts, sequence, summaries, strict=False):
        bound = named(1.0, 1.0, 0.2)
        rows.append(within(f"{start_name(start)} 2D", bound, errors(summary), told=told(run)))
    for start, summary in zip(starts, summaries[count:], strict=False):
        # Shown, not judged: the local minima that the source warns of.
        rows.append(Row(f"{start_name(start)} 2D, direct", {}, source=errors(summary)))
    ends = [list(distances(summary).values()) for summary in summaries[2 * count :]]
    medians = np.median(np.reshape(ends, (2, len(noise), 2)), axis=1)
    theirs_median, ours_median = (
        dict(zip(("position_cm", "phi_deg"), median.tolist(), strict=True)) for median in medians
    )
    case = f"{start_name(NOISY_START)} 1 px noise, median of {len(noise)}"
    bound = {"position_cm": theirs_median["position_cm"]}
    rows.append(within(f"{case}: 1D against 2D", bound, ours_median, source=theirs_median))
    return rows


def robot_3_14(bench: Bench) -> list[Row]:
    """Repeat the robot experiment on the simulator: P3-AT, rendered images."""
    job = RunSpec("default", ("robot=p3at", LAW_ALONE, *start_at(ROBOT_START)), bench.out / "p3at")
    summary = bench.run([job])[0]
    plot_states(bench.out, _recorded([job]), "P3-AT, rendered images")
    plot_tensors(bench.out, _recorded([job]), "normalised tensor elements")
    plot_motion(bench.out, _recorded([job]), "motion of the features in the image")
    bound = {"position_cm": 1.0, "phi_deg": 0.5}
    published = {"position_cm": ROBOT_CM}
    return [within(start_name(ROBOT_START), bound, distances(summary), published=published)]


def _simulated(
    bench: Bench,
    start: Start,
    *,
    phi_1: str = "estimated",
    law: str = "practical",
    camera: str = "hypercatadioptric",
) -> RunSpec:
    """Return a recorded run of an ideal robot whose step 1 takes 100 s, as in the source.

    phi_1 : ``estimated``, ``zero``, or its value in degrees.
    """
    settings = [*_ideal(start, camera), *_law_settings(law)]
    if phi_1 == "zero":
        settings.append(f"estimator.phi_1={phi_1}")
    elif phi_1 != "estimated":
        settings += ["estimator.phi_1=given", f"estimator.phi_1_deg={phi_1}"]
    usual = {"hypercatadioptric": "", "estimated": "", "practical": ""}
    special = [usual.get(word, word) for word in (camera, phi_1, law)]
    name = folder_name(start_name(start), *(word for word in special if word))
    return RunSpec("default", tuple(settings), bench.out / name)


def _law_settings(law: str, tau_s: float = 100.0) -> tuple[str, ...]:
    """Return what the source states of its law: τ; its own form also drives no leg of its own."""
    settings = (f"controller.tau_s={tau_s}", f"duration_s={2.0 * tau_s}")
    if law == "practical":
        return settings
    alone = ("approach.enabled=false", "controller.advance_m=0", "controller.finish=time")
    return (*settings, f"controller.law={law}", *alone)


def _noise_rows(bench: Bench) -> list[Row]:
    """Return the rows of twenty seeds with a pixel of noise: step 1 takes 60 s.

    Judged is the robot that has not been told how noisy its images are.
    """
    runs = {
        "plain": _law_settings("practical", 60.0),
        "told": (*_law_settings("practical", 60.0), "perception.noise_px=1"),
        "source": _law_settings("published", 60.0),
    }
    specs = [_noisy(bench, name, seed, more) for name, more in runs.items() for seed in SEEDS]
    ends = np.array([list(distances(s).values()) for s in bench.run(specs)])
    case = f"{start_name(NOISY_START)} 1 px noise"
    rows = []
    for word, summed in (("median", np.median), ("worst", np.max)):
        plain, informed, source = (
            dict(zip(("position_cm", "phi_deg"), summed(group, axis=0).tolist(), strict=True))
            for group in ends.reshape(len(runs), len(SEEDS), 2)
        )
        name = f"{case}, {word} of {len(SEEDS)}"
        if word == "median":
            rows.append(within(name, NOISE_BOUND, plain, source=source))
        else:
            rows.append(Row(name, plain, source=source))
        rows.append(Row(name, informed, source=source, told=("perception.noise_px=1",)))
    return rows


def _noisy(bench: Bench, name: str, seed: int, settings: tuple[str, ...]) -> RunSpec:
    noise = ("mock.noise_px=1", f"seed={seed}")
    out = bench.out / folder_name(name, str(seed)) if seed == SEEDS[0] else None
    whole = (*_ideal(NOISY_START, "hypercatadioptric"), *noise, *settings)
    return RunSpec("default", whole, out)


def _earlier(bench: Bench, start: Start, references: str = "sequence") -> RunSpec:
    """Return a recorded run of the scheme on the 2D tensor, 120 s as ours."""
    settings = [
        setting for setting in _ideal(start, "hypercatadioptric") if "scheme" not in setting
    ]
    settings += ["scheme=trifocal2d", "duration_s=130", "controller.tau_s=85"]
    settings += ["controller.turn_s=12"]
    if references != "sequence":
        settings.append(f"controller.references={references}")
    return RunSpec(
        "default", tuple(settings), bench.out / folder_name(start_name(start), references)
    )


def _ideal(start: Start, camera: str) -> tuple[str, ...]:
    return (
        *("backend=mock", "scheme=trifocal", "mock.ideal=true"),
        *(f"camera.name={camera}", "camera.width=1024", "camera.height=768"),
        LAW_ALONE,
        *start_at(start),
    )


def _judged(
    case: str,
    published: Errors,
    found: dict[str, float],
    source: dict[str, float] | None = None,
) -> Row:
    printed = named(RESOLUTION, RESOLUTION, RESOLUTION)
    return against_source(case, named(*published), found, resolution=printed, source=source)


def _mean_square(directory: Path, signal: str) -> float:
    return float(np.mean(column(directory, f"trifocal-smc.{signal}") ** 2))


def _recorded(jobs: list[RunSpec]) -> list[Path]:
    return [job.out for job in jobs if job.out is not None]
