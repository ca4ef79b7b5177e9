"""PyBullet neither talks nor ends the process."""

import os
import subprocess
import sys

import pytest

from visctrl.hal.errors import InputError
from visctrl.sim.world import engine


def test_native_output_is_discarded_and_python_output_kept(
    capfd: pytest.CaptureFixture[str],
) -> None:
    print("before")
    with engine.hushed():
        os.write(1, b"native chatter\n")
        os.write(2, b"native complaint\n")
    print("after", file=sys.stderr)
    out, err = capfd.readouterr()
    assert (out, err) == ("before\n", "after\n")


def test_importing_and_connecting_is_silent() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import visctrl.sim.world.engine as e; e.disconnect(e.connect())"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.skipif(sys.platform != "linux", reason="displays are named by DISPLAY on X11 only")
def test_without_a_display_the_window_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":9876")
    with pytest.raises(InputError, match="run without --gui"):
        engine.connect_window()


def test_disconnecting_twice_is_harmless() -> None:
    client = engine.connect()
    engine.disconnect(client)
    engine.disconnect(client)
