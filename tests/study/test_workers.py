"""Worker processes: order, death, and what they inherit."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import study_work

from visctrl.studies.workers import PRELOADED, Died, LocalWorkers, begin_early
from visctrl.threads import ONE_THREAD

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def alive(pid: int) -> bool:
    """Return whether a process runs (one that waits for its parent to take note does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
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
    with pytest.raises(ValueError, match="7 is no good") as caught:
        list(LocalWorkers(1).each(study_work.raising, [7]))
    assert "in raising" in "".join(caught.value.__notes__)


def test_a_result_that_cannot_be_sent_is_an_error() -> None:
    with pytest.raises((AttributeError, pickle.PicklingError), match=r"local|lambda"):
        list(LocalWorkers(1).each(study_work.a_lambda, [7]))


def test_workers_that_die_idle_are_replaced() -> None:
    """Each kills itself a moment after its answer, and the next item comes later."""

    def slowly() -> Iterator[int]:
        for number in range(6):
            yield number
            time.sleep(0.1)

    done = sorted(LocalWorkers(2).each(study_work.squared_then_dying, slowly()))
    assert done == [(n, n * n) for n in range(6)]


def test_workers_keep_to_one_thread_and_leave_the_callers_environment() -> None:
    before = dict(os.environ)
    names = list(ONE_THREAD)
    [(_, values)] = LocalWorkers(1).each(study_work.environment, [names])
    assert values == list(ONE_THREAD.values())
    assert dict(os.environ) == before


def test_workers_have_the_environment_of_the_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not that of the moment when the first of them was made."""
    name = "VISCTRL_TEST_OF_WORKERS"
    assert list(LocalWorkers(1).each(study_work.environment, [[name]])) == [([name], [None])]
    monkeypatch.setenv(name, "set since")
    assert list(LocalWorkers(1).each(study_work.environment, [[name]])) == [([name], ["set since"])]
    monkeypatch.delenv(name)
    assert list(LocalWorkers(1).each(study_work.environment, [[name]])) == [([name], [None])]


@pytest.mark.skipif(sys.platform != "linux", reason="workers start from nothing there")
def test_workers_are_forked_from_a_process_of_one_thread_that_has_imported_what_runs_need() -> None:
    begin_early()
    [(_, (threads, imported))] = LocalWorkers(1).each(study_work.origin, [PRELOADED])
    assert threads == 1
    assert imported == list(PRELOADED)


@pytest.mark.skipif(sys.platform != "linux", reason="workers start from nothing there")
def test_workers_are_made_of_the_modules_that_their_parent_would_import(tmp_path: Path) -> None:
    """A folder of the same name where the command is called is none of them."""
    (tmp_path / "here" / "hal").mkdir(parents=True)
    (tmp_path / "here" / "hal" / "__init__.py").write_text("raise SystemExit('the wrong one')\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import study_work\n"
        "from visctrl.studies.workers import LocalWorkers\n"
        "if __name__ == '__main__':\n"
        "    [(_, (_, imported))] = LocalWorkers(1).each("
        "study_work.origin, [('visctrl.hal.mock.backend',)])\n"
        "    print(imported)\n"
    )
    paths = os.pathsep.join(map(str, (ROOT, HERE)))
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path / "here",
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "['visctrl.hal.mock.backend']\n"
    assert done.stderr == ""


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
def test_ctrl_c_is_not_the_workers() -> None:
    [(_, held_back)] = LocalWorkers(1).each(study_work.held_back, [signal.SIGINT])
    assert held_back


def test_stdout_is_not_the_workers(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(LocalWorkers(1).each(study_work.printing, [1])) == [(1, 1)]
    assert capfd.readouterr().out == ""


def test_workers_of_a_killed_process_end(tmp_path: Path) -> None:
    code = (
        "import sys, study_work\n"
        "from visctrl.studies.workers import LocalWorkers\n"
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
