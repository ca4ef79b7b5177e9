"""Work for worker processes, importable by name; it does little and dies on demand."""

from __future__ import annotations

import os
import signal
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


def raising(number: int) -> int:
    raise ValueError(f"{number} is no good")


def environment(names: list[str]) -> list[str | None]:
    return [os.environ.get(name) for name in names]


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
