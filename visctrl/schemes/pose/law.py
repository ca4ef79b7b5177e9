"""Controller ``pose-tracking``: Cartesian control of the estimated pose along a planned path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Obstacle, Signal
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.planning.avoidance import Avoidance, AvoidanceOptions
from visctrl.planning.lattice_planner import Drive
from visctrl.planning.paths import (
    STRAIGHT_SHARE,
    TURN_FROM,
    TURN_TO,
    ParabolicPath,
    Reference,
    path_time,
)
from visctrl.robots.errors import InputError
from visctrl.schemes.pose.estimate import Need, PoseEstimate
from visctrl.schemes.pose.waypoints import TARGET, Goal, Stage, Waypoints

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]

#: The control point moves by less than half its lever in a tick, or the heading zigzags: its
#: error obeys e⁺ = (1 − v Ts/ℓ) e.
_LEVER_PER_STEP = 2.0
#: Straight way at the end, in levers: what a curve leaves of the heading falls to e⁻⁵.
_STRAIGHT_LEVERS = 5.0
_STRAIGHT_M = 0.4
#: Standing for so long at most (s), the robot corrects its heading at the goal.
_ALIGN_S = 4.0
#: To this the path's pace is found where the robot is too slow for it.
_PACE_STEP = 1e-3
_ALIGNED_RAD = math.radians(0.15)


class PoseTrackingOptions(AvoidanceOptions):
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

    Those about obstacles are of `AvoidanceOptions`.
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


class PoseTracking(Controller[PoseTrackingOptions, PoseEstimate]):
    """Input–output linearisation about the camera, (4.18)–(4.21), along parabolas (4.25).

    Raises
    ------
    InputError
        The camera sits on the turning centre (ℓ = 0), or a gain is outside (0, 2/Ts).
    """

    Options: ClassVar[type[PoseTrackingOptions]] = PoseTrackingOptions
    accepts: ClassVar[type[PoseEstimate]] = PoseEstimate
    avoids: ClassVar[bool] = True
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
        self._avoidance = Avoidance(options, context)
        self._itinerary: Waypoints | None = None
        self._stage: Stage | None = None
        self._turning = False
        self._t = 0.0
        self._elapsed = 0.0
        self._settled = 0.0
        self._task_time = 0.0
        self._stretched = 0.0
        self._reference: Reference | None = None

    def expect(self, obstacles: Sequence[Obstacle]) -> None:
        """Check that the goals leave room between obstacles (see the contract)."""
        goals = {"the target": (0.0, 0.0)}
        goals |= {f"controller.goals.{k}": (g.x_m, g.y_m) for k, g in enumerate(self.options.goals)}
        self._avoidance.expect(goals, obstacles)

    def sense(self, obstacles: Sequence[Obstacle]) -> None:
        """Keep what stands around for the next `update`."""
        self._avoidance.sense(obstacles)

    def update(self, estimate: PoseEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; its time is the sum of ``dt`` (s)."""
        self._t += dt
        if estimate.need is Need.STILL:
            return Decision(STANDSTILL, "stand")
        if estimate.need is Need.FORWARD:
            if not self._avoidance.may_advance():
                return Decision(STANDSTILL, "blocked")
            return Decision(Velocity(self.options.advance_m_s, 0.0), "advance")
        if self._itinerary is None:
            self._itinerary = Waypoints(self.options.goals, self.options.tau_s, estimate.pose)
        self._elapsed += dt
        if self._stage is not None:
            self._stage.time += dt * self._stage.pace
            if self._stage.time >= self._stage.tau:
                if not self._itinerary.left:
                    return self._follow(self._stage, estimate, dt)
                self._stage = None
        if not self._avoidance.free:
            halt = self._find_way(self._itinerary, estimate)
            if halt is not None:
                return halt
        if self._stage is None:
            return self._begin(self._itinerary, estimate)
        if self._blocked(self._stage, estimate):
            return self._halt(self._itinerary, under_way=True)
        return self._follow(self._stage, estimate, dt)

    def values(self) -> Mapping[str, float]:
        """Return the reference and the time that the whole path takes."""
        if self._reference is None:
            return {}
        x, y = self._reference.position
        return {"x_reference": x, "y_reference": y, "task_time": self._task_time}

    def notes(self) -> Sequence[str]:
        """Say by how much the robot's limits have made the task longer."""
        if self._stretched < self.context.period_s:
            return ()
        return (
            f"the path takes {self._stretched:.1f} s longer than controller.tau_s: in "
            f"{self.options.tau_s:g} s it asks for more than the robot's speed, acceleration and "
            "period allow",
        )

    # --- stages ------------------------------------------------------------------------------

    def _begin(self, itinerary: Waypoints, estimate: PoseEstimate) -> Decision:
        """Turn on the spot if the next stage asks for it, then start it."""
        asked = itinerary.time_for_next(estimate.pose, self._elapsed)
        nearest = self._stage_to(itinerary.left[0], self.context.camera_forward_m, estimate)
        tau = self._least_time(nearest, max(asked, self._settling(nearest.target)), estimate)
        lever = self._lever(math.dist(estimate.pose[:2], nearest.target.place), tau)
        stage = self._stage_to(nearest.target, lever, estimate)
        path = stage.path(estimate.initial)
        error = math.remainder(path.heading - estimate.pose.phi, math.tau)
        if abs(error) > (TURN_TO if self._turning else TURN_FROM):
            if not self._avoidance.may_turn(estimate.pose, error):
                return Decision(STANDSTILL, "blocked")
            self._turning = True
            most = math.radians(self.options.turn_deg_s)
            return Decision(Velocity(0.0, max(-most, min(most, error))), "turn")
        self._turning = False
        if self._blocked(stage, estimate):
            return self._halt(itinerary, under_way=False)
        stage.tau = self._least_time(stage, tau, estimate)
        self._stretched += stage.tau - asked
        itinerary.take()
        self._stage = stage
        rest = self.options.tau_s - self._elapsed - asked if itinerary.left else 0.0
        self._task_time = self._elapsed + stage.tau + max(rest, 0.0)
        return self._follow(stage, estimate, 0.0)

    def _stage_to(self, goal: Goal, lever: float, estimate: PoseEstimate) -> Stage:
        """Return a stage from the present pose."""
        camera = self.context.camera_forward_m
        straight = self._straight(lever)
        return Stage(estimate.pose, estimate.initial, goal, camera, lever, straight)

    def _least_time(self, stage: Stage, tau: float, estimate: PoseEstimate) -> float:
        """Return the time for a stage (s): ``tau``, or as long as the robot needs for its path."""
        path, phi = stage.path(estimate.initial), estimate.pose.phi
        limits, reserve = self.context.limits, self.options.reserve
        return max(tau, path_time(path, phi, stage.lever, limits, reserve))

    def _lever(self, way: float, tau: float) -> float:
        """Return how far the control point is ahead of the axle on a way of some length (m)."""
        camera = self.context.camera_forward_m
        lever = abs(camera) + (self.options.lookahead_m or 0.0)
        if self.options.lookahead_m is None:
            step = math.pi / 2.0 * way / tau * self.context.period_s
            lever = max(lever, _LEVER_PER_STEP * step)
        return math.copysign(lever, camera)

    def _settling(self, goal: Goal) -> float:
        """Return the least time (s) in which the heading settles on the way to a goal.

        The lever grows with the speed, and the path's end must be long enough for it.
        """
        if goal is not TARGET or self.options.lookahead_m is not None:
            return 0.0
        levers = STRAIGHT_SHARE / _STRAIGHT_LEVERS
        return _LEVER_PER_STEP * math.pi / 2.0 * self.context.period_s / levers

    def _straight(self, lever: float) -> float:
        """Return the length of a path's straight end (m)."""
        if self.options.straight_m is not None:
            return self.options.straight_m
        return max(_STRAIGHT_M, _STRAIGHT_LEVERS * abs(lever))

    # --- obstacles ---------------------------------------------------------------------------

    def _blocked(self, stage: Stage, estimate: PoseEstimate) -> bool:
        """Return whether something stands in the way of a stage, from the present pose on."""
        if not self._avoidance.aware:
            return False
        goal = stage.target.place if stage.target is TARGET else None
        rest = stage.rest(estimate.pose, estimate.initial)
        return self._avoidance.blocked(estimate.pose, rest, goal)

    def _halt(self, itinerary: Waypoints, *, under_way: bool) -> Decision:
        """Give up the stage and stop."""
        itinerary.give_up(under_way=under_way)
        self._stage = None
        return self._avoidance.halt(self._t)

    def _find_way(self, itinerary: Waypoints, estimate: PoseEstimate) -> Decision | None:
        """Return what to do about what blocks the way; None once there is a way."""
        pose, aim = estimate.pose, itinerary.aim
        tau = itinerary.time_for_next(pose, self._elapsed)
        lever = self._lever(math.dist(pose[:2], aim.place), tau)
        drive = Drive(lever, self._straight(lever))
        final = aim is TARGET
        way = self._avoidance.decide(pose, aim.place, drive, self._t, final=final)
        if isinstance(way, Decision):
            return way
        itinerary.lead_round(way)
        return None

    # --- following ---------------------------------------------------------------------------

    def _follow(self, stage: Stage, estimate: PoseEstimate, dt: float) -> Decision:
        """Return the linearising velocity (4.21) towards the reference."""
        if stage.time >= stage.tau + self.options.settle_s:
            return self._at_goal(estimate, dt)
        path = stage.path(estimate.initial)
        ahead, back = self._law(stage, path, estimate.pose)
        stage.pace = self._pace(ahead, back)
        waited = (1.0 - stage.pace) * self.context.period_s
        self._stretched += waited
        self._task_time += waited
        arrived = stage.time >= stage.tau
        velocity = Velocity(stage.pace * ahead.v + back.v, stage.pace * ahead.omega + back.omega)
        return Decision(velocity, "settle" if arrived else "path")

    def _law(self, stage: Stage, path: ParabolicPath, pose: Pose) -> tuple[Velocity, Velocity]:
        """Return (4.21) in two parts: what follows the path, and what corrects the position."""
        self._reference = path.at(stage.time, stage.tau)
        forth = (0.0, 0.0)
        if stage.time < stage.tau:
            # Constant over a tick, the velocity is right on average when taken in its middle.
            forth = path.at(stage.time + self.context.period_s / 2.0, stage.tau).velocity
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        x, y = pose.x - s * stage.ahead, pose.y + c * stage.ahead
        x_wanted, y_wanted = self._reference.position
        back = self.options.lambda_x * (x_wanted - x), self.options.lambda_y * (y_wanted - y)
        ahead, corrected = (
            Velocity(-s * nu_x + c * nu_y, -(c * nu_x + s * nu_y) / stage.lever)
            for nu_x, nu_y in (forth, back)
        )
        return ahead, corrected

    def _pace(self, ahead: Velocity, back: Velocity) -> float:
        """Return how fast the path's time may pass: it waits for the robot.

        The other way, a robot that is not fast enough would cut the path's corners.
        """
        if self._feasible(ahead, back, 1.0):
            return 1.0
        low, high = 0.0, 1.0
        while high - low > _PACE_STEP:
            pace = (low + high) / 2.0
            if self._feasible(ahead, back, pace):
                low = pace
            else:
                high = pace
        return low

    def _feasible(self, ahead: Velocity, back: Velocity, pace: float) -> bool:
        wanted = Velocity(pace * ahead.v + back.v, pace * ahead.omega + back.omega)
        return self.context.slowdown(wanted) == 1.0

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
