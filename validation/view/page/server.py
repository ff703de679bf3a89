"""The server of the page: the page, its pictures, and the record's lines as server-sent events.

It reads files and nothing else, so that it may be started and ended whatever `live` does.
"""

from __future__ import annotations

import asyncio
import errno
import json
import socket
import time
from collections.abc import Callable, Iterator
from importlib.resources import files

from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler

from validation.view.page.access import Access
from validation.view.pictures import colours
from validation.view.places import ALARMS, LATEST, Places
from validation.view.tail import Tail

POLL_S = 0.2
"""Time between looks at the record."""
CLOCK_S = 1.0
"""Time between events that tell the time: without them the page knows that it is cut off."""
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
HEADERS = {
    # no script, style or picture but our own; no other page may frame this one, nor learn its address and token
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


async def serve(places: Places, host: str, port: int, tell: Callable[[str], None]) -> None:
    """Serve the page of a test until cancelled; `tell` is called with its address. Port 0: any that is free.

    Raises ValueError, in one line, where this machine has no such address, OSError where the port is not to be had.
    """
    access = Access.at(host)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            raise ValueError(f"--host: expected an address of this machine, found {host!r}") from None
        if error.errno == errno.EADDRINUSE:
            raise OSError(error.errno, f"expected a free port, found {port} in use", host) from None
        raise OSError(error.errno, error.strerror, f"{host}:{port}") from None
    listener.setblocking(False)
    port = int(listener.getsockname()[1])
    server = HTTPServer(application(places, access, port))
    server.add_sockets([listener])
    try:
        tell(access.url(port))
        await asyncio.Event().wait()
    finally:
        server.stop()
        await server.close_all_connections()


def application(places: Places, access: Access, port: int) -> Application:
    """Return what answers requests."""
    given = {"access": access, "cookie": f"pdvc-bench-{port}"}
    tables = {"strain": colours("inferno").tolist(), "residual": colours("RdBu_r").tolist()}
    assets = {each.name: each.read_bytes() for each in files("validation.view.page").joinpath("assets").iterdir()} | {
        "colours.js": f"export const colours = {json.dumps(tables)};\n".encode()
    }
    return Application(
        [
            (r"/()", _Asset, {**given, "assets": assets}),
            (r"/events", _Events, {**given, "places": places}),
            (
                rf"/pictures/((?:{ALARMS}/)?\d{{5,}}\.(?:radiograph|residual)\.png)",
                _Picture,
                {**given, "places": places},
            ),
            (r"/([a-z]+\.[a-z]+)", _Asset, {**given, "assets": assets}),
        ],
        log_function=lambda _: None,
    )


class _Guarded(RequestHandler):
    """What is answered to those who may look."""

    def initialize(self, access: Access, cookie: str) -> None:
        self.access, self.cookie = access, cookie

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)
        self.clear_header("Server")

    def prepare(self) -> None:
        given = self.get_query_argument("token", "") or self.get_cookie(self.cookie, "") or ""
        if self.access.refuses_name(self.request.headers.get("Host", "")) or self.access.refuses_token(given):
            raise HTTPError(403)
        if self.access.token and self.get_query_argument("token", ""):
            # what the page loads comes without the token in its address
            self.set_cookie(self.cookie, given, httponly=True, samesite="Strict")

    def write_error(self, status_code: int, **_: object) -> None:
        self.set_header("Content-Type", "text/plain")
        why = ": open the page at the address that the command printed" if status_code == 403 else ""
        self.finish(f"{status_code} {self._reason}{why}\n")


class _Asset(_Guarded):
    """A file of the page itself."""

    def initialize(self, access: Access, cookie: str, assets: dict[str, bytes]) -> None:  # type: ignore[override]
        super().initialize(access, cookie)
        self.assets = assets

    def get(self, name: str) -> None:
        name = name or "index.html"
        if name not in self.assets:
            raise HTTPError(404)
        self.set_header("Content-Type", f"{TYPES[name.rpartition('.')[2]]}; charset=utf-8")
        self.finish(self.assets[name])


class _Picture(_Guarded):
    """A picture that `live` left."""

    def initialize(self, access: Access, cookie: str, places: Places) -> None:  # type: ignore[override]
        super().initialize(access, cookie)
        self.folder = places.pictures

    def get(self, name: str) -> None:
        try:
            picture = (self.folder / name).read_bytes()
        except OSError:
            raise HTTPError(404) from None
        self.set_header("Content-Type", "image/png")
        # asked for again it is sent again only where it is another one
        self.set_header("Cache-Control", "no-cache")
        self.finish(picture)


class _Events(_Guarded):
    """The lines of the record, pictures and the time, as they come; a reader that was cut off goes on after a mark."""

    def initialize(self, access: Access, cookie: str, places: Places) -> None:  # type: ignore[override]
        super().initialize(access, cookie)
        self.places = places

    async def get(self) -> None:
        self.set_header("Content-Type", "text/event-stream")
        tail, told, clock_s = Tail(self.places.record), "", float("-inf")
        mark = self.request.headers.get("Last-Event-ID", "")
        if mark and not tail.resume(mark):
            self.write(_event("reset", ""))
        try:
            while True:
                for event in _news(tail):
                    self.write(event)
                latest = _latest(self.places)
                if latest != told:
                    told = latest
                    self.write(_event("pictures", latest))
                if time.monotonic() > clock_s + CLOCK_S:
                    clock_s = time.monotonic()
                    self.write(_event("clock", f"{time.time():.3f}"))
                await self.flush()
                await asyncio.sleep(POLL_S)
        except StreamClosedError:
            return
        except asyncio.CancelledError:
            # the server ends: that is the end of the events too, and no error
            self.finish()
            raise


def _news(tail: Tail) -> Iterator[str]:
    if tail.shrunk():
        yield _event("reset", "")
    for line in tail.added():
        yield f"id: {line.mark}\n{_event('line', line.text)}"


def _latest(places: Places) -> str:
    """Return of which step the newest pictures are, as one line; nothing where there are none."""
    try:
        return json.dumps(json.loads((places.pictures / LATEST).read_bytes()))
    except (OSError, ValueError):
        return ""


def _event(name: str, data: str) -> str:
    return f"event: {name}\ndata: {data}\n\n"
