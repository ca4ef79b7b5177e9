"""Whether a pose can be told from what is measured along a motion: rank tests.

Three tests (source, A.3), each a matrix whose rank is 3 if every direction of (x, y, φ) is
observable. An *output* maps poses (..., 3) to values (..., m) and their derivatives (..., m, 3).

- `lie_matrix`: gradients of Lie derivatives, (A.6). Rank 3 means that the pose is locally
  weakly observable: told from its neighbours at once, if both velocities are applied.
- `discrete_matrix`: derivatives of the outputs of a few steps by the first pose, (A.7). Rank 3
  means that these steps tell it.
- `stripped_matrix`: local observability matrices of the linearised steps, (A.8), which is what
  an extended Kalman filter believes. It may be of higher rank than the truth.

What follows from them, and is tested: epipoles, and the target epipole alone, make the pose
locally weakly observable; pure translation along the baseline loses it. A metric tensor element
never does: its outputs along any motion are combinations a cos ε + b sin ε of two functions of
the pose, so that a and b are all it tells — in discrete time, too, where the source concludes
otherwise (4.13): the third column there depends on the other two. The stripped matrix is of
full rank all the same. Elements over T121, which the filters use, are ratios of two such
combinations and observe all three directions, but for the one that the source takes: T111/T121
is −cot of the bearing of one fixed point, where the x axes of the initial and the target view
meet, and a robot that goes round that point, facing it as before, sees nothing change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.robots.unicycle import exact_jacobians, step_exact

Array = NDArray[np.float64]
Output = Callable[[Array], tuple[Array, Array]]
Fields = Literal["both", "translation", "rotation"]

#: Step along a flow for derivatives (m, rad), and a five-point stencil of orders 0, 1, 2.
_STEP = 0.01
_NODES = np.arange(-2.0, 3.0)
_STENCIL = (
    np.array([0.0, 0.0, 1.0, 0.0, 0.0]),
    np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * _STEP),
    np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12.0 * _STEP**2),
)
#: Singular values below this share of the largest count as zero.
RANK_TOLERANCE = 1e-6


def lie_matrix(output: Output, pose: ArrayLike, offset: float, fields: Fields = "both") -> Array:
    """Return the gradients (R, 3) of the output's Lie derivatives up to the second order, (A.6).

    L_g^k h is the k-th derivative of h along the flow of g, and a mixed one along one flow and
    then the other. The flows of g1 (translation) and g2 (rotation) are exact arcs; their
    derivatives by time come from a five-point stencil, good to 1e-7.

    Parameters
    ----------
    output : Output
    pose : (3,) array
        Where to test (m, m, rad).
    offset : float
        Camera ahead of the axle, ℓ (m).
    fields : {"both", "translation", "rotation"}
        Which velocities are applied.
    """
    pose = np.asarray(pose, dtype=np.float64)
    moves = {"translation": (1.0, 0.0), "rotation": (0.0, 1.0)}
    used = list(moves.values()) if fields == "both" else [moves[fields]]
    rows = [output(pose)[1]]
    for flow in used:
        samples = np.stack([_pulled_back(output, pose, [(flow, n)], offset) for n in _NODES])
        rows += [np.tensordot(_STENCIL[order], samples, axes=1) for order in (1, 2)]
    for first, second in [(a, b) for a in used for b in used if a is not b]:
        samples = np.stack(
            [
                [_pulled_back(output, pose, [(first, m), (second, n)], offset) for n in _NODES]
                for m in _NODES
            ]
        )
        rows.append(np.einsum("a,b,abij->ij", _STENCIL[1], _STENCIL[1], samples))
    return np.vstack(rows)


def discrete_matrix(
    output: Output, pose: ArrayLike, velocities: ArrayLike, dt: float, offset: float
) -> Array:
    """Return the derivatives (R, 3) of the outputs of K + 1 moments by the first pose, (A.7).

    Parameters
    ----------
    output : Output
    pose : (3,) array
        At the first moment (m, m, rad).
    velocities : (K, 2) array
        (v, ω) between the moments (m/s, rad/s).
    dt : float
        Between two moments (s).
    offset : float
        Camera ahead of the axle, ℓ (m).
    """
    pose = np.asarray(pose, dtype=np.float64)
    rows, product = [output(pose)[1]], np.eye(3)
    for v, omega in np.asarray(velocities, dtype=np.float64):
        F, _ = exact_jacobians(pose, v, omega, dt, offset)
        pose, product = step_exact(pose, v, omega, dt, offset), F @ product
        rows.append(output(pose)[1] @ product)
    return np.vstack(rows)


def stripped_matrix(
    output: Output, pose: ArrayLike, velocities: ArrayLike, dt: float, offset: float
) -> Array:
    """Return the stripped observability matrix (R, 3) over K steps, (A.8).

    The local matrices [H; HF; HF²] of the linearised system at each moment, one below the
    other; arguments as in `discrete_matrix`.
    """
    pose = np.asarray(pose, dtype=np.float64)
    rows = []
    for v, omega in np.asarray(velocities, dtype=np.float64):
        H = output(pose)[1]
        F, _ = exact_jacobians(pose, v, omega, dt, offset)
        rows += [H, H @ F, H @ F @ F]
        pose = step_exact(pose, v, omega, dt, offset)
    return np.vstack(rows)


def singular_values(matrix: ArrayLike, length: float = 1.0) -> Array:
    """Return the three singular values, largest first, of an observability matrix (R, 3).

    length : what counts as much as one radian (m), as the columns have different units.
    """
    scaled = np.asarray(matrix, dtype=np.float64) * [length, length, 1.0]
    values = np.linalg.svd(scaled, compute_uv=False)
    return np.pad(values, (0, 3 - len(values)))


def rank(matrix: ArrayLike, length: float = 1.0, tolerance: float = RANK_TOLERANCE) -> int:
    """Return how many directions of the pose an observability matrix (R, 3) tells."""
    values = singular_values(matrix, length)
    return int(np.sum(values > tolerance * max(float(values[0]), 1e-300)))


def unobservable(
    matrix: ArrayLike, length: float = 1.0, tolerance: float = RANK_TOLERANCE
) -> Array:
    """Return the directions (U, 3), in (x/length, y/length, φ), that a matrix does not tell."""
    scaled = np.asarray(matrix, dtype=np.float64) * [length, length, 1.0]
    _, values, vectors = np.linalg.svd(scaled, full_matrices=True)
    values = np.pad(values, (0, 3 - len(values)))
    return np.asarray(vectors[values <= tolerance * max(float(values[0]), 1e-300)])


def _pulled_back(
    output: Output, pose: Array, moves: Sequence[tuple[tuple[float, float], float]], offset: float
) -> Array:
    """Return the output's derivative (m, 3) by ``pose``, taken after moves of (flow, steps)."""
    product = np.eye(3)
    for (v, omega), steps in moves:
        duration = float(steps) * _STEP
        F, _ = exact_jacobians(pose, v, omega, duration, offset)
        pose, product = step_exact(pose, v, omega, duration, offset), F @ product
    return np.asarray(output(pose)[1] @ product, dtype=np.float64)
