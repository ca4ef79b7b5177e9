"""Runs of the pose scheme with what its filter said of itself, and what many of them tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.reproduce.cases import LAW_ALONE, Start, Summary, start_at
from visctrl.robots.unicycle import wrap_angle
from visctrl.runtime.consistency import NAME, chi_square_bounds
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.schemes.pose.estimate import Need, PoseEstimate
from visctrl.studies.run_spec import RunSpec

Array = NDArray[np.float64]

#: Columns of a trace, from the first pose on.
COLUMNS = ("t", "x_error", "y_error", "phi_error", "x_sd", "y_sd", "phi_sd", "nees", "nis", "dof")
#: What is executed scatters by so much about what is commanded: what the filters count on.
SCATTER_V_M_S, SCATTER_OMEGA_DEG_S = 0.002, 0.1
_NOISE = (
    "mock.noise_px=1.0",
    *(f"mock.scatter.v_m_s={SCATTER_V_M_S}", f"mock.scatter.omega_deg_s={SCATTER_OMEGA_DEG_S}"),
)
#: What a filter may be told of the noise in its images.
NOISE_TOLD = "perception.noise_px=1.0"
#: The source's period, Ts = 0.5 s.
RATE = "rate_hz=2"
#: Keys of the controller that the source states.
STATED = ("controller.tau_s",)


def simulated(start: Start, *settings: str, tau_s: float = 100.0) -> tuple[str, ...]:
    """Return the settings of an ideal robot in a scene of points, the source's large image."""
    return (
        *("backend=mock", "scheme=pose", "camera.width=1024", "mock.ideal=true"),
        LAW_ALONE,
        *start_at(start),
        *(f"controller.tau_s={tau_s}", f"duration_s={2.0 * tau_s}"),
        *settings,
    )


def noisy(start: Start, seed: int, *settings: str, tau_s: float = 100.0) -> RunSpec:
    """Return a run with a pixel of noise and a scene of its own."""
    return RunSpec("default", simulated(start, *_NOISE, f"seed={seed}", *settings, tau_s=tau_s))


def told_start(start: Start) -> str:
    """Return the setting that tells the source's filter C1."""
    x, y, phi = start
    return f"estimator.start={{x_m: {x}, y_m: {y}, phi_deg: {phi}}}"


class Trace(Observer):
    """Collects what `COLUMNS` names."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def on_tick(self, record: TickRecord) -> None:
        """Take a tick into account, once there is a pose."""
        estimate, truth = record.estimate, record.truth
        if not isinstance(estimate, PoseEstimate) or truth is None:
            return
        if estimate.need is not Need.NOTHING:
            return
        judged = dict(record.signals).get(NAME, {})
        error = np.subtract(estimate.pose, truth)
        error[2] = wrap_angle(error[2])
        self._rows.append(
            (
                record.t,
                *error.tolist(),
                *np.sqrt(np.diag(estimate.covariance)).tolist(),
                judged.get("nees", np.nan),
                judged.get("nis", 0.0),
                judged.get("nis_dof", 0.0),
            )
        )

    def array(self) -> Array:
        """Return the trace (ticks, columns)."""
        return np.array(self._rows, dtype=np.float64).reshape(-1, len(COLUMNS))


def run_traced(run: RunSpec) -> dict[str, Any]:
    """Run one and return its summary with its ``trace``, an array (ticks, `COLUMNS`)."""
    trace = Trace()
    summary = run_session(run.plan(), run.directory(), observers=[trace]).summary
    return {**summary, "trace": trace.array()}


def ended(summary: Summary) -> bool:
    """Return whether the controller itself ended the run."""
    return bool(summary["reason"].startswith("the controller finished"))


class Spread(NamedTuple):
    """Mean and standard deviation (3,) of final errors (cm, cm, deg), and how sure the mean is.

    half : half the mean's 95 % confidence interval.
    """

    mean: Array
    deviation: Array
    half: Array


def spread(errors: Array) -> Spread:
    """Return the mean and deviation of errors (runs, 3)."""
    from scipy.stats import t

    deviation = errors.std(axis=0, ddof=1)
    half = float(t.ppf(0.975, len(errors) - 1)) * deviation / np.sqrt(len(errors))
    return Spread(errors.mean(axis=0), deviation, half)


@dataclass(frozen=True)
class Averages:
    """NEES and NIS over many runs, step by step.

    nees, nis : (steps,) averages per degree of freedom.
    nees_bounds, nis_bounds : (steps, 2) 95 % bounds of those.
    """

    nees: Array
    nees_bounds: Array
    nis: Array
    nis_bounds: Array

    @property
    def nees_inside(self) -> float:
        """Share of the steps whose average NEES lies between the bounds."""
        return _inside(self.nees, self.nees_bounds)

    @property
    def nis_inside(self) -> float:
        """Share of the steps whose average NIS lies between the bounds."""
        return _inside(self.nis, self.nis_bounds)


def averages(traces: Sequence[Array]) -> Averages:
    """Return NEES and NIS averaged over runs, from their first pose on while all are under way."""
    steps = min(len(trace) for trace in traces)
    stack = np.stack([trace[:steps] for trace in traces])
    nees, nis, dof = (stack[..., COLUMNS.index(name)] for name in ("nees", "nis", "dof"))
    nees_dof = np.full(steps, 3.0 * len(traces))
    nis_dof = dof.sum(axis=0)
    # Where no run has used a feature there is no innovation to judge.
    seen = nis_dof > 0.0
    return Averages(
        nees.sum(axis=0) / nees_dof,
        _bounds(nees_dof),
        nis.sum(axis=0)[seen] / nis_dof[seen],
        _bounds(nis_dof[seen]),
    )


def _bounds(dof: Array) -> Array:
    return np.array([np.divide(chi_square_bounds(round(d)), d) for d in dof.tolist()])


def _inside(values: Array, bounds: Array) -> float:
    return float(np.mean((values >= bounds[:, 0]) & (values <= bounds[:, 1])))
