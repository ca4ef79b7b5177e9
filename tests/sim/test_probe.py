"""Probes fail in their own process only."""

import sys

import pytest

from visctrl.sim.render import probe


def test_a_probe_answers_among_chatter() -> None:
    assert probe.answer("print('chatter'); print('answer: 12'); print('more')") == "12"
    assert probe.works("print('answer: works')")
    assert not probe.works("print('answer: works not')")


@pytest.mark.parametrize(
    "script",
    [
        "import os; print('answer: works', flush=True); os._exit(1)",
        "import os; print('answer: works', flush=True); os.abort()",
        "raise SystemExit('no')",
        "print('works')",
    ],
)
def test_one_that_crashes_or_is_silent_has_no_answer(script: str) -> None:
    assert probe.answer(script) is None


def test_one_that_hangs_has_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_TIMEOUT_S", 0.2)
    assert probe.answer("import time; print('answer: works', flush=True); time.sleep(30)") is None


def test_a_probe_finds_the_modules_of_this_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("modules")
    (folder / "module_of_this_test.py").write_text("word = 'found'\n", encoding="utf-8")
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder)])
    assert (
        probe.answer("import module_of_this_test; print('answer:', module_of_this_test.word)")
        == "found"
    )
