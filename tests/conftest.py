"""What all tests share: repeatable examples, and robots on simulated time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import settings
from virtual_robot import Site, make_site
from virtual_time import VirtualTime

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """Robots and a camera on simulated time."""
    with VirtualTime() as world:
        site = make_site(monkeypatch, world)
        yield site
        for robot in site.robots:
            robot.close()
