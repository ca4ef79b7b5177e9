"""A run directory is new or visibly ours, locked while it is used, and loses nothing."""

from __future__ import annotations

import json
import os
import resource
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from visctrl.robots.errors import DiskError, InputError
from visctrl.robots.files import owner_only, replacing, write_bytes, write_text, writing
from visctrl.runtime.plan import Plan
from visctrl.runtime.recorder import FILES
from visctrl.runtime.run_directory import MARKER, RunDirectory
from visctrl.viewers.run_pictures import run_with_pictures

MakePlan = Callable[..., Plan]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MARKER
    }


def earlier_run(folder: Path) -> dict[str, bytes]:
    """Make the directory of a run that has ended, with a file of the user's beside."""
    directory = RunDirectory(folder)
    for name in FILES:
        directory.write_text(name, f"earlier {name}")
    (folder / "images").mkdir()
    for name in ("000001.png", "target-0.png", "index.csv", "camera.yaml"):
        (folder / "images" / name).write_text(f"earlier {name}")
    directory.close()
    (folder / "notes.txt").write_text("the user's")
    (folder / "images" / "holiday.jpg").write_text("the user's")
    return contents(folder)


def test_a_directory_with_other_files_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "000001.png").write_text("mine")
    (tmp_path / "config.yaml").write_text("mine")
    before = contents(tmp_path)
    for overwrite in (False, True):
        with pytest.raises(InputError, match="not a run's"):
            RunDirectory(tmp_path, overwrite=overwrite)
    assert contents(tmp_path) == before
    assert not (tmp_path / MARKER).exists()


def test_an_earlier_run_is_replaced_only_when_asked_and_only_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    before = earlier_run(folder)
    with pytest.raises(InputError, match="--overwrite"):
        RunDirectory(folder)
    assert contents(folder) == before

    refused = RunDirectory(folder, overwrite=True)
    refused.write_text("config.yaml", "the new one")
    refused.discard()
    assert contents(folder) == before

    directory = RunDirectory(folder, overwrite=True)
    directory.write_text("config.yaml", "the new one")
    directory.close()
    assert contents(folder) == {
        "config.yaml": b"the new one",
        "notes.txt": b"the user's",
        "images/holiday.jpg": b"the user's",
    }


def test_files_set_aside_by_a_killed_run_come_back(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    before = earlier_run(folder)
    killed = RunDirectory(folder, overwrite=True)
    killed._unlock()  # as the system does
    assert contents(folder) != before
    with pytest.raises(InputError, match="--overwrite"):
        RunDirectory(folder)
    assert contents(folder) == before


def test_two_runs_cannot_share_a_directory(tmp_path: Path) -> None:
    first = RunDirectory(tmp_path / "run")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="another run is writing there"):
            RunDirectory(tmp_path / "run", overwrite=overwrite)
    first.write_text("config.yaml", "first")
    first.close()
    assert contents(tmp_path / "run") == {"config.yaml": b"first"}
    names = [RunDirectory.numbered(tmp_path / "runs", "now").path.name for _ in range(3)]
    assert names == ["now", "now-2", "now-3"]


def test_a_refused_start_leaves_nothing_not_even_parents(tmp_path: Path) -> None:
    RunDirectory(tmp_path / "a" / "b" / "c").discard()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty").mkdir()
    RunDirectory(tmp_path / "empty").discard()
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.parametrize("name", ["file", "file/below", "x" * 300, "x" * 300 + "/y", "nul\0byte"])
def test_names_that_cannot_be_used_are_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"--out.*cannot be written"):
        RunDirectory(tmp_path / name)
    assert contents(tmp_path) == {"file": b"mine"}


def test_everything_is_its_owners_alone_unless_asked_otherwise(
    toy_plan: MakePlan, tmp_path: Path
) -> None:
    def modes(folder: Path) -> set[int]:
        return {stat.S_IMODE(path.stat().st_mode) for path in (folder, *folder.rglob("*"))}

    before = os.umask(0o022)
    try:
        run_with_pictures(toy_plan(), tmp_path / "mine", video=True)
        run_with_pictures(toy_plan(), RunDirectory(tmp_path / "ours", shared=True))
        assert os.umask(0o022) == 0o022, "what others create is theirs"
    finally:
        os.umask(before)
    assert modes(tmp_path / "mine") == {0o700, 0o600}
    assert modes(tmp_path / "ours") == {0o755, 0o644}


@contextmanager
def small_files(most: int) -> Iterator[None]:
    """Let no file grow beyond so many bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_is_full_ends_the_run_with_what_could_be_saved(
    toy_plan: MakePlan, tmp_path: Path
) -> None:
    plan = toy_plan({"controller.drive_s": 40.0, "duration_s": 60.0, "controller.v": 0.005})
    with small_files(80_000):
        outcome = run_with_pictures(plan, tmp_path / "run")
    assert outcome.exit_code == 3
    assert outcome.summary["status"] == "fault"
    assert "recording ended early" in outcome.summary["reason"]
    assert outcome.summary["ticks"] > 10
    kept = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert kept == outcome.summary
    assert (tmp_path / "run" / "ticks.csv").stat().st_size > 70_000
    assert (tmp_path / "run" / "final.png").exists()


def test_a_disk_that_is_full_from_the_start_is_told_before_anything_moves(
    toy_plan: MakePlan, tmp_path: Path
) -> None:
    with small_files(1000), pytest.raises(DiskError, match="--out"):
        run_with_pictures(toy_plan(), tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_verdict_whose_record_is_lost_is_no_success(
    toy_plan: MakePlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: RunDirectory, summary: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RunDirectory, "write_summary", full)
    outcome = run_with_pictures(toy_plan(), tmp_path / "run")
    assert outcome.summary["status"] == "reached"
    assert outcome.exit_code == 3
    assert any("No space left" in note for note in outcome.notes)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(old=st.binary(max_size=64), new=st.binary(min_size=1, max_size=4096))
def test_a_file_is_the_old_one_or_the_new_one(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(old)
    with small_files(len(new) - 1), pytest.raises(DiskError), writing(path):
        write_bytes(path, new)
    assert path.read_bytes() == old
    write_bytes(path, new)
    assert path.read_bytes() == new
    assert os.listdir(tmp_path) == ["file"]


def test_a_long_name_can_be_replaced_and_a_failure_leaves_no_draft(tmp_path: Path) -> None:
    long = tmp_path / ("x" * 255)
    write_text(long, "ü\udcff")
    with pytest.raises(IsADirectoryError), replacing(long) as fresh:
        fresh.parent.write_text("this cannot be written")
    assert long.read_bytes() == "ü\\udcff".encode()
    assert os.listdir(tmp_path) == [long.name]
    with owner_only():
        write_text(long, "")
    assert stat.S_IMODE(long.stat().st_mode) == 0o600
