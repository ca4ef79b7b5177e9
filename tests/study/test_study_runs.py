"""Whole studies: the table, and what happens when workers or the study itself are killed."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml

from visctrl.cli.main import main
from visctrl.robots.errors import InputError
from visctrl.runtime.interrupts import Interrupts
from visctrl.studies.loading import LoadedStudy, load_study
from visctrl.studies.log import LOG, StudyLog
from visctrl.studies.runner import run_study, table_rows
from visctrl.studies.table import TABLE, write_table
from visctrl.studies.workers import LocalWorkers, Workers

ROOT = Path(__file__).parents[2]
#: Short runs that end for different reasons: too short a time, too few features, none in common.
#: One by one, so that there is something to interrupt.
STUDY: dict[str, Any] = {
    "title": "short runs",
    "settings": {"duration_s": 0.5, "approach.enabled": False},
    "grid": {"mock.noise_px": [0, 0.5, 1], "mock.features": [60, 2]},
    "random": {"start.x_m": {"uniform": [-0.5, 0.5]}, "start.phi_deg": {"normal": [0, 10]}},
    "runs": 3,
    "seed": 4,
}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "short.yaml"
    path.write_text(yaml.safe_dump(STUDY, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def undisturbed(file: Path) -> bytes:
    """The table of one worker whom nobody disturbs."""
    return table(load_study(str(file)), file.parent / "undisturbed", LocalWorkers(1))


def table(study: LoadedStudy, folder: Path, workers: Workers, on_done: Any = None) -> bytes:
    study.check()
    with StudyLog(folder) as log, Interrupts() as interrupts:
        died = run_study(study, log, workers, interrupts, on_done or (lambda *done: None))
        [path, *_] = write_table(table_rows(study, log, died), folder)
    return path.read_bytes()


def logged(folder: Path) -> list[str]:
    """Return the keys of the finished runs, in the order of their end."""
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)[1:]
    return [json.loads(line)["key"] for line in lines if line.endswith(b"\n")]


def run(arguments: list[str]) -> int:
    """Run the program in this process; return its exit code."""
    before = sys.argv
    sys.argv = ["visctrl", *arguments]
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = before
    return 0


def test_the_table_has_a_row_for_every_run(undisturbed: bytes) -> None:
    rows = list(csv.DictReader(undisturbed.decode().splitlines()))
    assert [int(row["run"]) for row in rows] == list(range(18))
    statuses = Counter((row["mock.features"], row["status"]) for row in rows)
    ended = {("60", "missed"): 9}
    assert statuses == {**ended, ("2", "refused"): 9}
    for row in rows:
        assert -0.5 <= float(row["start.x_m"]) <= 0.5
        assert (row["distance_cm"] == "") == (row["status"] == "refused")
        assert row["reason"]


def test_two_workers_one_of_them_killed_give_the_same_table(
    file: Path, tmp_path: Path, undisturbed: bytes
) -> None:
    killed = []

    def kill_one(done: int, simulated: float) -> None:
        if done >= 4 and not killed:
            victim = multiprocessing.active_children()[0]
            killed.append(victim)
            assert victim.pid is not None
            os.kill(victim.pid, signal.SIGKILL)

    study = load_study(str(file))
    assert table(study, tmp_path / "out", LocalWorkers(2), kill_one) == undisturbed
    assert len(killed) == 1
    assert set(Counter(logged(tmp_path / "out")).values()) == {1}


def test_a_killed_study_goes_on_where_it_was(
    file: Path, tmp_path: Path, undisturbed: bytes
) -> None:
    command = [sys.executable, "-m", "visctrl", "study", str(file), "--out", str(tmp_path)]
    study = subprocess.Popen([*command, "--workers", "1", "-q"], cwd=ROOT)
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        if (tmp_path / LOG).exists() and len(logged(tmp_path)) >= 3:
            break
        time.sleep(0.01)
    study.kill()
    study.wait()
    assert not (tmp_path / TABLE).exists()
    before = logged(tmp_path)
    assert 3 <= len(before) < 18
    with (tmp_path / LOG).open("ab") as log:  # as if killed in the middle of a line
        log.write(b'{"key": "0123')
    assert run(["study", str(file), "--out", str(tmp_path), "-q"]) == 0
    after = logged(tmp_path)
    assert after[: len(before)] == before
    assert len(after) == len(set(after)) == 18
    assert (tmp_path / TABLE).read_bytes() == undisturbed


def test_a_run_that_kills_its_worker_is_named_and_not_taken_for_finished(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By SIGKILL and by SIGTERM, which a run takes for the wish to end it."""
    path = tmp_path / "deadly.yaml"
    study = {
        "settings": {"approach.enabled": False, "controller.name": "study_plugins:Killer"},
        "grid": {"controller.number": [0, int(signal.SIGKILL), int(signal.SIGTERM)]},
    }
    path.write_text(yaml.safe_dump(study))
    assert run(["study", str(path), "--out", str(tmp_path), "--workers", "2", "-q"]) == 1
    errors = capfd.readouterr().err
    assert "run 1 failed: its process died, and again when" in errors
    assert "run 2 failed: stopped by SIGTERM, and again when" in errors
    rows = list(csv.DictReader((tmp_path / TABLE).read_text().splitlines()))
    assert [row["status"] for row in rows] == ["missed", "died", "died"]
    assert len(logged(tmp_path)) == 1


def test_ctrl_c_leaves_a_table_of_what_is_finished(
    file: Path, tmp_path: Path, undisturbed: bytes
) -> None:
    """The whole process group gets the signal, as from a terminal; nobody shows a traceback."""
    command = [sys.executable, "-m", "visctrl", "study", str(file), "--out", str(tmp_path)]
    study = subprocess.Popen(
        command, cwd=ROOT, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        if (tmp_path / LOG).exists() and len(logged(tmp_path)) >= 2:
            break
        time.sleep(0.01)
    os.killpg(study.pid, signal.SIGINT)
    _, errors = study.communicate(timeout=120.0)
    assert study.returncode == 130
    assert "Traceback" not in errors
    assert "stopped by Ctrl-C with" in errors
    finished = (tmp_path / TABLE).read_bytes().splitlines()
    assert len(finished) - 1 == len(logged(tmp_path)) < 18
    assert set(finished) <= set(undisturbed.splitlines())
    with StudyLog(tmp_path):
        pass  # the folder is free again


def test_json_is_all_that_is_on_stdout(
    file: Path, tmp_path: Path, undisturbed: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["study", str(file), "--out", str(out), "--workers", "1", "--json"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert Path(summary["table"]).read_bytes() == undisturbed
    assert (summary["runs"], summary["finished"], summary["died"]) == (18, 18, [])
    assert summary["statuses"] == {"missed": 9, "refused": 9}
    assert [cell["values"]["mock.features"] for cell in summary["cells"]] == [60, 2] * 3
    written = json.loads((out / "summary.json").read_text())
    assert written == {key: value for key, value in summary.items() if key != "table"}


def test_a_grown_study_runs_only_what_is_new(tmp_path: Path) -> None:
    path = tmp_path / "grows.yaml"
    settings = STUDY["settings"]
    for grid, runs, expected in (([1], 2, 2), ([0, 1], 3, 6)):
        study = {"settings": settings, "grid": {"mock.noise_px": grid}, "runs": runs}
        path.write_text(yaml.safe_dump(study))
        table(load_study(str(path)), tmp_path / "out", LocalWorkers(1))
        keys = logged(tmp_path / "out")
        assert len(keys) == len(set(keys)) == expected


def test_folders_of_others_are_refused(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    one = {"settings": {"mock.features": 2}, "runs": 1}
    path.write_text(yaml.safe_dump(one))
    table(load_study(str(path)), tmp_path, LocalWorkers(1))
    with pytest.raises(InputError, match=r"another study.*delete .*runs\.jsonl"):
        table(load_study(str(file)), tmp_path, LocalWorkers(1))
    with StudyLog(tmp_path), pytest.raises(InputError, match="another study is running in it"):
        table(load_study(str(path)), tmp_path, LocalWorkers(1))
    log = (tmp_path / LOG).read_text()
    (tmp_path / LOG).write_text(log.replace('"numpy": "', '"numpy": "0.'))
    with pytest.raises(InputError, match="made by numpy 0"):
        table(load_study(str(path)), tmp_path, LocalWorkers(1))
    (tmp_path / LOG).write_text("something else\n")
    with pytest.raises(InputError, match="not the log of a study"):
        table(load_study(str(path)), tmp_path, LocalWorkers(1))


def test_the_parquet_table_is_the_csv_table(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    rows = [
        {"run": 0, "mock.noise_px": 0, "title": "a", "x_cm": 0.1, "camera": None},
        {"run": 1, "mock.noise_px": 0.5, "title": 2, "x_cm": None, "camera": [1, 2]},
    ]
    csv_file, parquet = write_table(rows, tmp_path)
    found = pandas.read_parquet(parquet)
    assert found.equals(pandas.read_csv(csv_file))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["study", "nois"], "unknown study 'nois'; known: .*did you mean 'noise'"),
        (["study", "missing.yaml"], "missing.yaml: no such file"),
        (["study", "noise", "--cluster", "127.0.0.1:1"], "--cluster 127.0.0.1:1: no Dask"),
        (["study", "noise", "--cluster", "over there"], "--cluster over there: .*missing port"),
        (
            ["study", "noise", "--cluster", "host:1", "--workers", "2"],
            "a cluster has its own workers",
        ),
        (["study", "noise", "--out", "/dev/null/x"], "--out /dev/null/x: cannot be written"),
    ],
)
def test_what_cannot_be_used_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    if "--cluster" in arguments and "--workers" not in arguments:
        pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
        monkeypatch.setattr("visctrl.studies.cluster.CONNECT_S", 0.5)
    assert run([*arguments, "-q"]) == 2
    [line, *_] = [line for line in capfd.readouterr().err.splitlines() if "visctrl:" in line]
    assert re.search(message, line)
    assert not (tmp_path / "runs").exists()


def test_without_dask_the_command_that_installs_it_is_shown(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run(["study", "noise", "--cluster", "tcp://127.0.0.1:8786", "-q"]) == 2
    assert "pip install 'visctrl[cluster]'" in capfd.readouterr().err
