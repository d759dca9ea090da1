"""The dashboard in headless Chromium: what a person at the screen, the keyboard or a phone gets."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from src.dashboard.single_file import export_dashboard
from src.report.sweep_record import read_record, record_path, write_record
from tests.dashboard.experiments import EVIL, World, build, serve

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed (extra `test`)")
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None or DRIVER is None, reason="no chromium with chromedriver (Debian: chromium chromium-driver)"
    ),
]
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update",
    "--disable-background-networking", "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip
RUN, OTHER, BASELINE = World.run_id(0, 0), World.run_id(0, 1), World.run_id(2, 0)
WAIT_S = 20.0


@pytest.fixture(scope="module")
def chromium(tmp_path_factory) -> Iterator:
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def browser(chromium) -> Iterator:
    """A desktop window in light colours; whatever a page asked of elsewhere, or complained of, fails the test."""
    show(chromium, 1280, "light")
    for log in ("performance", "browser"):
        chromium.get_log(log)
    yield chromium
    asked = [
        message["params"]["request"]["url"]
        for entry in chromium.get_log("performance")
        if (message := json.loads(entry["message"])["message"])["method"] == "Network.requestWillBeSent"
    ]
    foreign = [url for url in asked if not url.startswith(("http://127.0.0.1:", "data:", "file:///"))]
    assert not foreign
    assert [entry["message"] for entry in chromium.get_log("browser")] == []


@pytest.fixture(scope="module")
def exported(shared_world, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("export") / "dashboard.html"
    export_dashboard(shared_world.reports, shared_world.outputs, path)
    return path


def show(driver, width: int, colours: str) -> None:
    size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    wish = {"features": [{"name": "prefers-color-scheme", "value": colours}]}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", wish)


def texts(driver, selector: str) -> list[str]:
    """What is shown of these elements."""
    shown = "[...document.querySelectorAll(arguments[0])].filter(e => e.getClientRects().length)"
    script = f"return {shown}.map(e => e.innerText.trim())"
    return driver.execute_script(script, selector)


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "the page did not get there"
        time.sleep(0.1)


def keys(driver, *pressed: str) -> None:
    actions = webdriver.ActionChains(driver)
    for key in pressed:
        actions.send_keys(key)
    actions.perform()


def test_overview(browser, served):
    browser.get(served)
    assert texts(browser, "h1") == ["Experiments"]
    assert texts(browser, ".card h3") == ["Margin"]
    assert (
        "ended with failures" in texts(browser, ".card")[0]
        and "5 of 6 runs done, 1 failed" in texts(browser, ".card")[0]
    )
    broken = texts(browser, ".notice.bad")[0]
    assert "results/horizon3d-phase1-mini-deadbeef.json" in broken and "not readable as JSON" in broken
    assert "sweeps/old_mini.json" in broken
    assert len(texts(browser, "#table-mini tbody tr")) == 6 and len(texts(browser, "#table-debug tbody tr")) == 1


def test_table_is_the_results(browser, served, shared_world):
    browser.get(f"{served}/sweep/epsilon_mini")
    rows = browser.execute_script(
        "return [...document.querySelectorAll('table[data-table=table12_epsilon] tbody tr')]"
        ".map(r => [r.dataset.key, ...[...r.cells].map(c => c.innerText.split('\\n')[0].trim())])"
    )
    for row, label in enumerate(["0.8 m", EVIL, "4.8 m"]):
        files = [shared_world.reports / "results" / f"{World.run_id(row, seed)}.json" for seed in (0, 1)]
        values = [100 * json.loads(path.read_text())["metrics"]["mAP"] for path in files if path.is_file()]
        assert rows[row][0] == label and rows[row][1] == label
        assert rows[row][2].split(" ")[2] == f"{sum(values) / len(values):.1f}"
    assert texts(browser, "table[data-table] strong") == ["22.8", "41.0", "1.59"]
    assert len(texts(browser, ".figures.paired .chart")) == 2
    assert not texts(browser, "script + script")


def test_pictures_show_side_by_side(browser, served):
    script = "return [...document.images].map(i => [i.complete, i.naturalWidth, i.getBoundingClientRect().x])"
    for address, count in ((f"/run/{RUN}", 1), (f"/run/{RUN}?against={BASELINE}", 2)):
        browser.get(served + address)
        browser.execute_script("document.querySelector('.picture').scrollIntoView()")
        until(lambda: all(complete for complete, *_ in browser.execute_script(script)))
        images = browser.execute_script(script)
        assert [width for _, width, _ in images] == [320] * count
    assert images[0][2] + 300 < images[1][2]
    assert "margin_m" in " ".join(texts(browser, "table")) and "30.0" in " ".join(texts(browser, "table"))


def test_keyboard_alone(browser, served):
    browser.get(served)
    tab, enter = "\ue004", "\ue007"
    focused = "return document.activeElement.innerText || document.activeElement.tagName"
    keys(browser, tab)
    assert browser.execute_script(focused) == "Skip to content"
    keys(browser, enter, tab)
    assert browser.execute_script("return document.getElementById('content').contains(document.activeElement)")
    head = "document.querySelector('#table-mini th[data-number][aria-sort]:nth-child(5)')"
    browser.execute_script(f"{head}.querySelector('button').focus()")
    assert browser.execute_script("return getComputedStyle(document.activeElement).outlineStyle") == "solid"
    order = "return [...document.querySelectorAll('#table-mini tbody tr')].map(r => r.cells[4].innerText)"
    keys(browser, enter)
    assert browser.execute_script(f"return {head}.ariaSort") == "descending"
    assert browser.execute_script(order) == ["42.0", "40.0", "35.0", "32.0", "30.0", ""]
    keys(browser, enter)
    assert browser.execute_script(order) == ["30.0", "32.0", "35.0", "40.0", "42.0", ""]
    browser.execute_script("document.querySelector('input[data-filter=table-mini]').focus()")
    keys(browser, "4.8")
    assert (
        browser.execute_script(
            "return [...document.querySelectorAll('#table-mini tbody tr')].filter(r => !r.hidden).length"
        )
        == 2
    )


@pytest.mark.parametrize("page", ["/", "/sweep/epsilon_mini", f"/run/{RUN}", f"/run/{RUN}?against={BASELINE}"])
def test_phone_in_the_dark(browser, served, page):
    show(browser, 390, "dark")
    browser.get(served + page)
    assert browser.execute_script("return [innerWidth, document.documentElement.scrollWidth]") == [390, 390]
    ground, text = browser.execute_script(
        "const s = getComputedStyle(document.body);"
        "return [s.backgroundColor, s.color].map(c => c.match(/\\d+/g).map(Number))"
    )
    assert max(ground[:3]) < 50 and min(text[:3]) > 200
    size = browser.execute_script(
        "const t = document.querySelector('.chart text'); return t ? t.getBoundingClientRect().height : 12"
    )
    assert size >= 9  # figures can be read


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_words_stand_out(browser, served, colours):
    """WCAG's contrast of at least 4.5 for every text that is shown."""
    show(browser, 1280, colours)
    for page in ("/", "/sweep/epsilon_mini", f"/run/{RUN}"):
        browser.get(served + page)
        worst = browser.execute_script("""
            const light = c => c.map(v => v / 255).map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
                .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
            const rgb = text => text.match(/[\\d.]+/g).map(Number);
            const ground = e => { for (; e; e = e.parentElement) {
                const c = rgb(getComputedStyle(e).backgroundColor);
                if (c.length < 4 || c[3] > 0) return c.slice(0, 3); }
                return [255, 255, 255]; };
            let worst = [99, ''];
            for (const e of document.querySelectorAll('main *, header *')) {
                if (![...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())) continue;
                if (!e.getClientRects().length) continue;
                if (['TITLE', 'DESC'].includes(e.tagName.toUpperCase())) continue;
                const style = getComputedStyle(e), colour = e.namespaceURI.endsWith('svg') ? style.fill : style.color;
                const [a, b] = [light(rgb(colour).slice(0, 3)), light(ground(e))];
                const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
                if (ratio < worst[0]) worst = [ratio, e.outerHTML.slice(0, 120)];
            }
            return worst;""")
        assert worst[0] >= 4.5, worst


def test_what_changes_appears_and_nothing_else_moves(browser, tmp_path):
    world = build(tmp_path)
    path = record_path(world.reports, "epsilon", "mini")
    record = read_record(path)
    run = record.runs[World.run_id(2, 1)]  # besides one that has failed, whose log can be opened
    run.state, run.started, record.updated = "running", time.time(), time.time()
    write_record(path, record)
    for base in serve(world):
        browser.get(f"{base}/sweep/epsilon_mini")
        browser.execute_script(
            "window.kept = document.querySelector('h1'); document.querySelector('details').open = true;"
            "document.querySelector('th button').focus(); window.scrollTo(0, 200)"
        )
        at = browser.execute_script("return scrollY")
        assert "running" in texts(browser, ".facts")[0]
        run.state, run.reason, record.updated = "failed", "disk full", time.time()
        write_record(path, record)
        until(lambda: "disk full" in " ".join(texts(browser, ".notice.bad")))
        assert "ended with failures" in texts(browser, ".facts")[0]
        assert browser.execute_script(
            "return [window.kept === document.querySelector('h1'), document.querySelector('details').open,"
            "document.activeElement.tagName]"
        ) == [True, True, "BUTTON"]
        assert abs(browser.execute_script("return scrollY") - at) < 400
        # With nothing running it asks no more than now and then.
        browser.execute_script("performance.clearResourceTimings()")
        time.sleep(3.5)
        assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
        browser.get("data:text/html,")


def test_exported_file_is_complete_in_itself(browser, exported, shared_world):
    browser.get(exported.as_uri())
    assert texts(browser, "h1") == ["Experiments"]  # one page at a time
    browser.execute_script("location.hash = '#sweep-epsilon_mini'")
    until(lambda: texts(browser, ".page.shown h1") == ["Margin scale mini"])
    assert "41.0\n[39.0, 44.0]" in " ".join(texts(browser, ".page.shown table"))
    browser.execute_script(f"location.hash = '#run-{RUN}'")
    until(lambda: RUN in " ".join(texts(browser, ".page.shown .facts")))
    browser.execute_script("document.querySelector('.page.shown .picture').scrollIntoView()")
    widths = "return [...document.querySelectorAll('.page.shown img')].map(i => i.naturalWidth)"
    until(lambda: browser.execute_script(widths) == [320])
    browser.execute_script("document.querySelector('.page.shown a[data-compare]').click()")
    until(lambda: "Pictures" in texts(browser, ".page.shown h2"))
    browser.execute_script(
        "const choice = document.querySelectorAll('#compare select')[1]; choice.value = arguments[0];"
        "choice.dispatchEvent(new Event('change', {bubbles: true}))",
        f"run-{BASELINE}",
    )
    rows = texts(browser, "#compared tr")
    assert any(row.split() == ["mAP,", "%", "30.0", "40.0", "\N{MINUS SIGN}10.0"] for row in rows)
    assert any("model.ocsf.margin_m" in row and "0.8" in row and "4.8" in row for row in rows)
    assert len(texts(browser, "#compared .pair img")) == 2
    assert str(shared_world.outputs.parent) not in exported.read_text()
