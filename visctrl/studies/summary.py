"""What a study found: per cell, how many runs arrived and how near, with confidence intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from visctrl.runtime.summary import REACHED
from visctrl.studies.grid import Study
from visctrl.studies.intervals import CONFIDENCE, deviation, mean, median, wilson
from visctrl.studies.table import DIED, ERRORS, Row

SUMMARY = "summary.json"
#: How each interval is made, for whoever reads the summary.
METHODS = {
    "confidence": CONFIDENCE,
    "reached": "Wilson's score interval",
    "mean": "Student's t",
    "sd": "percentile bootstrap, 2000 resamples",
    "median": "order statistics",
    "errors": "over all runs whose final pose is known, arrived or not",
}


def summarised(study: Study, origin: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the summary that ``--json`` prints and ``summary.json`` holds.

    Parameters
    ----------
    study, origin : Study, str
        The study and its file.
    rows : sequence of Row
        The table, as far as it goes.
    """
    return {
        "study": origin,
        "title": study.title,
        "runs": study.count,
        "finished": sum(row["status"] != DIED for row in rows),
        "died": [row["run"] for row in rows if row["status"] == DIED],
        "statuses": dict(sorted(Counter(row["status"] for row in rows).items())),
        "intervals": METHODS,
        "cells": _cells(study, rows),
    }


def _cells(study: Study, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the statistics of every cell of which any run has ended."""
    members: dict[int, list[Row]] = {}
    for row in rows:
        members.setdefault(row["cell"], []).append(row)
    return [
        _cell(study, number, cell, members[number])
        for number, cell in enumerate(study.cells())
        if number in members
    ]


def _cell(
    study: Study, number: int, cell: Mapping[str, Any], members: Sequence[Row]
) -> dict[str, Any]:
    reached = sum(row["status"] == REACHED for row in members)
    rng = np.random.default_rng([study.seed, number])
    return {
        "cell": number,
        "values": dict(cell),
        "runs": len(members),
        "reached": wilson(reached, len(members))._asdict(),
        "errors": _errors(members, rng),
    }


def _errors(rows: Sequence[Row], rng: np.random.Generator) -> dict[str, Any]:
    """Return the statistics of the final errors; empty where no final pose is known."""
    known = [row for row in rows if row["distance_cm"] is not None]
    if not known:
        return {}
    distance = np.array([row["distance_cm"] for row in known])
    found: dict[str, Any] = {
        "known": len(known),
        "distance_cm": {
            "median": median(distance)._asdict(),
            "max": float(distance.max()),
        },
    }
    for name in ERRORS:
        sample = np.array([row[name] for row in known])
        found[name] = {"mean": mean(sample)._asdict()}
        if len(sample) > 1:
            found[name]["sd"] = deviation(sample, rng)._asdict()
    return found
