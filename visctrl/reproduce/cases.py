"""What the entries share: starts as settings, errors as rows, columns of recorded runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: x right (m), y forward (m), φ counter-clockwise (deg), in the target's frame.
Start = tuple[float, float, float]
Summary = Mapping[str, Any]


#: What a law leaves is what is judged: the last stage by the image, which would close it, is off.
LAW_ALONE = "final.enabled=false"


def start_at(start: Start) -> tuple[str, ...]:
    """Return the settings that put the robot at a start."""
    keys = ("x_m", "y_m", "phi_deg")
    return tuple(f"start.{key}={value}" for key, value in zip(keys, start, strict=True))


def start_name(start: Start) -> str:
    """Return a start as a row's case names it."""
    return " ".join(f"{value:g}" for value in start)


def folder_name(*parts: str) -> str:
    """Return the words of a case as one name that every file system takes."""
    return "".join(c if c.isalnum() or c in "+-." else "_" for c in "_".join(parts))


def named(x_cm: float, y_cm: float, phi_deg: float) -> dict[str, float]:
    """Return final errors under the keys of the source's tables."""
    return {"x_cm": float(x_cm), "y_cm": float(y_cm), "phi_deg": float(phi_deg)}


def errors(summary: Summary) -> dict[str, float]:
    """Return the signed final errors of a run; infinite where the truth is not known."""
    error = summary["final_error"]
    if error is None:
        return named(math.inf, math.inf, math.inf)
    return named(100.0 * error["x_m"], 100.0 * error["y_m"], error["phi_deg"])


def distances(summary: Summary) -> dict[str, float]:
    """Return how far from the target a run ended: distance (cm) and heading (deg)."""
    x, y, phi = errors(summary).values()
    return {"position_cm": math.hypot(x, y), "phi_deg": abs(phi)}


def column(directory: Path | None, name: str) -> NDArray[np.float64]:
    """Return a numeric column of a recorded run, without the ticks that leave it empty.

    Raises
    ------
    ValueError
        The run was not recorded.
    """
    from visctrl.viewers.report.ticks import read_ticks

    if directory is None:
        raise ValueError("the run was not recorded")
    numbers = np.asarray(read_ticks(directory / "ticks.csv").numbers[name], dtype=np.float64)
    return np.asarray(numbers[np.isfinite(numbers)])
