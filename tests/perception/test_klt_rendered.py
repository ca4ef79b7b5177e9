"""The tracker on PyBullet's frames, judged by the trilinear relation of the true poses."""

from __future__ import annotations

import numpy as np
import pytest

from hal.central_camera import load_camera
from hal.types import Pose, Velocity
from robots import load_robot
from sim.backend import SimBackend
from sim.options import SimOptions
from visctrl.geometry.trifocal import tensor_from_poses
from visctrl.perception.klt import Klt, KltOptions
from visctrl.plugins import Context, Health, Views

pytestmark = pytest.mark.sim

START = Pose(-0.5, -1.6, np.radians(-20.0))


def transfer_errors(views: Views, initial: Pose, current: Pose) -> np.ndarray:
    """Return the errors (deg) of current bearings against those that the two others imply.

    Only of features with so much parallax that the others' noise is not amplified.
    """
    u, c, w = (
        rays[:, :2] / np.linalg.norm(rays[:, :2], axis=1)[:, None]
        for rays in (views.initial, views.current, views.target)
    )
    T = np.asarray(tensor_from_poses(initial, current)).reshape(2, 2, 2)
    line = np.einsum("ijk,ni,nk->nj", T, u, w)
    norm = np.linalg.norm(line, axis=1)
    s, cos = np.sin(initial.phi), np.cos(initial.phi)
    parallax = np.abs(np.cross(u @ np.array([[cos, s], [-s, cos]]), w))
    error = np.degrees(np.arcsin(np.clip((line * c).sum(axis=1) / norm, -1, 1)))
    return np.abs(error[parallax > 0.1])


@pytest.mark.parametrize("name", ["hypercatadioptric", "fisheye"])
def test_tracks_on_rendered_frames_keep_to_the_three_views(name):
    robot, camera = load_robot("p3dx"), load_camera(name).resized(400, 300)
    backend = SimBackend(
        robot, camera, camera, robot.mount("centre"), START, None, SimOptions(), 1, False
    )
    klt = Klt(KltOptions(), Context(camera, None, 0.0, 0.1, 0, True))
    with backend:
        klt.set_target(backend.teach(2))
        klt.set_initial(backend.camera.read())
        initial = backend.truth()
        assert initial is not None
        for tick in range(1, 16):
            backend.base.command(Velocity(0.8, -0.25))
            backend.clock.sleep_until(0.1 * tick)
            views, current = klt.update(backend.camera.read()), backend.truth()
            assert views.health is Health.OK
            assert current is not None
            error = transfer_errors(views, initial, current)
            assert len(error) > 30
            assert np.mean(error > 0.5) <= 0.05
            assert np.median(error) < 0.1
    klt.close()
    assert np.hypot(current.x, current.y) < 0.75
