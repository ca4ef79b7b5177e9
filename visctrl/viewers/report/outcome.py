"""What a report needs of a run's ``summary.json`` and ``config.yaml``: other types are refused."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict


class _Part(BaseModel):
    """A part of a file of which the report reads some keys; numbers are numbers, not text."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class FinalError(_Part):
    """Where a run ended, in the target's frame."""

    x_m: float
    y_m: float
    phi_deg: float


class Spread(_Part):
    """Statistics of a number of each tick; None where there were no ticks."""

    median: float | None = None
    p99: float | None = None
    min: float | None = None


class Driven(_Part):
    """What the summary of a run has, and that of a replay has not."""

    path_length_m: float
    duration_s: float
    ticks: int
    missed_ticks: int


class Outcome(_Part):
    """The keys of a summary that every run has."""

    status: str
    reason: str = ""
    camera: str = ""
    final_error: FinalError | None = None
    compute_ms: Spread = Spread()
    features: Spread = Spread()
    versions: dict[str, str] = {}


class Settings(_Part):
    """The keys of a configuration that the report names."""

    title: str = ""
    scheme: str = ""
    backend: str = ""
    robot: str = ""
    seed: int = 0
    camera: dict[str, Any] = {}
