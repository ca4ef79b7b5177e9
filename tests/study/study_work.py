"""Work for worker processes, importable by name; it does little and dies on demand."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path


def squared(number: int) -> int:
    return number * number


def squared_unless_13(number: int) -> int:
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def squared_at_second_try(task: tuple[int, str]) -> int:
    """Die the first time; the file remembers it."""
    number, name = task
    mark = Path(name)
    if not mark.exists():
        mark.touch()
        os._exit(3)
    return number * number


def squared_then_dying(number: int) -> int:
    threading.Timer(0.02, os._exit, (3,)).start()
    return number * number


def a_lambda(number: int) -> object:
    return lambda: number


def held_back(number: int) -> bool:
    """Return whether a signal would wait."""
    return number in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def raising(number: int) -> int:
    raise ValueError(f"{number} is no good")


def environment(names: list[str]) -> list[str | None]:
    return [os.environ.get(name) for name in names]


def origin(modules: tuple[str, ...]) -> tuple[int, list[str]]:
    """Return how many threads the process has that this one is forked from, and what is there.

    That is, which of the modules were imported before this worker got anything to do.
    """
    status = Path(f"/proc/{os.getppid()}/status").read_text()
    threads = next(line for line in status.splitlines() if line.startswith("Threads:"))
    return int(threads.split()[1]), [name for name in modules if name in sys.modules]


def printing(number: int) -> int:
    os.write(1, b"a library says hello\n")
    return number


def sleeping(task: tuple[int, str]) -> int:
    """Say that it is under way, and stay so; number 0 returns once another one is."""
    number, folder = task
    while number == 0 and not any(Path(folder).iterdir()):
        time.sleep(0.01)
    if number:
        (Path(folder) / str(os.getpid())).touch()
        time.sleep(60.0)
    return number
