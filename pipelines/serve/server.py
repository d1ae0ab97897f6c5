"""The addresses of `serve`, on the loopback interface: a table of patterns, each with what answers it.

A request's path is matched against these patterns and names, and never used as a file name. Requests that name another
host are refused, so that a page elsewhere cannot read the run through a name that it points at this machine.
"""

from __future__ import annotations

import io
import json
import logging
import math
import re
import shutil
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import IO, Any
from urllib.parse import parse_qs, unquote, urlsplit

from pipelines.archive import to_json
from pipelines.errors import OutputError
from pipelines.serve.answers import ServedRun

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
POLICY = "default-src 'none'; img-src 'self' data:; connect-src 'self'; style-src {own}; script-src {own}"
OWN, INLINE = "'self'", "'unsafe-inline'"  # the report holds its scripts itself
PAGES = {"viewer.js": "text/javascript", "viewer.css": "text/css"}
FILES = {
    "camera.csv": "text/csv",
    "run.json": "application/json",
}  # what the report links to, beside shots' files
KINDS = {".jpg": "image/jpeg", ".png": "image/png", ".tif": "image/tiff", ".json": "application/json"}

Answer = tuple[HTTPStatus, str, bytes | Path]  # a Path: the file's content, which may be larger than memory
NOT_FOUND: Answer = (
    HTTPStatus.NOT_FOUND,
    "text/plain; charset=utf-8",
    b"There is nothing at this address.\n",
)


class RunServer(ThreadingHTTPServer):
    """Serves one run. `with make_server(out, port) as server: server.serve_forever()`; `url` is where it is."""

    daemon_threads = True
    # A second server on the same port would share its requests with the first.
    allow_reuse_port = False

    def __init__(self, run: ServedRun, port: int) -> None:
        self.run = run
        super().__init__((HOST, port), _Handler)

    @property
    def url(self) -> str:
        """Address of the viewer."""
        return f"http://{HOST}:{self.server_port}/"

    def server_close(self) -> None:
        super().server_close()
        self.run.close()


def make_server(out: Path, port: int) -> RunServer:
    """A server on 127.0.0.1; port 0: any that is free. Raises InputError: the run; OutputError: the port."""
    run = ServedRun(out)
    try:
        return RunServer(run, port)
    except (OSError, OverflowError) as error:
        run.close()
        cause = f"cannot be listened on ({getattr(error, 'strerror', None) or error})"
        raise OutputError(f"{HOST}:{port}", cause, "choose another --port, or 0 for any") from None


# ---- answers by address


def _page(run: ServedRun, query: dict[str, float]) -> Answer:
    return HTTPStatus.OK, "text/html; charset=utf-8", _resource("viewer.html")


def _report(run: ServedRun, query: dict[str, float]) -> Answer:
    return _file(run.out / "report.html", "text/html; charset=utf-8")


def _overview(run: ServedRun, query: dict[str, float]) -> Answer:
    return _json(run.overview())


def _point(run: ServedRun, query: dict[str, float], shot: int) -> Answer:
    return _json(run.point(shot, query.get("x", math.nan), query.get("y", math.nan)))


def _frame(run: ServedRun, query: dict[str, float], shot: int, number: int) -> Answer:
    return _json(run.frame(number, shot, query.get("x"), query.get("y")))


def _tile(run: ServedRun, query: dict[str, float], shot: int, level: int, column: int, row: int) -> Answer:
    tiles = run.tiles.get(shot)
    data = tiles.jpeg(level, column, row) if tiles is not None else None
    return NOT_FOUND if data is None else (HTTPStatus.OK, "image/jpeg", data)


def _thumbnail(run: ServedRun, query: dict[str, float], number: int) -> Answer:
    found = run.thumbnails.get(number)
    return NOT_FOUND if found is None else (HTTPStatus.OK, *found)


NUMBER = r"(\d{1,9})"
ROUTES: tuple[tuple[re.Pattern[str], Callable[..., Answer]], ...] = tuple(
    (re.compile(pattern), answer)
    for pattern, answer in (
        (r"/", _page),
        (r"/report", _report),
        (r"/api/run", _overview),
        (rf"/api/point/{NUMBER}", _point),
        (rf"/api/frame/{NUMBER}/{NUMBER}", _frame),
        (rf"/tile/{NUMBER}/{NUMBER}/{NUMBER}/{NUMBER}", _tile),
        (rf"/thumbnail/{NUMBER}", _thumbnail),
    )
)


def answer(run: ServedRun, target: str) -> Answer:
    """What a GET of `target` (path and query) gets."""
    parts = urlsplit(target)
    for name, kind in PAGES.items():
        if parts.path == f"/{name}":
            return HTTPStatus.OK, f"{kind}; charset=utf-8", _resource(name)
    for name, kind in FILES.items():
        if parts.path == f"/{name}":
            return _file(run.out / name, f"{kind}; charset=utf-8")
    listed = run.files.get(unquote(parts.path.removeprefix("/")))
    if listed is not None:
        return HTTPStatus.OK, KINDS.get(listed.suffix, "application/octet-stream"), listed
    for pattern, function in ROUTES:
        match = pattern.fullmatch(parts.path)
        if match is not None:
            return function(run, _numbers(parts.query), *map(int, match.groups()))
    return NOT_FOUND


def _numbers(query: str) -> dict[str, float]:
    found = {}
    for name, values in parse_qs(query[:1000]).items():
        try:
            found[name] = float(values[0])
        except ValueError:
            continue  # as if it were not there: what needs it answers "not found"
    return found


def _json(document: Any) -> Answer:
    if document is None:
        return NOT_FOUND
    return HTTPStatus.OK, "application/json", json.dumps(to_json(document), allow_nan=False).encode()


def _file(path: Path, kind: str) -> Answer:
    try:
        return HTTPStatus.OK, kind, path.read_bytes()
    except OSError:
        return NOT_FOUND


def _opened(found: Answer) -> tuple[HTTPStatus, str, IO[bytes], int]:
    """Status, kind, open content and its bytes."""
    status, kind, body = found
    if isinstance(body, bytes):
        return status, kind, io.BytesIO(body), len(body)
    try:
        return status, kind, body.open("rb"), body.stat().st_size
    except OSError:  # gone since the run was opened
        return _opened(NOT_FOUND)


def _resource(name: str) -> bytes:
    return files("pipelines.serve").joinpath("viewer", name).read_bytes()


class _Handler(BaseHTTPRequestHandler):
    server: RunServer
    server_version = "broadcast-mosaic"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        host = (self.headers.get("Host") or "").rpartition(":")[0] or self.headers.get("Host") or ""
        found: Answer
        if host not in (HOST, "localhost"):
            found = HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", b"This server answers to 127.0.0.1.\n"
        else:
            found = answer(self.server.run, self.path)
        status, kind, stream, size = _opened(found)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        own = INLINE if self.path.partition("?")[0] == "/report" else OWN
        self.send_header("Content-Security-Policy", POLICY.format(own=own))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        # A run may be made again into the same folder while the page is open.
        self.send_header(
            "Cache-Control", "no-store" if kind.startswith(("text/html", "application")) else "no-cache"
        )
        self.end_headers()
        with stream:
            if with_body:
                try:
                    shutil.copyfileobj(stream, self.wfile)
                except ConnectionError:
                    log.debug("the browser went away")

    def log_message(self, format: str, *args: Any) -> None:
        log.debug(format, *args)
