"""A Dask scheduler and two workers on loopback: the same table, also when one is killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import study_work
import yaml

from visctrl.robots.errors import InputError
from visctrl.runtime.interrupts import Interrupts
from visctrl.studies import cluster
from visctrl.studies.cluster import ClusterError, ClusterWorkers
from visctrl.studies.loading import load_study
from visctrl.studies.log import StudyLog
from visctrl.studies.runner import run_study, table_rows
from visctrl.studies.table import write_table
from visctrl.studies.workers import Died, LocalWorkers, Workers

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
STUDY = {
    "settings": {"duration_s": 1, "approach.enabled": False},
    "grid": {"mock.noise_px": [0, 1]},
    "runs": 10,
}


class Dask:
    """A scheduler and its workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        paths = os.pathsep.join(map(str, (ROOT, HERE)))
        # Two workers may die of an item before it is given up; the default is four.
        failures = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1"}
        self._environment = {**os.environ, "PYTHONPATH": paths, **failures}
        self._file = folder / "scheduler.json"
        options = ("--scheduler-file", str(self._file), "--no-dashboard", "--host", "127.0.0.1")
        self.scheduler = self._start("scheduler", *options, "--port", "0")
        wait_for(self._file.exists)
        self.address = json.loads(self._file.read_text())["address"]
        self.workers = [self._worker(name) for name in ("first", "second", "third")]

    def _worker(self, name: str) -> subprocess.Popen[bytes]:
        options = ("--name", name, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        folder = str(self._folder / name)
        return self._start("worker", self.address, *options, "--local-directory", folder)

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        log = (self._folder / f"{arguments[0]}.log").open("ab")
        command = [sys.executable, "-m", "dask", *arguments]
        with log:
            return subprocess.Popen(command, env=self._environment, stdout=log, stderr=log)


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    started = Dask(tmp_path)
    yield started
    started.stop()


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


def table(
    path: Path,
    folder: Path,
    workers: Workers,
    on_done: Callable[[int, float], None] = lambda *done: None,
) -> bytes:
    study = load_study(str(path))
    with StudyLog(folder) as log, Interrupts() as interrupts:
        died = run_study(study, log, workers, interrupts, on_done)
        [file, *_] = write_table(table_rows(study, log, died), folder)
    return file.read_bytes()


def test_a_cluster_gives_the_table_that_one_process_gives(
    tmp_path: Path, dask: Dask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One worker is killed on the way; then an item kills the others, and the scheduler goes."""
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(STUDY))
    expected = table(path, tmp_path / "here", LocalWorkers(1))

    def kill_one(done: int, simulated: float) -> None:
        if done == 5:
            dask.workers[0].kill()

    with closing(ClusterWorkers(dask.address)) as workers:
        assert table(path, tmp_path / "there", workers, kill_one) == expected
        assert dask.workers[0].wait() != 0

        with monkeypatch.context() as other:
            other.setattr(cluster, "versions", lambda: {"numpy": "0.1"})
            with pytest.raises(InputError, match=r"worker tcp://.* has numpy .*, here it is 0\.1"):
                ClusterWorkers(dask.address)

        [(_, result)] = workers.each(study_work.squared_unless_13, [13])
        assert isinstance(result, Died)

        threading.Timer(0.5, dask.scheduler.kill).start()
        with pytest.raises(ClusterError, match="is gone; what is finished is kept"):
            list(workers.each(study_work.squared, [1]))


def test_a_scheduler_that_mixes_up_its_greeting_is_asked_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that is losing a worker at that moment does."""
    answers: list[BaseException] = [AssertionError(), AssertionError(), TimeoutError("silence")]

    def client(address: str, **options: object) -> None:
        raise answers.pop(0)

    monkeypatch.setattr("distributed.Client", client)
    with pytest.raises(InputError, match="no Dask scheduler answers: silence"):
        ClusterWorkers("tcp://127.0.0.1:1")
    assert answers == []
