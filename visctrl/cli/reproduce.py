"""``visctrl reproduce``: run published tables and figures again, and compare."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from visctrl.reproduce.catalogue import ENTRIES, Entry, entries_named
from visctrl.reproduce.entry import Bench, Row
from visctrl.reproduce.record import keep, page
from visctrl.robots.files import write_text
from visctrl.studies.workers import default_workers


def show_entries() -> None:
    """Print the name and title of every entry."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for entry in ENTRIES.values():
        table.add_row(entry.name, entry.title)
    Console().print(table)


def reproduce(
    names: list[str],
    out: Path,
    workers: int | None,
    repeats: int | None = None,
    *,
    as_json: bool,
    record: Path | None = None,
) -> int:
    """Run entries; return 0 if no judged row falls short, else 1.

    Parameters
    ----------
    repeats : int or None
        Runs of every cell, for entries that have cells; None for as many as these want.
    record : Path or None
        Also write the page of everything that has been run into ``out``, now or earlier.

    Raises
    ------
    InputError
        An unknown name; nothing has been run.
    """
    chosen = entries_named(names)
    results: list[dict[str, Any]] = []
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    with bar:
        whole = bar.add_task("entries", total=len(chosen))
        for entry in chosen:
            began = time.perf_counter()
            rows = _run(entry, out, workers or default_workers(), repeats, bar)
            bar.advance(whole)
            result = {
                "name": entry.name,
                "ok": not any(row.ok is False for row in rows),
                "seconds": time.perf_counter() - began,
                "rows": [row.as_dict() for row in rows],
            }
            keep(out / entry.name, result)
            results.append(result)
            if not as_json:
                _show(entry, rows, out)
    if record is not None:
        write_text(record, page(out))
    if as_json:
        print(json.dumps(results, indent=2))
    return 0 if all(result["ok"] for result in results) else 1


def _run(entry: Entry, out: Path, workers: int, repeats: int | None, bar: Progress) -> list[Row]:
    task = bar.add_task(entry.name, total=None)

    def announce(total: int, done: int) -> None:
        bar.update(task, total=total, completed=done)
        if not bar.console.is_terminal:  # a log shows no bar
            bar.console.print(f"{entry.name}: {done} of {total} runs", highlight=False)

    return entry.run(Bench(out / entry.name, workers, announce, repeats))


def _show(entry: Entry, rows: list[Row], out: Path) -> None:
    """Print an entry's rows: published, our bound, the source's law, ours, the verdict."""
    columns = ("case", "quantity", "published", "own bound", "source's law", "ours", "")
    table = Table(*columns, title=entry.title)
    for row in rows:
        case = f"{row.case}\n  told {' '.join(row.told)}" if row.told else row.case
        verdict = _VERDICTS[row.ok]
        for key in dict.fromkeys((*row.published, *row.source, *row.ours)):
            numbers = (row.published, row.bound, row.source, row.ours)
            cells = (f"{n[key]:.3g}" if key in n else "" for n in numbers)
            table.add_row(escape(case), key, *cells, verdict)
            case = verdict = ""
    console = Console()
    console.print(table)
    console.print(f"files: {out / entry.name}", highlight=False)


_VERDICTS = {True: "ok", False: "[bold red]worse[/bold red]", None: "shown"}
