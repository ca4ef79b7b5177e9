"""What can be adverse to a run: the cells of ``visctrl reproduce adverse``.

Each cell is one thing that is wrong, or one place, driven from random starts. Lengths in pixels
are shares of the image's width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Generator = np.random.Generator
Settings = tuple[str, ...]
#: x right, y forward (m), φ counter-clockwise (deg).
Start = tuple[float, float, float]

WIDTH = 400
#: Robots and cameras that take turns in every cell.
MACHINES: tuple[Settings, ...] = (
    ("robot=p3dx", "camera.name=hypercatadioptric", f"camera.width={WIDTH}"),
    ("robot=p3at", "camera.name=hypercatadioptric", f"camera.width={WIDTH}"),
    ("robot=p3dx", "camera.name=paracatadioptric", f"camera.width={WIDTH}"),
    ("robot=p3dx", "camera.name=fisheye", f"camera.width={WIDTH}"),
)


class Cell(NamedTuple):
    """One row of the table.

    settings : drawn anew for every run. well_posed : the task can be done; where it cannot, a
    refusal or a stated doubt is right. start : where runs begin.
    """

    name: str
    settings: Callable[[Generator], Settings] = lambda rng: ()
    well_posed: bool = True
    start: Callable[[Generator], Start] = lambda rng: _anywhere(rng)


def cells() -> list[Cell]:
    """Return all cells."""
    return [*_places(), *_starts(), *_cameras(), *_drives(), *_sights(), *_scenes(), *_together()]


def _places() -> list[Cell]:
    well = ("hall", "office", "workshop", "clutter", "gallery", "glass", "far-hall", "yard")
    ill = ("checkers", "tiles", "pillars", "warehouse", "wall", "sparse")
    return [
        *(Cell(name, _always(f"sim.scene={name}")) for name in well),
        Cell("corridor", _always("sim.scene=corridor"), start=_narrow),
        Cell("random rooms", lambda rng: (f"sim.scene='random:{rng.integers(2000, 10**6)}'",)),
        *(Cell(name, _always(f"sim.scene={name}"), well_posed=False) for name in ill),
    ]


def _starts() -> list[Cell]:
    return [
        Cell("starts within 15 cm", start=lambda rng: _ring(rng, 0.02, 0.15, 10.0)),
        Cell("starts within 0.3 m, any heading", start=lambda rng: _ring(rng, 0.05, 0.3, 180.0)),
        Cell("starts in front", start=lambda rng: _box(rng, (-0.6, 0.6), (0.1, 0.5), 30.0)),
        Cell("starts far, turned away", start=lambda rng: _box(rng, (-1.5, 1.5), (-4, -2), 60.0)),
    ]


def _cameras() -> list[Cell]:
    def centre(share: float) -> Callable[[Generator], Settings]:
        def drawn(rng: Generator) -> Settings:
            angle = rng.uniform(-math.pi, math.pi)
            x, y = share * WIDTH * np.array([math.cos(angle), math.sin(angle)])
            return (f"camera_error.cx_px={x:.3f}", f"camera_error.cy_px={y:.3f}")

        return drawn

    def either(key: str, middle: float, by: float) -> Callable[[Generator], Settings]:
        return lambda rng: (f"{key}={middle + by * rng.choice((-1.0, 1.0)):g}",)

    return [
        Cell("image centre off by 1 %", centre(0.01)),
        Cell("image centre off by 2.5 %", centre(0.025)),
        Cell("focal length off by 10 %", either("camera_error.focal_scale", 1.0, 0.1)),
        Cell("xi off by 0.08", either("camera_error.xi", 0.0, 0.08)),
        Cell("camera pitched by 3 deg", either("camera_error.tilt_deg", 0.0, 3.0)),
        Cell("camera rolled by 2 deg", either("camera_error.roll_deg", 0.0, 2.0)),
        Cell("camera yawed by 3 deg", either("camera_error.yaw_deg", 0.0, 3.0)),
        Cell("camera 5 cm beside its mount", either("sim.mount_error.left_m", 0.0, 0.05)),
        Cell("camera 0.3 s late", _always("sim.latency_s=0.3")),
    ]


def _drives() -> list[Cell]:
    act = "sim.actuation."
    return [
        Cell("slip 15 %", _always(f"{act}slip_v=0.15", f"{act}slip_omega=0.15")),
        Cell(
            "wheels unequal by 3 %", _always(f"{act}wheels.left=0.985", f"{act}wheels.right=1.015")
        ),
        Cell("turning gain off by 15 %", lambda rng: (f"{act}wheels.track={_either(rng, 0.15)}",)),
        Cell("commands 0.2 s late", _always(f"{act}delay_s=0.2")),
        Cell("commands 0.5 s late", _always(f"{act}delay_s=0.5")),
        Cell("motion scatters", _always("sim.scatter.v_m_s=0.02", "sim.scatter.omega_deg_s=2")),
    ]


def _sights() -> list[Cell]:
    light = "sim.changes.light"
    return [
        Cell("shutter 30 ms, shake 0.3 deg", _always("sim.shutter_s=0.03", "sim.shake_deg=0.3")),
        Cell("light from one side", _always(f"{light}={{side: 0.5, from_deg: 90}}")),
        Cell("light of another colour", _always(f"{light}={{tint: 0.2}}")),
        Cell("dim light", _always(f"{light}={{brightness: 0.3}}")),
        Cell("over-exposed", _always("sim.changes.gain=1.5")),
        Cell("stray light", _always("sim.veil=0.4")),
        Cell("20 % of the frames lost", _always("sim.faults.frame_drop_probability=0.2")),
        Cell("black for 2 s", _always("sim.faults.camera_black_s=[4, 6]")),
        Cell("two people walk", _always("sim.people=2")),
    ]


def _scenes() -> list[Cell]:
    def changed(**shares: float) -> Callable[[Generator], Settings]:
        named = tuple(f"sim.changes.{key}={value}" for key, value in shares.items())
        return lambda rng: (*named, f"sim.changes.seed={rng.integers(10**6)}")

    return [
        Cell("a third moved by 0.5 m", changed(moved=0.33)),
        Cell("half moved by 0.5 m", changed(moved=0.5), well_posed=False),
        Cell("a third replaced", changed(replaced=0.33)),
        Cell("a third removed", changed(removed=0.33)),
        Cell("everything shifted by 2 cm", changed(scatter_m=0.02)),
    ]


def _together() -> list[Cell]:
    act = "sim.actuation."
    return [
        Cell(
            "centre 2 %, slip 10 %, 0.2 s late",
            _always(
                f"camera_error.cx_px={0.02 * WIDTH}",
                f"{act}slip_v=0.1",
                f"{act}slip_omega=0.1",
                f"{act}delay_s=0.2",
            ),
        ),
        Cell(
            "xi 0.05, pitch 2 deg, track 10 %",
            _always("camera_error.xi=0.05", "camera_error.tilt_deg=2", f"{act}wheels.track=1.1"),
        ),
        Cell(
            "side light, two people, a fifth moved",
            _always(
                "sim.changes.light={side: 0.4}",
                "sim.people=2",
                "sim.changes.moved=0.2",
            ),
        ),
    ]


def _always(*settings: str) -> Callable[[Generator], Settings]:
    return lambda rng: settings


def _either(rng: Generator, by: float) -> float:
    return 1.0 + by * float(rng.choice((-1.0, 1.0)))


def _anywhere(rng: Generator) -> Start:
    return _box(rng, (-1.0, 1.0), (-3.3, -1.3), 30.0)


def _narrow(rng: Generator) -> Start:
    return _box(rng, (-0.6, 0.6), (-3.3, -1.3), 25.0)


def _box(rng: Generator, x: tuple[float, float], y: tuple[float, float], phi: float) -> Start:
    return (
        round(float(rng.uniform(*x)), 3),
        round(float(rng.uniform(*y)), 3),
        round(float(rng.uniform(-phi, phi)), 2),
    )


def _ring(rng: Generator, near: float, far: float, phi: float) -> Start:
    distance, angle = rng.uniform(near, far), rng.uniform(-math.pi, math.pi)
    return (
        round(float(distance * math.sin(angle)), 4),
        round(float(distance * math.cos(angle)), 4),
        round(float(rng.uniform(-phi, phi)), 2),
    )
