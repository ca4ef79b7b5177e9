"""Controller ``pose-tracking``: Cartesian control of the estimated pose along a planned path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

from pydantic import Field

from hal.types import STANDSTILL, Pose, Velocity
from robots.errors import InputError
from visctrl.control.avoidance import Avoidance, AvoidanceOptions
from visctrl.control.paths import (
    TURN_FROM,
    TURN_TO,
    ParabolicPath,
    Reference,
    path_demand,
)
from visctrl.control.stages import TARGET, Goal, Itinerary, Stage
from visctrl.control.way_search import Drive
from visctrl.estimation.pose_estimate import Need, PoseEstimate
from visctrl.plugins import Context, Controller, Decision, Obstacle, Signal

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
        self._itinerary: Itinerary | None = None
        self._stage: Stage | None = None
        self._turning = False
        self._t = 0.0
        self._elapsed = 0.0
        self._settled = 0.0
        self._task_time = 0.0
        self._reference: Reference | None = None

    def expect(self, obstacles: Sequence[Obstacle]) -> None:
        """Check that the goals leave room between obstacles (see the contract)."""
        goals = {"the target": (0.0, 0.0)}
        goals |= {f"controller.goals.{k}": (g.x_m, g.y_m) for k, g in enumerate(self.options.goals)}
        self._avoidance.expect(goals, obstacles)

    def sense(self, obstacles: Sequence[Obstacle]) -> None:
        """Keep what stands around for the next `update`."""
        self._avoidance.sense(obstacles)

    def update(self, estimate: PoseEstimate, t: float) -> Decision:
        """Return the velocity for an estimate at ``t`` seconds since this controller started."""
        dt, self._t = t - self._t, t
        if estimate.need is Need.STILL:
            return Decision(STANDSTILL, "stand")
        if estimate.need is Need.FORWARD:
            if not self._avoidance.may_advance():
                return Decision(STANDSTILL, "blocked")
            return Decision(Velocity(self.options.advance_m_s, 0.0), "advance")
        if self._itinerary is None:
            self._itinerary = Itinerary(self.options.goals, self.options.tau_s, estimate.pose)
        self._elapsed += dt
        if self._stage is not None:
            self._stage.time += dt
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

    # --- stages ------------------------------------------------------------------------------

    def _begin(self, itinerary: Itinerary, estimate: PoseEstimate) -> Decision:
        """Turn on the spot if the next stage asks for it, then start it."""
        tau = itinerary.time_for_next(estimate.pose, self._elapsed)
        stage = self._prepared(itinerary.left[0], tau, estimate)
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
        demand = path_demand(path, estimate.pose.phi, stage.lever)
        stage.tau = max(tau, demand.time(self.context.limits, self.options.reserve))
        itinerary.take()
        self._stage = stage
        rest = self.options.tau_s - self._elapsed - tau if itinerary.left else 0.0
        self._task_time = self._elapsed + stage.tau + max(rest, 0.0)
        return self._follow(stage, estimate, 0.0)

    def _prepared(self, goal: Goal, tau: float, estimate: PoseEstimate) -> Stage:
        """Return a stage from the present pose."""
        lever = self._lever(math.dist(estimate.pose[:2], goal.place), tau)
        camera = self.context.camera_forward_m
        straight = self._straight(lever)
        return Stage(estimate.pose, estimate.initial, goal, camera, lever, straight)

    def _lever(self, way: float, tau: float) -> float:
        """Return how far the control point is ahead of the axle on a way of some length (m)."""
        camera = self.context.camera_forward_m
        lever = abs(camera) + (self.options.lookahead_m or 0.0)
        if self.options.lookahead_m is None:
            step = math.pi / 2.0 * way / tau * self.context.period_s
            lever = max(lever, _LEVER_PER_STEP * step)
        return math.copysign(lever, camera)

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

    def _halt(self, itinerary: Itinerary, *, under_way: bool) -> Decision:
        """Give up the stage and stop."""
        itinerary.give_up(under_way=under_way)
        self._stage = None
        return self._avoidance.halt(self._t)

    def _find_way(self, itinerary: Itinerary, estimate: PoseEstimate) -> Decision | None:
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
        velocity = self._law(stage, path, estimate.pose)
        excess = self._excess(velocity)
        if excess > 1.0 and stage.time < stage.tau:
            # The path waits for the robot, instead of the robot cutting its corners.
            stage.time -= dt * (1.0 - 1.0 / excess)
            stage.time = max(stage.time, 0.0)
            velocity = self._law(stage, path, estimate.pose)
        arrived = stage.time >= stage.tau
        return Decision(velocity, "settle" if arrived else "path")

    def _law(self, stage: Stage, path: ParabolicPath, pose: Pose) -> Velocity:
        period = self.context.period_s
        self._reference = path.at(stage.time, stage.tau)
        # Constant over a tick, the velocity is right on average when taken in its middle.
        if stage.time < stage.tau:
            ahead = path.at(stage.time + period / 2.0, stage.tau).velocity
        else:
            ahead = (0.0, 0.0)
        offset = stage.ahead
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
