"""The page's server, asked over HTTP as a browser or an intruder would ask it."""

from __future__ import annotations

import http.client
import json
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_plugins import SpyBackend

from visctrl.cli.main import main
from visctrl.contracts import Match
from visctrl.hal.types import STANDSTILL, Frame, Pose
from visctrl.robots.errors import InputError
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import Outcome, run_session
from visctrl.runtime.stop import StopRequest
from visctrl.viewers.web import server
from visctrl.viewers.web.address import Access, Address
from visctrl.viewers.web.lanes import PENALTY_S, Connection, Lanes
from visctrl.viewers.web.server import WebPage
from visctrl.viewers.web.view import LiveView

LOOPBACK = Address("127.0.0.1", 0)
MakePlan = Callable[..., Plan]


@contextmanager
def served(plan: Plan, address: Address = LOOPBACK) -> Iterator[tuple[WebPage, LiveView]]:
    view, stop = LiveView(plan), StopRequest()
    with WebPage(view, stop, address) as page:
        yield page, view


def ask(
    page: WebPage, path: str, method: str = "GET", **headers: str
) -> tuple[int, bytes, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", page.address.port, timeout=5.0)
    try:
        connection.request(
            method, path, headers={k.replace("_", "-"): v for k, v in headers.items()}
        )
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


class AsksAt(Observer):
    """Has another thread ask for something right after a tick, and waits for the answer."""

    def __init__(self, number: int, work: Callable[[], object]) -> None:
        self.number, self.work = number, work
        self.answer: Any = None

    def on_tick(self, record: TickRecord) -> None:
        if record.number == self.number:
            thread = threading.Thread(target=lambda: setattr(self, "answer", self.work()))
            thread.start()
            thread.join()


def drive(plan: Plan, page: WebPage, view: LiveView, *others: Observer) -> Outcome:
    return run_session(plan, observers=[view, *others], stop=page._server.stop)


# --- STOP ------------------------------------------------------------------------------------


def test_stop_ends_the_run_within_one_tick(toy_plan: MakePlan) -> None:
    plan = toy_plan()
    with served(plan) as (page, view):
        asks = AsksAt(12, lambda: ask(page, "/stop", "POST"))
        outcome = drive(plan, page, view, asks)
    assert asks.answer[0] == 200
    assert outcome.exit_code == 130
    assert outcome.summary["reason"] == "stopped on the page, from 127.0.0.1"
    (backend,) = SpyBackend.opened
    assert outcome.summary["ticks"] == 13, "the tick of the request was the last"
    moving = [t for t, sent in backend.commands if sent != STANDSTILL]
    assert backend.commands[-1][1] == STANDSTILL
    assert backend.commands[-1][0] - max(moving) <= 0.1 + 1e-9


def test_on_the_wall_clock_the_base_stands_before_stop_is_answered(toy_plan: MakePlan) -> None:
    plan = toy_plan({"realtime": True, "controller.drive_s": 20.0})
    answered: list[float] = []

    def press() -> None:
        while not SpyBackend.opened or len(SpyBackend.opened[0].commands) < 4:
            time.sleep(0.01)
        assert ask(page, "/stop", "POST")[0] == 200
        answered.append(SpyBackend.opened[0].clock.now())

    with served(plan) as (page, view):
        pressing = threading.Thread(target=press)
        pressing.start()
        outcome = drive(plan, page, view)
        pressing.join()
    assert outcome.summary["status"] == "stopped"
    (backend,) = SpyBackend.opened
    first = min(t for t, sent in backend.commands if sent == STANDSTILL)
    assert first <= answered[0]
    assert all(sent == STANDSTILL for t, sent in backend.commands if t >= first)


def test_only_a_post_to_stop_stops(toy_plan: MakePlan) -> None:
    with served(toy_plan()) as (page, _):
        assert ask(page, "/stop")[0] == 404
        assert ask(page, "/state", "POST")[0] == 404
        assert ask(page, "/stop", "PUT")[0] == 501
        assert not page._server.stop.made


def trickle(page: WebPage, count: int, over: threading.Event) -> list[socket.socket]:
    """Open connections of which each sends a byte now and then and never a whole request."""
    made: list[socket.socket] = []

    def work() -> None:
        while not over.wait(0.05):
            for each in made:
                with suppress(OSError):
                    each.sendall(b"G")

    where = ("127.0.0.1", page.address.port)
    made += (socket.create_connection(where, timeout=5.0) for _ in range(count))
    threading.Thread(target=work, daemon=True).start()
    return made


@pytest.mark.parametrize("count", [24, 150])
def test_stop_is_reached_however_many_trickle(toy_plan: MakePlan, count: int) -> None:
    """Strangers make room for each other, and their requests have a deadline."""
    over = threading.Event()
    with served(toy_plan()) as (page, _):
        made = trickle(page, count, over)
        for _ in range(10):
            assert ask(page, "/state")[0] == 200
        assert ask(page, "/stop", "POST")[0] == 200
        assert page._server.stop.made
        assert len(page._server.lanes) <= 100
        clock = page._server.lanes._clock
        page._server.lanes._clock = lambda: clock() + 10.0
        for each in made:
            with suppress(ConnectionError):
                assert each.recv(1) == b"", "its time was over"
        over.set()
        for each in made:
            each.close()


def test_wrong_tokens_take_their_time(toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[float] = []
    with served(toy_plan(), Address("0.0.0.0", 0)) as (page, _):
        monkeypatch.setattr(server.time, "sleep", waited.append)
        assert ask(page, "/stop", "POST", Authorization="Bearer wrong")[0] == 401
        assert PENALTY_S in waited
        waited.clear()
        assert ask(page, "/stop", "POST", Authorization=f"Bearer {page.token}")[0] == 200
        assert PENALTY_S not in waited


class Line:
    """A socket that notes whether it was shut."""

    def __init__(self) -> None:
        self.open = True

    def shutdown(self, how: int) -> None:
        self.open = False


@given(
    st.lists(
        st.tuples(st.sampled_from(["come", "ask", "leave", "wait"]), st.integers(0, 400)),
        max_size=600,
    )
)
@settings(max_examples=60, deadline=None)
def test_whoever_comes_is_let_in_and_there_are_never_too_many(steps: list[tuple[str, int]]) -> None:
    now = 0.0
    lanes = Lanes(lambda: now, lambda seconds: None)
    there: list[Connection] = []
    for step, number in steps:
        if step == "come" or not there:
            there.append(lanes.admit(Line(), f"peer {number % 7}"))  # type: ignore[arg-type]
            assert there[-1].socket.open  # type: ignore[attr-defined]
        elif step == "ask":
            guest = there[number % len(there)]
            lanes.welcome(guest)
            lanes.waits(guest)
        elif step == "leave":
            lanes.leave(there.pop(number % len(there)))
        else:
            now += number / 100.0
            lanes.dismiss_late()
        staying = [each for each in there if each.socket.open]  # type: ignore[attr-defined]
        assert all(each.deadline >= now for each in staying) or step != "wait"
        strangers = Counter(each.peer for each in staying if not each.guest)
        assert len(staying) - strangers.total() <= 32
        assert strangers.total() <= 96
        assert max(strangers.values(), default=0) <= 64


# --- who may -----------------------------------------------------------------------------------


def test_elsewhere_than_on_loopback_a_token_is_needed(toy_plan: MakePlan) -> None:
    with served(toy_plan(), Address("0.0.0.0", 0)) as (page, _):
        assert len(page.token) >= 20
        assert page.url.endswith(f":{page.address.port}/#{page.token}")
        assert ask(page, "/")[0] == 200, "the empty page is no secret"
        wrong = page.token[:-1] + ("a" if page.token[-1] != "a" else "b")
        for shown in ({}, {"Authorization": f"Bearer {wrong}"}, {"Authorization": "Bearer é"}):
            for path in ("/state", "/about", "/image"):
                status, body, _ = ask(page, path, **shown)
                assert status == 401
                assert page.token.encode() not in body
            assert ask(page, "/stop", "POST", **shown)[0] == 401
        assert not page._server.stop.made
        right = {"Authorization": f"Bearer {page.token}"}
        assert ask(page, "/state", **right)[0] == 200
        assert ask(page, "/stop", "POST", **right)[0] == 200
        assert page._server.stop.made


def test_every_run_has_another_token(toy_plan: MakePlan) -> None:
    plan = toy_plan()
    with (
        served(plan, Address("0.0.0.0", 0)) as (a, _),
        served(plan, Address("0.0.0.0", 0)) as (b, _),
    ):
        assert a.token != b.token
    with served(plan) as (page, _):
        assert page.token == ""


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "192.168.1.7", "", "[::2]:1"])
def test_on_loopback_other_host_names_are_refused(toy_plan: MakePlan, host: str) -> None:
    """A page of another site may let its name point at this machine."""
    with served(toy_plan()) as (page, _):
        for path, method in (("/", "GET"), ("/state", "GET"), ("/stop", "POST")):
            assert ask(page, path, method, Host=host)[0] == 403
        assert not page._server.stop.made
        for name in ("localhost", "127.0.0.1", "[::1]"):
            assert ask(page, "/state", Host=f"{name}:9000")[0] == 200, "through a tunnel, too"


def test_another_sites_page_cannot_stop_the_robot(toy_plan: MakePlan) -> None:
    with served(toy_plan()) as (page, _):
        own = f"127.0.0.1:{page.address.port}"
        for origin in ("http://evil.example", "null", f"https://{own}", "http://127.0.0.1:1"):
            assert ask(page, "/stop", "POST", Host=own, Origin=origin)[0] == 403
        assert not page._server.stop.made
        assert ask(page, "/stop", "POST", Host=own, Origin=f"http://{own}")[0] == 200


def test_in_a_network_addresses_and_own_names_are_known() -> None:
    access = Access(Address("robot.lab", 80), "token")
    for host in (
        "192.168.1.7:8050",
        "[fe80::1]:8050",
        "robot.lab",
        "localhost",
        socket.gethostname(),
    ):
        assert access.knows_host(host), host
    assert not access.knows_host("evil.example:8050")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ("127.0.0.1", 8050)),
        ("9000", ("127.0.0.1", 9000)),
        (":9000", ("127.0.0.1", 9000)),
        ("0.0.0.0", ("0.0.0.0", 8050)),
        ("robot:81", ("robot", 81)),
        ("[::1]:81", ("::1", 81)),
        ("[::]", ("::", 8050)),
    ],
)
def test_addresses_are_read(text: str, expected: tuple[str, int]) -> None:
    address = Address.parse(text, 8050, "--web-address")
    assert (address.host, address.port) == expected
    assert address.is_loopback == (address.host in ("127.0.0.1", "::1"))


@pytest.mark.parametrize("text", ["a:b", "1.2.3.4:99999", "::1:x", "a:b:1", "host:-1"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected HOST:PORT"):
        Address.parse(text, 8050, "--web-address")


def test_a_port_in_use_is_bad_input(
    toy_plan: MakePlan,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Any,
) -> None:
    with served(toy_plan()) as (page, _):
        where = f"127.0.0.1:{page.address.port}"
        out = tmp_path / "run"
        arguments = ["run", "mock", "--web-address", where, "--out", str(out)]
        monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
    assert caught.value.code == 2
    assert f"--web-address {where}: cannot listen there" in capsys.readouterr().err
    assert not out.exists()


# --- what it shows -----------------------------------------------------------------------------


def test_the_page_and_its_parts_are_served(toy_plan: MakePlan) -> None:
    with served(toy_plan()) as (page, _):
        for path, words in (("/", b"STOP"), ("/page.css", b"#stop"), ("/page.js", b'"/stop"')):
            status, body, headers = ask(page, path)
            assert status == 200
            assert words in body
            assert headers["X-Frame-Options"] == "DENY"
            assert "default-src 'self'" in headers["Content-Security-Policy"]
        for path in ("/nothing", "/page.css/../../server.py", "/%2e%2e/server.py"):
            assert ask(page, path)[0] == 404


def test_the_state_follows_the_run(toy_plan: MakePlan) -> None:
    plan = toy_plan()
    with served(plan) as (page, view):
        states = [AsksAt(n, lambda: json.loads(ask(page, "/state")[1])) for n in (5, 20)]
        outcome = drive(plan, page, view, *states)
        page.finish(outcome.summary["status"], outcome.summary["reason"])
        end = json.loads(ask(page, "/state")[1])["end"]
    early, later = (state.answer for state in states)
    assert (early["tick"], later["tick"]) == (5, 20)
    assert early["battery"] == 12.5
    assert early["sent"][0] > 0.0
    assert early["stage"] == "main"
    assert set(early["seconds"]) == {"frame", "perception", "estimation", "control", "command"}
    assert len(early["ids"]) == len(early["pixels"]) == early["views"]["count"]
    assert len(later["path"]["points"]) > len(early["path"]["points"])
    assert later["pose"][1] > early["pose"][1], "it drives forward"
    assert end == {"status": "reached", "reason": outcome.summary["reason"]}


class Keeps(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


@pytest.fixture
def record(toy_plan: MakePlan) -> TickRecord:
    keeps = Keeps()
    run_session(toy_plan({"controller.drive_s": 0.3}), observers=[keeps])
    return keeps.records[0]


def test_only_the_new_part_of_a_path_is_sent_and_its_memory_is_bounded(
    toy_plan: MakePlan, record: TickRecord
) -> None:
    view = LiveView(toy_plan())
    edition, points = 0, []
    for k in range(20_000):
        view.on_tick(record._replace(truth=Pose(0.02 * k, 0.0, 0.0)))
        if k % 500 == 0:
            sent = view.state(edition, len(points))["path"]
            points = (points if sent["edition"] == edition else [])[: sent["from"]] + sent["points"]
            edition = sent["edition"]
    assert edition > 0
    assert points == sorted(points)
    assert 1000 < len(points) <= 4001
    assert points[0][0] == 0.0
    assert points[-1][0] > 350.0
    assert view.state(edition, len(points))["path"]["points"][:1] != [points[0]]


def test_images_are_encoded_once_for_all(toy_plan: MakePlan, record: TickRecord) -> None:
    plan = toy_plan()
    with served(plan) as (page, view):
        assert ask(page, "/image")[0] == 204
        grey = np.tile(np.arange(200, dtype=np.uint8), (100, 1))
        nothing = np.empty((0, 2))
        view.on_initial(Frame(0.0, 1, grey), Match(0, 0, nothing, nothing))
        status, first, headers = ask(page, "/image")
        assert (status, headers["Content-Type"], first[:2]) == (200, "image/jpeg", b"\xff\xd8")
        view.on_tick(record._replace(frame=Frame(0.0, 2, grey.T.copy())))
        assert view.image() == view.image()
        assert view.image()[1] is view.image()[1]
        assert ask(page, "/image")[1] != first


def test_values_that_are_no_numbers_do_not_break_the_page(
    toy_plan: MakePlan, record: TickRecord
) -> None:
    view = LiveView(toy_plan())
    view.on_tick(record._replace(truth=Pose(float("nan"), 0.0, 0.0)))
    json.dumps(view.state(0, 0), allow_nan=False)


def test_clients_that_never_read_delay_no_tick(toy_plan: MakePlan) -> None:
    """More of them than are served at a time, each with megabytes to read."""
    plan = toy_plan({"controller.drive_s": 4.0})
    took: list[float] = []

    class Timed(Observer):
        def on_tick(self, record: TickRecord) -> None:
            began = time.monotonic()
            view.on_tick(record)
            took.append(time.monotonic() - began)

    with served(plan) as (page, view):
        stuck = []
        for _ in range(30):
            client = socket.create_connection(("127.0.0.1", page.address.port))
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            client.setblocking(False)
            with suppress(BlockingIOError, ConnectionError):
                client.sendall(b"GET /page.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 600)
            stuck.append(client)
        outcome = run_session(plan, observers=[Timed()])
        began = time.monotonic()
    assert time.monotonic() - began < 3.0, "the server ends, too"
    for client in stuck:
        client.close()
    assert outcome.summary["ticks"] == len(took) > 30
    assert sorted(took)[len(took) // 2] < 0.01
    assert max(took) < 2.0, "less than the 5 s for which a client is waited for"
