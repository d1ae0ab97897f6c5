"""A headless Chromium for the tests, driven by its own DevTools protocol over two pipes: no driver program, no socket.

`with Browser(folder) as browser: page = browser.open(url)`, then `page.evaluate`, mouse, keys, screenshots. Everything
that the page asked the network for is in `page.requests`, everything that it complained about in `page.errors`.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--remote-debugging-pipe",
)
PATIENCE_S = 60.0  # two loaded cores start a browser in a few seconds
KEYS = {"ArrowLeft": 37, "ArrowRight": 39, "Home": 36, "End": 35, "Tab": 9, "Enter": 13}


def chromium() -> str | None:
    """The browser's program, None where it is not installed."""
    return shutil.which("chromium")


class Browser:
    """One browser process with an empty profile in `folder`."""

    def __init__(self, folder: Path) -> None:
        program = chromium()
        assert program is not None, "chromium is not installed"
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # The browser takes commands on 3 and answers on 4: copies far above them first, so that none is overwritten. A
        # shell moves them, because Python may not run code of its own between fork and exec beside other threads.
        high = [fcntl.fcntl(fd, fcntl.F_DUPFD, 50) for fd in (to_read, to_write)]
        move = f'exec "$0" "$@" 3<&{high[0]} 4>&{high[1]} {high[0]}<&- {high[1]}>&-'
        self._process = subprocess.Popen(
            ["bash", "-c", move, program, *FLAGS, f"--user-data-dir={folder / 'profile'}"],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=high,
        )  # fmt: skip
        for fd in (to_read, to_write, *high):
            os.close(fd)
        self._buffer = b""
        self._next = 0
        self._pages: dict[str, Page] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.call("Browser.close")
        except (OSError, EOFError, TimeoutError):
            self._process.kill()
        try:
            self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def open(
        self,
        url: str,
        *,
        size: tuple[int, int] = (1280, 900),
        dark: bool = False,
        mobile: bool = False,
        media: str = "",
    ) -> Page:
        """A new tab with that view port, loaded."""
        target = self.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        session = self.call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        page = Page(self, session)
        self._pages[session] = page
        for domain in ("Page", "Runtime", "Network", "Log"):
            page.call(f"{domain}.enable")
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": mobile}
        page.call("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.call("Emulation.setEmulatedMedia", {"media": media, "features": [scheme]})
        page.call("Page.navigate", {"url": url})
        page.wait_for_load()
        return page

    def call(
        self, method: str, params: dict[str, Any] | None = None, session: str | None = None
    ) -> dict[str, Any]:
        """Send a command and wait for its answer. Raises RuntimeError with the browser's words, TimeoutError."""
        self._next += 1
        number = self._next
        message: dict[str, Any] = {"id": number, "method": method, "params": params or {}}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.receive()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                result: dict[str, Any] = answer["result"]
                return result

    def receive(self) -> dict[str, Any]:
        """The next message; events go to their page. Raises TimeoutError, EOFError when the browser is gone."""
        deadline = time.monotonic() + PATIENCE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise TimeoutError(f"the browser said nothing for {PATIENCE_S:.0f} s")
            data = os.read(self._read, 1 << 20)
            if not data:
                raise EOFError("the browser is gone")
            self._buffer += data
        text, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        page = self._pages.get(message.get("sessionId", ""))
        if page is not None and "method" in message:
            page.note(message["method"], message["params"])
        return message


class Page:
    """One tab. Coordinates are CSS px of the view port."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser = browser
        self._session = session
        self._loaded = False
        self.requests: list[str] = []
        self.errors: list[str] = []

    def call(self, method: str, params: dict[str, Any] | None = None) -> dict[str, Any]:
        """A command for this tab."""
        return self._browser.call(method, params, self._session)

    def note(self, method: str, params: dict[str, Any]) -> None:
        """Keep what an event says."""
        if method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append(str(params["args"]))

    def wait_for_load(self) -> None:
        """Until the load event."""
        while not self._loaded:
            self._browser.receive()

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, promises awaited. Raises RuntimeError with the page's exception."""
        answer = self.call(
            "Runtime.evaluate", {"expression": expression, "returnByValue": True, "awaitPromise": True}
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def settle(self) -> None:
        """Let two frames be drawn: what an event changes is then on the page."""
        self.evaluate(
            "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
        )

    def place_of(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width, height of an element in the view port, scrolled into its middle."""
        box = self.evaluate(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({ block: 'center' }); const r = e.getBoundingClientRect();"
            "return [r.left, r.top, r.width, r.height]; })()"
        )
        return tuple(box)

    def move(self, x: float, y: float) -> None:
        """The mouse to a point."""
        self.call("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": x, "y": y})
        self.settle()

    def hover(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        """The mouse over an element, at those shares of its width and height."""
        left, top, width, height = self.place_of(selector)
        self.settle()
        self.move(left + across * width, top + down * height)

    def click(self, x: float, y: float, count: int = 1) -> None:
        """The left button at a point, `count` clicks."""
        for number in range(1, count + 1):
            for kind in ("mousePressed", "mouseReleased"):
                event = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": number}
                self.call("Input.dispatchMouseEvent", event)
        self.settle()

    def drag(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """The left button down at a point, up at another."""
        point = {"button": "left", "buttons": 1, "clickCount": 1}
        self.call("Input.dispatchMouseEvent", {"type": "mousePressed", "x": x0, "y": y0, **point})
        for step in (0.5, 1.0):
            at = {"x": x0 + step * (x1 - x0), "y": y0 + step * (y1 - y0)}
            self.call("Input.dispatchMouseEvent", {"type": "mouseMoved", **at, **point})
        self.call("Input.dispatchMouseEvent", {"type": "mouseReleased", "x": x1, "y": y1, **point})
        self.settle()

    def press(self, key: str, *, shift: bool = False) -> None:
        """A key of KEYS, down and up."""
        event = {"key": key, "code": key, "windowsVirtualKeyCode": KEYS[key], "modifiers": 8 if shift else 0}
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", {"type": kind, **event})
        self.settle()

    def screenshot(self, path: Path, *, whole: bool = False) -> None:
        """A PNG of the view port, or of the whole page."""
        data = self.call("Page.captureScreenshot", {"format": "png", "captureBeyondViewport": whole})
        path.write_bytes(base64.b64decode(data["data"]))

    def print_pdf(self) -> bytes:
        """The page as it prints."""
        data = self.call(
            "Page.printToPDF", {"printBackground": False, "paperWidth": 8.27, "paperHeight": 11.69}
        )
        return base64.b64decode(data["data"])
