"""What README and docs name exists: links, files, modules, entries, studies, commands, options."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer

from visctrl.cli.main import app
from visctrl.reproduce.catalogue import ENTRIES

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
FOLDERS = "visctrl|hal|sim|robots|configs|benchmarks|tests|docs"
#: Files that a reader makes by following a guide; NAME and the like stand for something.
MADE_BY_READERS = {"polar.py", "line.py", "rover.py", "law_NAME.py", "NAME.py"}
COMMAND_LINE = typer.main.get_command(app)

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def text_of(page: Path) -> str:
    """Return the page with continued lines joined."""
    return page.read_text(encoding="utf-8").replace("\\\n", " ")


def anchors(page: Path) -> set[str]:
    """Return the names under which GitHub links the page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def commands(page: Path) -> list[str]:
    """Return every ``visctrl ...`` that stands in a code span or a code block."""
    text = text_of(page)
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    indented = re.findall(r"^ {4}(.*)$", text, re.MULTILINE)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    lines = [line for block in (*blocks, *indented) for line in block.splitlines()] + spans
    found = (re.search(r"(?:^|[/\s])visctrl (.+)", re.sub(r"\s#.*", "", line)) for line in lines)
    return [match[1] for match in found if match]


def options(command: Any) -> set[str]:
    """Return the command's options, with those of the program and of its own commands."""
    parts = getattr(command, "commands", {}).values()
    own = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return own.union({"--help"}, *map(options, parts))


def missing(line: str) -> list[str]:
    """Return what a line of arguments names that the command line does not know."""
    command: Any = COMMAND_LINE
    words = line.split()
    while words and hasattr(command, "commands"):
        if words[0].startswith("-"):
            break
        if words[0] not in command.commands:
            return [words[0]]
        command = command.commands[words.pop(0)]
    known = options(command)
    wanted = (re.match(r"--?[a-z][a-z-]*", word) for word in words)
    return [match[0] for match in wanted if match and match[0] not in known]


@pages
def test_links_lead_to_files_and_headings(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        name, _, heading = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), target
        if heading:
            assert heading in anchors(file), target


@pages
def test_paths_exist(page: Path) -> None:
    named = re.findall(rf"(?<![\w/.-])((?:{FOLDERS})/[\w./*-]*)", page.read_text(encoding="utf-8"))
    for path in (each.rstrip(".") for each in named):
        if Path(path).name not in MADE_BY_READERS:
            assert list(ROOT.glob(path.rstrip("/"))), path


@pages
def test_files_named_without_their_folder_exist(page: Path) -> None:
    here = {file.name for folder in FOLDERS.split("|") for file in (ROOT / folder).rglob("*.py")}
    named = re.findall(r"`(?:[\w/]*/)?(\w+\.py)`", page.read_text(encoding="utf-8"))
    assert set(named) - MADE_BY_READERS <= here


@pages
def test_modules_exist(page: Path) -> None:
    groups = {"perception", "estimators", "controllers", "obstacles", "backends", "robots"}
    for name in re.findall(r"\bvisctrl(?:\.\w+)+", page.read_text(encoding="utf-8")):
        if name.removeprefix("visctrl.") in groups:
            continue
        module, _, attribute = name.rpartition(".")
        parent = __import__(module, fromlist=[attribute])
        is_package = hasattr(parent, "__path__")
        assert hasattr(parent, attribute) or (is_package and find_spec(name)), name


@pages
def test_commands_and_their_options_exist(page: Path) -> None:
    for line in commands(page):
        assert not missing(line), f"visctrl {line}"


@pages
def test_options_named_alone_belong_to_some_command(page: Path) -> None:
    known = options(COMMAND_LINE)
    for name in re.findall(r"`(--[a-z][a-z-]*)[^`\n]*`", page.read_text(encoding="utf-8")):
        assert name in known, name


@pages
def test_entries_and_studies_exist(page: Path) -> None:
    studies = {file.stem for file in (ROOT / "configs" / "studies").glob("*.yaml")}
    for line in commands(page):
        command, *words = line.split()
        names = [word for word in words if re.fullmatch(r"[a-z][\w.-]*", word)]
        if command == "reproduce":
            assert set(names) <= set(ENTRIES), line
        elif command == "study" and names and not names[0].endswith(".yaml"):
            assert names[0] in studies, line


def test_a_page_is_read_as_it_is_written(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("`visctrl run --no-such 1` and\n\n    visctrl drvie  # moves\n", "utf-8")
    assert [missing(line) for line in commands(page)] == [["drvie"], ["--no-such"]]
