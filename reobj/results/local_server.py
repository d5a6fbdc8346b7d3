"""Web server for the user of this machine: 127.0.0.1, and a token in every request."""

from __future__ import annotations

import hmac
import json
import os
import secrets
import sys
import threading
import webbrowser
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from reobj.types import ReobjError, log, one_line

HOST = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
}


class LocalHandler(BaseHTTPRequestHandler):
    """Answer requests that name this server and have its token; refuse all others."""

    server: LocalServer
    protocol_version = "HTTP/1.1"
    server_version = "reobj_track"
    sys_version = ""
    timeout = 60  # s, of a connection without a request

    def log_message(self, text: str, *args: Any) -> None:
        """Log requests with --debug, without the token."""
        log.debug("serve: %s", one_line((text % args).replace(self.server.token, "TOKEN")))

    def _may_read(self) -> bool:
        """Check the address, the host, which a page of another server cannot give, the token."""
        try:
            urlsplit(self.path)
        except ValueError:  # such as http://[
            self._refuse(HTTPStatus.BAD_REQUEST, "no address")
            return False
        if self.headers.get("Host", "").lower() not in self.server.hosts:
            self._refuse(HTTPStatus.FORBIDDEN, "unknown host")
            return False
        if not any(hmac.compare_digest(t, self.server.token.encode()) for t in self._tokens()):
            self._refuse(HTTPStatus.FORBIDDEN, "no token: open the address that was printed")
            return False
        return True

    def _tokens(self) -> list[bytes]:
        """Return the tokens of the address and of the cookie."""
        found = parse_qs(urlsplit(self.path).query).get("token", [])
        # SimpleCookie reads none if another program on 127.0.0.1 has set one that it cannot read
        for cookie in self.headers.get("Cookie", "").split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == self.server.cookie:
                found.append(value)
        return [token.encode("utf-8", "replace") for token in found]

    def _token_moved(self) -> bool:
        """Move the token of the address to a cookie, by another request of the browser."""
        if not urlsplit(self.path).query:
            return False
        cookie = f"{self.server.cookie}={self.server.token}; HttpOnly; SameSite=Lax; Path=/"
        more = {"Location": "/", "Set-Cookie": cookie}
        self._answer(HTTPStatus.SEE_OTHER, b"", "text/plain", more)
        return True

    def _json(self, data: dict[str, Any]) -> None:
        self._answer(HTTPStatus.OK, json.dumps(data).encode(), "application/json")

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._answer(status, f"{one_line(why)}\n".encode(), "text/plain; charset=utf-8")

    def _answer(
        self, status: HTTPStatus, body: bytes, kind: str, more: dict[str, str] | None = None
    ) -> None:
        self._head(status, len(body), kind, more)
        if self.command != "HEAD":
            self.wfile.write(body)

    def _head(
        self, status: HTTPStatus, length: int | None, kind: str, more: dict[str, str] | None = None
    ) -> None:
        """Send the head of an answer of `length` bytes; None: until the connection is closed."""
        self.send_response(status)
        end = {"Connection": "close"} if length is None else {"Content-Length": str(length)}
        headers = {"Content-Type": kind} | end
        for name, value in (HEADERS | headers | (more or {})).items():
            self.send_header(name, value)
        self.end_headers()


class LocalServer(ThreadingHTTPServer):
    """A server on 127.0.0.1.

    Attributes:
        token: that every request must have. hosts, origins: names of this server.
    """

    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # elsewhere it lets two programs use one port

    def __init__(self, port: int, handler: type[LocalHandler]) -> None:
        self.token = secrets.token_urlsafe(32)
        try:
            super().__init__((HOST, port), handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or "0 to 65535 are possible"
            raise ReobjError(f"--port {port}: {why}; give another one, or none") from error
        number = self.server_address[1]
        self.cookie = f"reobj_{number}"  # cookies do not distinguish ports
        self.hosts = {f"{name}:{number}" for name in (HOST, "localhost")}
        self.origins = {f"http://{host}" for host in self.hosts}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log a connection that the browser closed with --debug; print other errors."""
        error = sys.exception()
        if isinstance(error, ConnectionError):
            log.debug("serve: %s", error)
        else:
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Address of the page with its token."""
        return f"http://{HOST}:{self.server_address[1]}/?token={self.token}"

    def open_browser(self) -> None:
        """Open the page in the browser; in a thread, as one in the terminal returns at its end."""
        threading.Thread(target=webbrowser.open, args=(self.url,), daemon=True).start()
