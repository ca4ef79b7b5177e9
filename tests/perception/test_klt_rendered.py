"""The tracker on PyBullet's frames, judged by the trilinear relation of the true poses."""

from __future__ import annotations

import numpy as np
import pytest

from visctrl.contracts import Context, Health, Views
from visctrl.geometry.trifocal.tensor import tensor_from_poses
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.types import Pose, Velocity
from visctrl.perception.klt import Klt, KltOptions
from visctrl.robots import load_robot
from visctrl.sim.backend import SimBackend
from visctrl.sim.options import SimOptions

pytestmark = pytest.mark.sim

START = Pose(-0.5, -1.6, np.radians(-20.0))


def transfer_errors(views: Views, initial: Pose, current: Pose) -> np.ndarray:
    """Return the errors (deg) of current bearings against those that the two others imply.

    Only of features with so much parallax (0.25 rad) that the noise of the other two views is
    amplified by no more than four; NaN for the others.
    """
    u, c, w = (
        rays[:, :2] / np.linalg.norm(rays[:, :2], axis=1)[:, None]
        for rays in (views.initial, views.current, views.target)
    )
    T = np.asarray(tensor_from_poses(initial, current)).reshape(2, 2, 2)
    line = np.einsum("ijk,ni,nk->nj", T, u, w)
    norm = np.linalg.norm(line, axis=1)
    s, cos = np.sin(initial.phi), np.cos(initial.phi)
    turned = u @ np.array([[cos, s], [-s, cos]])
    parallax = np.abs(turned[:, 0] * w[:, 1] - turned[:, 1] * w[:, 0])
    error = np.degrees(np.arcsin(np.clip((line * c).sum(axis=1) / norm, -1, 1)))
    return np.where(parallax > 0.25, np.abs(error), np.nan)


@pytest.mark.parametrize("name", ["hypercatadioptric", "fisheye"])
def test_tracks_on_rendered_frames_keep_to_the_three_views(name):
    robot, camera = load_robot("p3dx"), load_camera(name)
    backend = SimBackend(
        BackendSetup(robot, robot.mount("centre"), camera, camera, START, None, SimOptions(), 1)
    )
    klt = Klt(KltOptions(), Context(camera, None, 0.0, 0.1, 0, True))
    with backend:
        klt.set_target(backend.teach(2))
        klt.set_initial(backend.camera.read())
        initial = backend.truth()
        assert initial is not None
        errors, doubtful = [], []
        for tick in range(1, 13):
            backend.base.command(Velocity(1.0, -0.3))
            backend.clock.sleep_until(0.1 * tick)
            views, current = klt.update(backend.camera.read()), backend.truth()
            assert views.health is Health.OK
            assert current is not None
            error = transfer_errors(views, initial, current)
            judged = ~np.isnan(error)
            errors.append(error[judged])
            doubtful.append((views.bearing_sigmas()[2] > 1.5 * views.sigma)[judged])
    klt.close()
    error, doubted = np.concatenate(errors), np.concatenate(doubtful)
    assert len(error) > 200
    assert np.median(error) < 0.05
    assert np.mean(error > 0.5) <= 0.02
    assert np.hypot(current.x, current.y) < 0.75
    # Features that are said to be less certain are.
    assert doubted.sum() > 20
    assert np.median(error[doubted]) > 2.0 * np.median(error[~doubted])
