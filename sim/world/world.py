"""Everything simulated, behind one door: physics, camera, wheels and their encoders."""

from __future__ import annotations

import math

import numpy as np

from visctrl.hal.actuation import Actuation, ActuationOptions
from visctrl.hal.types import STANDSTILL, Frame, Odometry, Pose, Range, Velocity
from visctrl.robots.model import Mount
from visctrl.robots.unicycle import step_exact
from visctrl.sim.render.imaging import Sensor
from visctrl.sim.render.renderer import Renderer
from visctrl.sim.world.physics import STEPS_PER_SECOND, Physics

_STEP_S = 1.0 / STEPS_PER_SECOND
#: Times this close, in steps, are the same.
_STEP_TOLERANCE = 1e-6
_ORIGIN = Pose(0.0, 0.0, 0.0)


class World:
    """Everything simulated, advanced to a time on demand.

    Time counts from the opening of the backend. The wheels follow the actuation's set-point in
    every physics step, less the slip that odometry does not notice.
    """

    def __init__(
        self,
        physics: Physics,
        renderer: Renderer,
        sensor: Sensor,
        actuation: Actuation,
        options: ActuationOptions,
        mount: Mount,
    ) -> None:
        self.physics = physics
        self.actuation = actuation
        self._renderer = renderer
        self._sensor = sensor
        self._options = options
        self._mount = mount
        self._ring = physics.robot.sonar
        self.closed = False
        self._time = 0.0
        self._steps = 0
        self._sequence = 0
        self._dead_reckoned = _ORIGIN
        self._measured = STANDSTILL

    def advance(self, seconds: float) -> None:
        """Let time pass: as many whole physics steps as it takes to get there."""
        self._time += seconds
        while self._steps + _STEP_TOLERANCE < self._time * STEPS_PER_SECOND:
            set_point = self.actuation.velocity_at(self._steps * _STEP_S, _STEP_S)
            self.physics.drive(self._options.executed(set_point))
            self.physics.step()
            self._reckon()
            self._steps += 1

    def put(self, camera: Pose) -> None:
        """Put the robot down at rest with its camera at ``camera``; odometry starts anew."""
        self.actuation.halt()
        self.physics.put(Pose(*step_exact(camera, -self._mount.forward_m, 0.0, 1.0)))
        self._dead_reckoned = _ORIGIN
        self._measured = STANDSTILL

    def move(self, item: str, at: Pose) -> None:
        """Move an item of the scene (x, y, φ = its yaw), for the robot and for its camera."""
        self.physics.move(item, at)
        self._renderer.place(item, at)

    def camera_pose(self) -> Pose:
        """Return where the camera is, in the target's frame."""
        ahead = step_exact(self.physics.axle(), self._mount.forward_m, 0.0, 1.0)
        return Pose(*ahead.tolist())

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
        ideal = self._renderer.render(self.camera_pose(), self._mount.height_m)
        self._sequence += 1
        return Frame(stamp, self._sequence, self._sensor.expose(ideal, stamp, self._sequence))

    def close(self) -> None:
        """Stop the robot and release both PyBullet clients."""
        self.closed = True
        self.actuation.halt()
        self._renderer.close()
        self.physics.close()

    def _reckon(self) -> None:
        wheels = self.physics.wheel_velocity()
        self._measured = Velocity(
            wheels.v / (1.0 - self._options.slip_v),
            wheels.omega / (1.0 - self._options.slip_omega),
        )
        pose = self._dead_reckoned
        middle = pose.phi + self._measured.omega * _STEP_S / 2
        self._dead_reckoned = Pose(
            pose.x - self._measured.v * _STEP_S * math.sin(middle),
            pose.y + self._measured.v * _STEP_S * math.cos(middle),
            pose.phi + self._measured.omega * _STEP_S,
        )
