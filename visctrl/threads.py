"""How many threads numerical libraries may start."""

from __future__ import annotations

import os
import sys
from contextlib import AbstractContextManager, nullcontext

#: Of linear algebra. The matrices here are small: threads cost more than they bring, and what a
#: sum comes to would depend on their number.
LINEAR_ALGEBRA = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
#: Of a process that is one of as many as there are cores; the last is Mesa's, which then draws in
#: the thread that asks.
ONE_THREAD = {**LINEAR_ALGEBRA, "OPENCV_FOR_THREADS_NUM": "1", "LP_NUM_THREADS": "0"}


def limit_linear_algebra() -> None:
    """Keep linear algebra to one thread, unless the environment says otherwise.

    It must be called before numpy is imported.
    """
    for name, value in LINEAR_ALGEBRA.items():
        os.environ.setdefault(name, value)


def one_thread_of_algebra() -> AbstractContextManager[object]:
    """Keep linear algebra to one thread for a while, though numpy may long be imported.

    On two cores, threads make a tick of the pose scheme take six times as long.
    """
    if os.environ.items() >= LINEAR_ALGEBRA.items():
        return nullcontext()
    from threadpoolctl import threadpool_limits

    limited: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limited


def limit_all() -> None:
    """Keep this process to one thread, what is already imported as well."""
    os.environ.update(ONE_THREAD)
    if "cv2" in sys.modules:
        import cv2

        cv2.setNumThreads(1)
