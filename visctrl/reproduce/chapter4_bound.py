"""Cramér–Rao bound of a final pose: what the noise of the target's images leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.mock.backend import MockOptions, Purpose
from visctrl.hal.mock.scene import scatter, view_matrix
from visctrl.hal.types import Pose
from visctrl.studies.run_spec import RunSpec

Array = NDArray[np.float64]

#: Steps of the numerical derivatives by x, y (m) and φ (rad).
_STEPS = (1e-4, 1e-4, 1e-5)


def cramer_rao(runs: Sequence[RunSpec], frames: int) -> Array:
    """Return the least standard deviations (3,) of the final pose (cm, cm, deg) over runs.

    The bound of an estimator that is given the scene without error and sees as many current
    images as it likes: only the target's own images are noisy, and with them the place where it
    believes the target to be. Real ones must make do with less, so that none scatters less.

    Parameters
    ----------
    runs : sequence of RunSpec
        On the mock, each with a scene of its own.
    frames : int
        Images of the target that are averaged.
    """
    variances = [np.diag(np.linalg.inv(frames * _information(run))) for run in runs]
    x, y, phi = np.sqrt(np.mean(variances, axis=0))
    return np.array([100.0 * x, 100.0 * y, np.degrees(phi)])


def _information(run: RunSpec) -> Array:
    """Return Fisher's information (3, 3) about (x, y, φ) in one image of the target."""
    plan = run.plan()
    options = plan.backend_options
    if not isinstance(options, MockOptions):
        raise TypeError("the scene is known on the mock alone")
    points = scatter(
        options.features,
        (options.near_m, options.far_m),
        plan.true_camera,
        plan.mount,
        plan.scenario.start.pose(),
        Purpose.SCENE.generator(plan.scenario.seed),
    )
    J = _jacobian(plan.true_camera, points) / options.noise_px
    return np.asarray(J.T @ J)


def _jacobian(camera: CentralCamera, points: Array) -> Array:
    """Return d pixels / d (x, y, φ) at the target, (2 N, 3), by central differences."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    columns = []
    for k, step in enumerate(_STEPS):
        moved = [Pose(*(sign * step * (np.arange(3) == k)).tolist()) for sign in (1.0, -1.0)]
        ahead, behind = (camera.robot_pixels(homogeneous @ view_matrix(p))[0] for p in moved)
        columns.append(((ahead - behind) / (2.0 * step)).ravel())
    return np.stack(columns, axis=1)
