"""Estimator plugin ``epipoles``: the epipoles of all pairs of views, every tick."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from visctrl.contracts import Context, Estimator, Health, Signal, Views
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.epipolar.estimate import EpipoleEstimate, EpipolePair
from visctrl.schemes.epipolar.location_filter import LocationFilter
from visctrl.schemes.epipolar.motion_solvers import Calibrated, Solver, Uncalibrated, solver_for
from visctrl.schemes.epipolar.position import Structure
from visctrl.schemes.epipolar.view_pairs import (
    ALIGNED,
    REFERENCE,
    TARGET,
    FixedViews,
    PairsFollower,
    ViewSet,
)

#: While the fixed views cannot be told apart, every so many ticks it is tried anew.
_SEARCH_EVERY = 4
#: Standard deviation of the first guess of the inverse distance (1/m): it hardly counts.
_DISTANCE_SD = 0.5


class EpipolesOptions(StrictModel):
    """Options of the estimator ``epipoles``.

    solver : ``planar-free`` leaves the focal length and the image's centre column open
        (perspective cameras), ``planar`` uses the calibration (any camera), ``auto`` takes the
        first for perspective cameras and the second for all others. ``fundamental`` and
        ``essential`` are OpenCV's MAGSAC, which takes nothing for planar (perspective cameras).
    hypotheses : random samples per pair and tick.
    sd_limit_rad : epipoles less certain than this do not correct the location.
    distance_m : rough distance to the target, before motion shows it.
    slip : standard deviation of the executed motion as a fraction of the commanded one.
    aligned_after_s : when the "aligned robot" view is stored, in seconds since the reset; None
        stores it as soon as both epipoles towards the target stay within ``aligned_deg``.
    horizon_deg : how far the horizon may lie off its row in the image (a wrong image centre, a
        camera that pitches); it is found from the start and target views where the calibration
        is left open. 0 trusts the row.
    reference_deg : the reference view moves with the robot until it sees the target this much
        off the target's axis, so that the depth can be told.
    """

    solver: Solver = "auto"
    hypotheses: Annotated[int, Field(ge=8, le=2000)] = 64
    sd_limit_rad: Annotated[float, Field(gt=0)] = 0.1
    distance_m: Annotated[float, Field(gt=0)] = 10.0
    slip: Annotated[float, Field(ge=0)] = 0.05
    aligned_after_s: Annotated[float, Field(ge=0)] | None = None
    aligned_deg: Annotated[float, Field(gt=0)] = 2.0
    horizon_deg: Annotated[float, Field(ge=0, le=10)] = 3.0
    reference_deg: Annotated[float, Field(ge=0)] = 10.0


class Epipoles(Estimator[EpipolesOptions, EpipoleEstimate]):
    """Epipoles of the pairs current–target, initial–current, initial–target, aligned–current."""

    Options = EpipolesOptions
    signals = (
        Signal("e23", "1"),
        Signal("e32", "1"),
        Signal("e12", "1"),
        Signal("e21", "1"),
        Signal("e13", "1"),
        Signal("e31", "1"),
        Signal("e22ar", "1"),
        Signal("e2ar2", "1"),
        Signal("e23_sd", "1"),
        Signal("e32_sd", "1"),
        Signal("e12_sd", "1"),
        Signal("e21_sd", "1"),
        Signal("e13_sd", "1"),
        Signal("e31_sd", "1"),
        Signal("e23_bearing_sd", "rad"),
        Signal("e32_bearing_sd", "rad"),
        Signal("e12_bearing_sd", "rad"),
        Signal("inverse_distance", "1/m"),
        Signal("horizon", "1"),
    )

    _reported = frozenset(signal.name for signal in signals)

    def __init__(self, options: EpipolesOptions, context: Context) -> None:
        super().__init__(options, context)
        self._solver = solver_for(options.solver, context.camera)
        #: Whether angles are angles: without a calibration, points in space are not.
        self._metric = isinstance(self._solver, Calibrated)
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""
        self._ticks = 0
        self._time = 0.0
        self._within = 0
        self._views = FixedViews()
        self._pairs = PairsFollower(self._solver, self.options.hypotheses)
        self._fixed: EpipolePair | None = None
        self._filter: LocationFilter | None = None
        self._structure: Structure | None = None
        self._levelled = False
        self._last = EpipoleEstimate(Health.LOST, "no view yet")

    def update(self, views: Views, sent: Velocity, dt: float) -> EpipoleEstimate:
        """Return the epipoles of this tick (see `Estimator.update`)."""
        self._ticks += 1
        if self._ticks > 1:
            self._time += dt
            if self._filter is not None:
                self._filter.predict(sent, dt)
        if views.health is Health.LOST:
            self._last = EpipoleEstimate(Health.LOST, views.reason)
            return self._last
        self._level(views)
        seed = self.context.seed + self._ticks
        fixed = self._between_fixed(views, seed)
        if not fixed.usable(self.options.sd_limit_rad):
            reason = f"start and target cannot be told apart: {_problem(fixed)}"
            self._last = EpipoleEstimate(Health.LOST, reason)
            return self._last
        sight = self._views.see(views)
        motions = self._pairs.update(sight, views.sigma, sent.omega * dt, seed)
        pairs = {name: EpipolePair.of(motion) for name, motion in motions.items()}
        target = pairs[TARGET].swapped()
        self._locate(views, sight, target, pairs[REFERENCE], fixed)
        self._last = EpipoleEstimate(
            target.health,
            target.reason,
            target,
            pairs[REFERENCE],
            self._fixed,
            pairs.get(ALIGNED),
            self._filter.location if self._filter is not None else None,
        )
        self._store(views, target)
        return self._last

    def values(self) -> Mapping[str, float]:
        """Return the epipoles for a unit focal length, and their standard deviations."""
        found: dict[str, float] = {}
        for pair, a, b in (
            (self._last.current_target, "e23", "e32"),
            (self._last.initial_current, "e12", "e21"),
            (self._last.initial_target, "e13", "e31"),
            (self._last.aligned_current, "e2ar2", "e22ar"),
        ):
            if pair is not None and pair.health is not Health.LOST:
                found[a], found[b] = pair.epipole_a, pair.epipole_b
                found[f"{a}_bearing_sd"], found[f"{b}_bearing_sd"] = pair.sd_a, pair.sd_b
                found[f"{a}_sd"] = pair.sd_a * (1.0 + pair.epipole_a**2)
                found[f"{b}_sd"] = pair.sd_b * (1.0 + pair.epipole_b**2)
        if self._last.location is not None:
            found["inverse_distance"] = self._last.location.inverse_distance
        if isinstance(self._solver, Uncalibrated):
            found["horizon"] = self._solver.horizon
        return {name: value for name, value in found.items() if name in self._reported}

    def _level(self, views: Views) -> None:
        """Find the horizon once, where the solver leaves it open."""
        if self._levelled or not isinstance(self._solver, Uncalibrated):
            return
        self._levelled = True
        widest = math.tan(math.radians(self.options.horizon_deg))
        self._solver.level(views.initial, views.target, views.sigma, widest, self.context.seed)

    def _between_fixed(self, views: Views, seed: int) -> EpipolePair:
        """Return the pair of the initial, or a later reference, and the target view.

        It is a constant of the run once it is known well enough; before, it is searched at times.
        """
        fixed, limit = self._fixed, self.options.sd_limit_rad
        if fixed is not None and (fixed.usable(limit) or self._ticks % _SEARCH_EVERY != 0):
            return fixed
        rays, hypotheses = (views.target, views.initial), self.options.hypotheses
        motion = self._solver.search(*rays, views.sigma, hypotheses, seed)
        self._fixed = EpipolePair.of(motion).swapped()
        # The robot still stands about where the initial view was taken.
        self._pairs.begin(TARGET, motion)
        self._pairs.begin(REFERENCE)
        return self._fixed

    # --- location ---------------------------------------------------------------------------

    def _locate(
        self,
        views: Views,
        sight: ViewSet,
        target: EpipolePair,
        reference: EpipolePair,
        fixed: EpipolePair,
    ) -> None:
        if self._filter is None:
            self._filter = self._filter_from(fixed, 1.0 / self.options.distance_m, _DISTANCE_SD)
            return
        self._filter.update(target, reference, self.options.sd_limit_rad)
        if self._metric:
            structure = self._structure_of(sight, self._filter)
            placed = structure.place(sight.current, self._filter.pose, views.sigma)
            self._filter.place(placed)
        self._move_reference(views, target, self._filter)

    def _structure_of(self, sight: ViewSet, found: LocationFilter) -> Structure:
        """Return where target and reference view see the features: constant while they stay."""
        structure = self._structure
        if structure is None or not structure.stands_for(sight.fixed, found.reference):
            structure = Structure(sight.fixed, found.reference, sight.present)
            self._structure = structure
        return structure

    def _filter_from(self, fixed: EpipolePair, guess: float, sd: float) -> LocationFilter:
        ahead, slip = self.context.camera_forward_m, self.options.slip
        return LocationFilter(fixed, guess, sd, ahead, slip, self._metric)

    def _move_reference(self, views: Views, target: EpipolePair, old: LocationFilter) -> None:
        """Take the current view as the reference if the old one lies on the target's axis."""
        limit = math.radians(self.options.reference_deg)
        if abs(math.sin(old.psi1)) >= math.sin(limit) or not target.usable(
            self.options.sd_limit_rad
        ):
            return
        at = old.location
        off, rho = math.atan2(at.x, -at.y), math.hypot(at.x, at.y)
        if limit < abs(off) < math.pi / 2.0 and rho > 0.0:
            self._views.store(REFERENCE, views)
            self._pairs.begin(REFERENCE)
            self._fixed = target
            sd = math.sqrt(float(at.covariance[3, 3]))
            self._filter = self._filter_from(target, at.inverse_distance / rho, sd / rho)

    def _store(self, views: Views, target: EpipolePair) -> None:
        """Keep the current view as the aligned one when it is time."""
        if ALIGNED in self._views:
            return
        limit = math.radians(self.options.aligned_deg)
        off = max(abs(math.atan(target.epipole_a)), abs(math.atan(target.epipole_b)))
        ok = target.usable(limit) and off < limit
        self._within = self._within + 1 if ok else 0
        after = self.options.aligned_after_s
        due = self._within * self.context.period_s >= 1.0 if after is None else self._time >= after
        if due:
            self._views.store(ALIGNED, views)
            self._pairs.begin(ALIGNED)


def _problem(pair: EpipolePair) -> str:
    """Return why a pair of views does not do, and what to do."""
    if pair.degeneracy is Degeneracy.ONE_PLANE:
        return pair.reason
    if pair.reason:
        return f"{pair.reason}; start farther from the target, or where more is to be seen"
    sd = math.degrees(max(pair.sd_a, pair.sd_b))
    return f"the epipoles are known to {sd:.0f} deg only: start farther from the target"
