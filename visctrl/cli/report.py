"""``visctrl report``: the page of a run made again, or several runs compared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from visctrl.viewers.report.comparison import write_comparison
from visctrl.viewers.report.run_report import write_report

COMPARISON = Path("comparison.html")


def report(runs: Sequence[Path], out: Path | None) -> int:
    """Write the page and print its path.

    Raises
    ------
    InputError
        A run cannot be read, or the page cannot be written.
    """
    if len(runs) == 1:
        print(write_report(runs[0], out))
    else:
        print(write_comparison(runs, out or COMPARISON))
    return 0
