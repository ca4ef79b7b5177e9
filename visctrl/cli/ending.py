"""How the program ends: every error as one line on stderr and an exit code, never a traceback."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from types import FrameType
from typing import Any

import typer

from visctrl.cli.streams import standard_outlets

_INTERRUPTED = 130
_UNFORESEEN = 3
#: Exit codes up to here are results, which count only where they could be delivered.
_RESULT = 1


class Program(typer.core.TyperGroup):
    """A group of commands whose unforeseen errors are not taken for the user's wish to leave."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that is asked for."""
        try:
            return super().invoke(ctx)
        except (OSError, EOFError) as error:
            raise _UnforeseenError(error) from error


class _UnforeseenError(Exception):
    """Carries an error past Typer, which would end the program in its own way."""


class _Interruption:
    """Whether Ctrl-C was pressed: what it interrupts may turn it into any other error."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        raise KeyboardInterrupt


def run_program(program: Callable[[], object]) -> int:
    """Run a program to its end; return the exit code."""
    interruption = _Interruption()
    before = signal.signal(signal.SIGINT, interruption)
    try:
        with standard_outlets() as (out, _):
            code = _exit_code(program, interruption)
            out.flush()
            if out.lost is not None and code <= _RESULT:
                _tell(f"stdout: {out.lost.strerror or out.lost}")
                code = _UNFORESEEN
            return code
    finally:
        # Nothing is left but to end, which a second Ctrl-C must not disturb.
        signal.signal(signal.SIGINT, before)


def _exit_code(program: Callable[[], object], interruption: _Interruption) -> int:
    try:
        program()
    except SystemExit as ended:
        if interruption.came and ended.code == _INTERRUPTED:
            _tell("stopped by Ctrl-C")
        return ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) or interruption.came:
            _tell("stopped by Ctrl-C")
            return _INTERRUPTED
        return _told(error)
    return 0


def _told(error: BaseException) -> int:
    """Say what went wrong; return the exit code."""
    from visctrl.robots.errors import VisctrlError

    if isinstance(error, VisctrlError):
        _tell(str(error))
        return error.exit_code
    cause = error.__cause__ if isinstance(error, _UnforeseenError) else error
    assert cause is not None
    summary = str(cause).partition("\n")[0]
    _tell(f"internal error: {type(cause).__name__}: {summary}{_kept(cause)}")
    return _UNFORESEEN


def _kept(error: BaseException) -> str:
    """Write an error's details to a file; return where they are."""
    try:
        number, path = tempfile.mkstemp(prefix="visctrl-", suffix=".txt")
        with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as file:
            traceback.print_exception(error, file=file)
    except Exception:
        return ""
    return f" (details in {path})"


def _tell(text: str) -> None:
    """Print a message; what a file or a device has put into it cannot steer the terminal."""
    shown = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
    print(f"visctrl: {shown}", file=sys.stderr, flush=True)
