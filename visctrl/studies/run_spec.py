"""A run as a value: what a study, an entry of ``visctrl reproduce`` and a worker pass around."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from visctrl.runtime.plan import Plan
    from visctrl.runtime.run_directory import RunDirectory


@dataclass(frozen=True)
class RunSpec:
    """One run.

    scenario : built-in name or path, or the keys themselves.
    settings : what is laid over it, each as ``--set`` takes it.
    out : run directory, or None to keep only the summary.
    index, cell : its place in the study's table, and the number of its cell.
    values : what is its own in the study, by dotted key, the seed included.
    key : digest of everything that its result depends on, to know it again in a later call.
    """

    scenario: str | Mapping[str, Any]
    settings: tuple[str, ...] = ()
    out: Path | None = None
    index: int = 0
    cell: int = 0
    values: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""

    def plan(self) -> Plan:
        """Return the plan of the run.

        Raises
        ------
        InputError
            The scenario or a setting cannot be used.
        """
        from visctrl.runtime.config import load_scenario, parse_setting, scenario_from
        from visctrl.runtime.plan import make_plan
        from visctrl.runtime.registry import REGISTRIES

        laid = [parse_setting(text) for text in self.settings]
        backends = REGISTRIES.backends.names()
        if isinstance(self.scenario, str):
            return make_plan(load_scenario(self.scenario, laid, backends))
        name = f"run {self.index} of the study"
        return make_plan(scenario_from(self.scenario, name, laid, backends))

    def directory(self) -> RunDirectory | None:
        """Return where the run's files go: those of the same run, made earlier, are replaced.

        Raises
        ------
        InputError, DiskError
            The directory holds something else, or cannot be written to.
        """
        from visctrl.runtime.run_directory import RunDirectory

        return None if self.out is None else RunDirectory(self.out, overwrite=True)

    def command(self) -> str:
        """Return the command that makes this run alone; for one whose scenario has a name."""
        words = ["visctrl run", *(f"--set {_quoted(text)}" for text in self.settings)]
        if self.scenario != "default":
            words.insert(1, str(self.scenario))
        return " ".join(words)


def _quoted(text: str) -> str:
    return f"'{text}'" if set(text) & set(" {}[]'") else text
