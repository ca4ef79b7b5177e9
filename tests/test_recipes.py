"""The recipes of docs/design.md: each adds something without touching what is there."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

import visctrl.schemes.trifocal
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import Registries
from visctrl.runtime.session import run_session

GUIDE = Path(__file__).parent.parent / "docs" / "plugins.md"
#: What the guide's law may know of the project: contracts, the types they use, the estimate.
NEEDED = {"contracts", "hal.types", "robots.documents", "schemes.trifocal.estimate"}


@pytest.fixture
def law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The guide's law, put beside the scheme's own and named in its table."""
    text = GUIDE.read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert code is not None
    path = tmp_path / "law_polar.py"
    path.write_text(code[1], encoding="utf-8")
    folder = visctrl.schemes.trifocal
    monkeypatch.setattr(folder, "__path__", [*folder.__path__, str(tmp_path)])
    monkeypatch.setitem(folder.CONTROLLERS, "trifocal-polar", "law_polar:Polar")
    monkeypatch.delitem(sys.modules, "visctrl.schemes.trifocal.law_polar", raising=False)
    return path


def test_a_law_takes_its_file_and_a_row_in_its_scheme(law: Path) -> None:
    registries = Registries()
    assert registries.controllers.target("trifocal-polar").endswith("trifocal.law_polar:Polar")
    chosen = [parse_setting(text) for text in ("backend=mock", "controller.name=trifocal-polar")]
    loaded = load_scenario("default", chosen, registries.backends.names())
    summary = run_session(make_plan(loaded, registries)).summary
    assert summary["status"] == "reached", summary["reason"]


def test_a_law_needs_three_files_to_be_understood(law: Path) -> None:
    """The contracts, the estimate that it accepts, and a law to begin from."""
    imported = re.findall(r"^from visctrl\.(\S+) import", law.read_text(encoding="utf-8"), re.M)
    assert set(imported) <= NEEDED
