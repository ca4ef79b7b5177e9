"""Work spread over processes of this machine, which may die without taking the rest along."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeVar

from visctrl.threads import ONE_THREAD, limit_all

T = TypeVar("T")
R = TypeVar("R")

_NO_MORE: Any = object()


@dataclass(frozen=True)
class Died:
    """What comes of an item whose worker died, and died again when it was repeated."""

    reason: str


class WorkerStoppedError(Exception):
    """Somebody stopped a worker in the middle of an item."""


#: Items with their results; closing it gives up what is under way.
Results = Generator[tuple[T, R | Died], None, None]


class Workers(Protocol):
    """Somewhere to work."""

    @property
    def count(self) -> int:
        """How many items are worked on at a time."""
        ...

    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Results[T, R]:
        """Yield every item with its result, in the order in which they are done.

        ``work`` is importable by name. What it raises is raised here.
        """
        ...


class LocalWorkers:
    """Processes of this machine.

    A worker that dies breaks its pool, and nobody knows which item killed it. Those that were
    under way are therefore repeated alone, each in a process of its own; one that dies again is
    to blame.

    Parameters
    ----------
    count : int
        Processes at a time.
    """

    def __init__(self, count: int) -> None:
        self._count = count

    @property
    def count(self) -> int:
        """How many processes there are at a time."""
        return self._count

    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Results[T, R]:
        """Yield every item with its result (see `Workers`)."""
        left = iter(items)
        while True:
            suspects: list[T] = []
            with _pool(self._count) as pool:
                fresh = _until(suspects, left)
                for item, future in stream(_submitter(pool, work), fresh, lambda: self._count):
                    try:
                        result = future.result()
                    except (BrokenProcessPool, WorkerStoppedError):
                        suspects.append(item)
                    else:
                        yield item, result
            if not suspects:
                return
            yield from _one_by_one(work, suspects)


def stream(
    submit: Callable[[T], Future[R]], items: Iterable[T], window: Callable[[], int]
) -> Iterator[tuple[T, Future[R]]]:
    """Yield items with their finished futures; never more than ``window()`` are under way.

    Items are taken only as they are submitted, so that there may be any number of them.
    """
    left = iter(items)
    running: dict[Future[R], T] = {}
    while True:
        while len(running) < window() and (item := next(left, _NO_MORE)) is not _NO_MORE:
            running[submit(item)] = item
        if not running:
            return
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield running.pop(future), future


def default_workers() -> int:
    """Return how many processes go side by side: one for each core that this one may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _until(stop: Sized, items: Iterator[T]) -> Iterator[T]:
    """Yield items as long as ``stop`` is empty."""
    while not len(stop) and (item := next(items, _NO_MORE)) is not _NO_MORE:
        yield item


def _one_by_one(work: Callable[[T], R], items: Iterable[T]) -> Results[T, R]:
    """Yield items with their results; nothing else is under way beside each."""
    left = deque(items)
    while left:
        with _pool(1) as pool:
            submit, alive = _submitter(pool, work), True
            while left and alive:
                item = left.popleft()
                result: R | Died
                try:
                    result = submit(item).result()
                except BrokenProcessPool:
                    alive = False
                    result = Died("its process died, and again when the run was repeated alone")
                except WorkerStoppedError as error:
                    result = Died(f"{error}, and again when the run was repeated alone")
                yield item, result


def _submitter(pool: ProcessPoolExecutor, work: Callable[[T], R]) -> Callable[[T], Future[R]]:
    def submit(item: T) -> Future[R]:
        try:
            with _signals_held_back():
                return pool.submit(work, item)
        except BrokenProcessPool as error:
            broken: Future[R] = Future()
            broken.set_exception(error)
            return broken

    return submit


@contextmanager
def _pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool; when the context is left in a hurry, its processes end at once."""
    # Spawned, not forked: a forked child would share PyBullet's and OpenCV's threads and locks.
    spawn = multiprocessing.get_context("spawn")
    theirs, ours = spawn.Pipe(duplex=False)
    with closing(theirs), closing(ours), _environment():
        pool = ProcessPoolExecutor(
            count, mp_context=spawn, initializer=_begin_worker, initargs=(theirs,)
        )
        try:
            yield pool
        except BaseException:
            ours.close()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()


@contextmanager
def _environment() -> Iterator[None]:
    """Have processes started in this context keep to one thread from their first import on."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Have a process started in this context never see Ctrl-C: it is this one's to handle."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker(lifeline: Connection) -> None:
    """Prepare a worker: one thread, nothing on stdout, and an end when its parent ends."""
    limit_all()
    # C libraries greet on stdout, which is for results.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    threading.Thread(target=_outlive, args=(lifeline,), name="lifeline", daemon=True).start()


def _outlive(lifeline: Connection) -> None:
    """End this process when the other end of the lifeline is closed, by will or by death."""
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)
