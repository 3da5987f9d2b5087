"""The page in a real browser, headless Chromium: ships appear, are chosen by mouse and by keyboard, and new ones come by themselves."""

import shutil

import numpy as np
import pytest

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="playwright drives the browser; install the extra dev"
)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None,
    reason="no Chromium on this machine; install the package chromium to test the page in a browser",
)
LOADED = 60_000


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def opened(browser):
    """Open an address; nothing may be logged as an error, and nothing asked of other servers."""
    troubles, contexts = [], []

    def visit(address, width=1400, height=1000):
        contexts.append(browser.new_context(viewport={"width": width, "height": height}))
        page = contexts[-1].new_page()
        page.on(
            "console", lambda said: troubles.append(said.text) if said.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on(
            "request",
            lambda asked: (
                None if asked.url.startswith((address, "data:", "blob:")) else troubles.append(asked.url)
            ),
        )
        page.on("requestfailed", lambda asked: None if "events" in asked.url else troubles.append(asked.url))
        page.goto(address)
        page.wait_for_selector("body[data-shown]", timeout=LOADED)
        return page

    yield visit
    for context in contexts:
        context.close()
    assert troubles == []


def test_a_track_appears_with_everything_around_it(page, opened):
    shown = opened(page)
    assert shown.inner_text("#station") == "XX.SIM01"
    items = shown.locator("#tracks [role=option]")
    assert items.count() == 1 and "km" in items.first.inner_text()
    assert shown.locator("#plan .scatterlayer .trace").count() >= 6
    assert shown.locator("#strips .heatmaplayer image").count() == 3
    assert "nearest at" in shown.get_attribute("#plan", "aria-label")
    assert "AIS" in shown.inner_text("#plan-key")
    assert "gaps" in shown.inner_text("#health")
    assert shown.locator("#files a").count() >= 5


def test_a_click_shows_its_numbers(page, opened, finished):
    shown = opened(page)
    assert "Choose a ship" in shown.inner_text("#details")
    shown.click("#tracks [role=option]")
    said = shown.inner_text("#details")
    row = (finished / "tracks.csv").read_text().splitlines()[1].split(",")
    assert f"{float(row[4]) / 1e3:.2f}" in said and f"{float(row[7]):.2f}" in said and "±" in said
    assert shown.get_attribute("#tracks [role=option]", "aria-selected") == "true"


def test_a_click_on_the_map_chooses_a_ship(page, opened):
    shown = opened(page)
    shown.locator("#plan").scroll_into_view_if_needed()
    centre = shown.evaluate(
        """() => { const plan = document.getElementById('plan'), area = plan._fullLayout, box = plan.getBoundingClientRect();
        const trace = plan.data.findLast((t) => t.mode === 'lines' && t.customdata && t.hoverinfo === 'text'), i = Math.floor(trace.x.length / 2);
        return [box.left + area.xaxis._offset + area.xaxis.d2p(trace.x[i]), box.top + area.yaxis._offset + area.yaxis.d2p(trace.y[i])]; }"""
    )
    shown.mouse.move(*centre, steps=4)
    shown.wait_for_timeout(300)
    shown.mouse.click(*centre)
    shown.wait_for_selector("#tracks [aria-selected=true]")
    assert "Ship 1" in shown.inner_text("#details")


def test_the_keyboard_reaches_and_chooses_everything(station_folder, listening, opened):
    folder, write = station_folder
    write.tracks(3)
    with listening(folder) as address:
        shown = opened(address)
        met = []
        for _ in range(12):
            shown.keyboard.press("Tab")
            met.append(
                shown.evaluate(
                    "() => document.activeElement.id || document.activeElement.name || document.activeElement.className"
                )
            )
        assert met[0] == "skip" and "range" in met and "track-3" in met
        assert met.index("range") < met.index("track-3")
        shown.focus("#track-3")
        outline = shown.evaluate("() => getComputedStyle(document.activeElement).outlineStyle")
        shown.keyboard.press("ArrowDown")
        assert shown.evaluate("() => document.activeElement.id") == "track-2"
        assert "Ship 2" in shown.inner_text("#details") and outline == "solid"
        shown.keyboard.press("End")
        assert shown.get_attribute("#track-1", "aria-selected") == "true"
        shown.keyboard.press("Home")
        assert "Ship 3" in shown.inner_text("#details")
        shown.keyboard.press("Escape")
        assert shown.locator("#tracks [aria-selected=true]").count() == 0
        shown.context.close()


def test_what_a_station_writes_appears_by_itself(station_folder, listening, opened):
    folder, write = station_folder
    with listening(folder) as address:
        shown = opened(address)
        assert shown.locator("#tracks [role=option]").count() == 0 and shown.is_visible("#none")
        assert "live" in shown.inner_text("#state")
        write.minutes(30)
        write.tracks(1)
        shown.wait_for_selector("#track-1", timeout=15_000)
        assert shown.is_visible("#now") and "probability 0.98" in shown.inner_text("#now")
        assert shown.locator("#strips .heatmaplayer image").count() == 3
        write.status(trouble="no packet for 400 s")
        shown.wait_for_selector("#state[data-state=bad]", timeout=15_000)
        assert "no packet for 400 s" in shown.inner_text("#state")
        shown.context.close()


def test_a_time_range_leaves_out_what_is_outside(station_folder, listening, opened):
    folder, write = station_folder
    write.minutes(60)
    write.tracks(2, apart_h=30.0)
    with listening(folder) as address:
        shown = opened(address)
        assert shown.locator("#tracks [role=option]").count() == 2
        shown.check("input[value='6']", force=True)
        shown.wait_for_selector("#track-1", state="detached", timeout=15_000)
        assert shown.locator("#tracks [role=option]").count() == 1
        shown.context.close()


@pytest.mark.parametrize("width", [390, 320])
def test_a_phone_scrolls_down_and_not_sideways(page, opened, width):
    shown = opened(page, width=width, height=844)
    wide = shown.evaluate("() => [document.documentElement.scrollWidth, window.innerWidth]")
    assert wide[0] <= wide[1] == width
    plan = shown.locator("#plan").bounding_box()
    assert plan["width"] <= width and plan["height"] > 250


def test_a_name_that_is_markup_is_text(station_folder, listening, opened):
    folder, write = station_folder
    write.status(trouble="<img src=x onerror=alert(1)>", code="<b>XX</b>")
    with listening(folder) as address:
        shown = opened(address)
        assert shown.inner_text("#station") == "<b>XX</b>"
        assert "<img" in shown.inner_text("#state")
        assert shown.locator("#state img").count() == 0
        assert np.array_equal(shown.locator("#station b").count(), 0)
        shown.context.close()
