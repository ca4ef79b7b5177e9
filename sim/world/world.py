"""Everything simulated, behind one door: physics, camera, wheels and their encoders."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from visctrl.hal.actuation import Actuation, ActuationOptions
from visctrl.hal.types import STANDSTILL, Frame, Odometry, Pose, Range, Velocity
from visctrl.sim.world.eye import Eye
from visctrl.sim.world.people import Walker
from visctrl.sim.world.physics import STEPS_PER_SECOND, Physics

_STEP_S = 1.0 / STEPS_PER_SECOND
#: Times this close, in steps, are the same.
_STEP_TOLERANCE = 1e-6
_ORIGIN = Pose(0.0, 0.0, 0.0)


class World:
    """Everything simulated, advanced to a time on demand.

    Time counts from the opening of the backend. The wheels follow the actuation's set-point in
    every physics step, less the slip that odometry does not notice.

    Parameters
    ----------
    physics, eye, actuation, options
        What moves, sees and drives.
    camera_at : (ahead, left)
        Where the camera really is, from the axle's centre (m).
    scatter : callable
        Draws what is added to the executed velocity in a tick.
    walkers : sequence of Walker
        People, whom the robot may run into.
    """

    def __init__(
        self,
        physics: Physics,
        eye: Eye,
        actuation: Actuation,
        options: ActuationOptions,
        camera_at: tuple[float, float],
        scatter: Callable[[], Velocity] = lambda: STANDSTILL,
        walkers: Sequence[Walker] = (),
    ) -> None:
        self.physics = physics
        self.actuation = actuation
        self._eye = eye
        self._options = options
        self._ahead, self._left = camera_at
        self._draw_scatter = scatter
        self._scattered = STANDSTILL
        self._walkers = walkers
        self._ring = physics.robot.sonar
        self.closed = False
        self._time = 0.0
        self._steps = 0
        self._dead_reckoned = _ORIGIN
        self._measured = STANDSTILL

    def advance(self, seconds: float) -> None:
        """Let time pass: as many whole physics steps as it takes to get there."""
        self._time += seconds
        drawn = self._draw_scatter()
        for walker in self._walkers:
            self.physics.move(walker.item.name, walker.pose(self._time))
        while self._steps + _STEP_TOLERANCE < self._time * STEPS_PER_SECOND:
            set_point = self.actuation.velocity_at(self._steps * _STEP_S, _STEP_S)
            executed = self._options.executed(set_point, self.physics.track_m)
            self._scattered = drawn if executed != STANDSTILL else STANDSTILL
            self.physics.drive(_sum(executed, self._scattered))
            self.physics.step()
            self._reckon()
            self._steps += 1
            if self._eye.remembers:
                self._eye.note(self._steps * _STEP_S, self.camera_pose())

    def put(self, camera: Pose) -> None:
        """Put the robot down at rest with its camera at ``camera``; odometry starts anew."""
        self.actuation.halt()
        self.physics.put(displaced(camera, -self._ahead, -self._left))
        self._eye.forget()
        self._dead_reckoned = _ORIGIN
        self._measured = STANDSTILL

    def move(self, item: str, at: Pose) -> None:
        """Move an item of the scene (x, y, φ = its yaw), for the robot and for its camera."""
        self.physics.move(item, at)
        self._eye.renderer.place(item, at)

    def camera_pose(self) -> Pose:
        """Return where the camera is, in the target's frame."""
        return displaced(self.physics.axle(), self._ahead, self._left)

    def odometry(self, stamp: float) -> Odometry:
        """Return the axle's dead-reckoned pose since the robot was put down."""
        return Odometry(stamp, self._dead_reckoned, self._measured)

    def ranges(self) -> list[Range]:
        """Return what the robot's sonar rings would measure: the nearest in each cone."""
        ring = self._ring
        if ring is None:
            return []
        axle, places = self.physics.axle(), list(ring.transducers.values())
        at = np.array([[-pose.left_m, pose.forward_m] for pose in places])
        s, c = math.sin(axle.phi), math.cos(axle.phi)
        start = np.array([axle.x, axle.y]) + at @ np.array([[c, s], [-s, c]])
        angle = axle.phi + np.array([[p.direction_rad] for p in places]) + ring.ray_angles
        rays = ring.range_m * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        origins = np.broadcast_to(start[:, None], rays.shape)
        start, end = origins.reshape(-1, 2), (origins + rays).reshape(-1, 2)
        shares = self.physics.echoes(start, end, ring.height_m)
        nearest = shares.reshape(angle.shape).min(axis=1)
        distance = np.where(nearest < 1.0, ring.range_m * nearest, math.inf)
        return [
            Range(float(right), float(forward), -pose.direction_rad, float(away))
            for pose, (right, forward), away in zip(places, at, distance, strict=True)
        ]

    def photograph(self, stamp: float) -> Frame:
        """Return a new frame."""
        moving = self._measured != STANDSTILL and self.actuation.moving
        return self._eye.photograph(stamp, self.camera_pose(), moving)

    def close(self) -> None:
        """Stop the robot and release both PyBullet clients."""
        self.closed = True
        self.actuation.halt()
        self._eye.close()
        self.physics.close()

    def _reckon(self) -> None:
        wheels = self.physics.wheel_velocity()
        unscattered = Velocity(wheels.v - self._scattered.v, wheels.omega - self._scattered.omega)
        self._measured = self._options.noticed(unscattered, self.physics.track_m)
        pose = self._dead_reckoned
        middle = pose.phi + self._measured.omega * _STEP_S / 2
        self._dead_reckoned = Pose(
            pose.x - self._measured.v * _STEP_S * math.sin(middle),
            pose.y + self._measured.v * _STEP_S * math.cos(middle),
            pose.phi + self._measured.omega * _STEP_S,
        )


def displaced(pose: Pose, ahead: float, left: float) -> Pose:
    """Return a pose moved ahead and to its left (m), in its own axes."""
    s, c = math.sin(pose.phi), math.cos(pose.phi)
    return Pose(pose.x - s * ahead - c * left, pose.y + c * ahead - s * left, pose.phi)


def _sum(a: Velocity, b: Velocity) -> Velocity:
    return a if b == STANDSTILL else Velocity(a.v + b.v, a.omega + b.omega)
