"""Simulated time for code with threads: what takes seconds takes none, and always the same.

Threads take turns. One runs until it waits (sleeps, reads, takes a lock, joins); then the next
one that can go on does; if none can, time jumps to the first deadline. So nothing is ever late,
and how long a test says that something took does not depend on the machine.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

#: A thread that computes for so long (s, in truth) without waiting has gone astray.
_ASTRAY_S = 60.0


#: Shortest sleep (s): some time passes, however small the difference of two times is.
_TICK_S = 1e-9


class Abandoned(BaseException):
    """Raised in threads that are still there when the simulated time ends."""


@dataclass(eq=False)
class Task:
    """A thread: what it waits for, and the program that it belongs to."""

    program: str
    until: float = 0.0
    ready: Callable[[], bool] | None = None
    done: bool = False
    turn: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.turn.acquire()  # released when it is this task's turn


class VirtualTime:
    """Time that only passes while everybody waits, as a context.

    ``time`` and ``threading`` stand in for the modules of those names. Threads belong to the
    program of the thread that starts them, or to the one they are given; programs can be
    frozen and killed like processes.
    """

    #: Whether it has ended: whoever still waits is only to unwind.
    over = False

    def __init__(self) -> None:
        self.now = 0.0
        self.time = _Time(self)
        self.threading = _Threading(self)
        self._me = threading.local()
        self._waiting: list[Task] = []
        self._out: set[str] = set()
        self._main: Task | None = None

    def __enter__(self) -> Self:
        self._me.task = self._main = Task("test")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let every thread that is left unwind."""
        self.over = True
        self._out.clear()
        while self._waiting:
            self.sleep(0.0)

    @property
    def program(self) -> str:
        """Program of the running thread."""
        return str(self._me.task.program)

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.wait(None, seconds)

    def wait(self, ready: Callable[[], bool] | None, seconds: float = math.inf) -> bool:
        """Wait until ``ready()``, or for so many seconds; return whether it is ready."""
        task: Task = self._me.task
        task.until, task.ready = self.now + max(_TICK_S, seconds), ready
        self._waiting.append(task)
        self._pass_on(task)
        return ready is not None and ready()

    def start(self, work: Callable[[], object], program: str) -> Task:
        """Run ``work`` in a thread of its own."""
        task = Task(program, until=self.now)
        self._waiting.append(task)
        threading.Thread(target=self._run, args=(task, work), daemon=True).start()
        return task

    def kill(self, program: str) -> None:
        """Let a program never run again: none of its threads, not even to clean up."""
        self._out.add(program)

    freeze = kill

    def thaw(self, program: str) -> None:
        """Let a frozen program go on."""
        self._out.remove(program)

    def _run(self, task: Task, work: Callable[[], object]) -> None:
        self._me.task = task
        _take(task)
        try:
            if not self.over:
                work()
        except Abandoned:
            pass
        finally:
            task.done = True
            self._next().turn.release()

    def _pass_on(self, task: Task) -> None:
        chosen = self._next()
        if chosen is not task:
            chosen.turn.release()
            _take(task)
        if self.over and task is not self._main:
            raise Abandoned

    def _next(self) -> Task:
        """Return the task whose turn it is, after letting time pass if nobody can go on."""
        able = [task for task in self._waiting if task.program not in self._out]
        for task in able:
            if self.over or task.until <= self.now or (task.ready is not None and task.ready()):
                break
        else:
            task = min(able, key=lambda task: task.until)
            assert task.until < math.inf, "everybody waits for somebody else"
            self.now = task.until
        self._waiting.remove(task)
        return task


def _take(task: Task) -> None:
    assert task.turn.acquire(timeout=_ASTRAY_S), "another thread does not give its turn away"


class _Time:
    """What is used of the module `time`."""

    def __init__(self, world: VirtualTime) -> None:
        self._world = world
        self.sleep = world.sleep

    def monotonic(self) -> float:
        return self._world.now

    perf_counter = monotonic


class _Threading:
    """What is used of the module `threading`."""

    current_thread = staticmethod(threading.current_thread)
    main_thread = staticmethod(threading.main_thread)

    def __init__(self, world: VirtualTime) -> None:
        self._world = world

    def Lock(self) -> _Lock:
        return _Lock(self._world)

    RLock = Lock

    def Event(self) -> _Event:
        return _Event(self._world)

    def Condition(self, lock: _Lock | None = None) -> _Condition:
        return _Condition(self._world, lock or _Lock(self._world))

    def Thread(self, *, target: Callable[..., object], **others: Any) -> _Thread:
        return _Thread(self._world, target, **others)


class _Thread:
    def __init__(
        self,
        world: VirtualTime,
        target: Callable[..., object],
        args: Sequence[object] = (),
        name: str = "",
        daemon: bool = False,
    ) -> None:
        self._world = world
        self._work = lambda: target(*args)
        self._task: Task | None = None

    def start(self) -> None:
        self._task = self._world.start(self._work, self._world.program)

    def is_alive(self) -> bool:
        return self._task is not None and not self._task.done

    def join(self, timeout: float = math.inf) -> None:
        self._world.wait(lambda: not self.is_alive(), timeout)


class _Lock:
    """Re-entrant, and a plain lock as far as correct programs can tell."""

    def __init__(self, world: VirtualTime) -> None:
        self._world = world
        self.owner: Task | None = None
        self.depth = 0

    def acquire(self) -> bool:
        me = self._world._me.task
        if self.owner is not me:
            self._world.wait(lambda: self.owner is None)
            self.owner = me
        self.depth += 1
        return True

    def release(self) -> None:
        if self.owner is not self._world._me.task:
            assert self._world.over, "released by another than its owner"
            return
        self.depth -= 1
        if self.depth == 0:
            self.owner = None

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *error: object) -> None:
        self.release()


class _Event:
    def __init__(self, world: VirtualTime) -> None:
        self._world = world
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def wait(self, timeout: float | None = None) -> bool:
        return self._world.wait(self.is_set, math.inf if timeout is None else timeout)


class _Condition(_Lock):
    def __init__(self, world: VirtualTime, lock: _Lock) -> None:
        super().__init__(world)
        self._lock = lock
        self._news = 0

    def acquire(self) -> bool:
        return self._lock.acquire()

    def release(self) -> None:
        self._lock.release()

    def wait(self, timeout: float | None = None) -> bool:
        seen, depth = self._news, self._lock.depth
        self._lock.owner, self._lock.depth = None, 0
        seconds = math.inf if timeout is None else timeout
        woken = self._world.wait(lambda: self._news > seen, seconds)
        self._lock.acquire()
        self._lock.depth = depth
        return woken

    def wait_for(self, ready: Callable[[], Any], timeout: float = math.inf) -> Any:
        deadline = self._world.now + timeout
        while not (result := ready()) and self._world.now < deadline:
            self.wait(deadline - self._world.now)
        return result

    def notify(self) -> None:
        self._news += 1

    notify_all = notify
