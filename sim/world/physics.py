"""PyBullet's world: a floor, walls, items as boxes, and a robot on driven wheels."""

from __future__ import annotations

import math
from importlib import resources
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.errors import DeviceError, InputError
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.robots import Robot
from visctrl.robots.documents import suggestion
from visctrl.robots.unicycle import from_rep103, to_rep103
from visctrl.sim.world.engine import connect, connect_window, disconnect, pybullet
from visctrl.sim.world.frames import TO_ENGINE
from visctrl.sim.world.scene import Item, Scene
from visctrl.sim.world.tyres import SkidTyres
from visctrl.sim.world.window import furnish_window

Array = NDArray[np.float64]

#: Physics steps per second: with sphere wheels and an acceleration ramp, rolling is exact here.
STEPS_PER_SECOND = 240
_GRAVITY_M_S2 = 9.81
_WALL_THICKNESS_M = 0.2
#: Time for the robot to come to rest on its wheels after it has been put down.
_SETTLE_STEPS = 60
#: Collision groups: wheels roll on the floor; the body's outline meets everything else.
_FLOOR, _THINGS, _BODY, _WHEELS = 1, 2, 4, 8
#: The engine counts rays into its first group.
_RAYS = _FLOOR


class Physics:
    """The world in which the robot drives.

    Parameters
    ----------
    scene : Scene
        Walls and items.
    robot : Robot
        Its URDF and wheel geometry.
    gui : bool
        Open PyBullet's window.

    Raises
    ------
    InputError
        The window cannot be opened.
    """

    def __init__(self, scene: Scene, robot: Robot, gui: bool = False) -> None:
        self._robot = robot
        self.client = connect_window() if gui else connect()
        options = {"physicsClientId": self.client}
        pybullet.setGravity(0.0, 0.0, -_GRAVITY_M_S2, **options)
        pybullet.setTimeStep(1.0 / STEPS_PER_SECOND, **options)
        self._floor = self._add_floor()
        self._things = {name: self._add_box(*box) for name, box in _boxes(scene).items()}
        with resources.as_file(robot.urdf()) as path:
            self._body = pybullet.loadURDF(str(path), **options)
        joints = {
            pybullet.getJointInfo(self._body, i, **options)[1].decode(): i
            for i in range(pybullet.getNumJoints(self._body, **options))
        }
        self._wheels = [joints[name] for name in robot.wheels.joints_left]
        self._wheels += [joints[name] for name in robot.wheels.joints_right]
        self._lefts = len(robot.wheels.joints_left)
        self._separate_wheels(set(joints.values()))
        self._speeds: list[float] = []
        self._tyres = self._skid_tyres() if robot.drive == "skid-steer" else None
        self._window = furnish_window(self.client, scene, self._things.values()) if gui else None
        self._items = {item.name for item in scene.items}
        self._touching: set[int] = set()
        self._contacts = 0

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self._robot

    @property
    def track_m(self) -> float:
        """Track with which the robot's software turns wheel speeds into turning rates (m)."""
        return self._robot.wheels.effective_track_m

    def put(self, axle: Pose) -> None:
        """Put the robot down, at rest, with its axle's centre at ``axle``."""
        self._reset_to(axle)
        self.drive(STANDSTILL)
        for _ in range(_SETTLE_STEPS):
            self._advance()
        self._touching = set()

    def drive(self, velocity: Velocity) -> None:
        """Set the wheels' speeds for a velocity of the axle's centre."""
        wheels = self._robot.wheels
        half = velocity.omega * wheels.effective_track_m / 2
        rights = len(self._wheels) - self._lefts
        speeds = [velocity.v - half] * self._lefts + [velocity.v + half] * rights
        if speeds == self._speeds:
            return
        self._speeds = speeds
        pybullet.setJointMotorControlArray(
            self._body,
            self._wheels,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[speed / wheels.radius_m for speed in speeds],
            forces=[wheels.torque_n_m] * len(speeds),
            physicsClientId=self.client,
        )

    def step(self) -> None:
        """Advance the world by one step and note what the robot touches."""
        self._advance()
        touched = {
            contact[2]
            for contact in pybullet.getContactPoints(self._body, physicsClientId=self.client)
            if contact[2] not in (self._floor, self._body)
        }
        self._contacts += len(touched - self._touching)
        self._touching = touched

    def wheel_velocity(self) -> Velocity:
        """Return the (v, ω) that the wheels' encoders show."""
        states = pybullet.getJointStates(self._body, self._wheels, physicsClientId=self.client)
        speeds = [state[1] * self._robot.wheels.radius_m for state in states]
        left, right = fmean(speeds[: self._lefts]), fmean(speeds[self._lefts :])
        return Velocity((left + right) / 2, (right - left) / self._robot.wheels.effective_track_m)

    def axle(self) -> Pose:
        """Return the pose of the axle's centre, in the target's frame."""
        position, yaw = self._base_state()
        return Pose(*from_rep103([position[0], position[1], yaw]).tolist())

    def tilt(self) -> float:
        """Return the angle (rad) between the robot's vertical and the world's."""
        quaternion = pybullet.getBasePositionAndOrientation(
            self._body, physicsClientId=self.client
        )[1]
        return math.acos(min(1.0, pybullet.getMatrixFromQuaternion(quaternion)[8]))

    def echoes(self, start: Array, end: Array, height: float) -> Array:
        """Return how far along segments (N, 2, floor plan) things are met, as shares (N,).

        The segments run at ``height`` (m); 1 is nothing. The robot itself is not met.
        """
        ends = [
            np.column_stack([to_rep103(np.pad(points, ((0, 0), (0, 1))))[:, :2], level])
            for points in (start, end)
            for level in [np.full(len(points), height)]
        ]
        hits = pybullet.rayTestBatch(
            ends[0].tolist(),
            ends[1].tolist(),
            collisionFilterMask=_THINGS,
            physicsClientId=self.client,
        )
        return np.array([hit[2] if hit[0] >= 0 else 1.0 for hit in hits])

    @property
    def contacts(self) -> int:
        """How often the robot has begun to touch something other than the floor."""
        return self._contacts

    def move(self, item: str, at: Pose) -> None:
        """Move an item of the scene to another place (x, y, φ = its yaw)."""
        if item not in self._items:
            raise InputError(f"the scene has no item '{item}'; {suggestion(item, self._items)}")
        body = self._things[item]
        height = pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)[0][2]
        pybullet.resetBasePositionAndOrientation(
            body, *_engine_pose(at, height), physicsClientId=self.client
        )
        if self._window is not None:
            self._window.place(item, at)

    def close(self) -> None:
        """Disconnect. Safe to call twice."""
        if self.client >= 0:
            disconnect(self.client)
            self.client = -1

    def _advance(self) -> None:
        try:
            if self._tyres is not None:
                self._tyres.push(self._speeds)
            pybullet.stepSimulation(physicsClientId=self.client)
        except pybullet.error as error:
            raise DeviceError(f"the simulation is gone (its window was closed?): {error}") from None

    def _skid_tyres(self) -> SkidTyres:
        """Replace the wheels' contact friction by tyre forces."""
        options = {"physicsClientId": self.client}
        for wheel in self._wheels:
            pybullet.changeDynamics(self._body, wheel, lateralFriction=0.0, **options)
        # Joint positions are given in the frame of the base's centre of mass.
        offset = np.array(self._inertial_frame()[0])
        info = [pybullet.getJointInfo(self._body, wheel, **options) for wheel in self._wheels]
        feet = np.array([joint[14] for joint in info]) + offset
        links = range(-1, pybullet.getNumJoints(self._body, **options))
        mass = sum(pybullet.getDynamicsInfo(self._body, i, **options)[0] for i in links)
        return SkidTyres(self.client, self._body, feet[:, :2], mass)

    def _add_floor(self) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_PLANE, planeNormal=[0, 0, 1], physicsClientId=self.client
        )
        floor = pybullet.createMultiBody(
            0, baseCollisionShapeIndex=shape, physicsClientId=self.client
        )
        pybullet.changeDynamics(floor, -1, lateralFriction=1.0, physicsClientId=self.client)
        self._filter(floor, -1, _FLOOR, _BODY | _WHEELS)
        return int(floor)

    def _add_box(self, size: Array, centre: Pose, height: float) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=(size / 2).tolist(), physicsClientId=self.client
        )
        position, orientation = _engine_pose(centre, height)
        body = pybullet.createMultiBody(
            0,
            baseCollisionShapeIndex=shape,
            basePosition=position,
            baseOrientation=orientation,
            physicsClientId=self.client,
        )
        self._filter(body, -1, _THINGS, _BODY | _RAYS)
        return int(body)

    def _separate_wheels(self, links: set[int]) -> None:
        self._filter(self._body, -1, _BODY, _FLOOR | _THINGS)
        for link in links:
            self._filter(self._body, link, _WHEELS, _FLOOR)

    def _filter(self, body: int, link: int, group: int, mask: int) -> None:
        pybullet.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=self.client)

    def _reset_to(self, axle: Pose) -> None:
        x, y, yaw = to_rep103(axle).tolist()
        offset, _ = self._inertial_frame()
        orientation = pybullet.getQuaternionFromEuler([0.0, 0.0, yaw])
        position, _ = pybullet.multiplyTransforms([x, y, 0.0], orientation, offset, [0, 0, 0, 1])
        options = {"physicsClientId": self.client}
        pybullet.resetBasePositionAndOrientation(self._body, position, orientation, **options)
        pybullet.resetBaseVelocity(self._body, [0, 0, 0], [0, 0, 0], **options)
        for joint in self._wheels:
            pybullet.resetJointState(self._body, joint, 0.0, 0.0, **options)

    def _inertial_frame(self) -> tuple[list[float], list[float]]:
        """Return where the base's centre of mass is, in base coordinates."""
        info = pybullet.getDynamicsInfo(self._body, -1, physicsClientId=self.client)
        return list(info[3]), list(info[4])

    def _base_state(self) -> tuple[list[float], float]:
        """Return the position of the base link's origin and its yaw, in engine axes."""
        position, orientation = pybullet.getBasePositionAndOrientation(
            self._body, physicsClientId=self.client
        )
        inverse = pybullet.invertTransform(*self._inertial_frame())
        position, orientation = pybullet.multiplyTransforms(position, orientation, *inverse)
        return list(position), float(pybullet.getEulerFromQuaternion(orientation)[2])


def _boxes(scene: Scene) -> dict[str, tuple[Array, Pose, float]]:
    """Return size, centre and height of centre of everything solid, by name.

    No item has a wall's name: these have a slash in front.
    """
    boxes = {item.name: _item_box(item) for item in scene.items}
    room = scene.room
    (x0, x1), (y0, y1) = room.x_m, room.y_m
    thick, high = _WALL_THICKNESS_M, room.height_m
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    for name, at, size in (
        ("/front", (middle[0], y1 + thick / 2), (x1 - x0 + 2 * thick, thick)),
        ("/back", (middle[0], y0 - thick / 2), (x1 - x0 + 2 * thick, thick)),
        ("/right", (x1 + thick / 2, middle[1]), (thick, y1 - y0)),
        ("/left", (x0 - thick / 2, middle[1]), (thick, y1 - y0)),
    ):
        boxes[name] = (np.array([*size, high]), Pose(*at, 0.0), high / 2)
    return boxes


def _item_box(item: Item) -> tuple[Array, Pose, float]:
    height = item.bottom_m + item.size_m[2] / 2
    return np.array(item.size_m), Pose(*item.at_m, math.radians(item.yaw_deg)), height


def _engine_pose(pose: Pose, height: float) -> tuple[list[float], list[float]]:
    """Return position and orientation, in engine axes, of a box whose width runs along x."""
    position = TO_ENGINE @ np.array([pose.x, pose.y, height])
    # Its width is along the target frame's x, which is the engine's −Y.
    orientation = pybullet.getQuaternionFromEuler([0.0, 0.0, pose.phi - math.pi / 2])
    return position.tolist(), list(orientation)
