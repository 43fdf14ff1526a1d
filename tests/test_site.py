"""The built site in a browser: every page loads whole, from its own server alone.

Runs where the extra `docs` and Chromium are installed. With the environment variable `SITE`
naming the folder of a built site, that one is tested, and nothing is skipped.
"""

import functools as ft
import http.server
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest


ROOT = Path(__file__).parent.parent
BUILT = os.environ.get("SITE")
CHROMEDRIVER = "/usr/bin/chromedriver"
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--window-size=1300,1000"
).split()


def _missing() -> str:
    packages = "mkdocs material mkdocstrings math_core ziamath selenium".split()
    missing = [p for p in packages if importlib.util.find_spec(p) is None]
    programs = [shutil.which("chromium"), shutil.which(CHROMEDRIVER)]
    return ", ".join(missing + ["Chromium and its driver"] * (None in programs))


pytestmark = pytest.mark.skipif(
    BUILT is None and _missing() != "",
    reason=f"not installed: {_missing()} (pip install -e '.[docs]')",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    if BUILT is not None:
        return Path(BUILT)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True)
    return folder


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture(scope="module")
def address(site):
    handler = ft.partial(_Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "/usr/bin/chromium"
    for flag in [*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"]:
        options.add_argument(flag)
    logs = {"browser": "ALL", "performance": "ALL"}
    options.set_capability("goog:loggingPrefs", logs)
    service = webdriver.ChromeService(executable_path=CHROMEDRIVER)
    driver = webdriver.Chrome(options=options, service=service)
    yield driver
    driver.quit()


# Text outside of code (bibliography entries are code).
_TEXT = """
const main = document.querySelector('article').cloneNode(true);
main.querySelectorAll('code, pre').forEach(x => x.remove());
return main.textContent;
"""
_READY = """
const done = arguments[0];
document.querySelectorAll('details').forEach(x => { x.open = true; });
const pictures = [...document.images].map(x => { x.loading = 'eager'; return x.decode(); });
Promise.allSettled([document.fonts.ready, ...pictures]).then(() => done());
"""
_BAD_PICTURES = """
return [...document.images].filter(x => x.naturalWidth === 0).map(x => x.src);
"""
_WIDER = "return document.documentElement.scrollWidth - window.innerWidth;"


def _problems(browser, address: str) -> list[str]:
    """What is wrong with the page that the browser has just loaded."""
    browser.execute_async_script(_READY)
    text = browser.execute_script(_TEXT)
    found = [f"in the text: {sign}" for sign in ("$", "\\") if sign in text]
    found += [f"no picture: {x}" for x in browser.execute_script(_BAD_PICTURES)]
    if browser.execute_script(_WIDER) > 0:
        found.append("wider than the window")
    for entry in browser.get_log("browser"):
        if entry["level"] == "SEVERE":
            found.append(f"console: {entry['message']}")
    return found + _failed_requests(browser, address)


def _failed_requests(browser, address: str) -> list[str]:
    requests, found = {}, []
    for entry in browser.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        number = message["params"].get("requestId")
        match message["method"], message["params"]:
            case "Network.requestWillBeSent", {"request": {"url": url}, **more}:
                # Of the pages, not of the browser's own.
                if more["documentURL"].startswith(address):
                    requests[number] = url
                    if not url.startswith((address, "data:", "blob:")):
                        found.append(f"fetches from elsewhere: {url}")
            case "Network.responseReceived", {"response": response}:
                if number in requests and response["status"] >= 400:
                    found.append(f"{response['status']}: {response['url']}")
            case "Network.loadingFailed", {"errorText": error}:
                if number in requests:
                    found.append(f"{error}: {requests[number]}")
    return found


def test_every_page_loads_whole_and_from_here_alone(site, address, browser):
    pages = sorted(str(p.relative_to(site)) for p in site.rglob("*.html"))
    assert "index.html" in pages and "solvers/general.html" in pages
    problems = {}
    for page in pages:
        browser.get(address + page)
        if found := _problems(browser, address):
            problems[page] = found
    assert not problems, json.dumps(problems, indent=2)
