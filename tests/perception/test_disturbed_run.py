"""A whole simulated run with a blackout of a second and somebody walking through the view."""

from __future__ import annotations

import csv
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml

from visctrl.hal.types import Frame, Pose
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.plan import make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import Registries
from visctrl.runtime.session import run_session
from visctrl.sim.backend import SimBackend

pytestmark = pytest.mark.sim

BLACK_S = (4.0, 5.0)
#: The walker crosses the view from right to left, a metre before the target view.
WALK_S, WALK_FROM, WALK_TO = (6.0, 10.0), (2.2, 1.1), (-2.2, 1.1)
WALKER = {"name": "walker", "at_m": [2.2, 1.1], "size_m": [0.9, 0.4, 2.2], "pattern": "noise"}


class Seen(Observer):
    """Remembers which landmarks were tracked when."""

    def __init__(self) -> None:
        self.ids: list[tuple[float, set[int]]] = []

    def on_tick(self, record: TickRecord) -> None:
        self.ids.append((record.t, set(record.views.ids.tolist())))

    def within(self, start: float, end: float) -> set[int]:
        """Return the landmarks that were tracked all through an interval."""
        return set.intersection(*(ids for t, ids in self.ids if start <= t < end))


class Walked(SimBackend):
    """The simulated robot with somebody else in its hall."""

    def open(self) -> None:
        super().open()
        read = self.camera.read

        def walked_past() -> Frame:
            share = np.interp(self.clock.now(), WALK_S, (0.0, 1.0))
            x, y = (1 - share) * np.array(WALK_FROM) + share * np.array(WALK_TO)
            self.move("walker", Pose(x, y, 0.0))
            return read()

        self.camera.read = walked_past  # type: ignore[method-assign]


def test_blackout_and_walker_cost_neither_the_run_nor_its_accuracy(tmp_path: Path):
    scene = yaml.safe_load((resources.files("visctrl.sim") / "scenes" / "hall.yaml").read_text())
    scene["items"].append(WALKER)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    registries = Registries()
    registries.backends.builtin["walked"] = f"{__name__}:Walked"
    settings = {
        "backend": "walked",
        "camera.width": 400,
        "walked.scene": str(tmp_path / "scene.yaml"),
        "walked.faults.camera_black_s": list(BLACK_S),
        "walked.show_floor": False,
        "approach.enabled": False,
        "start.phi_deg": -25.0,
    }
    overrides = [Override(tuple(k.split(".")), v, f"--set {k}") for k, v in settings.items()]
    loaded = load_scenario("default", overrides, registries.backends.names())
    seen = Seen()
    outcome = run_session(make_plan(loaded, registries), tmp_path / "run", observers=[seen])
    assert outcome.summary["status"] == "reached", outcome.summary["reason"]
    error = outcome.summary["final_error"]
    assert np.hypot(error["x_m"], error["y_m"]) < 0.005
    assert abs(error["phi_deg"]) < 0.3
    with (tmp_path / "run" / "ticks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    t = np.array([float(row["t [s]"]) for row in rows])
    features = np.array([int(row["features"]) for row in rows])
    lost = np.array([row["views_health"] == "lost" for row in rows])
    black = (t >= BLACK_S[0]) & (t < BLACK_S[1] - 1e-6)
    assert lost[black].all()
    assert not lost[(t > BLACK_S[1] + 1.0)].any(), "seen again within a second, and for good"
    assert features[~lost].min() > 60
    before = seen.within(5.5, 6.0)
    hidden = {i for i in before if any(6 <= t < 10 and i not in ids for t, ids in seen.ids)}
    assert len(hidden) > 30, "the walker hid some of what was tracked"
    after = seen.within(10.5, 10.8)
    assert len(after) > 100
    assert len(after - (before - hidden)) > 0.5 * len(hidden), "and others took their place"
