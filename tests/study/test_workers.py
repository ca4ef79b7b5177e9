"""Worker processes: order, death, and what they inherit."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
import study_work

from visctrl.experiments.workers import Died, LocalWorkers
from visctrl.threads import ONE_THREAD

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def alive(pid: int) -> bool:
    """Return whether a process runs (one that waits for its parent to take note does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def gone(pids: list[int], within_s: float = 20.0) -> bool:
    deadline = time.monotonic() + within_s
    while any(map(alive, pids)):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def test_every_item_comes_once_with_its_result() -> None:
    done = sorted(LocalWorkers(2).each(study_work.squared, range(20)))
    assert done == [(n, n * n) for n in range(20)]


def test_an_item_that_kills_its_worker_is_named_and_the_others_are_done() -> None:
    done = dict(LocalWorkers(2).each(study_work.squared_unless_13, range(10, 18)))
    assert isinstance(done.pop(13), Died)
    assert done == {n: n * n for n in range(10, 18) if n != 13}


def test_an_item_whose_worker_dies_once_is_repeated(tmp_path: Path) -> None:
    tasks = [(n, str(tmp_path / str(n))) for n in range(3)]
    done = dict(LocalWorkers(2).each(study_work.squared_at_second_try, tasks[:1]))
    assert done == {tasks[0]: 0}


def test_what_work_raises_is_raised() -> None:
    with pytest.raises(ValueError, match="7 is no good"):
        list(LocalWorkers(1).each(study_work.raising, [7]))


def test_workers_keep_to_one_thread_and_leave_the_callers_environment() -> None:
    before = dict(os.environ)
    names = list(ONE_THREAD)
    [(_, values)] = LocalWorkers(1).each(study_work.environment, [names])
    assert values == ["1"] * len(names)
    assert dict(os.environ) == before


def test_stdout_is_not_the_workers(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(LocalWorkers(1).each(study_work.printing, [1])) == [(1, 1)]
    assert capfd.readouterr().out == ""


def test_workers_of_a_killed_process_end(tmp_path: Path) -> None:
    code = (
        "import sys, study_work\n"
        "from visctrl.experiments.workers import LocalWorkers\n"
        "if __name__ == '__main__':\n"
        "    tasks = [(1, sys.argv[1]), (2, sys.argv[1])]\n"
        "    list(LocalWorkers(2).each(study_work.sleeping, tasks))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    marks = tmp_path / "marks"
    marks.mkdir()
    paths = os.pathsep.join(map(str, (ROOT, HERE)))
    parent = subprocess.Popen(
        [sys.executable, script, marks], env={**os.environ, "PYTHONPATH": paths}
    )
    deadline = time.monotonic() + 60.0
    while len(list(marks.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    pids = [int(mark.name) for mark in marks.iterdir()]
    assert len(pids) == 2
    parent.kill()
    parent.wait()
    assert gone(pids)


def test_closing_ends_what_is_under_way(tmp_path: Path) -> None:
    tasks = [(0, str(tmp_path)), (1, str(tmp_path))]
    with closing(LocalWorkers(2).each(study_work.sleeping, tasks)) as work:
        assert next(work) == (tasks[0], 0)
    [mark] = tmp_path.iterdir()
    assert gone([int(mark.name)])
