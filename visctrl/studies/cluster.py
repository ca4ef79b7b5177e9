"""Work spread over a Dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import suppress
from typing import Any, TypeVar

from visctrl.hal.errors import DeviceError
from visctrl.robots.errors import InputError
from visctrl.runtime.summary import versions
from visctrl.studies.workers import Died, Results
from visctrl.threads import limit_all

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S = 10.0
#: How often a client greets a scheduler that mixes up its answer.
_GREETINGS = 3
#: Items under way at a time: enough for any cluster, and for workers that join later.
_WINDOW = 2000
_NO_MORE: Any = object()


class ClusterError(DeviceError):
    """The cluster went away in the middle of its work."""


class ClusterWorkers:
    """The workers of a Dask scheduler.

    One that dies is replaced by the others; an item that has outlived several workers is given
    up (Dask's ``distributed.scheduler.allowed-failures``).

    Parameters
    ----------
    address : str
        Of the scheduler, as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    InputError
        Dask is not installed, nothing answers, or a worker has other versions than this machine.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
            from distributed.comm import addressing
        except ImportError:
            raise InputError(
                "--cluster needs Dask's distributed: pip install 'visctrl[cluster]'"
            ) from None
        # Lost connections are reported below, in one line.
        logging.getLogger("distributed").handlers = [logging.NullHandler()]
        self._address = address
        try:
            # Checked here first: a client that fails on it takes long to give up.
            split: Any = addressing.get_address_host_port
            split(address)
            self._client = _connected(distributed.Client, address)
        except (OSError, TimeoutError, ValueError, TypeError, ImportError) as error:
            raise InputError(f"--cluster {address}: no Dask scheduler answers: {error}") from None
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
            _compare(address, self._client.run(_worker_versions, on_error="return"))
        except TimeoutError:
            self.close()
            raise InputError(
                f"--cluster {address}: the scheduler has no workers: start some with `dask worker "
                f"{address} --nthreads 1`"
            ) from None
        except BaseException:
            self.close()
            raise

    @property
    def count(self) -> int:
        """How many workers there are now."""
        return max(len(self._client.scheduler_info()["workers"]), 1)

    def close(self) -> None:
        """Let go of the scheduler; what is queued for this client is dropped."""
        self._client.close(timeout=CONNECT_S)

    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Results[T, R]:
        """Yield every item with its result (see `Workers`).

        Raises
        ------
        ClusterError
            The scheduler is gone.
        """
        from distributed.scheduler import KilledWorker

        executor = self._client.get_executor(pure=False)
        try:
            for item, future in _stream(lambda item: executor.submit(work, item), items):
                try:
                    result = future.result()
                except KilledWorker as error:
                    tried = error.allowed_failures + 1
                    yield item, Died(f"{tried} workers in a row died while they ran it")
                except CancelledError:
                    raise ClusterError(
                        f"the Dask scheduler at {self._address} is gone; what is finished is kept: "
                        "the same command goes on from there"
                    ) from None
                else:
                    yield item, result
        finally:
            executor.shutdown(wait=False)


def _stream(submit: Callable[[T], Future[R]], items: Iterable[T]) -> Iterator[tuple[T, Future[R]]]:
    """Yield items with their finished futures; never more than `_WINDOW` are under way.

    Items are taken only as they are submitted, so that there may be any number of them.
    """
    left = iter(items)
    running: dict[Future[R], T] = {}
    while True:
        while len(running) < _WINDOW and (item := next(left, _NO_MORE)) is not _NO_MORE:
            running[submit(item)] = item
        if not running:
            return
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield running.pop(future), future


def _worker_versions() -> dict[str, str]:
    """Return the versions on a worker, and keep it to one thread a run from here on."""
    limit_all()
    return versions()


def _connected(client: Any, address: str) -> Any:
    """Return a client of the scheduler at ``address``.

    A scheduler that is just then losing a worker says so in the message in which the client
    expects a greeting alone, and the client gives up: it has to ask again.
    """
    for _ in range(_GREETINGS - 1):
        with suppress(AssertionError):
            return client(address, timeout=CONNECT_S, set_as_default=False)
    return client(address, timeout=CONNECT_S, set_as_default=False)


def _compare(address: str, found: dict[str, Any]) -> None:
    """Raise `InputError` where a worker would compute with other software than is here."""
    for worker, theirs in found.items():
        if isinstance(theirs, Exception):
            raise InputError(
                f"--cluster {address}: worker {worker} cannot use visctrl: "
                f"{type(theirs).__name__}: {theirs}; install the same version there"
            )
        for name, ours in versions().items():
            if theirs.get(name) != ours:
                raise InputError(
                    f"--cluster {address}: worker {worker} has {name} {theirs.get(name)}, here it "
                    f"is {ours}: results would depend on the worker"
                )
