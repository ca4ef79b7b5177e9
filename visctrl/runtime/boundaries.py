"""What passes from one stage of the tick to the next is finite, or does not pass.

One place for all of them: frames and views lose the features that are no numbers, an estimate
that is none counts as lost, a base that reports none has failed. `Checkpoint` takes an estimator
back to before such a tick, so that nothing of it lives on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Estimate, Estimator, Health, Obstacle, Views
from visctrl.hal.errors import BaseFaultError
from visctrl.hal.types import Features, Frame, Odometry, Range, Velocity

EstimateT = TypeVar("EstimateT", bound=Estimate)

#: Standard deviation of a bearing that has none (rad): it says as good as nothing.
_NO_BEARING = math.pi
#: Fields that tell of doubt may be infinite: nothing is known then.
_DOUBTS = ("sd", "sigma", "covariance")
#: So many ticks lie between two checkpoints of an estimator at most: a tick is repeated as often
#: at worst, and copying its state costs a tenth of a copy (0.1 to 0.5 ms) in each.
_CHECKPOINT_TICKS = 10


def sound_frame(frame: Frame) -> Frame:
    """Return a frame without the features whose pixels are not finite."""
    features = frame.features
    if features is None or np.isfinite(features.pixels).all():
        return frame
    kept = np.isfinite(features.pixels).all(axis=1)
    return frame._replace(features=Features(features.ids[kept], features.pixels[kept]))


def sound_views(views: Views) -> tuple[Views, str]:
    """Return views without the features whose rays are not finite, and why none are left.

    Views whose ``sigma`` is no standard deviation are refused altogether.
    """
    if views.health is Health.LOST:
        return views, ""
    if not (math.isfinite(views.sigma) and views.sigma >= 0.0):
        return _refused(views, f"the bearings' doubt is not a number: {views.sigma}")
    arrays = (views.target, views.initial, views.current, views.pixels)
    if all(np.isfinite(array).all() for array in arrays):
        return views, ""
    kept = np.ones(len(views), dtype=np.bool_)
    for array in arrays:
        kept &= np.isfinite(array).all(axis=1)
    if not kept.any():
        return _refused(views, "no feature has finite rays")
    sigmas = views.sigmas
    left = replace(
        views,
        ids=views.ids[kept],
        target=views.target[kept],
        initial=views.initial[kept],
        current=views.current[kept],
        pixels=views.pixels[kept],
        sigmas=None if sigmas is None else lambda: _sound_sigmas(sigmas()[:, kept]),
    )
    return left, ""


def sound_estimate(estimate: EstimateT) -> tuple[EstimateT, bool]:
    """Return an estimate, lost with a reason if it is not finite, and whether it was sound."""
    if estimate.health is Health.LOST:
        return estimate, True
    name = _not_finite(estimate, "")
    if not name:
        return estimate, True
    return lost(estimate, f"the estimate is not finite: {name}"), False


def lost(estimate: EstimateT, reason: str) -> EstimateT:
    """Return an estimate that counts as lost for a reason."""
    return replace(estimate, health=Health.LOST, reason=reason)


def sound_ranges(ranges: Sequence[Range]) -> Sequence[Range]:
    """Return the readings of range sensors without those that are no numbers."""
    return [each for each in ranges if not any(math.isnan(value) for value in each)]


def unsound_obstacle(obstacles: Sequence[Obstacle]) -> str:
    """Return what is wrong with the obstacles that a provider found, empty if nothing."""
    for obstacle in obstacles:
        if not all(math.isfinite(value) for value in obstacle[:3]):
            return f"obstacle is not finite: {obstacle}"
    return ""


def check_odometry(odometry: Odometry) -> None:
    """Raise BaseFaultError for odometry that is not finite."""
    if not all(map(math.isfinite, (odometry.stamp, *odometry.pose, *odometry.velocity))):
        raise BaseFaultError(
            f"the base's odometry is not finite: pose {tuple(odometry.pose)}, velocity "
            f"{tuple(odometry.velocity)}, stamp {odometry.stamp}"
        )


def check_sent(sent: Velocity) -> None:
    """Raise BaseFaultError for a base that says it was sent no velocity."""
    if not sent.finite:
        raise BaseFaultError(f"the base says that it was sent {tuple(sent)}")


class Checkpoint:
    """Takes an estimator's state back to before a tick whose estimate was not finite.

    It keeps a copy of the state and what the estimator has been given since. Going back repeats
    that without the bad tick. An estimator that cannot be copied stays as it is: while its
    estimates are not finite it counts as lost.
    """

    def __init__(self, estimator: Estimator[Any, Any]) -> None:
        self._estimator = estimator
        self._state: Mapping[str, Any] | None = None
        self._since: list[tuple[Views, Velocity, float]] = []
        self._keep()

    def passed(self, views: Views, sent: Velocity, dt: float) -> None:
        """Note a tick that went well."""
        self._since.append((views, sent, dt))
        if len(self._since) >= _CHECKPOINT_TICKS:
            self._keep()

    def go_back(self, reason: str, stamp: float, sent: Velocity, dt: float) -> None:
        """Undo the last tick; the estimator hears that nothing was seen in it."""
        if self._state is None:
            return
        since, self._since = self._since, []
        before = self._copy(self._state)
        vars(self._estimator).clear()
        vars(self._estimator).update(before)
        nothing = Views.nothing(stamp, reason)
        for views, velocity, seconds in (*since, (nothing, sent, dt)):
            self._estimator.update(views, velocity, seconds)
            self._since.append((views, velocity, seconds))
        if len(self._since) >= _CHECKPOINT_TICKS:
            self._keep()

    def _keep(self) -> None:
        try:
            self._state = self._copy(vars(self._estimator))
        except Exception:  # an estimator may hold anything: locks, threads, files
            self._state = None
        self._since = []

    def _copy(self, state: Mapping[str, Any]) -> dict[str, Any]:
        context, options = self._estimator.context, self._estimator.options
        return copy.deepcopy(dict(state), {id(context): context, id(options): options})


def _refused(views: Views, reason: str) -> tuple[Views, str]:
    return Views.nothing(views.stamp, reason), reason


def _sound_sigmas(sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(sigmas), sigmas, _NO_BEARING)


def _not_finite(value: object, name: str) -> str:
    """Return the name of the first number in ``value`` that must be finite and is not."""
    if isinstance(value, float | np.floating):
        bad = math.isnan(value) if _tells_doubt(name) else not math.isfinite(value)
        return name if bad else ""
    if isinstance(value, np.ndarray):
        if value.dtype.kind != "f":
            return ""
        fine = ~np.isnan(value) if _tells_doubt(name) else np.isfinite(value)
        return "" if fine.all() else name
    for part, of in _parts(value):
        if found := _not_finite(of, part or name):
            return found
    return ""


def _tells_doubt(name: str) -> bool:
    return any(word in name for word in _DOUBTS)


def _parts(value: object) -> list[tuple[str, object]]:
    """Return what a value is made of, with names; a pair of views that is lost says nothing."""
    if getattr(value, "health", None) is Health.LOST:
        return []
    if is_dataclass(value):
        return [(each.name, getattr(value, each.name)) for each in fields(value)]
    if isinstance(value, tuple):
        names = getattr(value, "_fields", ("",) * len(value))
        return list(zip(names, value, strict=True))
    return []
