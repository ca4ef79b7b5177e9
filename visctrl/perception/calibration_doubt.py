"""Is it the calibration that is wrong, not the match? One motion and one fault for all pairs.

With a wrong image centre, tilt or scale, no planar motion fits a match to its noise, and the best
one is degrees off. But one set of faults then explains nearly all pairs of features that look
alike, to a fraction of a pixel; moved things and other places do not do that.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.two_view.planar import ransac_planar_motion, sampson_residuals
from visctrl.hal.cameras.central import CentralCamera
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]

#: What a calibration may be wrong by, and the robot be tilted by between two views: centre (share
#: of the width), tilt (rad), scale; one standard deviation each.
_CENTRE, _TILT, _SCALE = 0.025, math.radians(1.5), 0.1
#: Deviations (px) of the search, and of the fit from loose to tight (graduated non-convexity).
_SEARCH_PX = 2.0
_TIGHTER_PX = (6.0, 4.0, 3.0, 2.0, 1.4, 1.0, 0.7, 0.5, 0.5, 0.5)
_REPEATS = 2
#: Pairs that agree: how far off at most (px), how many, which share of all, and their median (px).
_AGREE_PX, _FEWEST, _SHARE, _MEDIAN_PX = 2.0, 60, 0.75, 0.2
#: Steps of the numerical derivatives: of the motion (rad), of the faults.
_STEPS = np.diag([1e-5, 1e-5, *np.full(5, 1e-3)])
_PRIOR = np.array([0.0, 0.0, *np.ones(5)])


def explained_by_calibration(
    rays_a: Array, rays_b: Array, canvas: Canvas, camera: CentralCamera, seed: int
) -> bool:
    """Return whether one motion with one wrong calibration explains nearly all pairs (N, 3).

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Rays of features that are each other's best match, outliers included.
    canvas, camera
        On which the pictures are drawn, and which took them.
    seed : int
        Of the random samples.
    """
    if len(rays_a) < _FEWEST:
        return False
    residual = np.abs(_fitted(rays_a, rays_b, canvas, camera, seed))
    agree = residual < _AGREE_PX
    enough = max(_FEWEST, _SHARE * len(residual))
    return bool(agree.sum() >= enough and np.median(residual[agree]) < _MEDIAN_PX)


def _fitted(
    rays_a: Array, rays_b: Array, canvas: Canvas, camera: CentralCamera, seed: int
) -> Array:
    """Return the residuals (N,) (px) at the motion and faults that fit best."""
    found = ransac_planar_motion(rays_a, rays_b, _SEARCH_PX / canvas.scale, seed=seed)
    views = _Faulty(rays_a, rays_b, camera)

    def residuals(x: Array) -> Array:
        a, b = views.rays(x[2:])
        # Pixels that a fault would move out of the image say nothing of it.
        return canvas.scale * np.nan_to_num(sampson_residuals(a, b, x[0], x[1])[0])

    x = np.array([found.phi, found.direction, *np.zeros(5)])
    for sigma in np.repeat(_TIGHTER_PX, _REPEATS):
        left = residuals(x)
        J = np.stack([(residuals(x + h) - left) / h.sum() for h in _STEPS], axis=1)
        # Geman and McClure's weights.
        weighted = J / (sigma * (1.0 + (left / sigma) ** 2)[:, None]) ** 2
        H = weighted.T @ J + np.diag(_PRIOR + 1e-9)
        x = x - np.linalg.solve(H, weighted.T @ left + _PRIOR * x)
    return residuals(x)


class _Faulty:
    """Rays of two views as a camera with other faults would have given them.

    The faults are the image centre's column and row, the robot's tilt between the views about
    its right and its forward axis, and the image's scale, each in its standard deviation.
    """

    def __init__(self, rays_a: Array, rays_b: Array, camera: CentralCamera) -> None:
        self._camera = camera
        self._pixels = [camera.robot_pixels(rays)[0] for rays in (rays_a, rays_b)]
        self._middle = np.array([camera.width - 1.0, camera.height - 1.0]) / 2.0

    def rays(self, faults: Array) -> tuple[Array, Array]:
        """Return the rays (N, 3) of both views for faults (5,)."""
        shift = _CENTRE * self._camera.width * faults[:2]
        scale = 1.0 + _SCALE * faults[4]
        a, b = (
            self._camera.robot_rays(self._middle + scale * (pixels - self._middle) + shift)[0]
            for pixels in self._pixels
        )
        return a, b + np.cross([_TILT * faults[2], _TILT * faults[3], 0.0], b)
