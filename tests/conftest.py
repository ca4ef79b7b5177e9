"""What all tests share: repeatable examples, and a machine that keeps time for real-time tests."""

from __future__ import annotations

from collections.abc import Generator

import pytest
from hypothesis import settings
from steady import STALL_S, STOPWATCH

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start to look for stalls."""
    if item.get_closest_marker("realtime") is not None:
        STOPWATCH.begin()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Skip a failed test in real time if it was the machine that failed."""
    try:
        return (yield)
    except Exception as error:
        stall = STOPWATCH.worst()
        if pyfuncitem.get_closest_marker("realtime") is None or stall <= STALL_S:
            raise
        pytest.skip(f"failed while the machine stood still for {stall:.2f} s: {error!r:.200}")
