"""Those who watch a run from outside, by the options of ``visctrl run``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer
from visctrl.runtime.session import Outcome
from visctrl.runtime.stop import StopRequest

if TYPE_CHECKING:
    from visctrl.viewers.foxglove.stream import ViewerStream
    from visctrl.viewers.web.server import WebPage


@dataclass(frozen=True)
class Watching:
    """Who is to watch.

    web : address of the page, as the user wrote it; empty for the usual one, None for no page.
    live : address for the Foxglove app, likewise.
    mcap : write a file for it, too.
    """

    web: str | None = None
    live: str | None = None
    mcap: bool = False


class Watchers:
    """What watches a run, and the stop that some of it may ask for."""

    def __init__(self) -> None:
        self.observers: list[Observer] = []
        self.stop = StopRequest()
        self._pages: list[WebPage] = []
        self._streams: list[ViewerStream] = []

    def add_page(self, plan: Plan, address: str) -> WebPage:
        """Make the page; it is served once it is entered."""
        from visctrl.viewers.web.address import Address
        from visctrl.viewers.web.server import DEFAULT_PORT, OPTION, WebPage
        from visctrl.viewers.web.view import LiveView

        view = LiveView(plan)
        page = WebPage(view, self.stop, Address.parse(address, DEFAULT_PORT, OPTION))
        self.observers.append(view)
        self._pages.append(page)
        return page

    def add_stream(self, plan: Plan, address: str) -> ViewerStream:
        """Serve the Foxglove app from now on."""
        from visctrl.viewers.foxglove.stream import DEFAULT_PORT, ViewerStream
        from visctrl.viewers.web.address import Address

        option = "--live-address" if address else "--live"
        where = Address.parse(address, DEFAULT_PORT, option)
        stream = ViewerStream.to_viewers(plan, where.host, where.port, option)
        self.observers.append(stream)
        self._streams.append(stream)
        return stream

    def finish(self, outcome: Outcome) -> None:
        """Tell those who watch how the run ended."""
        for page in self._pages:
            page.finish(outcome.summary["status"], outcome.summary["reason"])
        for stream in self._streams:
            if stream.problem or stream.given_up:
                what = stream.problem or f"{stream.given_up} ticks were not shown"
                print(f"visctrl: --live: {what}", file=sys.stderr)


@contextmanager
def watchers(plan: Plan, watching: Watching) -> Iterator[Watchers]:
    """Start what is to watch a run, and end it afterwards.

    Raises
    ------
    InputError
        Something cannot be started.
    """
    if watching.mcap:
        from visctrl.viewers.foxglove.stream import require_viewer

        require_viewer("--mcap")
    found = Watchers()
    with ExitStack() as stack:
        if watching.web is not None:
            page = stack.enter_context(found.add_page(plan, watching.web))
            print(f"visctrl: watch and stop the robot at {page.url}", file=sys.stderr, flush=True)
        if watching.live is not None:
            stream = found.add_stream(plan, watching.live)
            stack.callback(stream.close)
            if stream.gate is not None:
                said = f"open {stream.gate.url} in the Foxglove app"
                print(f"visctrl: {said}", file=sys.stderr, flush=True)
        yield found
