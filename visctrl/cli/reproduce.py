"""``visctrl reproduce``: run published tables and figures again, and compare."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from visctrl.reproduce.catalogue import ENTRIES, Entry, entries_named
from visctrl.reproduce.entry import Bench, Row
from visctrl.study.workers import default_workers


def show_entries() -> None:
    """Print the name and title of every entry."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for entry in ENTRIES.values():
        table.add_row(entry.name, entry.title)
    Console().print(table)


def reproduce(names: list[str], out: Path, workers: int | None, *, as_json: bool) -> int:
    """Run entries; return 0 if every row is at least as good as published, else 1.

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
            rows = _run(entry, out, workers or default_workers(), bar)
            bar.advance(whole)
            results.append(
                {
                    "name": entry.name,
                    "ok": all(row.ok for row in rows),
                    "rows": [row.as_dict() for row in rows],
                }
            )
            if not as_json:
                _show(entry, rows, out)
    if as_json:
        print(json.dumps(results, indent=2))
    return 0 if all(result["ok"] for result in results) else 1


def _run(entry: Entry, out: Path, workers: int, bar: Progress) -> list[Row]:
    task = bar.add_task(entry.name, total=None)

    def announce(total: int, done: int) -> None:
        bar.update(task, total=total, completed=done)
        if not bar.console.is_terminal:  # a log shows no bar
            bar.console.print(f"{entry.name}: {done} of {total} runs", highlight=False)

    return entry.run(Bench(out / entry.name, workers, announce))


def _show(entry: Entry, rows: list[Row], out: Path) -> None:
    """Print an entry's rows: published, ours, the difference in magnitude, the verdict."""
    table = Table("case", "quantity", "published", "ours", "difference", "", title=entry.title)
    for row in rows:
        verdict = "ok" if row.ok else "[bold red]worse[/bold red]"
        if row.ok and not row.published:
            verdict = "shown"
        for key, ours in row.ours.items():
            published = row.published.get(key)
            known = published is not None
            table.add_row(
                row.case,
                key,
                f"{published:g}" if known else "",
                f"{ours:.3g}",
                f"{abs(ours) - abs(published):+.3g}" if published is not None else "",
                verdict,
            )
    console = Console()
    console.print(table)
    console.print(f"files: {out / entry.name}", highlight=False)
