"""(ξ, K) of the central model and the boards' poses, from corners in several images.

Bundle adjustment: the parameters of (1.6), (1.7) and one pose a board minimise the distances in
the images, all at once. It starts from a search: for each of a few (ξ, f), corners become rays,
and a board's pose follows from them linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from visctrl.calibration.boards import Board, Corners
from visctrl.hal.cameras.models.unified import UnifiedCamera

Array = NDArray[np.float64]

_INTRINSICS = 5
_POSE = 6
#: The search: ξ, and shares of the image's greater side that αx / (1 + ξ) may be.
_XIS = (0.0, 0.5, 0.8, 1.0, 1.3, 1.8)
_FOCALS = tuple(np.geomspace(0.08, 3.0, 14))
_CANDIDATES = 3
#: Errors beyond this (px) count less, until bad images are known.
_SOFT_PX = 1.0
_STEP = 1e-6
#: Cells across the picture in which residuals are compared.
_CELLS = 8


@dataclass(frozen=True)
class CameraFit:
    """A calibration.

    intrinsics : (5,) ξ, αx, αy, x0, y0; sigmas : (5,) their standard deviations.
    poses : (M, 6) rotation vectors and positions of the boards in camera axes.
    residuals : for each image, (N, 2) found minus predicted (px).
    misfit_px : root mean square of what the residuals of a place in the picture have in common.
    """

    intrinsics: Array
    sigmas: Array
    poses: Array
    residuals: tuple[Array, ...]
    misfit_px: float

    @property
    def rms(self) -> Array:
        """Root mean square distance in each image (M,) (px)."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])

    @property
    def total_rms(self) -> float:
        """Root mean square distance over all corners (px)."""
        return float(np.sqrt((np.concatenate(self.residuals) ** 2).sum(axis=1).mean()))


class Bundle:
    """The corners of M images of one board, with what is to be minimised over them.

    Parameters
    ----------
    board : Board
    images : sequence of Corners
    pinhole : bool
        ξ = 0 is known.
    """

    def __init__(self, board: Board, images: Sequence[Corners], pinhole: bool) -> None:
        self._points = np.concatenate([board.points[c.ids] for c in images])
        self._pixels = np.concatenate([c.pixels for c in images])
        self._image = np.repeat(np.arange(len(images)), [len(c) for c in images])
        self._count = len(images)
        self._free = np.arange(_INTRINSICS)[1 if pinhole else 0 :]

    def fit(self, intrinsics: Array, poses: Array, *, robust: bool) -> CameraFit:
        """Return the least-squares solution near a start; ``robust`` with a soft-L1 loss."""
        start = np.concatenate([intrinsics[self._free], poses.ravel()])
        lower = np.full(start.shape, -np.inf)
        if 0 in self._free:
            lower[0] = 0.0

        def split(p: Array) -> tuple[Array, Array]:
            full = intrinsics.copy()
            full[self._free] = p[: len(self._free)]
            return full, p[len(self._free) :].reshape(-1, _POSE)

        def residuals_at(p: Array) -> Array:
            return self._residuals(*split(p)).ravel()

        def jacobian_at(p: Array) -> Array:
            return self._jacobian(*split(p))

        solution = least_squares(
            residuals_at,
            np.maximum(start, lower),
            jac=jacobian_at,
            bounds=(lower, np.inf),
            x_scale="jac",
            loss="soft_l1" if robust else "linear",
            f_scale=_SOFT_PX,
            max_nfev=100,
        )
        intrinsics, poses = split(solution.x)
        residuals = -self._residuals(intrinsics, poses)
        per_image = tuple(residuals[self._image == i] for i in range(self._count))
        misfit_px, inflation = self._misfit(residuals)
        sigmas = inflation * self._sigmas(intrinsics, poses, residuals)
        return CameraFit(intrinsics, sigmas, poses, per_image, misfit_px)

    def start(self, size: tuple[int, int]) -> list[tuple[float, Array, Array]]:
        """Return the best starts as (cost, intrinsics, poses), from a search over (ξ, f).

        size : width and height of the images (px).
        """
        width, height = size
        found = []
        for xi in _XIS if 0 in self._free else (0.0,):
            for share in _FOCALS:
                focal = share * max(size) * (1.0 + xi)
                intrinsics = np.array([xi, focal, focal, (width - 1) / 2, (height - 1) / 2])
                poses = self._linear_poses(intrinsics)
                if poses is None:
                    continue
                error = np.linalg.norm(self._residuals(intrinsics, poses), axis=1)
                cost = float(np.median(np.nan_to_num(error, nan=1e6)))
                found.append((cost, intrinsics, poses))
        found.sort(key=lambda item: item[0])
        return found[:_CANDIDATES]

    def pose_only(self, intrinsics: Array) -> float:
        """Return the rms distance (px) that the best poses leave with these intrinsics."""
        poses = self._linear_poses(intrinsics)
        if poses is None:
            return float("inf")

        def residuals_at(p: Array) -> Array:
            return self._residuals(intrinsics, p.reshape(-1, _POSE)).ravel()

        solution = least_squares(residuals_at, poses.ravel(), x_scale="jac")
        return float(np.sqrt(2.0 * solution.cost / len(self._pixels)))

    # --- geometry ----------------------------------------------------------------------------

    def _residuals(self, intrinsics: Array, poses: Array) -> Array:
        """Return predicted minus found pixels (N, 2)."""
        R = Rotation.from_rotvec(poses[:, :3]).as_matrix()[self._image]
        points = np.einsum("nij,nj->ni", R, self._points) + poses[self._image, 3:]
        return np.asarray(_project(intrinsics, points) - self._pixels)

    def _jacobian(self, intrinsics: Array, poses: Array) -> Array:
        """Return ∂residuals/∂parameters (2N, P) by central differences.

        The poses are independent, so the same coordinate of all is varied at once.
        """
        n = len(self._pixels)
        J = np.zeros((n, 2, len(self._free) + _POSE * self._count))
        for column, k in enumerate(self._free):
            step = np.zeros(_INTRINSICS)
            step[k] = _STEP * max(1.0, abs(intrinsics[k]))
            plus, minus = (self._residuals(intrinsics + s * step, poses) for s in (1, -1))
            J[:, :, column] = (plus - minus) / (2.0 * step[k])
        columns = len(self._free) + _POSE * self._image
        for k in range(_POSE):
            step = np.zeros(_POSE)
            step[k] = _STEP
            plus, minus = (self._residuals(intrinsics, poses + s * step) for s in (1, -1))
            J[np.arange(n), :, columns + k] = (plus - minus) / (2.0 * _STEP)
        return J.reshape(2 * n, -1)

    def _sigmas(self, intrinsics: Array, poses: Array, residuals: Array) -> Array:
        """Return the intrinsics' standard deviations (5,) by first-order propagation."""
        J = self._jacobian(intrinsics, poses)
        freedom = max(1, J.shape[0] - J.shape[1])
        covariance = np.linalg.pinv(J.T @ J) * (residuals**2).sum() / freedom
        sigmas = np.zeros(_INTRINSICS)
        sigmas[self._free] = np.sqrt(np.diag(covariance)[: len(self._free)])
        return sigmas

    def _misfit(self, residuals: Array) -> tuple[float, float]:
        """Return the rms (px) of cells' mean residuals beyond chance, and what it does to sigmas.

        One-way analysis of variance over the cells of a grid on the picture. Corners of a cell
        that share an error are fewer observations than they are: the standard deviations grow by
        the root of the design effect (Kish 1965), the variance of means over that of chance.
        """
        low = self._pixels.min(axis=0)
        side = (self._pixels.max(axis=0) - low).max() / _CELLS + 1e-9
        column, row = ((self._pixels - low) // side).astype(int).T
        _, cell, counts = np.unique(
            row * (_CELLS + 1) + column, return_inverse=True, return_counts=True
        )
        sums = np.stack([np.bincount(cell, residuals[:, k]) for k in (0, 1)], axis=-1)
        means = sums / counts[:, None]
        freedom = len(residuals) - len(counts)
        if freedom < len(counts):
            return 0.0, 1.0
        between = float((counts[:, None] * means**2).sum()) / (2 * len(counts))
        within = float(((residuals - means[cell]) ** 2).sum()) / (2 * freedom)
        total = float((residuals**2).mean())
        shared = max(0.0, between - within) * len(counts) / len(residuals)
        return float(np.sqrt(2.0 * shared)), float(np.sqrt(max(1.0, between / max(total, 1e-300))))

    def _linear_poses(self, intrinsics: Array) -> Array | None:
        """Return a pose (M, 6) of each board from the rays of its corners."""
        rays = _unproject(intrinsics, self._pixels)
        if not np.isfinite(rays).all():
            return None
        poses = np.zeros((self._count, _POSE))
        for i in range(self._count):
            mine = self._image == i
            poses[i] = _plane_pose(self._points[mine, :2], rays[mine])
        return poses


def camera_from(fit: CameraFit, size: tuple[int, int], name: str) -> UnifiedCamera:
    """Return a fit as a camera that sees everything its model can."""
    xi, fx, fy, cx, cy = fit.intrinsics.tolist()
    width, height = size
    return UnifiedCamera(
        name=name, width=width, height=height, xi=xi, fx=fx, fy=fy, cx=cx, cy=cy, max_polar_deg=180
    )


def _project(intrinsics: Array, points: Array) -> Array:
    """Return the images (N, 2) of points in camera axes, wherever the model leads (1.6), (1.7).

    Unlike `UnifiedCamera.project` it has no field of view: a fit may pass outside of it.
    """
    xi, fx, fy, cx, cy = intrinsics
    depth = points[:, 2] + xi * np.linalg.norm(points, axis=1)
    depth = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return np.stack([fx * points[:, 0] / depth + cx, fy * points[:, 1] / depth + cy], axis=-1)


def _unproject(intrinsics: Array, pixels: Array) -> Array:
    """Return unit rays (N, 3) of pixels, NaN where the model has none."""
    xi, fx, fy, cx, cy = intrinsics
    x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    r2 = x * x + y * y
    root = 1.0 + (1.0 - xi**2) * r2
    factor = (xi + np.sqrt(np.where(root >= 0.0, root, np.nan))) / (1.0 + r2)
    return np.stack([factor * x, factor * y, factor - xi], axis=-1)


def _plane_pose(points: Array, rays: Array) -> Array:
    """Return the pose (6,) of a plane whose points (N, 2) are seen along rays (N, 3).

    Linear: ray × (H (X, Y, 1)) = 0 with H = [r1 r2 t], whose columns are then made a rotation.
    The board lies where its corners are seen, not opposite.
    """
    centre, spread = points.mean(axis=0), float(np.abs(points - points.mean(axis=0)).max())
    flat = (points - centre) / spread
    homogeneous = np.column_stack([flat, np.ones(len(flat))])
    zero = np.zeros_like(homogeneous)
    a, b, c = (rays[:, k, None] * homogeneous for k in range(3))
    rows = np.concatenate(
        [
            np.hstack([zero, -c, b]),
            np.hstack([c, zero, -a]),
            np.hstack([-b, a, zero]),
        ]
    )
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    H /= np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    if ((homogeneous @ H.T) * rays).sum() < 0.0:
        H = -H
    U, _, Vt = np.linalg.svd(np.column_stack([H[:, :2], np.cross(H[:, 0], H[:, 1])]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    t = spread * H[:, 2] - R[:, :2] @ centre
    return np.concatenate([Rotation.from_matrix(R).as_rotvec(), t])
