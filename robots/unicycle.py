"""The unicycle with a camera offset: the motion of the camera's planar pose.

Frames: x right, y forward, heading φ counter-clockwise from the y axis (REP-103 appears only
at the boundary, see `to_rep103`). The camera sits ``offset`` metres ahead of the wheel axle's
centre; the pose is the camera's. Everything broadcasts over leading axes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: ArrayLike) -> Array:
    """Return angles (rad) wrapped to (−π, π]."""
    angle = np.asarray(angle, dtype=np.float64)
    wrapped = -np.remainder(-angle + np.pi, 2.0 * np.pi) + np.pi
    return np.asarray(wrapped, dtype=np.float64)


def wrapped(angle: float) -> float:
    """Return one angle (rad) wrapped to (−π, π]: `wrap_angle` for a plain float."""
    return math.pi - (math.pi - angle) % math.tau


def along_arc(
    pose: tuple[float, float, float], velocity: tuple[float, float], dt: float
) -> tuple[float, float, float]:
    """Return one pose (x, y, φ) moved along the exact arc of a constant velocity (v, ω).

    It is `step_exact` for a single pose without offset, in plain floats: a hundredth of the
    cost of an array operation, in the innermost loop of every study.
    """
    x, y, phi = pose
    v, omega = velocity
    half = omega * dt / 2.0
    chord = v * dt
    if abs(half) > 1e-9:
        chord *= math.sin(half) / half
    middle = phi + half
    return x - chord * math.sin(middle), y + chord * math.cos(middle), phi + 2.0 * half


def step_exact(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float, offset: float = 0.0
) -> Array:
    """Advance the camera pose along the exact arc of constant (v, ω).

    Parameters
    ----------
    pose : (..., 3) array
        (x, y, φ) of the camera in metres and radians.
    v, omega : (...) arrays
        Forward speed of the axle's centre (m/s) and turning rate (rad/s).
    dt : float
        Duration (s).
    offset : float
        Camera ahead of the axle, ℓ (m).

    Returns
    -------
    (..., 3) array
        The pose after ``dt``: the integral of (1.3) for constant inputs. φ is not wrapped.
    """
    pose = np.asarray(pose, dtype=np.float64)
    v = np.asarray(v, dtype=np.float64)
    turn = np.asarray(omega, dtype=np.float64) * dt
    phi = pose[..., 2]
    phi_new = phi + turn
    # sinc keeps the chord exact through ω = 0.
    chord = v * dt * np.sinc(turn / (2.0 * np.pi))
    middle = phi + turn / 2.0
    x = pose[..., 0] - chord * np.sin(middle) + offset * (np.sin(phi) - np.sin(phi_new))
    y = pose[..., 1] + chord * np.cos(middle) + offset * (np.cos(phi_new) - np.cos(phi))
    return np.stack(np.broadcast_arrays(x, y, phi_new), axis=-1)


def step_euler(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float, offset: float = 0.0
) -> Array:
    """Advance the camera pose by one Euler step of (1.3); arguments as in `step_exact`."""
    pose = np.asarray(pose, dtype=np.float64)
    v = np.asarray(v, dtype=np.float64)
    omega = np.asarray(omega, dtype=np.float64)
    s, c = np.sin(pose[..., 2]), np.cos(pose[..., 2])
    x = pose[..., 0] - dt * (omega * offset * c + v * s)
    y = pose[..., 1] - dt * (omega * offset * s - v * c)
    return np.stack(np.broadcast_arrays(x, y, pose[..., 2] + dt * omega), axis=-1)


def euler_jacobians(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float, offset: float = 0.0
) -> tuple[Array, Array]:
    """Return the Jacobians of `step_euler`: F (..., 3, 3) by the pose, G (..., 3, 2) by (v, ω).

    They are (1.5); G carries the factor ``dt``, which the printed equation leaves out.
    """
    pose = np.asarray(pose, dtype=np.float64)
    v = np.asarray(v, dtype=np.float64)
    omega = np.asarray(omega, dtype=np.float64)
    s, c = np.sin(pose[..., 2]), np.cos(pose[..., 2])
    shape = np.broadcast_shapes(s.shape, v.shape, omega.shape)
    F = np.zeros((*shape, 3, 3))
    F[..., 0, 0] = F[..., 1, 1] = F[..., 2, 2] = 1.0
    F[..., 0, 2] = dt * (omega * offset * s - v * c)
    F[..., 1, 2] = -dt * (omega * offset * c + v * s)
    G = np.zeros((*shape, 3, 2))
    G[..., 0, 0] = -dt * s
    G[..., 0, 1] = -dt * offset * c
    G[..., 1, 0] = dt * c
    G[..., 1, 1] = -dt * offset * s
    G[..., 2, 1] = dt
    return F, G


def exact_jacobians(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float, offset: float = 0.0
) -> tuple[Array, Array]:
    """Return the Jacobians of `step_exact`: F (..., 3, 3) by the pose, G (..., 3, 2) by (v, ω)."""
    pose = np.asarray(pose, dtype=np.float64)
    v = np.asarray(v, dtype=np.float64)
    half = np.asarray(omega, dtype=np.float64) * (dt / 2.0)
    after = step_exact(pose, v, omega, dt, offset)
    middle = pose[..., 2] + half
    s, c = np.sin(middle), np.cos(middle)
    ratio = np.sinc(half / np.pi)
    chord = v * dt * ratio
    # Of v dt sin(a)/a by a; the closed form cancels near a = 0, where the series is exact.
    small = np.abs(half) < 1e-3
    safe = np.where(small, 1.0, half)
    slope = v * dt * np.where(small, -half / 3.0, (np.cos(safe) - ratio) / safe)
    F = np.zeros((*after.shape[:-1], 3, 3))
    F[..., 0, 0] = F[..., 1, 1] = F[..., 2, 2] = 1.0
    F[..., 0, 2] = pose[..., 1] - after[..., 1]
    F[..., 1, 2] = after[..., 0] - pose[..., 0]
    G = np.zeros((*after.shape[:-1], 3, 2))
    G[..., 0, 0] = -dt * ratio * s
    G[..., 1, 0] = dt * ratio * c
    G[..., 0, 1] = dt * (-(slope * s + chord * c) / 2.0 - offset * np.cos(after[..., 2]))
    G[..., 1, 1] = dt * ((slope * c - chord * s) / 2.0 - offset * np.sin(after[..., 2]))
    G[..., 2, 1] = dt
    return F, G


class Arc(NamedTuple):
    """The exact arc of one pose.

    dx, dy, turn : the camera's motion (m, m, rad).
    by_velocity : its derivatives (dx/dv, dx/dω, dy/dv, dy/dω); those of the turn are (0, dt).

    By the heading before, the motion has the derivatives (−dy, dx, 0).
    """

    dx: float
    dy: float
    turn: float
    by_velocity: tuple[float, float, float, float]


def arc(phi: float, v: float, omega: float, dt: float, offset: float = 0.0) -> Arc:
    """Return `step_exact` and `exact_jacobians` of a single pose, in plain floats.

    A twentieth of the cost of array operations, for the innermost loops. ``phi`` is the heading
    before (rad), the other arguments are as in `step_exact`.
    """
    half = omega * dt / 2.0
    middle, after = phi + half, phi + 2.0 * half
    s, c = math.sin(middle), math.cos(middle)
    s_after, c_after = math.sin(after), math.cos(after)
    if abs(half) < 1e-3:
        ratio, slope = 1.0 - half * half / 6.0, -half / 3.0
    else:
        ratio = math.sin(half) / half
        slope = (math.cos(half) - ratio) / half
    way = v * dt
    chord = way * ratio
    return Arc(
        offset * (math.sin(phi) - s_after) - chord * s,
        offset * (c_after - math.cos(phi)) + chord * c,
        2.0 * half,
        (
            -dt * ratio * s,
            -dt * ((way * slope * s + chord * c) / 2.0 + offset * c_after),
            dt * ratio * c,
            dt * ((way * slope * c - chord * s) / 2.0 - offset * s_after),
        ),
    )


def relative_pose(pose: ArrayLike, reference: ArrayLike) -> Array:
    """Return ``pose`` (..., 3) expressed in the frame of ``reference`` (..., 3), φ wrapped."""
    pose = np.asarray(pose, dtype=np.float64)
    reference = np.asarray(reference, dtype=np.float64)
    s, c = np.sin(reference[..., 2]), np.cos(reference[..., 2])
    dx = pose[..., 0] - reference[..., 0]
    dy = pose[..., 1] - reference[..., 1]
    phi = wrap_angle(pose[..., 2] - reference[..., 2])
    return np.stack(np.broadcast_arrays(c * dx + s * dy, -s * dx + c * dy, phi), axis=-1)


def compose(reference: ArrayLike, relative: ArrayLike) -> Array:
    """Return the pose (..., 3) that is ``relative`` (..., 3) in the frame of ``reference``.

    It undoes `relative_pose`, up to the wrapping of φ, which is not done here.
    """
    reference = np.asarray(reference, dtype=np.float64)
    relative = np.asarray(relative, dtype=np.float64)
    s, c = np.sin(reference[..., 2]), np.cos(reference[..., 2])
    dx, dy = relative[..., 0], relative[..., 1]
    x = reference[..., 0] + c * dx - s * dy
    y = reference[..., 1] + s * dx + c * dy
    return np.stack(np.broadcast_arrays(x, y, reference[..., 2] + relative[..., 2]), axis=-1)


def to_rep103(pose: ArrayLike) -> Array:
    """Return (x, y, φ) as REP-103 (X forward, Y left, yaw): X = y, Y = −x, yaw = φ."""
    pose = np.asarray(pose, dtype=np.float64)
    return np.stack([pose[..., 1], -pose[..., 0], pose[..., 2]], axis=-1)


def from_rep103(pose: ArrayLike) -> Array:
    """Return REP-103 (X, Y, yaw) in this project's planar convention: the inverse of above."""
    pose = np.asarray(pose, dtype=np.float64)
    return np.stack([-pose[..., 1], pose[..., 0], pose[..., 2]], axis=-1)
