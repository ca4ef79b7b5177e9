"""Any bytes as any file or request: taken, or refused in words (short form of a benchmark)."""

from __future__ import annotations

import importlib.util
import random
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from visctrl.robots.plain_yaml import YamlError, load_plain

Kinds = dict[str, Any]

PATH = Path(__file__).parents[2] / "benchmarks" / "hostile.py"
KINDS = (
    *("scenario", "study", "calibration, visctrl", "calibration, kalibr", "calibration, opencv"),
    *("calibration, ros", "calibration, camodocal", "calibration, basalt", "calibration, colmap"),
    *("target", "report, ticks.csv", "report, summary.json", "report, config.yaml"),
    *("replay, ticks.csv", "replay, images/index.csv", "study log", "HTTP request"),
    *(f"picture .{suffix}" for suffix in ("png", "jpg", "bmp", "tiff", "pgm")),
)


@pytest.fixture(scope="module")
def hostile() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hostile", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hostile"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def kinds(
    hostile: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    with hostile.kinds(tmp_path_factory.mktemp("hostile")) as found:
        assert found.keys() == set(KINDS)
        yield found


@pytest.mark.parametrize("name", KINDS)
def test_damaged_bytes(hostile: ModuleType, kinds: Kinds, name: str) -> None:
    kind = kinds[name]
    kind.take(kind.example)  # what is damaged has been good
    before = hostile.peak_mib()  # of the tests that ran in this process before
    rng = random.Random(name)
    for _ in range(40):
        data = hostile.mutated(kind.example, rng)
        assert hostile.check(kind, data) == "", data
    assert hostile.peak_mib() < max(hostile.MOST_MIB, before + 1.0)


@pytest.mark.parametrize("name", [name for name in KINDS if name != "HTTP request"])
def test_any_bytes(hostile: ModuleType, kinds: Kinds, name: str) -> None:
    @settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.binary(max_size=300))
    def holds(data: bytes) -> None:
        assert hostile.check(kinds[name], data) == ""

    holds()


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None)
@given(PLAIN)
def test_what_the_program_writes_as_yaml_it_reads_as_it_was(data: object) -> None:
    import yaml

    assert load_plain(yaml.safe_dump(data)) == data


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="{}[]&*!:-,?|>#'\"%@ \n\tab1.~<", max_size=60))
def test_yaml_is_refused_or_read_as_plain_values(text: str) -> None:
    def plain(value: object) -> bool:
        if isinstance(value, dict):
            return all(isinstance(key, str | int) and plain(value[key]) for key in value)
        if isinstance(value, list):
            return all(map(plain, value))
        return value is None or isinstance(value, str | int | float)

    with suppress(YamlError):
        assert plain(load_plain(text))
