"""A run keeps linear algebra to one thread, whoever starts it, and only while it lasts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.threads import LINEAR_ALGEBRA


def algebra_threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


class Counts(Observer):
    def __init__(self) -> None:
        self.threads: set[int] = set()

    def on_tick(self, record: TickRecord) -> None:
        self.threads.update(algebra_threads())


def test_linear_algebra_has_one_thread_during_a_run(
    toy_plan: Callable[..., Plan], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in LINEAR_ALGEBRA:
        monkeypatch.delenv(name, raising=False)
    counts = Counts()
    with threadpool_limits(limits=2, user_api="blas"):
        before = algebra_threads()
        run_session(toy_plan({"controller.drive_s": 0.3}), observers=[counts])
        assert algebra_threads() == before
    assert set(before) == {2}
    assert counts.threads == {1}
