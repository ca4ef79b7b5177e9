"""All that is adverse, in one table: what comes of a run, and whether it knows.

Every cell is driven with three schemes, from random starts, robots and cameras taking turns. The
status is what a user would be told; the truth is used for nothing but to judge it. What is
finished is kept in the entry's folder: a run that was interrupted goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from visctrl.reproduce.adverse_cells import MACHINES, Cell, cells
from visctrl.reproduce.entry import Bench, Row
from visctrl.studies.batch import run_all
from visctrl.studies.log import StudyLog
from visctrl.studies.run_spec import RunSpec
from visctrl.studies.runner import run_once

SCHEMES = ("trifocal", "epipolar", "pose")
RUNS = 20
SEED = 5
#: Beyond these a robot that says it is there is not (cm, deg), and so much farther than it began
#: it must never end (cm).
THERE_CM, THERE_DEG, AWAY_CM = 2.0, 1.0, 50.0
REACHED, DOUBTFUL, REFUSED = "reached", "doubtful", "refused"
_TOUCHED = "touched"
#: Of the runs whose task is well posed.
SUCCESS_PCT = 95.0
COLUMNS = (
    "success",
    "FALSE SUCCESS",
    "doubtful",
    "refused",
    "missed",
    "contacts",
    "away",
    "median cm",
    "worst cm",
    "worst deg",
)


class Run(NamedTuple):
    """One run of a cell."""

    cell: Cell
    scheme: str
    began_cm: float
    spec: RunSpec


def adverse(bench: Bench) -> list[Row]:
    """Drive every cell; return the table's rows, and write it as Markdown and CSV."""
    runs = planned(bench.repeats or RUNS)
    with StudyLog(bench.out / "runs") as log:
        specs = [run.spec for run in runs]
        log.check(specs)
        pending = [spec for spec in specs if spec.key not in log.rows]
        bench.announce(len(specs), len(specs) - len(pending))

        def keep(index: int, row: dict[str, Any]) -> None:
            log.add(pending[index], row)
            bench.announce(len(specs), len(log.rows))

        run_all(pending, bench.workers, keep, run_once)
        ended = [(run, log.rows[run.spec.key]) for run in runs]
    rows = []
    for cell in cells():
        for scheme in SCHEMES:
            chosen = [pair for pair in ended if pair[0].cell.name == cell.name]
            rows.append(_row(cell, scheme, [p for p in chosen if p[0].scheme == scheme]))
    rows += [_total(rows, cells()), _well_posed(ended)]
    _write(bench, rows)
    return rows


def planned(repeats: int) -> list[Run]:
    """Return every run, the n-th of every cell first: an early end leaves all cells alike."""
    return [
        _run(cell, scheme, number)
        for number in range(repeats)
        for cell in cells()
        for scheme in SCHEMES
    ]


def _run(cell: Cell, scheme: str, number: int) -> Run:
    rng = np.random.default_rng([SEED, number, zlib.crc32(cell.name.encode())])
    x, y, phi = cell.start(rng)
    drawn = cell.settings(rng)
    machine = MACHINES[(number + zlib.crc32(cell.name.encode())) % len(MACHINES)]
    settings = (
        f"scheme={scheme}",
        *machine,
        f"start.x_m={x}",
        f"start.y_m={y}",
        f"start.phi_deg={phi}",
        f"seed={rng.integers(2**31)}",
        "sim.renderer=gl",
        "duration_s=120",
        *drawn,
    )
    key = hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:32]
    return Run(cell, scheme, 100.0 * math.hypot(x, y), RunSpec("default", settings, key=key))


def _row(cell: Cell, scheme: str, ended: Sequence[tuple[Run, Mapping[str, Any]]]) -> Row:
    """Return a cell's row: it is ok if no run was wrong without saying so."""
    reached = [row for _, row in ended if row["status"] == REACHED]
    errors = [row["distance_cm"] for row in reached]
    counts = {
        "success": sum(_there(row) for row in reached),
        "FALSE SUCCESS": sum(not _there(row) for row in reached),
        "doubtful": sum(row["status"] == DOUBTFUL for _, row in ended),
        "refused": sum(row["status"] == REFUSED for _, row in ended),
        "contacts": sum(_TOUCHED in row["reason"] for _, row in ended),
        "away": sum(_away(run, row) for run, row in ended),
    }
    counts["missed"] = len(ended) - len(reached) - counts["doubtful"] - counts["refused"]
    ours = {
        "runs": float(len(ended)),
        **{name: float(count) for name, count in counts.items()},
        "median cm": float(np.median(errors)) if errors else math.nan,
        "worst cm": max(errors, default=math.nan),
        "worst deg": max((abs(row["phi_deg"]) for row in reached), default=math.nan),
    }
    bad = counts["FALSE SUCCESS"] + counts["contacts"] + counts["away"]
    return Row(f"{cell.name} | {scheme}", ours, ok=bad == 0)


def _there(row: Mapping[str, Any]) -> bool:
    return bool(row["distance_cm"] <= THERE_CM and abs(row["phi_deg"]) <= THERE_DEG)


def _away(run: Run, row: Mapping[str, Any]) -> bool:
    distance = row["distance_cm"]
    return distance is not None and distance > run.began_cm + AWAY_CM


def _total(rows: Sequence[Row], every: Sequence[Cell]) -> Row:
    """Return what must never happen, summed over all cells."""
    sums = {
        name: sum(row.ours[name] for row in rows)
        for name in ("runs", "FALSE SUCCESS", "contacts", "away")
    }
    never = dict.fromkeys(("FALSE SUCCESS", "contacts", "away"), 0.0)
    ok = all(sums[name] == 0.0 for name in never)
    return Row(f"all {len(every)} cells", sums, bound=never, ok=ok)


def _well_posed(ended: Sequence[tuple[Run, Mapping[str, Any]]]) -> Row:
    """Return the share of success over the cells in which the task is well posed."""
    posed = [row for run, row in ended if run.cell.well_posed]
    success = sum(row["status"] == REACHED and _there(row) for row in posed)
    share = 100.0 * success / max(len(posed), 1)
    bound = {"success_pct": SUCCESS_PCT}
    return Row("well posed", {"success_pct": share}, bound=bound, ok=share >= SUCCESS_PCT)


def _write(bench: Bench, rows: Sequence[Row]) -> None:
    """Write the table as Markdown."""
    lines = [
        "| " + " | ".join(("cell", "scheme", "runs", *COLUMNS)) + " |",
        "|" + "---|" * (3 + len(COLUMNS)),
    ]
    for row in rows:
        if "success" in row.ours:
            numbers = [_number(name, row.ours[name]) for name in ("runs", *COLUMNS)]
            lines.append("| " + " | ".join((row.case, *numbers)) + " |")
    (bench.out / "adverse.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number(name: str, value: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.2f}" if name.endswith(("cm", "deg")) else f"{value:.0f}"
