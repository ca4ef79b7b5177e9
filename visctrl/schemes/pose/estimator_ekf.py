"""Estimator ``ekf``: the source's pose filters, C1 taken for exact once it is found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.special import chdtri

from visctrl.contracts import Context, Estimator, Health, Signal, Views
from visctrl.geometry.trifocal.tensor import CALIBRATED, T111, T121, T211, T221
from visctrl.geometry.trifocal.transfer import bearings
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import compose, relative_pose, wrap_angle
from visctrl.schemes.pose.estimate import POSE_SIGNALS, Need, PoseEstimate
from visctrl.schemes.pose.first_leg import (
    ForwardLeg,
    InitialAverage,
    Leg,
    MotionNoise,
    RampedVelocity,
)
from visctrl.schemes.pose.leg_start import in_front, scale_of, solve_leg
from visctrl.schemes.pose.source_filters import (
    EpipoleModel,
    ExtendedPoseFilter,
    MeasurementModel,
    NotMeasured,
    PoseFilter,
    TensorMethod,
    TensorModel,
    UnscentedPoseFilter,
    measured_tensor,
)

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]


class KnownPose(StrictModel):
    """A pose in the target's frame that somebody measured."""

    x_m: float
    y_m: float
    phi_deg: float

    @property
    def array(self) -> Array:
        """(x, y, φ) in metres and radians."""
        return np.array([self.x_m, self.y_m, math.radians(self.phi_deg)])


class InitialSpread(StrictModel):
    """Standard deviations of the first pose, P0."""

    x_m: Positive = 0.05
    y_m: Positive = 0.10
    phi_deg: Positive = 1.0

    @property
    def covariance(self) -> Array:
        """P0 (3, 3)."""
        return np.diag([self.x_m**2, self.y_m**2, math.radians(self.phi_deg) ** 2])


class EkfOptions(StrictModel):
    """Options of `PoseEkf`.

    measurement : elements of the tensor, or epipoles.
    elements : those that are measured, over T121.
    tensor : how the tensor is found: ``linear`` as published, ``refined`` by bearing residuals,
        ``known`` by bearing residuals among the tensors that have this C1.
    epipoles : the one in the fixed view alone, or ``both``.
    switch_m : distance to the target from which on the epipoles are those with the initial view.
    filter : extended or unscented.
    initialise : C1 from the tensor's closed form, from the essential matrix, or from all frames
        of the leg (``batch``).
    start : C1, where it is known; nothing is initialised then.
    first_guess : first estimate of the pose, where it is not C1.
    initial_frames : frames averaged at the start, the robot standing; 1 is the source's.
    leg_m : length of the first leg (d_ini).
    p0 : spread of the first estimate.
    gate : probability that a good measurement passes.
    blind_max_s : without any measurement for longer, the pose counts as lost.
    noise : of the executed motion, M.
    """

    measurement: Literal["tensor", "epipoles"] = "tensor"
    elements: tuple[str, ...] = ("T111",)
    tensor: TensorMethod = "linear"
    epipoles: Literal["target", "both"] = "both"
    switch_m: NonNegative = 2.0
    filter: Literal["extended", "unscented"] = "extended"
    initialise: Literal["tensor", "essential", "batch"] = "tensor"
    start: KnownPose | None = None
    first_guess: KnownPose | None = None
    initial_frames: Annotated[int, Field(ge=1, le=100)] = 1
    leg_m: Positive = 0.4
    p0: InitialSpread = InitialSpread()
    gate: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.9999
    blind_max_s: Positive = 3.0
    noise: MotionNoise = MotionNoise()

    @field_validator("elements")
    @classmethod
    def _elements(cls, elements: tuple[str, ...]) -> tuple[str, ...]:
        known = ("T111", "T112", "T122", "T211", "T212", "T221", "T222")
        wrong = [name for name in elements if name not in known]
        if wrong or not elements or len(set(elements)) < len(elements):
            raise ValueError(
                f"name each element once, of {', '.join(known)} (all are divided by T121)"
            )
        for related in (("T112", "T211", "T222"), ("T111", "T122", "T212", "T221")):
            if set(related) <= set(elements):
                raise ValueError(f"{', '.join(related)} follow from each other: leave one out")
        return elements


@cache
def _gate(probability: float, dof: int) -> float:
    return float(chdtri(dof, 1.0 - probability))


class PoseEkf(Estimator[EkfOptions, PoseEstimate]):
    """Drives a first leg, finds C1, then filters (x, y, φ) as if C1 were exact."""

    Options: ClassVar[type[EkfOptions]] = EkfOptions
    signals: ClassVar[tuple[Signal, ...]] = POSE_SIGNALS

    def __init__(self, options: EkfOptions, context: Context) -> None:
        super().__init__(options, context)
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""
        self._ramp = RampedVelocity(self.context.limits)
        self._leg = ForwardLeg()
        self._average = InitialAverage()
        self._frames = 0
        self._initial: Array | None = None
        self._filter: PoseFilter | None = None
        self._model: MeasurementModel | None = None
        self._stamp = -math.inf
        self._blind = 0.0
        self._reason = ""
        self._nis: tuple[float, int] | None = None

    def update(self, views: Views, sent: Velocity, dt: float) -> PoseEstimate:
        """Return the pose after ``dt`` seconds under ``sent``, corrected by what is seen now."""
        velocity = self._ramp.during(sent, dt)
        fresh = views.health is not Health.LOST and len(views) > 0 and views.stamp > self._stamp
        if fresh:
            self._stamp = views.stamp
        self._nis = None
        self._blind += dt
        seen = views if fresh else None
        if self._filter is None or self._model is None:
            return self._begin(seen, velocity, dt)
        noise, offset = self.options.noise.covariance(velocity), self.context.camera_forward_m
        self._filter.predict(velocity.v, velocity.omega, dt, offset, noise)
        if seen is not None:
            self._correct(self._filter, self._model, self._average.applied(seen))
        return self._estimate(self._filter)

    def values(self) -> Mapping[str, float]:
        """Return the pose and the filter's own account of its accuracy."""
        if self._filter is None:
            return {}
        found = self._estimate(self._filter).values()
        if self._nis is not None:
            found |= {"nis": self._nis[0], "nis_dof": float(self._nis[1])}
        return found

    # --- first leg ---------------------------------------------------------------------------

    def _begin(self, views: Views | None, velocity: Velocity, dt: float) -> PoseEstimate:
        options, leg = self.options, self._leg
        leg.move(velocity, dt, self.context.camera_forward_m, options.noise.covariance(velocity))
        if views is None:
            health = Health.LOST if self._blind > options.blind_max_s else Health.DEGENERATE
            return PoseEstimate.unknown(Need.FORWARD, health, "no new frame")
        self._blind = 0.0
        # The frame that became the initial view says nothing new about it.
        repeated = np.array_equal(views.current, views.initial)
        self._frames += 1
        if leg.travelled == 0.0 and not repeated and self._frames <= options.initial_frames:
            self._average.add(views)
        if leg.travelled == 0.0 and self._frames < options.initial_frames:
            return PoseEstimate.unknown(Need.STILL, Health.DEGENERATE, "averaging the first view")
        views = self._average.applied(views)
        if not repeated:
            leg.look(views)
        if leg.travelled < options.leg_m:
            return PoseEstimate.unknown(Need.FORWARD, Health.DEGENERATE, "finding the start")
        initial = self._initial_pose(views)
        if isinstance(initial, NotMeasured):
            return PoseEstimate.unknown(
                Need.FORWARD, Health.LOST, f"no start found: {initial.reason}"
            )
        self._initial = initial
        self._model = self._measurements(initial)
        guess = initial if options.first_guess is None else options.first_guess.array
        kind = ExtendedPoseFilter if options.filter == "extended" else UnscentedPoseFilter
        self._filter = kind(compose(guess, leg.motion), options.p0.covariance)
        return self._estimate(self._filter)

    def _initial_pose(self, views: Views) -> Array | NotMeasured:
        """Return C1, or why it cannot be told."""
        options = self.options
        if options.start is not None:
            return options.start.array
        if options.initialise == "tensor":
            return initial_by_tensor(views, float(self._leg.motion[1]), self.context.seed)
        _, leg = self._leg.collected(500)
        if options.initialise == "essential":
            return initial_by_essential(views, leg, self.context.seed)
        start = solve_leg(leg)
        if start is None:
            return NotMeasured("too few features, or no start agrees with them")
        return np.array(
            [math.sin(start.beta) / start.q, -math.cos(start.beta) / start.q, start.phi]
        )

    def _measurements(self, initial: Array) -> MeasurementModel:
        options, seed = self.options, self.context.seed
        if options.measurement == "tensor":
            return TensorModel(initial, options.elements, method=options.tensor, seed=seed)
        both = options.epipoles == "both"
        return EpipoleModel(initial, both=both, switch=options.switch_m, seed=seed)

    # --- filtering ---------------------------------------------------------------------------

    def _correct(self, state: PoseFilter, model: MeasurementModel, views: Views) -> None:
        measured = model.measure(views, state.pose)
        if isinstance(measured, NotMeasured):
            self._reason = measured.reason
            return
        nis = state.update(measured, model, _gate(self.options.gate, len(measured.values)))
        if nis is None:
            self._reason = "measurement contradicts the estimate"
            return
        self._nis = (nis, len(measured.values))
        self._blind, self._reason = 0.0, ""

    def _estimate(self, state: PoseFilter) -> PoseEstimate:
        assert self._initial is not None
        lost = self._blind > self.options.blind_max_s
        reason = f"nothing usable for {self._blind:.1f} s: {self._reason or 'no frame'}"
        return PoseEstimate(
            health=Health.LOST if lost else Health.OK,
            reason=reason if lost else "",
            pose=Pose(*state.pose.tolist()),
            covariance=state.covariance,
            initial=Pose(*self._initial.tolist()),
        )


# --- pose of the initial view, by the source's procedures -------------------------------------


def initial_from_tensor(tensor: Array, distance: float) -> Array:
    """Return C1 (3,) in the target's frame from one tensor: the closed form of (4.16).

    Parameters
    ----------
    tensor : (8,) array
        Of the views in the order target, second, first, in any scale.
    distance : float
        Way straight ahead from the first to the second view (m).

    Returns
    -------
    (3,) array
        The tensor's sign is unknown, and C1 therefore up to half a turn about the target.
    """
    scale = distance / math.hypot(tensor[T111], tensor[T211])
    phi = math.atan2(scale * tensor[T111], scale * tensor[T211])
    tx, ty = -scale * tensor[T221], scale * tensor[T121]
    s, c = math.sin(phi), math.cos(phi)
    target = np.array([-tx * c + ty * s, -tx * s - ty * c, phi])
    return relative_pose(np.zeros(3), target)


def initial_by_tensor(views: Views, distance: float, seed: int) -> Array | NotMeasured:
    """Return C1 (3,) from the three views after a leg straight ahead, or why it fails."""
    reordered = Views(
        ids=views.ids,
        target=views.initial,
        initial=views.target,
        current=views.current,
        pixels=views.pixels,
        sigma=views.sigma,
        stamp=views.stamp,
    )
    found = measured_tensor(reordered, CALIBRATED, refined=False, seed=seed)
    if isinstance(found, NotMeasured):
        return found
    initial = initial_from_tensor(found[0], distance)
    angles = np.array([math.atan2(initial[0], -initial[1]), initial[2]])
    if not in_front(bearings(views.initial), bearings(views.target), angles[None])[0]:
        initial = np.array([-initial[0], -initial[1], wrap_angle(initial[2] + math.pi)])
    return initial


def initial_by_essential(views: Views, leg: Leg, seed: int) -> Array | NotMeasured:
    """Return C1 (3,): directions from the planar essential matrix, the scale from the leg."""
    motion = ransac_planar_motion(views.target, views.initial, views.sigma, seed=seed)
    if not motion.determined:
        return NotMeasured(motion.reason)
    # Seen from the target, C1 lies at the bearing θ: (sin θ, cos θ) = (sin β, −cos β).
    beta = math.pi - motion.direction
    q, _ = scale_of(leg, np.array([beta]), np.array([motion.phi]))
    if not q[0] > 0.0:
        return NotMeasured("the forward motion does not show in the images")
    distance = 1.0 / float(q[0])
    return np.array([distance * math.sin(beta), -distance * math.cos(beta), motion.phi])
