"""What a second process is worth on this machine, whatever it does: the bound of every study."""

from __future__ import annotations

import time

import numpy as np

from visctrl.studies.workers import LocalWorkers

_PRODUCTS, _ITEMS = 4000, 12


def multiply(number: int) -> float:
    """Keep a core busy for about a second with what a filter does: products of small matrices."""
    rng = np.random.default_rng(number)
    covariance, gain = rng.normal(size=(126, 126)), rng.normal(size=(60, 126)) / 126.0
    for _ in range(_PRODUCTS):
        covariance -= gain.T @ (gain @ covariance)
    return float(covariance[0, 0])


def machine_ratio() -> float:
    """Return the time of two workers over that of one, for work that shares nothing at all."""
    took = []
    for workers in (2, 1):
        each = LocalWorkers(workers).each(multiply, range(_ITEMS))
        next(each)  # the workers have started
        began = time.perf_counter()
        list(each)
        took.append(time.perf_counter() - began)
    return took[0] / took[1]
