"""Studies: one scenario run many times over a grid, with random values, starts and seeds."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from visctrl.robots.documents import StrictModel, read_yaml, suggestion
from visctrl.robots.errors import InputError

#: A study is held in memory as a table; more runs than this are a mistake.
MAX_RUNS = 100_000
START_KEYS = ("start.x_m", "start.y_m", "start.phi_deg")

Bounds = tuple[float, float]


class Draw(StrictModel):
    """A value drawn anew for every run; exactly one of the distributions is named.

    uniform, log_uniform : (low, high). normal : (mean, standard deviation).
    integer : (low, high), both included. choice : values, each as likely.
    """

    uniform: Bounds | None = None
    log_uniform: Bounds | None = None
    normal: Bounds | None = None
    integer: tuple[int, int] | None = None
    choice: Annotated[list[Any], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Draw:
        named = [name for name in Draw.model_fields if getattr(self, name) is not None]
        if len(named) != 1:
            known = ", ".join(Draw.model_fields)
            raise ValueError(f"expected exactly one distribution of {known}")
        for bounds in (self.uniform, self.log_uniform, self.integer):
            if bounds is not None and bounds[0] > bounds[1]:
                raise ValueError(f"{named[0]}: the lower bound comes first")
        if self.log_uniform is not None and self.log_uniform[0] <= 0.0:
            raise ValueError("log_uniform: the bounds must be positive")
        if self.normal is not None and self.normal[1] < 0.0:
            raise ValueError("normal: a standard deviation is not negative")
        return self

    def value(self, rng: np.random.Generator) -> Any:
        """Return a fresh value."""
        if self.uniform is not None:
            return float(rng.uniform(*self.uniform))
        if self.log_uniform is not None:
            low, high = self.log_uniform
            return float(math.exp(rng.uniform(math.log(low), math.log(high))))
        if self.integer is not None:
            return int(rng.integers(*self.integer, endpoint=True))
        if self.choice is not None:
            return self.choice[int(rng.integers(len(self.choice)))]
        mean, deviation = self.normal or (0.0, 0.0)
        return float(rng.normal(mean, deviation))


class Span(StrictModel):
    """Evenly spaced values: (first, last, how many), on a linear or a logarithmic scale."""

    linear: tuple[float, float, Annotated[int, Field(ge=2)]] | None = None
    log: tuple[float, float, Annotated[int, Field(ge=2)]] | None = None

    @model_validator(mode="after")
    def _one(self) -> Span:
        if (self.linear is None) == (self.log is None):
            raise ValueError("expected a list, or {linear: [first, last, count]}, or {log: [...]}")
        if self.log is not None and min(self.log[:2]) <= 0.0:
            raise ValueError("log: first and last must be positive")
        return self

    def values(self) -> list[float]:
        """Return the values, first and last included exactly."""
        spaced = np.linspace if self.linear is not None else np.geomspace
        first, last, count = self.linear or self.log or (0.0, 0.0, 0)
        return [float(value) for value in spaced(first, last, count)]


def _axis(value: Any) -> Any:
    """Return the values of one key of the grid; a `Span` is written out."""
    return Span.model_validate(value).values() if isinstance(value, dict) else value


Axis = Annotated[list[Any], BeforeValidator(_axis), Field(min_length=1)]


class Study(StrictModel):
    """What to run. All keys in it are dotted scenario keys, as ``--set`` takes them.

    scenario : built-in name, or a file (beside the study's own).
    settings : values of every run.
    grid : lists of values; every combination is a cell.
    starts : starts (x m, y m, φ deg): one more axis of the grid.
    random : values drawn anew for every run.
    runs : runs of every cell, each with a seed of its own.
    seeds : these seeds in every cell, in place of ``runs``.
    seed : what seeds and drawn values come from.
    paired : the n-th run of every cell has the same seed and draws, so that cells differ in
        nothing but the grid; else all are independent.
    """

    title: str = ""
    scenario: str = "mock"
    settings: dict[str, Any] = Field(default_factory=dict)
    grid: dict[str, Axis] = Field(default_factory=dict)
    starts: Annotated[list[tuple[float, float, float]], Field(min_length=1)] | None = None
    random: dict[str, Draw] = Field(default_factory=dict)
    runs: Annotated[int, Field(ge=1, le=MAX_RUNS)] | None = None
    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    paired: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if not (self.grid or self.starts or self.random or self.runs or self.seeds):
            raise ValueError("nothing to run: give grid, starts, random, runs or seeds")
        if self.runs is not None and self.seeds is not None:
            raise ValueError("give 'runs' or 'seeds', not both")
        self._check_keys()
        if self.count > MAX_RUNS:
            raise ValueError(f"{self.count} runs are more than {MAX_RUNS}")
        for name, values in (*self.grid.items(), ("starts", self.starts), ("seeds", self.seeds)):
            if (twice := _repeated(values or ())) is not None:
                raise ValueError(f"{name}: {twice} is there twice")
        return self

    def _check_keys(self) -> None:
        keys = [*self.settings, *self.grid, *self.random, *(START_KEYS if self.starts else ())]
        for key in keys:
            if key == "seed":
                raise ValueError("'seed' of the runs comes from the study's own seed or seeds")
            if not all(key.split(".")):
                raise ValueError(f"'{key}' is not a dotted key, as in start.x_m")
        for one, other in itertools.combinations(keys, 2):
            if f"{one}.".startswith(f"{other}.") or f"{other}.".startswith(f"{one}."):
                raise ValueError(f"'{one}' and '{other}' set the same value: keep one of them")

    @property
    def repeats(self) -> int:
        """Runs of every cell."""
        return self.runs or len(self.seeds or (0,))

    @property
    def count(self) -> int:
        """Runs in all."""
        cells = math.prod(len(values) for values in self.grid.values())
        return cells * len(self.starts or (0,)) * self.repeats

    @property
    def varied(self) -> tuple[str, ...]:
        """Keys whose values differ from cell to cell, and then from run to run."""
        return (*self.grid, *(START_KEYS if self.starts else ()), *self.random)

    def cells(self) -> Iterator[dict[str, Any]]:
        """Yield what every cell sets, by key; the last axis changes fastest."""
        axes: list[Sequence[dict[str, Any]]] = [
            [{key: value} for value in values] for key, values in self.grid.items()
        ]
        if self.starts is not None:
            axes.append([dict(zip(START_KEYS, start, strict=True)) for start in self.starts])
        for combination in itertools.product(*axes):
            yield {key: value for part in combination for key, value in part.items()}

    def trial(self, cell: Mapping[str, Any], number: int) -> dict[str, Any]:
        """Return what one run of a cell sets, its seed included.

        It depends on the study's seed, the cell's own values and the run's number in it, and on
        nothing else: a study that is extended keeps the runs it had.
        """
        entropy = [self.seed, number, *([] if self.paired else _words(cell))]
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        seed = int(rng.integers(2**31)) if self.seeds is None else self.seeds[number]
        drawn = {key: draw.value(rng) for key, draw in self.random.items()}
        return {**cell, **drawn, "seed": seed}


def _words(cell: Mapping[str, Any]) -> list[int]:
    """Return entropy that tells a cell from any other: a digest of its values."""
    text = json.dumps(cell, sort_keys=True, default=str)
    return list(np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype=np.uint32).tolist())


def _repeated(values: Sequence[Any]) -> Any | None:
    """Return a value that is there twice, if any; None is not taken for one."""
    seen = set()
    for value in values:
        mark = value if isinstance(value, Hashable) else json.dumps(value, default=str)
        if mark in seen:
            return value
        seen.add(mark)
    return None


@cache
def study_names() -> tuple[str, ...]:
    """Return the names of the studies that this package holds."""
    files = _folder().iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def study_title(name: str) -> str:
    """Return the title of a built-in study."""
    return str(read_yaml(_folder() / f"{name}.yaml").get("title", ""))


def study_source(name: str) -> Path | Traversable:
    """Return the file of a study, given by name or path.

    Raises
    ------
    InputError
        It is neither a built-in study nor a path.
    """
    if name in study_names():
        return _folder() / f"{name}.yaml"
    path = Path(name)
    if path.suffix in {".yaml", ".yml"} or os.path.exists(path):
        return path
    raise InputError(f"unknown study '{name}'; {suggestion(name, study_names())}")


def _folder() -> Traversable:
    return resources.files("visctrl.configs") / "studies"
