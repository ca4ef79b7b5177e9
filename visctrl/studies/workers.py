"""Work spread over processes of this machine, which may die without taking the rest along."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar, cast

from visctrl.threads import ONE_THREAD, limit_all

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

T = TypeVar("T")
R = TypeVar("R")

_NO_MORE: Any = object()
#: A process that is at work in a C library may need this long to see that it is to end (s).
_PARTING_S = 2.0
#: What most runs need, imported once for all workers. None of it may start a thread: OpenCV and
#: PyBullet are left to the workers that need them, and SciPy takes too long for the others.
PRELOADED = (
    "visctrl.hal.mock.backend",
    "visctrl.schemes.epipolar.law_smooth",
    "visctrl.schemes.approach.law",
    "visctrl.schemes.trifocal.law_smc",
    "visctrl.schemes.epipolar.estimator",
    "visctrl.schemes.approach.estimator",
    "visctrl.schemes.trifocal.estimator",
    "visctrl.studies.batch",
    "visctrl.studies.runner",
    "visctrl.perception.features",
)


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
    """Processes of this machine, each with one item at a time.

    An item whose process dies is repeated at the end, alone; one that kills its process again is
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
        suspects: list[T] = []
        with closing(_spread(work, items, self._count)) as results:
            for item, result in results:
                if isinstance(result, Died):
                    suspects.append(item)
                else:
                    yield item, result
        with closing(_spread(work, suspects, 1)) as results:
            for item, result in results:
                if isinstance(result, Died):
                    result = Died(f"{result.reason}, and again when the run was repeated alone")
                yield item, result


def _spread(work: Callable[[T], R], items: Iterable[T], count: int) -> Results[T, R]:
    """Yield every item with what came of it at the first try."""
    left = iter(items)
    busy: dict[Connection, tuple[_Worker, T]] = {}
    with ExitStack() as crew:

        def engage(worker: _Worker | None = None) -> bool:
            """Give a worker, or a new one, the next item; return False if there is none."""
            item = next(left, _NO_MORE)
            if item is _NO_MORE:
                return False
            if worker is None or not worker.begin(work, item):
                worker = crew.enter_context(_Worker())
                worker.begin(work, item)
            busy[worker.pipe] = worker, item
            return True

        while len(busy) < count and engage():
            pass
        while busy:
            for pipe in wait(list(busy)):
                worker, item = busy.pop(cast(Connection, pipe))
                result: R | Died = worker.result()
                # Before anybody looks at the result, which takes its time.
                engage(None if isinstance(result, Died) else worker)
                yield item, result


class _Worker:
    """A process that works on one item after the other.

    Used as a context; it ends when that is left, or when this process ends, whatever it is at.
    """

    def __init__(self) -> None:
        context = _context()
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, dict(os.environ)))
        with closing(theirs), _environment(), _signals_held_back():
            self._process.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.pipe.close()
        self._process.join(_PARTING_S)

    def begin(self, work: Callable[[T], R], item: T) -> bool:
        """Hand over an item; return False if the process has died."""
        try:
            self.pipe.send((work, item))
        except OSError:
            return False
        return True

    def result(self) -> Any:
        """Return what came of the item handed over last, and raise what ``work`` has raised."""
        try:
            fine, result = self.pipe.recv()
        except (EOFError, OSError):
            return Died("its process died")
        if isinstance(result, WorkerStoppedError):
            return Died(str(result))
        if not fine:
            raise result
        return result


def begin_early() -> None:
    """Begin to import what workers need, beside what this process does before it needs them."""
    _context()


def default_workers() -> int:
    """Return how many processes go side by side: one for each core that this one may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _context() -> ForkServerContext | SpawnContext:
    """Return how workers are made.

    Not forked from this process: they would share PyBullet's and OpenCV's threads and locks. On
    Linux they are forked from a server that has imported what runs need and has one thread;
    elsewhere each starts from nothing.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver, resource_tracker

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
    # Starting it lets signals through again.
    resource_tracker.ensure_running()
    # The server must find the modules that this process would find.
    path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    with _environment(PYTHONPATH=path, PYTHONSAFEPATH="1"), _signals_held_back():
        forkserver.ensure_running()
    return context


@contextmanager
def _environment(**more: str) -> Iterator[None]:
    """Have processes started in this context keep to one thread from their first import on."""
    changes = {**ONE_THREAD, **more}
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
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


def _serve(pipe: Connection, environment: dict[str, str]) -> None:
    """Work on what comes through the pipe: one thread, and nothing on stdout."""
    # What this process is forked from may be older than the environment.
    os.environ.clear()
    os.environ.update(environment)
    limit_all()
    # C libraries greet on stdout, which is for results.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    orders: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(pipe, orders), name="lifeline", daemon=True).start()
    while True:
        order = orders.get()
        try:
            work, item = pickle.loads(order)
            answer = ForkingPickler.dumps((True, work(item)))
        except Exception as error:
            error.add_note(f"In a worker:\n{traceback.format_exc()}")
            answer = ForkingPickler.dumps((False, error))
        pipe.send_bytes(answer)


def _listen(pipe: Connection, orders: SimpleQueue[bytes]) -> None:
    """Pass on what comes through the pipe; end this process when its other end is closed."""
    try:
        while True:
            orders.put(pipe.recv_bytes())
    except (EOFError, OSError):
        os._exit(1)
