"""The report in a real browser, headless: no errors, every picture there, nothing loaded from anywhere."""

import json
import shutil

import pytest

from quadhrl.eval.grid import GridConfig, run_grid
from quadhrl.eval.rollouts import StopRules
from quadhrl.policies import HighLevelConfig

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "results"
    config = GridConfig(
        out=str(folder), rollouts=2, infill=(1.0, 0.9), height_range=(0.0,), rules=StopRules(max_steps=75),
        hlp=HighLevelConfig(resolution=3, start_step=10),
    )  # fmt: skip
    return run_grid(config)


@pytest.fixture
def browser(tmp_path):
    if BROWSER is None or DRIVER is None:
        pytest.skip("no Chromium and ChromeDriver here")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.mark.parametrize("width", [390, 1200])
def test_report_in_a_browser(report, browser, width):
    browser.set_window_size(width, 900)
    browser.get(report.as_uri())
    assert "quadhrl" in browser.title
    images = browser.execute_script("return [...document.images].map(i => [i.complete, i.naturalWidth, i.alt])")
    assert len(images) == 4 and all(complete and size > 300 and alt for complete, size, alt in images)
    assert [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")] == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    requests = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    urls = [r["request"]["url"] for r in requests if r["documentURL"] == report.as_uri()]  # not the browser's own pages
    assert urls and all(url == report.as_uri() or url.startswith("data:") for url in urls), urls
    # Nothing sticks out of the page; wide tables scroll by themselves.
    overflow = browser.execute_script(
        "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )
    assert overflow <= 0
    text = browser.find_element("tag name", "body").text
    for words in ("alternating", "normalised reward", "training-", "95", "llp-in-place", "episodes.csv", "published"):
        assert words in text or words == "training-", words


def test_report_is_one_file_without_links(report):
    page = report.read_text()
    assert "://" not in page and "<script" not in page and page.count("data:image/png;base64,") == 4
