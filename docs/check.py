"""Opens every page of the built site in headless Chromium, and prints what is wrong with it.

`make docs` runs it after the build. A page is wrong if it logs an error, asks another host for anything, has a picture
that does not show or has no alt text, a link within the site that leads nowhere, a formula left as LaTeX, or is wider
than a phone. The moving picture has to move, and the page "Watch it learn" has to play. The search has to answer the
questions of newcomers, also when the site is opened from a folder.
"""

import functools
import os
import shutil
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote, urldefrag, urlsplit, urlunsplit

from playwright.sync_api import Browser, Page, Request, ViewportSize, sync_playwright
from playwright.sync_api import TimeoutError as PlaywrightTimeout

SITE = Path(__file__).parent.parent / "site"
NAMES = ("chromium", "chromium-browser", "google-chrome")
DESKTOP, PHONE = ViewportSize(width=1280, height=900), ViewportSize(width=390, height=844)
QUIET = ["--disable-quic", "--disable-sync"]  # beside Playwright's own: the browser itself asks no other host

ANSWERS = {  # what a newcomer types -> the place that answers, which has to be in one of the first three results
    "huber": "how_to/own_parts.html#a-loss-huber-and-your-own",
    "double": "how_to/own_parts.html#targets-double-dqn-and-your-own",
    "learning rate": "how_to/own_parts.html#an-optimizer-and-its-learning-rate",
    "custom env": "how_to/own_environment.html",
    "resume": "how_to/resume.html",
    "seed": "how_to/many_seeds.html",
    "tensorboard": "how_to/from_training_to_use.html#dashboards",
    "gpu": "how_to/scripts.html#cpu-or-gpu",
    "save": "how_to/scripts.html#save-the-network",
    "lunarlander": "how_to/own_environment.html#environments-of-gymnasium",
}

LOOK = r"""async () => {
    const images = [...document.images];
    await Promise.all(images.map(image => image.decode().catch(() => {})));
    const inText = node => !node.parentElement.closest("pre, code, script, style, math");
    const texts = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) if (inText(walker.currentNode)) texts.push(walker.currentNode.data);
    return {
        images: images.map(image => ({src: image.src, width: image.naturalWidth, alt: image.getAttribute("alt")})),
        links: [...document.querySelectorAll("a[href]")].map(link => link.href),
        ids: [...document.querySelectorAll("[id], a[name]")].map(element => element.id || element.name),
        formulas: document.querySelectorAll("math").length,
        latex: texts.filter(text => /\$[^$\n]+\$|\\[(\[]|\\(frac|hat|max|sum|gamma|tau)/.test(text)),
    };
}"""


class Handler(SimpleHTTPRequestHandler):
    """Serves the site without printing a line for each request."""

    def log_message(self, *_: object) -> None:
        """Prints nothing."""


def check(browser: Browser, host: str) -> int:
    """Checks every page, and returns the number of problems."""
    names = sorted(str(path.relative_to(SITE)) for path in SITE.rglob("*.html"))
    wrong: dict[str, list[str]] = {name: [] for name in names}
    seen, moving = {}, 0
    page = browser.new_page(viewport=DESKTOP)
    page.set_default_timeout(120_000)  # a busy machine may be slow
    for name in names:
        seen[name] = look(page, host, name, wrong[name])
        for image in seen[name]["images"]:
            file = SITE / unquote(urlsplit(image["src"]).path).lstrip("/")
            if file.is_file() and b"acTL" in file.read_bytes()[:200]:  # the mark of an animated PNG
                moving += 1
                if not moves(page, image["src"]):
                    wrong[name].append(f"does not move: {image['src']}")
    for name in names:
        for link in seen[name]["links"]:
            if problem := broken(link, host, seen):
                wrong[name].append(f"{problem}: {link}")
    if not moving:
        wrong["index.html"].append("no page has a moving picture")
    for where in (host, SITE.as_uri()):
        for words, place in ANSWERS.items():
            if not finds(page, where, words, place):
                wrong["index.html"].append(f"on pages of {where}, the search for '{words}' does not find {place}")
    if not plays(page, host):
        wrong["watch_it_learn.html"].append("the pole does not move by itself")

    for name in names:
        counts = {key: len(seen[name][key]) for key in ("images", "links")} | {"formulas": seen[name]["formulas"]}
        print("FAIL" if wrong[name] else "ok  ", name, ", ".join(f"{count} {key}" for key, count in counts.items()))
        for problem in dict.fromkeys(wrong[name]):
            print("    ", problem)
    num_wrong = sum(map(len, wrong.values()))
    print(f"{len(names)} pages, {moving} moving pictures, {num_wrong} problems")
    return num_wrong


def look(page: Page, host: str, name: str, problems: list[str]) -> dict:
    """Opens one page and returns what is on it. Adds to `problems`."""
    listeners = {
        "console": lambda message: message.type == "error" and problems.append(f"console: {message.text}"),
        "pageerror": lambda error: problems.append(f"error: {error}"),
        "requestfailed": lambda request: is_failure(request) and problems.append(f"request failed: {request.url}"),
        "request": lambda request: foreign(request.url, host) and problems.append(f"another host: {request.url}"),
        "response": lambda response: response.status >= 400 and problems.append(f"{response.status}: {response.url}"),
    }
    for event, listener in listeners.items():
        page.on(event, listener)
    page.goto(f"{host}/{name}", wait_until="networkidle")
    found = page.evaluate(LOOK)
    page.set_viewport_size(PHONE)
    if (width := page.evaluate("document.documentElement.scrollWidth")) > PHONE["width"]:
        problems.append(f"wider than a phone: {width} pixels")
    page.set_viewport_size(DESKTOP)
    page.wait_for_load_state("networkidle")  # pictures further down are loaded when `LOOK` decodes them
    for event, listener in listeners.items():
        page.remove_listener(event, listener)
    for image in found["images"]:
        if not image["width"]:
            problems.append(f"picture does not show: {image['src']}")
        if not image["alt"] and "assets/logo" not in image["src"]:
            problems.append(f"picture without alt text: {image['src']}")
    problems.extend(f"LaTeX left in the text: {text.strip()[:80]}" for text in found["latex"])
    return found


def is_failure(request: Request) -> bool:
    """Returns whether a request failed. Those that the browser cancels when it leaves a page do not count."""
    return request.failure != "net::ERR_ABORTED"


def foreign(url: str, host: str) -> bool:
    """Returns whether a URL is neither on the site nor data within a page."""
    return not url.startswith((f"{host}/", "data:", "blob:"))


def broken(link: str, host: str, seen: dict[str, dict]) -> str:
    """Returns what is wrong with a link within the site; an empty string for any other link."""
    if not link.startswith(f"{host}/"):
        return ""
    target, fragment = urldefrag(link)
    name = unquote(urlsplit(target).path).lstrip("/") or "index.html"
    if not (SITE / name).is_file():
        return "link to nothing"
    if fragment and name in seen and unquote(fragment) not in seen[name]["ids"]:
        return "link to no such place"
    return ""


def moves(page: Page, src: str) -> bool:
    """Returns whether a picture looks different a moment later."""
    image = page.locator(f'img[src$="{src.rsplit("/", 1)[1]}"]').first
    first = image.screenshot()
    for _ in range(10):
        page.wait_for_timeout(200)
        if image.screenshot() != first:
            return True
    return False


def finds(page: Page, host: str, words: str, place: str) -> bool:
    """Returns whether one of the first three results of the search, which runs in the browser, has the place."""
    page.goto(f"{host}/index.html?q={quote(words)}")
    results = page.locator(".md-search-result__item")
    try:
        results.first.wait_for(state="attached")
    except PlaywrightTimeout:
        return False
    links = results.locator("a").evaluate_all(
        """(links, items) => links.map(link => [
            [...document.querySelectorAll(items)].indexOf(link.closest(items)), link.href
        ])""",
        ".md-search-result__item",
    )
    return any(index < 3 and without_query(href) == f"{host}/{place}" for index, href in links)


def without_query(url: str) -> str:
    """Returns the URL without the query that the search adds to highlight words."""
    return urlunsplit(urlsplit(url)._replace(query=""))


def plays(page: Page, host: str) -> bool:
    """Returns whether the page "Watch it learn" starts and counts its steps."""
    page.goto(f"{host}/watch_it_learn.html")
    try:
        page.wait_for_function("parseInt(document.querySelector('#step').textContent) > 5")
    except PlaywrightTimeout:
        return False
    return True


def find_chromium() -> str | None:
    """Returns the path of a Chromium, if there is one."""
    return next(filter(None, map(shutil.which, NAMES)), None)


def main() -> int:
    """Returns the exit status: 0 if all is well, or if there is no browser and none is required."""
    chromium = find_chromium()
    if chromium is None:
        print("The pages are built but not checked: there is no Chromium (apt-get install chromium).")
        return int(os.environ.get("REQUIRE_BROWSER") == "1")
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=SITE))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=QUIET)
        num_wrong = check(browser, f"http://127.0.0.1:{server.server_port}")
        browser.close()
    server.shutdown()
    return int(num_wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
