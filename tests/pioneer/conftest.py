"""Fixtures for tests against the emulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from pioneer_bench import Bench, make_port

from hal.pioneer.emulator.character import ARCOS, Personality, character
from hal.pioneer.emulator.emulator import Emulator
from hal.pioneer.emulator.firmware import Firmware


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    """Return a maker of benches, which are taken down after the test."""
    with ExitStack() as stack:

        def make(
            kind: str = "pty", subclass: str = "p3dx-sh", personality: Personality = ARCOS
        ) -> Bench:
            firmware = Firmware(character(subclass, personality))
            emulator = stack.enter_context(Emulator(firmware, make_port(kind)))
            return Bench(emulator)

        yield make
