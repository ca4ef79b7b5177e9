"""Times beside a reference kernel that is timed in the same breath.

Milliseconds mean little on a machine that others use too. So every benchmark names a reference,
runs it right before each of its own rounds, and reports the median of the rounds' ratios.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

#: Array additions of 60 numbers: what the loop without pictures is measured in.
ADDITIONS = 1000
_NUMBERS = np.linspace(0.0, 1.0, 60)


def additions() -> None:
    """Do `ADDITIONS` small array operations: the reference where there is no picture."""
    for _ in range(ADDITIONS):
        _NUMBERS + _NUMBERS


def paired(
    benchmark: Any,
    ours: Callable[[], object],
    reference: Callable[[], object],
    *,
    rounds: int,
    against: str,
    bound: str = "",
    **notes: object,
) -> float:
    """Time ``ours`` in rounds, each right after ``reference``; return the median ratio.

    against : what the reference is, for the table.
    bound : what is aimed at, for the table.
    notes : further columns of the table's last cell.
    """
    taken: list[float] = []

    def before() -> None:
        began = time.process_time()
        reference()
        taken.append(time.process_time() - began)

    benchmark.pedantic(ours, setup=before, rounds=rounds, iterations=1, warmup_rounds=1)
    own = benchmark.stats.stats.data
    # The warm-up had a reference of its own.
    ratios = [mine / other for mine, other in zip(own, taken[-len(own) :], strict=True)]
    ratio = statistics.median(ratios)
    benchmark.extra_info.update(
        against=against,
        reference_ms=1e3 * statistics.median(taken[-len(own) :]),
        ratio=ratio,
        bound=bound,
        notes={name: str(value) for name, value in notes.items()},
    )
    return ratio
