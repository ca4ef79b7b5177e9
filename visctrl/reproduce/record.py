"""The published record as one page: every published number beside what is obtained here."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from visctrl.reproduce.catalogue import ENTRIES
from visctrl.robots.errors import InputError
from visctrl.robots.files import write_text
from visctrl.runtime.summary import versions

ROWS = "rows.json"

_HEAD = (
    "# The record\n\n"
    "Written by `visctrl reproduce --record docs/record.md`; do not edit. Every published\n"
    "number, what the source's law gives here, what ours gives with the defaults that a user\n"
    "gets, and the ratio of ours to the published magnitude. A row is judged by the published\n"
    "numbers, or, where the source gives none, by a bound of the project's own: those stand in\n"
    "brackets. **worse** is a row that falls short of what it is judged by. *told*: settings that\n"
    "neither the task nor the source states; `visctrl run --set` takes them.\n\n"
)


def keep(out: Path, result: Mapping[str, Any]) -> None:
    """Keep an entry's result in its folder, where `page` finds it."""
    write_text(out / ROWS, json.dumps(result, indent=2) + "\n")


def page(out: Path) -> str:
    """Return the record of every entry that has been run into ``out``, as Markdown.

    Raises
    ------
    InputError
        A result cannot be read.
    """
    results = {name: _read(out / name / ROWS) for name in ENTRIES}
    made = ", ".join(f"{name} {version}" for name, version in versions().items())
    where = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    rows = [row for result in results.values() if result for row in result["rows"]]
    judged = [row for row in rows if row["ok"] is not None]
    short = [row for row in judged if not row["ok"]]
    lines = [_HEAD, f"Made with {made} on {where}.\n\n"]
    missing = [name for name, result in results.items() if result is None]
    if missing:
        names = ", ".join(f"`{name}`" for name in missing)
        lines.append(f"Not run for this page, which says nothing of them: {names}.\n\n")
    lines.append(
        f"{len(judged)} rows are judged, {sum(not row['bound'] for row in judged)} of them by the "
        f"source's own numbers; {len(short)} fall short.\n"
    )
    for name, result in results.items():
        if result is not None:
            lines.extend(_section(name, result))
    return "".join(lines)


def _section(name: str, result: Mapping[str, Any]) -> Iterator[str]:
    yield f"\n## {name}: {ENTRIES[name].title}\n\n"
    yield f"`visctrl reproduce {name}`, {result['seconds']:.0f} s.\n\n"
    yield "| case | quantity | published | source's law here | ours | ratio | |\n"
    yield "|---|---|---|---|---|---|---|\n"
    for row in result["rows"]:
        case = row["case"].replace("|", "\\|")
        if row["told"]:
            settings = " ".join(row["told"]).replace("|", "\\|")
            case += f" (*told* `{settings}`)"
        quantities = dict.fromkeys((*row["published"], *row["source"], *row["ours"]))
        for place, key in enumerate(quantities):
            cells = [case if place == 0 else "", key, *_numbers(row, key)]
            cells.append(verdict(row) if place == 0 else "")
            yield "| " + " | ".join(cells) + " |\n"


def verdict(row: Mapping[str, Any]) -> str:
    """Return what a row's verdict is called."""
    if row["ok"] is None:
        return "shown"
    return "ok" if row["ok"] else "**worse**"


def _numbers(row: Mapping[str, Any], key: str) -> Sequence[str]:
    published, ours = row["published"].get(key), row["ours"].get(key)
    cells = [_number(published), _number(row["source"].get(key)), _number(ours), ""]
    if key in row["bound"]:
        cells[0] = f"{cells[0]} [{_number(row['bound'][key])}]".strip()
    if published and ours is not None:
        cells[3] = f"{abs(ours) / abs(published):.2g}"
    return cells


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    return found
