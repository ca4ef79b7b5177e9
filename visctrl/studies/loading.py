"""The runs that a study asks for, each checked before any is started."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from visctrl.hal.interfaces import Backend
from visctrl.robots.documents import read_yaml, validate
from visctrl.robots.errors import InputError, VisctrlError
from visctrl.runtime.config import (
    Override,
    Start,
    overlaid,
    scenario_from,
    scenario_names,
    scenario_source,
)
from visctrl.runtime.pipeline import PluginError
from visctrl.runtime.plan import Chosen, Plan, make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.studies.grid import START_KEYS, Study, study_source
from visctrl.studies.run_spec import RunSpec


@dataclass(frozen=True)
class LoadedStudy:
    """A study, and where its parts came from.

    origin : file of the study. base, base_origin : its scenario's keys and file.
    """

    study: Study
    origin: str
    base: dict[str, Any]
    base_origin: str

    def runs(self) -> Iterator[RunSpec]:
        """Yield every run, cell by cell."""
        study = self.study
        files: dict[str, str] = {}
        for cell, values in enumerate(study.cells()):
            for number in range(study.repeats):
                own = study.trial(values, number)
                scenario = overlaid(self.base, self._overrides(own))
                index = cell * study.repeats + number
                yield RunSpec(
                    scenario,
                    index=index,
                    cell=cell,
                    values=own,
                    key=_digest(scenario, files),
                )

    def check(self, announce: Callable[[int, int], None] = lambda total, done: None) -> None:
        """Check every scenario that will be run: each cell, and each draw.

        Parameters
        ----------
        announce : callable
            Told how many checks there are and how many are done.

        Raises
        ------
        InputError
            The first that cannot be run, with file, key and value.
        """
        study = self.study
        each = study.repeats if study.random else 1
        total = study.count // study.repeats * each
        done = 0
        checked: set[str] = set()
        for values in study.cells():
            for number in range(each):
                own = study.trial(values, number)
                kind = _kind(own)
                if kind not in checked or not self._starts(own):
                    self._check_one(own)
                checked.add(kind)
                done += 1
                announce(total, done)

    def _starts(self, own: Mapping[str, Any]) -> bool:
        """Return whether start and seed of a run are fit for use, the rest of it being so."""
        scenario = overlaid(self.base, self._overrides(own))
        try:
            Start.model_validate(scenario.get("start", {}))
        except ValidationError:
            return False
        return True

    def _check_one(self, own: Mapping[str, Any]) -> None:
        overrides = self._overrides(own)
        backends = REGISTRIES.backends.names()
        loaded = scenario_from(self.base, self.base_origin, overrides, backends)
        plan = make_plan(loaded)
        if plan.scenario.realtime:
            where = loaded.origin_of("realtime")
            raise InputError(
                f"{where}: key 'realtime': a study runs as fast as it can: leave it out"
            )
        if plan.backend.teach is Backend.teach:
            raise InputError(
                f"{loaded.origin_of('backend')}: key 'backend': a study drives simulated robots "
                f"only, '{plan.scenario.backend}' is none"
            )
        try:
            _build_plugins(plan)
        except InputError as error:
            raise InputError(f"{self.origin}: {_short(own)}: {error}") from error

    def _overrides(self, own: Mapping[str, Any]) -> list[Override]:
        origins = dict.fromkeys(START_KEYS, f"{self.origin}: starts")
        origins |= dict.fromkeys(self.study.grid, f"{self.origin}: grid")
        origins |= dict.fromkeys(self.study.random, f"{self.origin}: random")
        everything = {**self.study.settings, **own}
        return [
            Override(tuple(key.split(".")), value, origins.get(key, f"{self.origin}: settings"))
            for key, value in everything.items()
        ]


def load_study(name: str) -> LoadedStudy:
    """Read a study by name or path, and the scenario it names; its runs are not checked yet.

    Raises
    ------
    InputError
        A file cannot be used; the message names it, the key and what was expected.
    """
    source = study_source(name)
    origin = str(source)
    study = validate(read_yaml(source), Study, origin)
    chosen = study.scenario
    if chosen not in scenario_names() and isinstance(source, Path):
        beside = source.parent / chosen
        if beside.suffix in {".yaml", ".yml"} or os.path.exists(beside):
            chosen = str(beside)
    try:
        scenario = scenario_source(chosen)
        base = read_yaml(scenario)
    except InputError as error:
        raise InputError(f"{origin}: key 'scenario': {error}") from error
    return LoadedStudy(study, origin, base, str(scenario))


def _build_plugins(plan: Plan) -> None:
    """Build the plugins as a run would: some look at more than their own options."""
    context = plan.context(lockstep=True)
    chosen: list[Chosen[Any]] = [plan.perception]
    for stage in (plan.approach, plan.main, plan.final):
        chosen += [] if stage is None else [stage.estimator, stage.controller]
    for choice in chosen:
        try:
            choice.build(context).close()
        except VisctrlError:
            raise
        except Exception as error:
            raise PluginError(f"{choice.kind} '{choice.name}'", error) from error


def _short(own: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in own.items())


def _kind(own: Mapping[str, Any]) -> str:
    """Return what sets a run's values apart from those of others, but for start and seed."""
    rest = {key: value for key, value in own.items() if key not in (*START_KEYS, "seed")}
    return json.dumps(rest, sort_keys=True, default=str)


def _digest(scenario: Mapping[str, Any], files: dict[str, str]) -> str:
    """Return the digest of a scenario and of the files it names; ``files`` keeps theirs."""
    named = [(scenario.get("camera") or {}).get("name"), (scenario.get("target") or {}).get("file")]
    for name in named:
        if isinstance(name, str) and name not in files:
            path = Path(name)
            content = path.read_bytes() if os.path.isfile(path) else b""
            files[name] = hashlib.sha256(content).hexdigest()
    contents = [files.get(name) for name in named if isinstance(name, str)]
    text = json.dumps([scenario, contents], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
