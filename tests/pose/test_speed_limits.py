"""Hard starts in far too little time: the task takes longer, and no command is clipped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from obstacle_world import Watch, run

from visctrl.hal.actuation import bounded, quantised
from visctrl.hal.types import Velocity
from visctrl.planning.paths import path_between, path_time
from visctrl.robots import Limits, load_robot
from visctrl.runtime.records import TickRecord
from visctrl.runtime.safety import SafetyOptions, effective_limits

#: As much as the hardware allows: here it is the wheels that set the limit.
FAST = SafetyOptions(
    v_m_s=0.7, omega_deg_s=140.0, acceleration_m_s2=1.0, angular_acceleration_deg_s2=300.0
)
P3AT = load_robot("p3at")


class Commands(Watch):
    """Notes what was wanted and sent while the robot followed a path."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[float, ...]] = []
        self.stretched = 0.0

    def on_tick(self, record: TickRecord) -> None:
        super().on_tick(record)
        if record.decision.phase == "path":
            self.rows.append((record.t, *record.decision.velocity, *record.sent))
        values = dict(record.signals).get("pose-tracking", {})
        self.stretched = values.get("task_time", self.stretched)


@pytest.mark.parametrize("rate", [10.0, 2.0])
@pytest.mark.parametrize("start", [(2.0, -3.0, 60.0), (-1.5, -2.5, -80.0), (1.5, -2.0, -40.0)])
@pytest.mark.parametrize("options", [SafetyOptions(), FAST], ids=["operating", "hardware"])
def test_commands_are_sent_as_wanted(
    rate: float, start: tuple[float, float, float], options: SafetyOptions
) -> None:
    limits = effective_limits(P3AT, options, "")
    watch = Commands()
    settings: dict[str, Any] = {
        **{f"start.{k}": v for k, v in zip(("x_m", "y_m", "phi_deg"), start, strict=True)},
        **{"robot": "p3at", "rate_hz": rate, "controller.tau_s": 3.0, "duration_s": 100.0},
        **{"mock.actuation.quantise": False, "mock.noise_px": 0.5},
        "safety": options.model_dump(exclude_defaults=True),
    }
    outcome = run(settings, watch)
    assert outcome.summary["status"] == "reached", outcome.summary["reason"]
    t, *columns = np.array(watch.rows).T
    wanted, sent = np.array(columns[:2]), np.array(columns[2:])
    # At first the robot still brakes from its first leg, or from a turn, at its acceleration.
    settled = t > t[0] + 0.35
    np.testing.assert_allclose(sent[:, settled], wanted[:, settled], atol=1e-12)
    assert np.all(np.abs(sent[0]) <= limits.v_m_s)
    assert np.all(np.abs(sent[1]) <= limits.omega_rad_s)
    for side in (-1.0, 1.0):
        wheel = sent[0] + side * sent[1] * P3AT.wheels.effective_track_m / 2.0
        assert np.all(np.abs(wheel) <= P3AT.hardware.v_m_s)
    # The user is told, at the end and in ticks.csv.
    assert watch.stretched > 5.0
    assert any("s longer than controller.tau_s" in note for note in outcome.notes)


def test_a_task_with_enough_time_says_nothing() -> None:
    watch = Commands()
    outcome = run({"controller.tau_s": 40.0}, watch)
    assert watch.stretched == pytest.approx(40.0)
    assert not outcome.notes


def test_the_path_time_is_what_the_slowest_limit_asks_for() -> None:
    """Against the commands of a fine simulation of the law along the path."""
    limits = effective_limits(P3AT, FAST, "")
    path, lever, phi = path_between((1.5, -2.5), (0.0, 0.0), 0.5), 0.1, math.radians(-30.0)
    tau = path_time(path, phi, lever, limits, 1.0)
    ratios, step = [], tau / 20000
    last = np.zeros(2)
    for k in range(20000):
        x_rate, y_rate = path.at((k + 0.5) * step, tau).velocity
        s, c = math.sin(phi), math.cos(phi)
        now = np.array([-s * x_rate + c * y_rate, -(c * x_rate + s * y_rate) / lever])
        change = np.abs(now - last) / step
        ratios.append(
            max(
                limits.ratio(*now),
                change[0] / limits.acceleration_m_s2,
                change[1] / limits.angular_acceleration_rad_s2,
            )
        )
        phi, last = phi + step * now[1], now
    assert 0.9 < max(ratios) < 1.1


def limits_of(wheel: float) -> Limits:
    return Limits(
        v_m_s=0.5,
        omega_deg_s=60.0,
        acceleration_m_s2=1.0,
        angular_acceleration_deg_s2=100.0,
        wheel_m_s=wheel,
        track_m=0.4,
    )


def test_a_velocity_that_a_wheel_cannot_do_keeps_its_curvature() -> None:
    wanted = Velocity(0.4, 1.0)
    sent = bounded(wanted, limits_of(0.5))
    assert sent.v + 0.2 * sent.omega == pytest.approx(0.5)
    assert sent.v / sent.omega == pytest.approx(0.4)
    assert bounded(wanted, limits_of(0.7)) == wanted


@pytest.mark.parametrize("omega", [-0.7, -0.31, 0.0, 0.2, 0.66])
def test_whole_units_keep_the_wheels_within_their_bound(omega: float) -> None:
    limits = limits_of(0.5)
    at_bound = Velocity(0.5 - 0.2 * abs(omega), omega)
    sent = quantised(at_bound, limits)
    assert sent.v + 0.2 * abs(sent.omega) <= 0.5 + 1e-9
    assert abs(sent.v - at_bound.v) < 1e-3
    assert abs(sent.omega - omega) < math.radians(1.0)
