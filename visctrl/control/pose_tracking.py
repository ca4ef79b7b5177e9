"""Controller ``pose-tracking``: Cartesian control of the estimated pose along a planned path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from hal.types import STANDSTILL, Pose, Range, Velocity
from robots.documents import Document
from robots.errors import InputError
from robots.unicycle import compose, relative_pose, wrap_angle
from visctrl.control.avoidance import (
    EchoedObstacles,
    ListedObstacle,
    ListedObstacles,
    Obstacle,
    ObstacleProvider,
    blocking,
    refuse_blocked,
    way_round,
)
from visctrl.control.paths import (
    ParabolicPath,
    Reference,
    detour,
    path_between,
    path_demand,
    reachable,
)
from visctrl.estimation.pose_estimate import Need, PoseEstimate
from visctrl.plugins import Context, Controller, Decision, Signal

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]

#: The control point moves by less than half its lever in a tick, or the heading zigzags: its
#: error obeys e⁺ = (1 − v Ts/ℓ) e.
_LEVER_PER_STEP = 2.0
#: Straight way at the end, in levers: what a curve leaves of the heading falls to e⁻⁵.
_STRAIGHT_LEVERS = 5.0
_STRAIGHT_M = 0.4
#: Farther from the path's direction than this (rad), the robot turns on the spot first.
_TURN_FROM, _TURN_TO = math.radians(100.0), math.radians(20.0)
#: Standing for so long at most (s), the robot corrects its heading at the goal.
_ALIGN_S = 4.0
#: Share of the clearance under which a path under way counts as blocked.
_TOLERATED = 0.85
_ALIGNED_RAD = math.radians(0.15)


class Goal(Document):
    """An intermediate goal, reached with the heading 0.

    until_s : when it is to be reached, from the start of the path; by its share of the way if
        left out.
    """

    x_m: float
    y_m: float
    until_s: Positive | None = None


class PoseTrackingOptions(Document):
    """Options of `PoseTracking`.

    tau_s : time for the whole path, longer only where the robot is not fast enough.
    lambda_x, lambda_y : gains of the position errors (1/s), under 2/Ts.
    straight_m : straight end of the path; 0 is the source's plain parabola, and left out it is
        long enough for the heading to settle.
    lookahead_m : control point ahead of the camera; 0 is the source's, and left out it is as
        far as the period asks for.
    goals : on the way to the target.
    advance_m_s : speed while the estimator needs forward motion.
    turn_deg_s : speed of turns on the spot.
    settle_s : how long the goal is held at the end.
    align : whether the heading is corrected on the spot at the end.
    reserve : share of the robot's limits that a path may ask for; the rest is for corrections.
    obstacles : those of the scenario, each noticed when the camera comes near.
    sonar_m : range sensors are believed up to this distance; 0 ignores them.
    clearance_m : of the camera's path from an obstacle's edge: half the robot's diagonal, the
        camera's distance from its middle, and a margin.
    pause_s : how long the robot stops when something blocks its path.
    """

    tau_s: Positive = 40.0
    lambda_x: Positive = 1.0
    lambda_y: Positive = 1.0
    straight_m: NonNegative | None = None
    lookahead_m: NonNegative | None = None
    goals: tuple[Goal, ...] = ()
    advance_m_s: Positive = 0.1
    turn_deg_s: Positive = 20.0
    settle_s: NonNegative = 1.5
    align: bool = True
    reserve: Annotated[float, Field(gt=0.0, le=1.0)] = 0.8
    obstacles: tuple[ListedObstacle, ...] = ()
    sonar_m: NonNegative = 0.0
    clearance_m: Positive = 0.7
    pause_s: NonNegative = 1.0


class _Stage:
    """One path, from where the control point was when it began.

    anchor : that place relative to the initial view, with which it moves when the latter
        is estimated better.
    """

    def __init__(
        self,
        goal: tuple[float, float],
        anchor: tuple[float, float, float],
        lever: float,
        tau: float,
    ) -> None:
        self.goal = goal
        self.anchor = anchor
        self.lever = lever
        self.tau = tau
        self.straight = 0.0
        self.time = 0.0
        self.target = Goal(x_m=goal[0], y_m=goal[1])

    def path(self, initial: Pose) -> ParabolicPath:
        """Return the path as it lies for the present estimate of the initial view."""
        s, c = math.sin(initial.phi), math.cos(initial.phi)
        right, forward, _ = self.anchor
        x, y = initial.x + c * right - s * forward, initial.y + s * right + c * forward
        return path_between((x, y), self.goal, self.straight)


class PoseTracking(Controller[PoseTrackingOptions, PoseEstimate]):
    """Input–output linearisation about the camera, (4.18)–(4.21), along parabolas (4.25).

    Raises
    ------
    InputError
        The camera sits on the turning centre (ℓ = 0), a gain is outside (0, 2/Ts), or a goal is
        too near an obstacle.
    """

    Options: ClassVar[type[PoseTrackingOptions]] = PoseTrackingOptions
    accepts: ClassVar[type[PoseEstimate]] = PoseEstimate
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("x_reference", "m"),
        Signal("y_reference", "m"),
        Signal("task_time", "s"),
    )

    def __init__(self, options: PoseTrackingOptions, context: Context) -> None:
        super().__init__(options, context)
        if context.camera_forward_m == 0.0:
            raise InputError(
                "pose-tracking steers the camera's position and needs it off the turning centre: "
                "its distance ahead of the axle is 0; choose another mount (camera.mount: front)"
            )
        bound = 2.0 / context.period_s
        for key, gain in (("lambda_x", options.lambda_x), ("lambda_y", options.lambda_y)):
            if gain >= bound:
                raise InputError(
                    f"controller.{key}: {gain:g} 1/s is unstable with a period of "
                    f"{context.period_s:g} s: it must be under 2/Ts = {bound:g}"
                )
        goals = {"the target": (0.0, 0.0)}
        goals |= {f"goals.{k}": (g.x_m, g.y_m) for k, g in enumerate(options.goals)}
        refuse_blocked(goals, options.obstacles, options.clearance_m)
        self._providers: list[ObstacleProvider] = [ListedObstacles(options.obstacles)]
        if options.sonar_m > 0.0:
            self._providers.append(EchoedObstacles(options.sonar_m, context.camera_forward_m))
        self._ranges: Sequence[Range] = ()
        self._goals: list[Goal] | None = None
        self._stage: _Stage | None = None
        self._halted: float | None = None
        self._turning = False
        self._t = 0.0
        self._elapsed = 0.0
        self._pace = 0.0
        self._settled = 0.0
        self._task_time = 0.0
        self._reference: Reference | None = None

    @property
    def listens(self) -> bool:
        """Whether range sensors are believed at all (``sonar_m``)."""
        return self.options.sonar_m > 0.0

    def sense(self, ranges: Sequence[Range]) -> None:
        """Keep what the range sensors say for the next `update`."""
        self._ranges = ranges

    def update(self, estimate: PoseEstimate, t: float) -> Decision:
        """Return the velocity for an estimate at ``t`` seconds since this controller started."""
        dt, self._t = t - self._t, t
        if estimate.need is Need.STILL:
            return Decision(STANDSTILL, "stand")
        if estimate.need is Need.FORWARD:
            return Decision(Velocity(self.options.advance_m_s, 0.0), "advance")
        if self._goals is None:
            self._goals = self._plan(estimate.pose)
        self._elapsed += dt
        if self._stage is not None:
            self._stage.time += dt
            if self._stage.time >= self._stage.tau and self._goals:
                self._stage = None
        obstacles = self._obstacles(estimate.pose)
        halt = self._avoid(estimate, self._goals, obstacles)
        if halt is not None:
            return halt
        if self._stage is None:
            return self._begin(estimate, self._goals)
        return self._follow(estimate, dt)

    def values(self) -> Mapping[str, float]:
        """Return the reference and the time that the whole path takes."""
        if self._reference is None:
            return {}
        x, y = self._reference.position
        return {"x_reference": x, "y_reference": y, "task_time": self._task_time}

    # --- planning ----------------------------------------------------------------------------

    def _plan(self, pose: Pose) -> list[Goal]:
        """Return the goals of all stages, with a detour where the next one cannot be reached."""
        goals = [*self.options.goals, Goal(x_m=0.0, y_m=0.0)]
        planned: list[Goal] = []
        here = (pose.x, pose.y)
        for goal in goals:
            there = (goal.x_m, goal.y_m)
            if not reachable(here, there):
                x, y = detour(here, there)
                planned.append(Goal(x_m=x, y_m=y))
            planned.append(goal)
            here = there
        way = sum(self._ways((pose.x, pose.y), planned))
        self._pace = self.options.tau_s / max(way, 1e-9)
        return planned

    @staticmethod
    def _ways(here: tuple[float, float], goals: Sequence[Goal]) -> list[float]:
        """Return the lengths of the stages through some goals (m)."""
        ways = []
        for goal in goals:
            there = (goal.x_m, goal.y_m)
            ways.append(ParabolicPath(here, there).length)
            here = there
        return ways

    def _begin(self, estimate: PoseEstimate, goals: list[Goal]) -> Decision:
        """Turn on the spot if the next stage asks for it, then start it."""
        tau = self._time_for(estimate.pose, goals)
        stage = self._prepared(estimate, (goals[0].x_m, goals[0].y_m), tau)
        path = stage.path(estimate.initial)
        error = float(wrap_angle(path.heading - estimate.pose.phi))
        if abs(error) > (_TURN_TO if self._turning else _TURN_FROM):
            self._turning = True
            most = math.radians(self.options.turn_deg_s)
            return Decision(Velocity(0.0, max(-most, min(most, error))), "turn")
        self._turning = False
        demand = path_demand(path, estimate.pose.phi, stage.lever)
        stage.tau = max(tau, demand.time(self.context.limits, self.options.reserve))
        stage.target = goals.pop(0)
        self._stage = stage
        rest = self.options.tau_s - self._elapsed - tau if goals else 0.0
        self._task_time = self._elapsed + stage.tau + max(rest, 0.0)
        return self._follow(estimate, 0.0)

    def _time_for(self, pose: Pose, goals: list[Goal]) -> float:
        """Return the time for the next stage: as asked for, or by its share of the way left."""
        ways = self._ways((pose.x, pose.y), goals)
        # What a detour has cost is made up for by at most half of the planned time.
        least = 0.5 * self._pace * ways[0]
        until = goals[0].until_s
        if until is not None:
            return max(until - self._elapsed, least)
        left = self.options.tau_s - self._elapsed
        return max(left * ways[0] / max(sum(ways), 1e-9), least)

    def _prepared(self, estimate: PoseEstimate, goal: tuple[float, float], tau: float) -> _Stage:
        """Return a stage from the present pose, with its control point and straight end."""
        camera = self.context.camera_forward_m
        way = math.dist((estimate.pose.x, estimate.pose.y), goal)
        lever = abs(camera) + (self.options.lookahead_m or 0.0)
        if self.options.lookahead_m is None:
            step = math.pi / 2.0 * way / tau * self.context.period_s
            lever = max(lever, _LEVER_PER_STEP * step)
        lever = math.copysign(lever, camera)
        ahead = lever - camera
        point = compose(estimate.pose, np.array([0.0, ahead, 0.0]))
        right, forward, turn = relative_pose(point, estimate.initial).tolist()
        anchor = (right, forward, turn)
        stage = _Stage((goal[0], goal[1] + ahead), anchor, lever, tau)
        stage.straight = self._straight(lever)
        return stage

    def _straight(self, lever: float) -> float:
        """Return the length of a path's straight end (m)."""
        if self.options.straight_m is not None:
            return self.options.straight_m
        return max(_STRAIGHT_M, _STRAIGHT_LEVERS * abs(lever))

    # --- obstacles ---------------------------------------------------------------------------

    def _obstacles(self, pose: Pose) -> list[Obstacle]:
        return [o for source in self._providers for o in source.noticed(pose, self._ranges)]

    def _avoid(
        self, estimate: PoseEstimate, goals: list[Goal], obstacles: list[Obstacle]
    ) -> Decision | None:
        """Stop before what blocks the path and put a goal beside it; None where the way is free."""
        if not obstacles:
            return None
        clearance, here = self.options.clearance_m, (estimate.pose.x, estimate.pose.y)
        straight, stage = self._straight(self.context.camera_forward_m), self._stage
        if self._halted is None:
            if stage is not None:
                passed = min(stage.time / stage.tau, 1.0)
                rest = stage.path(estimate.initial).points()
                rest = rest[min(int(passed * len(rest)), len(rest) - 1) :]
            else:
                rest = path_between(here, (goals[0].x_m, goals[0].y_m), straight).points()
            # What was planned with the whole clearance is not given up for a centimetre.
            if not blocking(rest, obstacles, _TOLERATED * clearance):
                return None
            self._halted = self._t
            if stage is not None:
                goals.insert(0, stage.target)
                self._stage = None
        if self._t - self._halted < self.options.pause_s:
            return Decision(STANDSTILL, "stop")
        goal = (goals[0].x_m, goals[0].y_m)
        direct = path_between(here, goal, straight).points()
        if not blocking(direct, obstacles, _TOLERATED * clearance):
            self._halted = None
            return None
        between = way_round(here, goal, obstacles, clearance, straight)
        if between is None:
            return Decision(STANDSTILL, "blocked")
        self._halted = None
        goals.insert(0, Goal(x_m=between[0], y_m=between[1]))
        return None

    # --- following ---------------------------------------------------------------------------

    def _follow(self, estimate: PoseEstimate, dt: float) -> Decision:
        """Return the linearising velocity (4.21) towards the reference."""
        stage = self._stage
        assert stage is not None
        if stage.time >= stage.tau + self.options.settle_s:
            return self._at_goal(estimate, dt)
        path = stage.path(estimate.initial)
        velocity = self._law(stage, path, estimate.pose)
        excess = self._excess(velocity)
        if excess > 1.0 and stage.time < stage.tau:
            # The path waits for the robot, instead of the robot cutting its corners.
            stage.time -= dt * (1.0 - 1.0 / excess)
            stage.time = max(stage.time, 0.0)
            velocity = self._law(stage, path, estimate.pose)
        arrived = stage.time >= stage.tau
        return Decision(velocity, "settle" if arrived else "path")

    def _law(self, stage: _Stage, path: ParabolicPath, pose: Pose) -> Velocity:
        period = self.context.period_s
        self._reference = path.at(stage.time, stage.tau)
        # Constant over a tick, the velocity is right on average when taken in its middle.
        if stage.time < stage.tau:
            ahead = path.at(stage.time + period / 2.0, stage.tau).velocity
        else:
            ahead = (0.0, 0.0)
        offset = stage.lever - self.context.camera_forward_m
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        x, y = pose.x - s * offset, pose.y + c * offset
        x_wanted, y_wanted = self._reference.position
        nu_x = ahead[0] - self.options.lambda_x * (x - x_wanted)
        nu_y = ahead[1] - self.options.lambda_y * (y - y_wanted)
        return Velocity(-s * nu_x + c * nu_y, -(c * nu_x + s * nu_y) / stage.lever)

    def _excess(self, velocity: Velocity) -> float:
        limits = self.context.limits
        if limits is None:
            return 0.0
        return max(abs(velocity.v) / limits.v_m_s, abs(velocity.omega) / limits.omega_rad_s)

    def _at_goal(self, estimate: PoseEstimate, dt: float) -> Decision:
        """Correct the heading on the spot, which moves the camera by millimetres, and finish."""
        self._settled += dt
        phi = estimate.pose.phi
        done = not self.options.align or abs(phi) < _ALIGNED_RAD or self._settled > _ALIGN_S
        if done:
            return Decision(STANDSTILL, "arrived", finished=True)
        most = math.radians(self.options.turn_deg_s)
        # Half a second to the goal: slower would be lost in the rounding to whole deg/s.
        omega = max(-most, min(most, -phi / max(0.5, 2.0 * self.context.period_s)))
        return Decision(Velocity(0.0, omega), "align")
