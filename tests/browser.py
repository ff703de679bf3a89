"""A page in a real browser, headless Chromium, through its own protocol: what it shows, and pictures of it.

python -m tests.browser URL FILE.png [WIDTH HEIGHT]
"""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self
from urllib.request import urlopen

from tornado.websocket import WebSocketClientConnection, websocket_connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-dev-shm-usage"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-port=0"),
)
PATIENCE_S = 20.0


class Browser:
    """A page in a browser of its own, with a fresh profile; what it complains about is in `complaints`."""

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        self._profile = profile
        self._ids = itertools.count(1)
        # in a session of its own, as it starts others, which have to end with it
        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.complaints: list[str] = []

    async def __aenter__(self) -> Self:
        try:
            self._socket = await self._connect()
            for domain in ("Page", "Runtime", "Log", "Network"):
                await self.call(f"{domain}.enable")
        except BaseException:
            self._end()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        self._end()
        while await self._socket.read_message() is not None:
            pass
        self._socket.close()

    def _end(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    async def _connect(self) -> WebSocketClientConnection:
        port, since = self._profile / "DevToolsActivePort", time.monotonic()
        while not (port.is_file() and len(port.read_text().splitlines()) == 2):
            if self._process.poll() is not None or time.monotonic() > since + PATIENCE_S:
                raise RuntimeError("chromium: expected to start, did not")
            await asyncio.sleep(0.05)
        with urlopen(f"http://127.0.0.1:{port.read_text().splitlines()[0]}/json/list") as answer:
            (target,) = (each for each in json.load(answer) if each["type"] == "page")
        return await websocket_connect(target["webSocketDebuggerUrl"], max_message_size=2**26)

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Return what the browser answers to a command; what it says meanwhile is listened to."""
        number = next(self._ids)
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            text = await asyncio.wait_for(self._socket.read_message(), PATIENCE_S)
            assert text is not None, "chromium has ended"
            said = json.loads(text)
            if said.get("id") == number:
                assert "error" not in said, said
                return said["result"]
            self._hear(said)

    def _hear(self, said: dict[str, Any]) -> None:
        if said["method"] == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(said["params"]))
        elif said["method"] == "Log.entryAdded":
            self.complaints.append(said["params"]["entry"]["text"])

    async def open(self, url: str, width: int = 1600, height: int = 900) -> None:
        """Open a page in a window of this size."""
        await self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )
        await self.call("Page.navigate", url=url)
        await self.wait_for(f"location.href === {json.dumps(url)} && document.readyState === 'complete'")

    async def ask(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript."""
        answer = await self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def wait_for(self, expression: str) -> None:
        """Wait until an expression of JavaScript is true."""
        since = time.monotonic()
        while not await self.ask(f"Boolean({expression})"):
            if time.monotonic() > since + PATIENCE_S:
                page = await self.ask("document.body.innerText")
                raise TimeoutError(f"expected {expression}, page shows: {page}; complaints: {self.complaints}")
            await asyncio.sleep(0.05)

    async def picture(self) -> bytes:
        """Return the window as PNG."""
        return base64.b64decode((await self.call("Page.captureScreenshot", format="png"))["data"])


async def _take(url: str, file: Path, width: int, height: int) -> None:
    async with Browser(file.with_name(file.name + ".profile")) as browser:
        await browser.open(url, width, height)
        # pictures come, and figures are drawn
        await asyncio.sleep(1.5)
        file.write_bytes(await browser.picture())
        print(*browser.complaints, sep="\n")
    shutil.rmtree(file.with_name(file.name + ".profile"))


if __name__ == "__main__":
    asyncio.run(_take(sys.argv[1], Path(sys.argv[2]), *map(int, sys.argv[3:] or (1600, 900))))
