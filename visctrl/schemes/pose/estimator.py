"""Estimator ``transfer``: the consistent pose filter, from first frame to last."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from visctrl.contracts import Context, Estimator, Health, Signal, Views
from visctrl.geometry.trifocal.transfer import bearings
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.pose.estimate import POSE_SIGNALS, Need, PoseEstimate
from visctrl.schemes.pose.first_leg import ForwardLeg, Leg, MotionNoise, RampedVelocity
from visctrl.schemes.pose.leg_start import LegSolution, solve_leg
from visctrl.schemes.pose.schmidt_ekf import CORE, Innovation, SchmidtEkf

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]

#: Each attempt to solve the first leg waits until it has grown by this factor.
_GROWTH = 1.3


class TransferOptions(StrictModel):
    """Options of `PoseTransfer`.

    initial_frames : frames averaged at the start, the robot standing.
    scale_sd : the first leg ends when the distance to the target is known to this fraction.
    leg_min_m, leg_max_m : bounds of the first leg's length.
    rival : the first leg goes on while another start explains it nearly as well: within this
        much of the cost (half a squared Mahalanobis distance).
    max_features : more than this are not carried along.
    refine_s : how often the errors of the fixed views' bearings are estimated better (s); in
        between they only count. 0 is with every frame.
    exchange_frames : a feature unused for so many frames makes room for another one.
    blind_max_s : without any measurement for longer, the pose counts as lost.
    noise : of the executed motion.
    """

    initial_frames: Annotated[int, Field(ge=1, le=100)] = 5
    scale_sd: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    leg_min_m: Positive = 0.2
    leg_max_m: Positive = 1.5
    rival: NonNegative = 50.0
    max_features: Annotated[int, Field(ge=5, le=500)] = 60
    refine_s: NonNegative = 0.25
    exchange_frames: Annotated[int, Field(ge=1)] = 10
    blind_max_s: Positive = 3.0
    noise: MotionNoise = MotionNoise()

    @model_validator(mode="after")
    def _ordered(self) -> TransferOptions:
        if self.leg_min_m > self.leg_max_m:
            raise ValueError(
                f"leg_min_m {self.leg_min_m:g} must not exceed leg_max_m {self.leg_max_m:g}"
            )
        return self


class PoseTransfer(Estimator[TransferOptions, PoseEstimate]):
    """Stands, drives a first leg, then filters; see `SchmidtEkf`."""

    Options: ClassVar[type[TransferOptions]] = TransferOptions
    signals: ClassVar[tuple[Signal, ...]] = (
        *POSE_SIGNALS,
        Signal("features_used", "1"),
        Signal("noise_factor", "1"),
    )

    def __init__(self, options: TransferOptions, context: Context) -> None:
        super().__init__(options, context)
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""
        self._ramp = RampedVelocity(self.context.limits)
        self._leg = ForwardLeg()
        self._start: LegSolution | None = None
        self._next_try = self.options.leg_min_m
        self._frames = 0
        self._failed = ""
        self._filter: SchmidtEkf | None = None
        self._last: PoseEstimate | None = None
        self._ids: Ids = np.empty(0, dtype=np.int64)
        self._unused: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._seen = _Seen(self._ids, self._ids)
        self._stamp = self._refined = -math.inf
        self._blind = 0.0
        self._innovation = Innovation(0.0, np.empty(0, dtype=np.intp))

    def update(self, views: Views, sent: Velocity, dt: float) -> PoseEstimate:
        """Return the pose after ``dt`` seconds under ``sent``, corrected by what is seen now."""
        velocity = self._ramp.during(sent, dt)
        fresh = views.health is not Health.LOST and len(views) > 0 and views.stamp > self._stamp
        if fresh:
            self._stamp = views.stamp
        self._innovation = Innovation(0.0, np.empty(0, dtype=np.intp))
        self._blind = 0.0 if fresh else self._blind + dt
        if self._filter is None:
            return self._begin(views if fresh else None, velocity, dt)
        noise = self.options.noise.covariance(velocity)
        offset = self.context.camera_forward_m
        self._filter.advance(velocity.v, velocity.omega, dt, offset, noise)
        if fresh:
            self._correct(self._filter, views)
        return self._estimate(self._filter)

    def values(self) -> Mapping[str, float]:
        """Return the pose and the filter's own account of its accuracy."""
        if self._last is None:
            return {}
        found = self._last.values()
        if self._innovation.dof:
            found |= {"nis": self._innovation.nis, "nis_dof": float(self._innovation.dof)}
        found["features_used"] = float(self._innovation.dof)
        if self._filter is not None:
            found["noise_factor"] = math.sqrt(self._filter.factor)
        return found

    # --- first leg ---------------------------------------------------------------------------

    def _begin(self, views: Views | None, velocity: Velocity, dt: float) -> PoseEstimate:
        """Collect a frame of the first leg, and end the leg when it tells enough."""
        options, leg = self.options, self._leg
        if self._failed:
            return PoseEstimate.unknown(self._need, Health.LOST, self._failed)
        leg.move(velocity, dt, self.context.camera_forward_m, options.noise.covariance(velocity))
        if views is None:
            return PoseEstimate.unknown(self._need, self._blindness(), "no new frame")
        self._frames += 1
        # The frame that became the initial view says nothing new about it.
        if leg.travelled > 0.0 or not np.array_equal(views.current, views.initial):
            leg.look(views)
        if leg.travelled >= min(self._next_try, options.leg_max_m):
            self._next_try = leg.travelled * _GROWTH
            ids, seen = leg.collected(options.max_features)
            self._start = solve_leg(seen, self._start)
            if self._start is not None and self._settled(self._start):
                self._filter = _started(self._start, seen, leg)
                self._ids, self._unused = ids, np.zeros(len(ids), dtype=np.int64)
                return self._estimate(self._filter)
            if leg.travelled >= options.leg_max_m:
                self._failed = self._failure()
                return PoseEstimate.unknown(self._need, Health.LOST, self._failed)
        return PoseEstimate.unknown(self._need, Health.DEGENERATE, "finding the start")

    @property
    def _need(self) -> Need:
        return Need.STILL if self._frames < self.options.initial_frames else Need.FORWARD

    def _settled(self, start: LegSolution) -> bool:
        """Return whether the leg tells the start well enough, or as well as it ever will."""
        if not start.finite or 2 * start.used.sum() < start.tested.sum():
            return False
        if self._leg.travelled >= self.options.leg_max_m:
            return start.relative_scale_sd < 0.3
        return start.relative_scale_sd < self.options.scale_sd and start.rival > self.options.rival

    def _failure(self) -> str:
        way = f"the first {self._leg.travelled:.1f} m did not tell where the target is"
        if self._start is None:
            return f"{way}: too few features, or no start agrees with them"
        used = f"{int(self._start.used.sum())} of {int(self._start.tested.sum())} features agree"
        return f"{way}: {used}, distance known to {100.0 * self._start.relative_scale_sd:.0f} %"

    # --- filtering ---------------------------------------------------------------------------

    def _correct(self, state: SchmidtEkf, views: Views) -> None:
        if not np.array_equal(views.ids, self._seen.ids):
            self._seen = _Seen(views.ids, self._ids)
        seen, sigma, theta2 = self._seen, views.bearing_sigmas(), bearings(views.current)
        sigma2 = sigma[2]
        if len(seen.spare):
            theta2, sigma2 = theta2[seen.known], sigma2[seen.known]
        # Stamps are rounded: a period of exactly this long is not too short.
        refine = views.stamp - self._refined > 0.99 * self.options.refine_s
        if refine:
            self._refined = views.stamp
        self._innovation = state.correct(seen.slots, theta2, sigma2, refine=refine)
        self._unused += 1
        self._unused[seen.slots[self._innovation.used]] = 0
        if len(seen.spare) and self._unused.max() >= self.options.exchange_frames:
            self._exchange(state, views, seen.spare, sigma)
            self._seen = _Seen(views.ids, self._ids)

    def _exchange(
        self, state: SchmidtEkf, views: Views, spare: NDArray[np.intp], sigma: Array
    ) -> None:
        """Put features that are seen into the places of those that have long been useless."""
        idle = np.flatnonzero(self._unused >= self.options.exchange_frames)
        for slot, feature in zip(idle.tolist(), spare.tolist(), strict=False):
            state.exchange(
                slot,
                float(bearings(views.initial[feature])),
                float(bearings(views.target[feature])),
                float(sigma[1, feature]),
                float(sigma[0, feature]),
            )
            self._ids[slot] = views.ids[feature]
            self._unused[slot] = 0

    def _estimate(self, state: SchmidtEkf) -> PoseEstimate:
        health = self._blindness()
        self._last = PoseEstimate(
            health=health,
            reason=f"nothing seen for {self._blind:.1f} s" if health is Health.LOST else "",
            pose=state.pose,
            covariance=self._covariance(state),
            initial=state.initial,
        )
        return self._last

    def _covariance(self, state: SchmidtEkf) -> Array:
        """Return the metric covariance of the pose, the odometer's factor included."""
        gain = self.options.noise.gain
        if gain == 0.0:
            return state.covariance
        x, y, _ = state.pose
        position = gain * np.array([x, y, 0.0])
        return state.covariance + np.outer(position, position)

    def _blindness(self) -> Health:
        return Health.LOST if self._blind > self.options.blind_max_s else Health.OK


class _Seen:
    """Which of the features in view are in the state.

    ids : of the features in view. slots : where in the state those are that it knows, of which
    known are the positions in view. spare : positions in view of the others.
    """

    def __init__(self, ids: Ids, state: Ids) -> None:
        self.ids = ids
        order = np.argsort(state)
        place = np.minimum(np.searchsorted(state, ids, sorter=order), max(len(order) - 1, 0))
        slots = order.take(place) if len(order) else place
        known = state.take(slots) == ids if len(order) else np.zeros(len(ids), dtype=np.bool_)
        self.slots = slots[known]
        self.known, self.spare = np.flatnonzero(known), np.flatnonzero(~known)


def _started(start: LegSolution, seen: Leg, leg: ForwardLeg) -> SchmidtEkf:
    """Return the filter at the end of the first leg."""
    n = len(seen.theta1)
    s, c = math.sin(start.phi), math.cos(start.phi)
    R = np.array([[c, -s], [s, c]])
    way = R @ leg.motion[:2]
    x = np.empty(CORE + 2 * n)
    x[:2] = np.array([math.sin(start.beta), -math.cos(start.beta)]) + start.q * way
    x[2] = start.phi + leg.motion[2] + start.turn
    x[3:CORE] = start.beta, start.phi, start.q
    x[CORE:] = start.errors.ravel()
    J = np.zeros((len(x), 4 + 2 * n))
    J[:2, 0] = math.cos(start.beta), math.sin(start.beta)
    J[:2, 1] = start.q * np.array([-way[1], way[0]])
    J[:2, 2] = way
    J[2, 1] = J[2, 3] = J[3, 0] = J[4, 1] = J[5, 2] = 1.0
    J[CORE:, 4:] = np.eye(2 * n)
    P = J @ start.covariance @ J.T
    # What the base did about dead reckoning: across the way it moves the pose, along it the scale.
    turned = start.q * R
    P[:2, :2] += turned @ leg.spread[:2, :2] @ turned.T
    P[5, 5] += start.q**2 * leg.spread[1, 1] / max(leg.travelled, 1e-6) ** 2
    return SchmidtEkf(x, P, seen.theta1, seen.theta3)
