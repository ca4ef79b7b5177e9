"""The entries of ``visctrl reproduce``, imported when they are run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from robots.documents import suggestion
from robots.errors import InputError
from visctrl.experiments.entry import Bench, Row


@dataclass(frozen=True)
class Entry:
    """A table or figure that one command makes again.

    where : ``module:function``; the function takes a `Bench` and returns rows.
    """

    name: str
    title: str
    where: str

    def run(self, bench: Bench) -> list[Row]:
        """Run the entry; its files go to ``bench.out``."""
        module, function = self.where.split(":")
        work: Callable[[Bench], list[Row]] = getattr(import_module(module), function)
        bench.out.mkdir(parents=True, exist_ok=True)
        return work(bench)


_ENTRIES = (
    Entry(
        "sim-starts",
        "48 seeded starts on rendered images, trifocal scheme (bounds are the project's own)",
        "visctrl.experiments.starts:starts",
    ),
    Entry(
        "sim-cameras",
        "every camera and both robots on rendered images (bounds are the project's own)",
        "visctrl.experiments.starts:cameras",
    ),
)
ENTRIES = {entry.name: entry for entry in _ENTRIES}


def entries_named(names: list[str]) -> list[Entry]:
    """Return entries by name; no name means all.

    Raises
    ------
    InputError
        An unknown name; the message lists the known ones.
    """
    for name in names:
        if name not in ENTRIES:
            raise InputError(f"unknown entry '{name}'; {suggestion(name, ENTRIES)}")
    return [ENTRIES[name] for name in names] if names else list(ENTRIES.values())
