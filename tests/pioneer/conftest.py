"""Fixtures for tests of the driver."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pioneer_bench import Bench
from virtual_robot import Site

from visctrl.hal.emulator.firmware_profile import ARCOS, Personality


@pytest.fixture
def bench(site: Site) -> Callable[..., Bench]:
    """Return a maker of benches on simulated time."""

    def make(
        kind: str = "pty",
        subclass: str = "p3dx-sh",
        personality: Personality = ARCOS,
        seed: int = 0,
    ) -> Bench:
        url = "/dev/robot" if kind == "pty" else "socket://robot:8101"
        return Bench(site, site.robot(url, subclass, personality, seed))

    return make
