"""The renderer asked for draws or is refused; ``auto`` is the fastest that really draws."""

from collections.abc import Iterator

import numpy as np
import pytest

from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.sim.render import renderer_choice as drawers
from visctrl.sim.render.probe import answer
from visctrl.sim.render.renderer import Image, Renderer

pytestmark = pytest.mark.sim


@pytest.fixture(autouse=True)
def _undecided() -> Iterator[None]:
    drawers._fastest.cache_clear()
    yield
    drawers._fastest.cache_clear()


def say(monkeypatch: pytest.MonkeyPatch, **times: str | None) -> list[str]:
    """Make the probes give these answers; return the list of scripts that were run."""
    scripts: list[str] = []

    def said(script: str) -> str | None:
        scripts.append(script)
        return next((time for name, time in times.items() if f"'{name}'" in script), None)

    monkeypatch.setattr(drawers, "answer", said)
    return scripts


@pytest.mark.parametrize(
    ("times", "best"),
    [
        ({"gl": "9.2", "tiny": "70.1", "egl": "150"}, "gl"),
        ({"gl": "90.2", "tiny": "70.1", "egl": "5"}, "egl"),
        ({"gl": None, "tiny": "70.1", "egl": "150"}, "tiny"),
        ({"gl": None, "tiny": None, "egl": None}, "tiny"),
    ],
)
def test_auto_takes_the_fastest_and_says_why_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    times: dict[str, str | None],
    best: str,
) -> None:
    say(monkeypatch, **times)
    assert drawers.choose_drawer("auto") == best
    said = capsys.readouterr().err
    assert said.startswith(f"renderer: {best}, the fastest here (")
    assert said.count("\n") == 1
    for name, time in times.items():
        assert (f"{name} does not draw" if time is None else f"{name} {float(time):.0f} ms") in said


def test_auto_tries_each_once_only(monkeypatch: pytest.MonkeyPatch) -> None:
    scripts = say(monkeypatch, tiny="70")
    assert drawers.choose_drawer("auto") == drawers.choose_drawer("auto") == "tiny"
    assert len(scripts) == len(drawers.DRAWERS)


def test_what_does_not_work_is_refused_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawers, "egl_works", lambda: False)
    monkeypatch.setattr(drawers, "gl_problem", lambda: "no driver: install one")
    assert drawers.choose_drawer("tiny") == "tiny"
    with pytest.raises(InputError, match=r"renderer 'egl': PyBullet's .* install an EGL driver"):
        drawers.choose_drawer("egl")
    with pytest.raises(InputError, match=r"renderer 'gl': no driver: install one"):
        drawers.choose_drawer("gl")


@pytest.mark.parametrize("name", ["tiny", "gl"])
def test_a_typical_frame_is_timed_in_another_process(name: drawers.DrawerName) -> None:
    if problem := drawers.drawer_problem(name):
        pytest.skip(problem)
    code = f"from {drawers.__name__} import time_frame\ntime_frame({name!r})"
    said = answer(code)
    assert said is not None
    assert 0.1 < float(said) < 20e3


def test_a_renderer_that_shows_nothing_has_no_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Blank(Renderer):
        def render(self, pose: Pose, height_m: float) -> Image:
            return np.full((600, 800), 128, np.uint8)

        def place(self, item: str, at: Pose) -> None: ...

        def close(self) -> None: ...

    monkeypatch.setattr(drawers, "_open", lambda *_: Blank())
    drawers.time_frame("gl")
    assert capsys.readouterr().out == ""
