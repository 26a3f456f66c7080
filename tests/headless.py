"""Open a page in headless Chromium and report what a reader would meet.  Standard library only.

The browser speaks the DevTools protocol over two pipes, one JSON message after another, each closed by a
zero byte.  So no port is opened and no driver program is needed.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --hide-scrollbars "
    "--allow-file-access-from-files "
    "--remote-debugging-pipe"
).split()
PATIENCE = 60.0  # seconds for any one answer; a browser that starts on a busy machine needs a few

# The browser wants its pipes at descriptors 3 and 4.  Copies above 10 first, since ours may be 4 and 3.
LAUNCH = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(fd), fcntl.F_DUPFD, 10) for fd in sys.argv[1:3]]
for target, fd in zip((3, 4), ends):
    os.dup2(fd, target)
    os.close(fd)
os.execv(sys.argv[3], sys.argv[3:])
"""

# A picture is blank if it did not decode or if all its pixels are alike.
PICTURES = """
Promise.all([...document.images].map(async image => {
  await image.decode().catch(() => null);
  const name = image.alt || image.src.slice(0, 60);
  if (!image.naturalWidth) return {name, blank: true};
  const canvas = document.createElement('canvas');
  canvas.width = 200; canvas.height = 150;
  const context = canvas.getContext('2d');
  context.drawImage(image, 0, 0, 200, 150);
  const pixels = new Uint32Array(context.getImageData(0, 0, 200, 150).data.buffer);
  return {name, blank: pixels.every(pixel => pixel === pixels[0])};
}))
"""

# WCAG contrast of every piece of text against the nearest opaque background.
CONTRAST = """
(() => {
  const light = colour => {
    const [r, g, b] = colour.match(/[\\d.]+/g).map(Number).slice(0, 3).map(c => c / 255)
      .map(c => c <= .04045 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4);
    return .2126 * r + .7152 * g + .0722 * b;
  };
  const behind = element => {
    for (let e = element; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (colour !== 'rgba(0, 0, 0, 0)') return colour;
    }
    return 'rgb(255, 255, 255)';
  };
  const worst = {ratio: 21, text: ''};
  for (const e of document.body.querySelectorAll('*')) {
    const text = [...e.childNodes].filter(n => n.nodeType === 3).map(n => n.data.trim()).join('');
    if (!text || !e.getClientRects().length) continue;
    const [a, b] = [light(getComputedStyle(e).color), light(behind(e))].sort((x, y) => y - x);
    const ratio = (a + .05) / (b + .05);
    if (ratio < worst.ratio) Object.assign(worst, {ratio, text: text.slice(0, 40)});
  }
  return worst;
})()
"""


def find_browser() -> str | None:
    """The path of an installed browser of the Chromium family."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


@dataclass
class Visit:
    """What happened while the page was open."""

    errors: list[str] = field(default_factory=list)  # console errors, exceptions, blocked loads
    requests: list[str] = field(default_factory=list)  # everything asked for outside the page itself
    blank: list[str] = field(default_factory=list)  # pictures without content
    pictures: int = 0
    width: int = 0  # of the document; wider than the window means a sideways scroll of the page
    contrast: dict[str, Any] = field(default_factory=dict)
    screenshot: bytes = b""

    def faults(self, window: int) -> list[str]:
        """Everything wrong, in words."""
        found = [f"console: {text}" for text in self.errors]
        found += [f"outside request: {url}" for url in self.requests]
        found += [f"blank picture: {name}" for name in self.blank]
        if self.width > window:
            found.append(f"the page is {self.width} px wide in a window of {window} px")
        if self.contrast["ratio"] < 4.5:
            found.append(f"contrast {self.contrast['ratio']:.2f} < 4.5 at {self.contrast['text']!r}")
        return found


@dataclass
class Pipe:
    """One DevTools connection."""

    write: int
    read: int
    on_event: Callable[[dict[str, Any]], None]
    last: int = 0
    pending: bytes = b""

    def call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        """Send a command and wait for its answer; events on the way go to `on_event`."""
        self.last += 1
        message = {"id": self.last, "method": method, "params": params}
        if session:
            message["sessionId"] = session
        os.write(self.write, json.dumps(message).encode() + b"\0")
        answer = self.until(lambda got: got.get("id") == self.last)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Read messages up to the first wanted one."""
        deadline = time.monotonic() + PATIENCE
        while True:
            while b"\0" in self.pending:
                raw, self.pending = self.pending.split(b"\0", 1)
                message = json.loads(raw)
                self.on_event(message)
                if wanted(message):
                    return message
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self.read], [], [], left)[0]:
                raise TimeoutError(f"no answer from the browser within {PATIENCE:g} s")
            chunk = os.read(self.read, 1 << 20)
            if not chunk:
                raise RuntimeError("the browser closed the connection")
            self.pending += chunk


@contextmanager
def connection(browser: str) -> Iterator[Pipe]:
    """A running browser with an empty profile; ended and removed afterwards."""
    from_us, to_browser = os.pipe()
    from_browser, to_us = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        launch = [sys.executable, "-c", LAUNCH, str(from_us), str(to_us)]
        process = subprocess.Popen(
            [*launch, browser, *FLAGS, f"--user-data-dir={profile}"],
            pass_fds=(from_us, to_us),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(to_us)
        pipe = Pipe(to_browser, from_browser, on_event=lambda message: None)
        try:
            yield pipe
            pipe.call("Browser.close")
        finally:
            os.close(to_browser)
            os.close(from_browser)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def opened(pipe: Pipe, url: str, seen: Visit) -> Iterator[tuple[str, Callable[[str], Any]]]:
    """A new tab: its session, and a function that evaluates a script in it."""
    target = pipe.call("Target.createTarget", url="about:blank")["targetId"]
    session = pipe.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    pipe.on_event = lambda message: record(seen, message, url)
    for domain in ("Page", "Runtime", "Log", "Network"):
        pipe.call(f"{domain}.enable", session)

    def evaluate(script: str) -> Any:
        options = {"returnByValue": True, "awaitPromise": True}
        answer = pipe.call("Runtime.evaluate", session, expression=script, **options)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"the page refused a question: {answer['exceptionDetails']}")
        return answer["result"]["value"]

    yield session, evaluate
    pipe.call("Target.closeTarget", targetId=target)


def load(pipe: Pipe, session: str, url: str) -> None:
    """Go to a page and wait until it has loaded."""
    pipe.call("Page.navigate", session, url=url)
    pipe.until(lambda message: message.get("method") == "Page.loadEventFired")


def ask(pipe: Pipe, page: Path, script: str, query: str = "") -> Any:
    """Open a page and evaluate a script in it."""
    url = page.resolve().as_uri() + query
    with opened(pipe, url, Visit()) as (session, evaluate):
        load(pipe, session, url)
        return evaluate(script)


def visit(
    pipe: Pipe, page: Path, width: int = 1200, height: int = 900, scheme: str = "light", screenshot: bool = False
) -> Visit:
    """Open `page` in a new tab of the given size and colour scheme, and look; keep a picture of it on request."""
    seen, url = Visit(), page.resolve().as_uri()
    with opened(pipe, url, seen) as (session, evaluate):
        screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        pipe.call("Emulation.setDeviceMetricsOverride", session, **screen)
        feature = {"name": "prefers-color-scheme", "value": scheme}
        pipe.call("Emulation.setEmulatedMedia", session, features=[feature])
        load(pipe, session, url)
        pictures = evaluate(PICTURES)
        seen.pictures = len(pictures)
        seen.blank = [picture["name"] for picture in pictures if picture["blank"]]
        seen.width = evaluate("document.documentElement.scrollWidth")
        seen.contrast = evaluate(CONTRAST)
        if screenshot:
            shot = pipe.call("Page.captureScreenshot", session, captureBeyondViewport=True)
            seen.screenshot = base64.b64decode(shot["data"])
    return seen


def record(seen: Visit, message: dict[str, Any], page: str) -> None:
    """Note errors and requests among the browser's events."""
    method, params = message.get("method"), message.get("params", {})
    if method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
        seen.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
    elif method == "Runtime.exceptionThrown":
        seen.errors.append(str(params["exceptionDetails"].get("exception", {}).get("description", "exception")))
    elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
        seen.errors.append(params["entry"]["text"])
    elif method == "Network.requestWillBeSent":
        url = params["request"]["url"]
        if not url.startswith(("data:", "about:")) and url.split("#")[0] != page:
            seen.requests.append(url)
