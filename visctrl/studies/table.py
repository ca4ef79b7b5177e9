"""The table of a study: one row a run, nothing in it that depends on the machine's speed."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from visctrl.robots.files import replacing

Row = dict[str, Any]

TABLE, PARQUET = "table.csv", "table.parquet"
#: Columns of the final error, by the key in a run's summary, and the factors to their units.
ERRORS = {"x_cm": ("x_m", 100.0), "y_cm": ("y_m", 100.0), "phi_deg": ("phi_deg", 1.0)}
#: A pose filter's account of itself: the mean per degree of freedom, the share inside its bounds.
_JUDGED, _KEPT = ("nees", "nis"), ("mean", "inside")
_IF_KNOWN = tuple(f"{name}_{key}" for name in _JUDGED for key in _KEPT)
_NUMBERS = ("distance_cm", *ERRORS, "path_m", "time_s", "ticks", "features_min", *_IF_KNOWN)
#: Further statuses, beside those of a run: its scene cannot be set up; its process died.
REFUSED, DIED = "refused", "died"


def row_of(summary: Mapping[str, Any]) -> Row:
    """Return what the table keeps of a run's summary."""
    error = summary["final_error"]
    row = ended(summary["status"], summary["reason"])
    if error is not None:
        row["distance_cm"] = 100.0 * math.hypot(error["x_m"], error["y_m"])
        row |= {name: factor * error[key] for name, (key, factor) in ERRORS.items()}
    row["path_m"] = summary["path_length_m"]
    row["time_s"] = summary["duration_s"]
    row["ticks"] = summary["ticks"]
    row["features_min"] = summary["features"]["min"]
    for name, judged in ((name, (summary.get("consistency") or {}).get(name)) for name in _JUDGED):
        row |= {f"{name}_{key}": value for key, value in (judged or {}).items() if key in _KEPT}
    return row


def ended(status: str, reason: str) -> Row:
    """Return the row of a run that gave no numbers."""
    return {"status": status, "reason": reason, **dict.fromkeys(_NUMBERS)}


def is_row(found: object) -> bool:
    """Return whether a value, as JSON gives it, is what `row_of` returns."""
    if not isinstance(found, dict) or found.keys() != {"status", "reason", *_NUMBERS}:
        return False
    words, numbers = (found["status"], found["reason"]), (found[name] for name in _NUMBERS)
    return all(isinstance(word, str) for word in words) and all(map(_is_number_or_none, numbers))


def _is_number_or_none(value: object) -> bool:
    if value is None:
        return True
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < math.inf


def write_table(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write ``table.csv``, and ``table.parquet`` where pandas and pyarrow are installed.

    A file is replaced at once or not at all.

    Returns
    -------
    list of Path
        The files written.
    """
    known = {key for row in rows for key, value in row.items() if value is not None}
    kept = [key for key in (rows[0] if rows else ()) if key in known or key not in _IF_KNOWN]
    cells = [{key: _cell(row[key]) for key in kept} for row in rows]
    path = folder / TABLE
    with replacing(path) as fresh, fresh.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, kept, lineterminator="\n")
        writer.writeheader()
        writer.writerows(cells)
    try:
        import pandas
        import pyarrow  # noqa: F401
    except ImportError:
        return [path]
    parquet = folder / PARQUET
    with replacing(parquet) as fresh:
        columns = {key: _of_one_type([row[key] for row in cells]) for key in kept}
        pandas.DataFrame(columns).to_parquet(fresh, index=False)
    return [path, parquet]


def _of_one_type(column: list[Any]) -> list[Any]:
    """Return a column as Parquet takes it: words and numbers do not mix."""
    kinds = {isinstance(value, str) for value in column if value is not None}
    if len(kinds) < 2:
        return column
    return [None if value is None else str(value) for value in column]


def _cell(value: Any) -> Any:
    """Return what one cell holds: a list or a mapping as JSON."""
    return json.dumps(value) if isinstance(value, list | dict | tuple) else value
