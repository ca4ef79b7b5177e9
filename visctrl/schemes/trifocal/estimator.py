"""Estimator ``tensor``: the 1D trifocal tensor of the three views, every tick."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from visctrl.contracts import Context, Estimator, Health, Signal, Views
from visctrl.geometry.trifocal.tensor import (
    ELEMENTS,
    T121,
    normalised,
    normalised_covariance,
)
from visctrl.hal.types import Velocity
from visctrl.schemes.trifocal.constrained_fit import ConstrainedFit
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.linear_fit import LinearFit
from visctrl.schemes.trifocal.tensor_method import Measurement, TensorMethod, TensorOptions

#: A φ1 that was told and differs from the views' own by more than so many of its deviations and
#: so much besides (rad) is an assumption, which no law may rely on.
DISAGREEMENT_SIGMAS, DISAGREEMENT_RAD = 5.0, math.radians(2.0)

_ELEMENT_SDS = tuple(f"{name}_sd" for name in ELEMENTS)
_SIGNALS = (
    *(Signal(name, "1") for name in (*ELEMENTS, *_ELEMENT_SDS)),
    Signal("xi1", "1"),
    Signal("xi2", "1"),
    Signal("xi1_sd", "1"),
    Signal("xi2_sd", "1"),
    Signal("phi_1", "rad"),
    Signal("heading", "rad"),
    Signal("bearing", "rad"),
    Signal("distance", "m"),
    Signal("scale", "m"),
    Signal("scale_sd", "m"),
    Signal("inliers", "1"),
    Signal("residual_sd", "rad"),
)


class Tensor(Estimator[TensorOptions, TensorEstimate]):
    """1D trifocal tensor by a method of choice, scaled by what the robot was told to drive.

    It never raises for what the features show: without a usable tensor it repeats the last one,
    and health says that it is old.
    """

    Options: ClassVar[type[TensorOptions]] = TensorOptions
    signals: ClassVar[tuple[Signal, ...]] = _SIGNALS

    def __init__(self, options: TensorOptions, context: Context) -> None:
        super().__init__(options, context)
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""
        self._method = self._new_method()
        self._last = _nothing(self.options)
        # Whether the views bear out the φ1 that was told; None before they are seen.
        self._confirmed: bool | None = None
        self._measurement: Measurement | None = None

    def update(self, views: Views, sent: Velocity, dt: float) -> TensorEstimate:
        """Return the tensor of the three views (see the contract)."""
        self._method.predict(sent, dt)
        self._measurement = None
        if views.health is Health.LOST or len(views) < self.options.min_features:
            few = f"{len(views)} features, {self.options.min_features} are needed"
            return self._stale(Health.LOST, views.reason or few)
        measured = self._method.measure(views)
        if measured.health is not Health.OK:
            return self._stale(measured.health, measured.reason)
        self._measurement = measured
        scale, scale_sd = self._scale(measured)
        phi_1, phi_1_sd = self._phi_1(measured)
        self._last = TensorEstimate(
            health=Health.OK,
            elements=normalised(measured.tensor),
            covariance=normalised_covariance(measured.tensor, measured.covariance),
            phi_1=phi_1,
            phi_1_sd=phi_1_sd,
            scale_m=scale,
            scale_sd_m=scale_sd,
        )
        return self._last

    def values(self) -> Mapping[str, float]:
        """Return every element, what follows from them, and how well the features agree."""
        if self._measurement is None:
            return {}
        last = self._last
        xi, spread = last.outputs, last.outputs_covariance
        sds = np.sqrt(np.maximum(last.covariance.diagonal(), 0.0)).tolist()
        return {
            **dict(zip(ELEMENTS, last.elements.tolist(), strict=True)),
            **dict(zip(_ELEMENT_SDS, sds, strict=True)),
            "xi1": xi[0],
            "xi2": xi[1],
            "xi1_sd": math.sqrt(max(spread.a, 0.0)),
            "xi2_sd": math.sqrt(max(spread.c, 0.0)),
            "phi_1": last.phi_1,
            "heading": last.heading,
            "bearing": last.bearing,
            "distance": last.distance_m,
            "scale": last.scale_m,
            "scale_sd": last.scale_sd_m,
            "inliers": float(self._measurement.inliers),
            "residual_sd": self._measurement.spread,
        }

    def _new_method(self) -> TensorMethod:
        options, context = self.options, self.context
        if options.method == "constrained":
            return ConstrainedFit(options, context)
        return LinearFit(options, context)

    def _stale(self, health: Health, reason: str) -> TensorEstimate:
        return replace(self._last, health=health, reason=reason)

    def _phi_1(self, measured: Measurement) -> tuple[float, float]:
        """Return the law's φ1 and its standard deviation (rad)."""
        if self.options.phi_1 == "estimated":
            return measured.phi_1, measured.phi_1_sd
        told = math.radians(self.options.phi_1_deg) if self.options.phi_1 == "given" else 0.0
        if self._confirmed is None:
            off = abs(math.remainder(told - measured.phi_1, math.tau))
            within = off <= DISAGREEMENT_SIGMAS * measured.phi_1_sd + DISAGREEMENT_RAD
            known = math.isfinite(measured.phi_1_sd)
            self._confirmed = self.options.phi_1 == "given" and known and within
        return told, 0.0 if self._confirmed else math.inf

    def _scale(self, measured: Measurement) -> tuple[float, float]:
        """Return T121 in metres and its standard deviation."""
        if self.options.scale == "given" or not math.isfinite(measured.scale_sd_m):
            # Its sign is known even then, where the initial view is.
            known = self.options.method == "constrained"
            sign = float(measured.tensor[T121]) if known else 1.0
            return math.copysign(self.options.scale_m, sign), math.inf
        return measured.scale_m, measured.scale_sd_m


def _nothing(options: TensorOptions) -> TensorEstimate:
    """Return the tensor of a robot that has not moved and sees the target straight ahead."""
    return TensorEstimate(
        health=Health.LOST,
        elements=np.array([0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0]),
        covariance=np.eye(8),
        phi_1=0.0,
        phi_1_sd=math.inf,
        scale_m=options.scale_m,
        scale_sd_m=math.inf,
    )
