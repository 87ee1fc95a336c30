"""The viewer's local server: this machine only, nothing but the page, its session and what it sends back.

It listens on 127.0.0.1 and answers only requests that name it so, as a page of somewhere else could otherwise reach it
under a name of its own (DNS rebinding). What the browser sends back must come from the page itself. Paths are looked up
in a table and never in a folder, and every answer forbids the page to load anything from elsewhere.
"""

from __future__ import annotations

import json
import re
import sys
import threading
import webbrowser
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from reenact.errors import ReenactError
from reenact.viewer.session import EXPORTS, Session

HOST = "127.0.0.1"

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_KINDS = {"html": "text/html; charset=utf-8", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
_FLOATS = "application/octet-stream"
_SLACK = 1 << 20
"""Bytes that a request's body may have beside the weights of the whole clip."""


class Server(ThreadingHTTPServer):
    """A server of one session on a port of this machine.

    Raises:
        ReenactError: The port is taken or forbidden.
    """

    daemon_threads = True

    def __init__(self, session: Session, port: int = 0) -> None:
        """`port` 0 takes any free one."""
        self.session = session
        self.pages = _pages()
        shapes = max(len(rig.names) for rig in session.rigs.values())
        self.largest_body = 4 * shapes * len(session.clip) + _SLACK
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ReenactError(f"{HOST}:{port}: expected a free port, got {reason}; leave --port out") from None
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away in the middle of an answer is no news; anything else is our mistake, and shown."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


def serve(session: Session, port: int = 0, browser: bool = True) -> None:
    """Serves until Ctrl-C, and prints where."""
    with Server(session, port) as server:
        try:
            print(f"{server.url} shows {' and '.join(session.rigs)}; Ctrl-C ends it", flush=True)
            if browser:
                threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
            server.serve_forever()
        except KeyboardInterrupt:
            print("stopped")


class _Refused(Exception):
    """Ends a request with a status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "Reenact", ""
    timeout = 30  # seconds that a silent connection is kept
    body_was_read = False

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def _answer(self, route: Any) -> None:
        try:
            if self.headers.get_all("Host") is None or set(self.headers.get_all("Host")) - self.server.hosts:
                raise _Refused(HTTPStatus.FORBIDDEN, f"expected a request to {HOST}, got another host")
            site = self.headers.get("Sec-Fetch-Site", "same-origin")
            origin = self.headers.get("Origin")
            if site not in ("same-origin", "none") or (
                origin and origin.removeprefix("http://") not in self.server.hosts
            ):
                raise _Refused(HTTPStatus.FORBIDDEN, "expected a request of the page itself, got one of another page")
            path = self.path.split("?", 1)[0]
            parts = [unquote(part) for part in path.split("/")[1:]] if path.startswith("/") else [""] * 9
            route(parts)
        except _Refused as refused:
            self._fail(refused.status, str(refused))
        except ReenactError as error:
            self._fail(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except OSError as error:
            if isinstance(error, (ConnectionError, TimeoutError)):
                raise
            self._fail(HTTPStatus.INTERNAL_SERVER_ERROR, f"{error.filename or 'disk'}: {error.strerror}")

    def _get(self, parts: list[str]) -> None:
        session = self.server.session
        path = "/".join(parts) or "index.html"
        if path in self.server.pages:
            self._send(self.server.pages[path], _KINDS[path.rsplit(".", 1)[1]])
        elif parts == ["session.json"]:
            self._send(json.dumps(session.describe()).encode(), "application/json")
        elif parts == ["progress.json"] and session.run is not None:
            self._send(json.dumps(session.progress()).encode(), "application/json")
        elif parts[0] == "preview" and len(parts) == 2 and re.fullmatch(r"[0-9]{1,12}", parts[1]):
            self._send(session.preview(int(parts[1])), "image/png")
        elif parts == ["audio.wav"] and session.audio is not None:
            self._send_part(session.audio.read_bytes(), "audio/wav")
        elif parts[0] == "rig" and len(parts) == 2:
            self._send(session.geometry(self._key(parts[1])), _FLOATS)
        elif parts[0] == "texture" and len(parts) == 2:
            self._send(session.texture(self._key(parts[1])), "image/png")
        elif parts[0] == "track" and len(parts) == 3:
            key = self._key(parts[1])
            self._stream(session.track(key, parts[2]), len(session.clip), len(session.rigs[key].names))
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, "expected an address of the viewer, got another")

    def _post(self, parts: list[str]) -> None:
        session = self.server.session
        if parts[0] == "retarget" and len(parts) == 3:
            key = self._key(parts[1])
            weights = self._weights(len(session.clip.names))
            self._stream(session.track(key, parts[2], weights), len(weights), len(session.rigs[key].names))
        elif parts[0] == "export" and len(parts) == 3 and parts[2] in EXPORTS:
            key = self._key(parts[1])
            self._send(session.export(key, self._weights(len(session.rigs[key].names)), parts[2]), EXPORTS[parts[2]])
        elif parts == ["nudges"]:
            try:
                document = json.loads(self._body())
            except (ValueError, RecursionError):
                raise _Refused(HTTPStatus.BAD_REQUEST, "expected nudges as JSON, got something else") from None
            session.keep(document)
            self._send(b"{}", "application/json")
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, "expected an address of the viewer, got another")

    def _key(self, index: str) -> str:
        """Key of the rig with this number."""
        keys = list(self.server.session.rigs)
        if not re.fullmatch(r"[0-9]{1,4}", index) or int(index) >= len(keys):
            raise _Refused(HTTPStatus.NOT_FOUND, f"expected a rig of 0..{len(keys) - 1}, got another")
        return keys[int(index)]

    def _body(self) -> bytes:
        lengths = self.headers.get_all("Content-Length") or []
        if len(lengths) != 1 or not re.fullmatch(r"[0-9]{1,15}", lengths[0]) or self.headers.get("Transfer-Encoding"):
            self.close_connection = True
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "expected the length of what is sent, got none")
        if int(lengths[0]) > self.server.largest_body:
            self.close_connection = True
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {self.server.largest_body} bytes")
        body = self.rfile.read(int(lengths[0]))
        if len(body) != int(lengths[0]):
            raise ConnectionError("the browser went away")
        self.body_was_read = True
        return body

    def _weights(self, shapes: int) -> Tensor:
        body = self._body()
        if not body or len(body) % (4 * shapes):
            raise _Refused(HTTPStatus.BAD_REQUEST, f"expected rows of {shapes} numbers, got {len(body)} bytes")
        weights = torch.from_numpy(np.frombuffer(body, "<f4").astype(np.float32).reshape(-1, shapes))
        if len(weights) > len(self.server.session.clip) or not bool((weights.abs() < 1e3).all()):  # NaN compares false
            raise _Refused(HTTPStatus.BAD_REQUEST, "expected as many frames as the clip at most, and sound numbers")
        return weights

    def _send(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK, **headers: str) -> None:
        self._begin(status, kind, len(data), **headers)
        self.wfile.write(data)

    def _send_part(self, data: bytes, kind: str) -> None:
        """The bytes that are asked for: a browser seeks in sound only where it may ask for a part."""
        asked = re.fullmatch(r"bytes=([0-9]{1,15})-([0-9]{0,15})", self.headers.get("Range", ""))
        if asked is None or int(asked[1]) >= len(data):
            self._send(data, kind, accept_ranges="bytes")
            return
        first, last = int(asked[1]), min(int(asked[2] or len(data)), len(data) - 1)
        span = f"bytes {first}-{last}/{len(data)}"
        self._send(data[first : last + 1], kind, HTTPStatus.PARTIAL_CONTENT, accept_ranges="bytes", content_range=span)

    def _stream(self, pieces: Iterator[Tensor], frames: int, shapes: int) -> None:
        """Rows of float32 as they are made; what fails before the first is answered in words."""
        piece = next(pieces)
        self._begin(HTTPStatus.OK, _FLOATS, 4 * frames * shapes)
        try:
            while piece is not None:
                self.wfile.write(piece.contiguous().numpy().astype("<f4").tobytes())
                piece = next(pieces, None)
        except ReenactError:
            self.close_connection = True  # short of its length: the page sees that it is not whole

    def _begin(self, status: HTTPStatus, kind: str, length: int, **headers: str) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-").title(), value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        sent = self.headers.get("Content-Length", "0") != "0" or "Transfer-Encoding" in self.headers
        if sent and not self.body_was_read:
            self.close_connection = True  # what was sent and not read would be taken for the next request
        self.body_was_read = False
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def _fail(self, status: HTTPStatus, sentence: str) -> None:
        self._send(json.dumps({"error": sentence}).encode(), "application/json", status)


def _pages() -> dict[str, bytes]:
    """What the page is made of, by path."""
    folder = files("reenact.viewer") / "page"
    found = {}
    for place, prefix in ((folder, ""), (folder / "vendor", "vendor/")):
        for file in place.iterdir():
            if file.name.rsplit(".", 1)[-1] in _KINDS:
                found[prefix + file.name] = file.read_bytes()
    return found
