"""Cameras with lens distortion on rendered images: each model, each scheme, seeded starts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.files import Format, write_camera
from visctrl.reproduce.entry import Bench, Row, within
from visctrl.reproduce.main_job import Start, final_error
from visctrl.studies.run_spec import RunSpec

SCHEMES = ("trifocal", "trifocal2d", "epipolar", "pose")
COUNT, SEED = 4, 16
#: Ranges of the start: x right (m), y forward (m), φ counter-clockwise (deg). A camera that looks
#: ahead must see the target's surroundings from there.
ALL_ROUND = ((-0.7, 0.7), (-2.2, -1.3), (-25.0, 25.0))
AHEAD = ((-0.25, 0.25), (-2.0, -1.5), (-6.0, 6.0))
BOUNDS = {"position_cm": 0.5, "phi_deg": 0.3}

_PICTURE = {"width": 800, "height": 600, "cx": 401.3, "cy": 297.8}
#: Each is written in the format in which such cameras come, and read from it.
CAMERAS: dict[str, tuple[Format, Mapping[str, Any]]] = {
    "kannala-brandt-190": (
        "kalibr",
        {
            **_PICTURE,
            **{"model": "kannala-brandt", "fx": 178.0, "fy": 178.4},
            **{"k1": -0.012, "k2": 0.006, "k3": -0.004, "k4": 0.0005},
            **{"optical_axis": "up", "max_polar_deg": 95.0},
        },
    ),
    "mei-radtan": (
        "camodocal",
        {
            **_PICTURE,
            **{"model": "unified-radtan", "xi": 0.95, "fx": 165.0, "fy": 164.6},
            **{"k1": -0.09, "k2": 0.012, "p1": 4e-4, "p2": -3e-4},
            **{"optical_axis": "down", "min_polar_deg": 30.0, "max_polar_deg": 115.0},
        },
    ),
    "double-sphere": (
        "basalt",
        {
            **_PICTURE,
            **{"model": "double-sphere", "fx": 160.0, "fy": 160.3, "xi": -0.18, "alpha": 0.59},
            **{"optical_axis": "up", "max_polar_deg": 95.0},
        },
    ),
    "webcam-8": (
        "opencv",
        {
            **{"width": 640, "height": 480, "cx": 322.9, "cy": 236.2},
            **{"model": "pinhole-radtan", "fx": 592.0, "fy": 593.1, "k1": 0.11, "k2": -0.35},
            **{"p1": 8e-4, "p2": -5e-4, "k3": 0.12, "k4": 0.05, "k5": -0.1, "k6": 0.03},
            **{"max_polar_deg": 89.0},
        },
    ),
}


def camera_file(name: str, folder: Path) -> Path:
    """Write one of `CAMERAS` into a folder, in its format, and return the file."""
    form, fields = CAMERAS[name]
    path = folder / f"{name}.{'json' if form == 'basalt' else 'yaml'}"
    write_camera(parse_camera({"name": name, **fields}, name), path, form)
    return path


def seeded_starts(name: str) -> list[Start]:
    """Return `COUNT` starts (m, m, deg) for a camera."""
    ranges = AHEAD if CAMERAS[name][1].get("optical_axis") is None else ALL_ROUND
    low, high = np.transpose(ranges)
    drawn = np.random.default_rng(SEED).uniform(low, high, (COUNT, 3))
    return [(round(x, 3), round(y, 3), round(phi, 2)) for x, y, phi in drawn.tolist()]


def job(camera: Path, scheme: str, start: Start, seed: int) -> RunSpec:
    """Return a rendered run with a calibration file."""
    x, y, phi = start
    where = (f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}", f"seed={seed}")
    return RunSpec("default", (*where, f"scheme={scheme}", f"camera.name={camera}"))


def camera_models(bench: Bench) -> list[Row]:
    """Drive with every camera and every scheme from `COUNT` starts; the worst end of each."""
    cases = [(name, scheme) for name in CAMERAS for scheme in SCHEMES]
    files = {name: camera_file(name, bench.out).resolve() for name in CAMERAS}
    jobs = [
        job(files[name], scheme, start, seed)
        for name, scheme in cases
        for seed, start in enumerate(seeded_starts(name))
    ]
    ends = np.reshape([final_error(summary) for summary in bench.run(jobs)], (-1, COUNT, 2))
    return [
        within(f"{name}, {scheme}", BOUNDS, dict(zip(BOUNDS, worst.tolist(), strict=True)))
        for (name, scheme), worst in zip(cases, ends.max(axis=1), strict=True)
    ]
