"""Plans for tests of many runs at once."""

from __future__ import annotations

import numpy as np

from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES

Start = tuple[float, float, float]


def plan_from(start: Start, seed: int, *settings: str) -> Plan:
    """Return the plan of a run on the mock from (x m, y m, φ deg)."""
    x, y, phi = start
    where = (f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}", f"seed={seed}")
    changes = [parse_setting(text) for text in (*where, *settings)]
    return make_plan(load_scenario("mock", changes, REGISTRIES.backends.known()))


def random_plans(count: int, *settings: str, angle: float = 35.0) -> list[Plan]:
    """Return plans from random starts whose headings are up to ``angle`` (deg) off."""
    rng = np.random.default_rng(count)
    starts = rng.uniform((-0.6, -2.2, -angle), (0.6, -1.4, angle), (count, 3)).tolist()
    return [plan_from(tuple(start), seed, *settings) for seed, start in enumerate(starts)]
