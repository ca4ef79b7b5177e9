"""The page of a run, the page that compares runs, and the command that makes them."""

from __future__ import annotations

import html
import html.parser
import json
import re
import shutil
import sys
from pathlib import Path

import pytest

from visctrl.cli.main import main
from visctrl.robots.errors import InputError
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.viewers.report.comparison import write_comparison
from visctrl.viewers.report.run_report import write_report
from visctrl.viewers.run_pictures import run_with_pictures

SHORT = ("backend=mock", "duration_s=3", "mock.noise_px=0.3")
SCHEMES = {
    "trifocal": ("T111 ± 2σ", "ξ1 ± 2σ"),
    "epipolar": ("e23 ± 2σ", "e12 ± 2σ"),
    "pose": ("x estimated", "error of the estimated position"),
}


def drive(directory: Path, *settings: str) -> Path:
    overrides = [parse_setting(text) for text in (*SHORT, *settings)]
    run_with_pictures(
        make_plan(load_scenario("default", overrides, REGISTRIES.backends.names())), directory
    )
    return directory


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One short run of each scheme."""
    folder = tmp_path_factory.mktemp("runs")
    extra = {"pose": ("camera.mount=front", "duration_s=6")}
    return {
        scheme: drive(folder / scheme, f"scheme={scheme}", *extra.get(scheme, ()))
        for scheme in SCHEMES
    }


class Tags(html.parser.HTMLParser):
    """Holds that every tag is closed, and collects what the page would load."""

    VOID = frozenset({"meta", "img", "br", "link", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def assert_whole(page: str) -> None:
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert all(link.startswith("data:") for link in tags.loads), "needs no other file"
    assert "nan" not in re.findall(r'd="[^"]*"', page)
    assert not re.search(r'd="[^"]*(nan|inf)', page)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_run_leaves_a_report_of_what_its_estimator_is(
    runs: dict[str, Path], scheme: str
) -> None:
    page = (runs[scheme] / "report.html").read_text()
    assert_whole(page)
    for words in (*SCHEMES[scheme], "time of a tick", "features", "Target view", "asked for"):
        assert words in page
    assert page.count("data:image/jpeg") == 3
    summary = json.loads((runs[scheme] / "summary.json").read_text())
    assert html.escape(summary["reason"]) in page
    assert f"visctrl run {runs[scheme]}" in page


def test_boxes_and_listed_obstacles_are_drawn_beside_the_path(tmp_path: Path) -> None:
    disc = "{x_m: 2.0, y_m: -1.0, radius_m: 0.2}"
    listed = f"obstacles=[{{name: listed, discs: [{disc}, {disc}]}}]"
    directory = drive(tmp_path / "run", "scheme=pose", "camera.mount=front", listed)
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert page.count('class="obstacle"') == 2
    settings = ("backend=sim", "duration_s=0.3", "sim.boxes=[{x_m: 1.5, y_m: -1.0}]")
    page = (drive(tmp_path / "sim", *settings) / "report.html").read_text(encoding="utf-8")
    assert page.count('class="obstacle"') == 1


def test_the_report_made_again_is_the_same(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["visctrl", "report", str(runs["pose"])])
    before = (runs["pose"] / "report.html").read_text()
    (runs["pose"] / "report.html").unlink()
    with pytest.raises(SystemExit) as caught:
        main()
    assert not caught.value.code
    assert (runs["pose"] / "report.html").read_text() == before
    write_report(runs["pose"], tmp_path / "else.html")
    assert (tmp_path / "else.html").read_text() == before


def test_a_run_on_the_configuration_in_the_report_is_the_same_run(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    loaded = load_scenario(str(runs["trifocal"]), [], REGISTRIES.backends.names())
    run_with_pictures(make_plan(loaded), tmp_path / "again")
    again, before = (
        json.loads((path / "summary.json").read_text())["final_error"]
        for path in (tmp_path / "again", runs["trifocal"])
    )
    assert again == before


def test_several_runs_are_compared(runs: dict[str, Path], tmp_path: Path) -> None:
    page = write_comparison(list(runs.values()), tmp_path / "c.html").read_text()
    assert_whole(page)
    for scheme in SCHEMES:
        assert f"</i>{scheme}</span>" in page
    different = page[page.index("Settings that differ") :]
    assert "camera.mount" in different
    assert "rate_hz" not in different


def test_runs_of_one_name_are_told_apart(runs: dict[str, Path], tmp_path: Path) -> None:
    for parent in ("a", "b"):
        shutil.copytree(runs["trifocal"], tmp_path / parent / "run")
    paths = [tmp_path / parent / "run" for parent in ("a", "b")]
    page = write_comparison(paths, tmp_path / "c.html").read_text()
    assert "a/run" in page
    assert "the same settings" in page
    with pytest.raises(InputError, match="named twice"):
        write_comparison([paths[0], paths[0]], tmp_path / "c.html")


def test_what_holds_no_run_is_refused(runs: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such run directory"):
        write_report(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"ticks\.csv is missing"):
        write_report(tmp_path)
    broken = shutil.copytree(runs["trifocal"], tmp_path / "broken")
    (broken / "summary.json").write_text("[]")
    with pytest.raises(InputError, match="not the summary"):
        write_report(broken)
    (broken / "summary.json").unlink()
    with pytest.raises(InputError, match="has the run ended"):
        write_report(broken)
    with pytest.raises(InputError, match="cannot be written"):
        write_report(runs["trifocal"], tmp_path / "no" / "such" / "folder.html")


def test_names_and_reasons_cannot_break_the_page(runs: dict[str, Path], tmp_path: Path) -> None:
    run = shutil.copytree(runs["epipolar"], tmp_path / "a<b>&'c")
    summary = json.loads((run / "summary.json").read_text())
    summary["reason"] = "<script>alert(1)</script>"
    (run / "summary.json").write_text(json.dumps(summary))
    (run / "fault.txt").write_text("Traceback: </pre><b>")
    page = write_report(run).read_text()
    assert_whole(page)
    assert "<script>alert" not in page


def test_a_run_without_truth_or_ticks_has_a_report(runs: dict[str, Path], tmp_path: Path) -> None:
    run = shutil.copytree(runs["trifocal"], tmp_path / "run")
    lines = (run / "ticks.csv").read_text().splitlines()
    hidden = [k for k, name in enumerate(lines[0].split(",")) if "_true" in name]
    blank = [lines[0]]
    for line in lines[1:5]:
        cells = line.split(",")
        blank.append(",".join("" if k in hidden else cell for k, cell in enumerate(cells)))
    (run / "ticks.csv").write_text("\n".join(blank) + "\n")
    page = write_report(run).read_text()
    assert "path by odometry" in page
    (run / "ticks.csv").write_text(lines[0] + "\n")
    assert_whole(write_report(run).read_text())
    write_comparison([run, runs["pose"]], tmp_path / "c.html")


def test_a_long_run_has_a_report_no_larger(runs: dict[str, Path], tmp_path: Path) -> None:
    run = shutil.copytree(runs["trifocal"], tmp_path / "run")
    header, *lines = (run / "ticks.csv").read_text().splitlines()
    cells = [line.split(",") for line in lines]
    t = header.split(",").index("t [s]")
    many = [
        ",".join([*row[:t], f"{0.1 * k:.1f}", *row[t + 1 :]])
        for k, row in ((k, cells[k % len(cells)]) for k in range(9_000))
    ]
    (run / "ticks.csv").write_text("\n".join([header, *many]) + "\n")
    assert write_report(run).stat().st_size < 3_000_000
