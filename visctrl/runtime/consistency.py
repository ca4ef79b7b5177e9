"""Whether a pose filter is as good as it says: NEES and NIS with their χ² bounds, tick by tick.

The normalised estimation error squared, (A.11), needs the true pose, which no plugin sees: it is
computed here, outside of them, where the backend knows the truth. The normalised innovation
squared, (A.12), is the filter's own number. Of a consistent filter, 95 % of either lie between
the bounds; the source's index, the value over its upper bound, is then under 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np

from visctrl.contracts import Estimate, Estimator, Signal
from visctrl.hal.types import Pose
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import estimate_type
from visctrl.schemes.pose.estimate import Need, PoseEstimate

NAME = "consistency"
#: Share of the values of a consistent filter between the bounds.
CONFIDENCE = 0.95
_POSE_DOF = 3


@cache
def chi_square_bounds(dof: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the bounds between which χ² of ``dof`` degrees lies with this probability."""
    from scipy.special import gammaincinv

    tail = (1.0 - confidence) / 2.0
    low, high = 2.0 * gammaincinv(dof / 2.0, np.array([tail, 1.0 - tail]))
    return float(low), float(high)


def nees(estimate: PoseEstimate, truth: Pose) -> float:
    """Return the normalised estimation error squared, (A.11); NaN without a proper covariance."""
    turn = math.remainder(estimate.pose.phi - truth.phi, math.tau)
    x, y = estimate.pose.x - truth.x, estimate.pose.y - truth.y
    # By cofactors, in plain floats: three numbers are too few for an array operation to pay.
    covariance: list[list[float]] = estimate.covariance.tolist()
    (a, b, c), (_, d, e), (_, _, f) = covariance
    xx, xy, xt = d * f - e * e, c * e - b * f, b * e - c * d
    yy, yt, tt = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * xx + b * xy + c * xt
    if not (a > 0.0 and tt > 0.0 and determinant > 0.0):
        return math.nan
    square = xx * x * x + yy * y * y + tt * turn * turn
    return (square + 2.0 * (xy * x * y + xt * x * turn + yt * y * turn)) / determinant


def gives_pose(estimator: Estimator[Any, Any]) -> bool:
    """Return whether an estimator delivers poses, so that there is something to judge."""
    given = estimate_type(type(estimator))
    return given is not None and issubclass(given, PoseEstimate)


class Consistency:
    """Judges every estimate of a pose.

    It fills columns of ``ticks.csv`` like a plugin, but is none.
    """

    signals: ClassVar[tuple[Signal, ...]] = tuple(
        Signal(name, "1")
        for name in ("nees", "nees_low", "nees_high", "nis", "nis_dof", "nis_low", "nis_high")
    )

    def prepare(self, estimator: Estimator[Any, Any]) -> None:
        """Load what it takes to judge this estimator; in a tick that would take too long."""
        if gives_pose(estimator):
            chi_square_bounds(_POSE_DOF)

    def values(
        self, estimate: Estimate, truth: Pose | None, reported: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the numbers of a tick; none while there is no pose to judge.

        Parameters
        ----------
        estimate : Estimate
        truth : Pose or None
            True pose at the time of the estimate.
        reported : mapping
            What the estimator says of itself: its ``nis`` and ``nis_dof``.
        """
        if not isinstance(estimate, PoseEstimate) or estimate.need is not Need.NOTHING:
            return {}
        found: dict[str, float] = {}
        if truth is not None and math.isfinite(value := nees(estimate, truth)):
            low, high = chi_square_bounds(_POSE_DOF)
            found |= {"nees": value, "nees_low": low, "nees_high": high}
        dof = reported.get("nis_dof", 0.0)
        if dof > 0.0:
            low, high = chi_square_bounds(round(dof))
            found |= {"nis": reported["nis"], "nis_dof": dof, "nis_low": low, "nis_high": high}
        return found


class ConsistencyMeter(Observer):
    """Collects NEES and NIS of a run."""

    def __init__(self) -> None:
        self._nees, self._nis = _Share(), _Share()

    def on_tick(self, record: TickRecord) -> None:
        """Take a tick into account."""
        values = dict(record.signals).get(NAME, {})
        if "nees" in values:
            self._nees.add(values["nees"], _POSE_DOF, values["nees_low"], values["nees_high"])
        if "nis" in values:
            self._nis.add(values["nis"], values["nis_dof"], values["nis_low"], values["nis_high"])

    def summary(self) -> dict[str, Any] | None:
        """Return the part of a run's summary, or None where no pose was estimated.

        ``mean`` is per degree of freedom, 1 for a consistent filter. The errors of one run are
        alike from tick to tick, so that its NEES may stay beyond the bounds for long; many runs
        tell more.
        """
        if not self._nees.ticks and not self._nis.ticks:
            return None
        return {
            "confidence": CONFIDENCE,
            "nees": self._nees.judged(),
            "nis": self._nis.judged(),
        }


class _Share:
    """Sums of a normalised square and of its degrees of freedom, and how often it was inside."""

    def __init__(self) -> None:
        self.ticks = self._inside = 0
        self._sum = self._dof = 0.0

    def add(self, value: float, dof: float, low: float, high: float) -> None:
        """Count a value and its bounds."""
        self.ticks += 1
        self._sum += value
        self._dof += dof
        self._inside += low <= value <= high

    def judged(self) -> dict[str, float | int] | None:
        """Return the mean per degree of freedom and the share inside, None without a value."""
        if not self.ticks:
            return None
        mean, inside = self._sum / self._dof, self._inside / self.ticks
        return {"ticks": self.ticks, "mean": mean, "inside": inside}
