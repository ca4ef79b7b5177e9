"""The page in a real browser: what it shows, and its STOP button."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from toy_plugins import SpyBackend

from visctrl.hal.types import STANDSTILL
from visctrl.runtime.plan import Plan
from visctrl.runtime.session import Outcome, run_session
from visctrl.runtime.stop import StopRequest
from visctrl.viewers.web.address import Address
from visctrl.viewers.web.server import WebPage
from visctrl.viewers.web.view import LiveView

NAMES = ("chromium", "chromium-browser", "google-chrome", "chromium-headless-shell")
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), None)

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=f"none of {', '.join(NAMES)} is installed")
MakePlan = Callable[..., Plan]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        # Chromium's sandbox refuses to work for root.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


def until(tab: Any, expression: str) -> None:
    """Wait for an expression of the page to be true; its own policy forbids it to evaluate any."""
    deadline = time.monotonic() + 30.0
    while not tab.evaluate(expression):
        assert time.monotonic() < deadline, f"never true: {expression}"
        tab.wait_for_timeout(30)


@contextmanager
def driving(plan: Plan, address: Address) -> Iterator[tuple[WebPage, list[Outcome]]]:
    """Serve a page and run beside it; the outcome is there when the context has been left."""
    stop, outcomes = StopRequest(), []
    view = LiveView(plan)

    def run() -> None:
        outcome = run_session(plan, observers=[view], stop=stop)
        page.finish(outcome.summary["status"], outcome.summary["reason"])
        outcomes.append(outcome)

    with WebPage(view, stop, address) as page:
        running = threading.Thread(target=run)
        running.start()
        try:
            yield page, outcomes
        finally:
            stop.make("the test is over")
            running.join()


@contextmanager
def opened(browser: Any, url: str, **options: Any) -> Iterator[Any]:
    """Open a page that must not complain."""
    context = browser.new_context(**options)
    tab = context.new_page()
    complaints: list[str] = []
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.goto(url)
    yield tab
    context.close()
    assert complaints == []


def long_drive(toy_plan: MakePlan) -> Plan:
    slow = {"controller.drive_s": 60.0, "controller.v": 0.02, "duration_s": 70.0}
    return toy_plan({**slow, "realtime": True})


@pytest.mark.parametrize("press", ["button", "space"])
def test_the_stop_button_stops_the_base(browser: Any, toy_plan: MakePlan, press: str) -> None:
    plan = long_drive(toy_plan)
    with (
        driving(plan, Address("127.0.0.1", 0)) as (page, outcomes),
        opened(browser, page.url) as tab,
    ):
        until(tab, "document.querySelector('#status').textContent === 'driving'")
        until(tab, "document.querySelectorAll('.tiles div').length > 8")
        text = tab.locator("#numbers").inner_text()
        assert "12.5 V" in text, "the battery"
        assert "perception" in tab.locator("#stages").inner_text()
        if press == "button":
            tab.locator("#stop").click()
        else:
            tab.keyboard.press(" ")
        until(tab, "document.querySelector('#status').textContent === 'stopped'")
        assert tab.locator("#stop").inner_text().startswith("STOPPED")
    (outcome,) = outcomes
    assert outcome.summary["reason"] == "stopped on the page, from 127.0.0.1"
    (backend,) = SpyBackend.opened
    assert backend.commands[-1][1] == STANDSTILL


def test_features_and_path_are_drawn_and_fit_on_a_phone(browser: Any, toy_plan: MakePlan) -> None:
    plan = long_drive(toy_plan)
    coloured = """(id) => {
        const canvas = document.getElementById(id), pen = canvas.getContext("2d");
        const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
        let count = 0;
        for (let k = 0; k < data.length; k += 4)
            if (data[k + 3] && Math.abs(data[k] - data[k + 2]) > 60) count++;
        return count;
    }"""
    phone = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "color_scheme": "dark"}
    with (
        driving(plan, Address("127.0.0.1", 0)) as (page, _),
        opened(browser, page.url, **phone) as tab,
    ):
        until(tab, "document.querySelectorAll('.tiles div').length > 8")
        until(tab, f"({coloured})('camera') > 200")
        until(tab, f"({coloured})('map') > 50")
        assert tab.evaluate("document.documentElement.scrollWidth") <= 360
        assert tab.locator("#stop").is_visible()
        tab.evaluate("scrollTo(0, 1e4)")
        assert tab.locator("#stop").bounding_box()["y"] >= 0.0, "in reach wherever one reads"


def test_a_page_without_the_token_says_so_and_one_with_it_works(
    browser: Any, toy_plan: MakePlan
) -> None:
    plan = long_drive(toy_plan)
    with driving(plan, Address("0.0.0.0", 0)) as (page, outcomes):
        url = f"http://127.0.0.1:{page.address.port}/"
        with opened(browser, url) as tab:
            tab.wait_for_selector("#alarm:not([hidden])")
            assert "token" in tab.locator("#alarm").inner_text()
            tab.locator("#stop").click()
            until(tab, "document.querySelector('#alarm').textContent.includes('refused')")
            assert not page._server.stop.made
        with opened(browser, f"{url}#{page.token}") as tab:
            until(tab, "document.querySelector('#status').textContent === 'driving'")
            tab.locator("#stop").click()
            until(tab, "document.querySelector('#status').textContent === 'stopped'")
    assert outcomes[0].summary["reason"].startswith("stopped on the page")


def test_the_page_notices_that_the_program_is_gone(browser: Any, toy_plan: MakePlan) -> None:
    """A still picture must not pass for a live one, nor a lost STOP for a done one."""
    view, stop = LiveView(toy_plan()), StopRequest()
    with WebPage(view, stop, Address("127.0.0.1", 0)) as page:
        context = browser.new_context()
        tab = context.new_page()
        tab.goto(page.url)
        until(tab, "document.querySelector('#status').textContent === 'preparing'")
    until(tab, "document.querySelector('#status').textContent === 'no contact'")
    tab.locator("#stop").click()
    until(tab, "document.querySelector('#alarm').textContent.includes('NOT CONFIRMED')")
    context.close()
