"""The local web server of a session: one page, one socket each, one pair of hands at the controls.

Opening the address with its one-time token gives a cookie; page and socket need it. The first page
has the controls, others watch. Needs the `ui` extra.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import secrets
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from experiments.engine.files import as_json
from experiments.engine.runtime import UserError
from experiments.ui.protocol import LONGEST, Allowance, Malformed, Message, Order, parse

PAGE = Path(__file__).parent / "page"
FILES = {
    "/": ("index.html", "text/html"),
    "/style.css": ("style.css", "text/css"),
    "/page.js": ("page.js", "text/javascript"),
    "/hands.js": ("hands.js", "text/javascript"),
    "/road.js": ("road.js", "text/javascript"),
}
COOKIE = "ppl_session"
LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_PAGES = 16  # that watch at once
REFUSED = 1008  # WebSocket: policy violation
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class SessionBackend(Protocol):
    """A session, or the replay of one, as the server runs it.

    Attributes:
        lingers: Whether the page stays open after `run`, for the end to be read.
    """

    @property
    def lingers(self) -> bool: ...  # noqa: D102 - above

    def run(self) -> None:
        """Run until it is over."""
        ...

    def receive(self, message: Message) -> None:
        """Take a message of the page that has the controls."""
        ...

    def left(self) -> None:
        """The page that had the controls is gone."""
        ...

    def stop(self) -> None:
        """Save and end."""
        ...

    def about(self) -> dict[str, Any]:
        """First message to a page."""
        ...

    def status(self) -> dict[str, Any]:
        """Second message to a page."""
        ...


class _Mailbox:
    """Messages to be sent to a page: all of them, but only the newest frame and picture."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.newest: dict[str, str | bytes] = {}
        self.filled = asyncio.Event()

    def put(self, kind: str, message: str | bytes) -> None:
        if kind in ("frame", "picture"):
            self.newest[kind] = message
        else:
            self.messages.append(str(message))
        self.filled.set()

    async def take(self) -> list[str | bytes]:
        await self.filled.wait()
        self.filled.clear()
        taken = [*self.messages, *self.newest.values()]
        self.messages, self.newest = [], {}
        return taken


class Hub:
    """The pages, the one that has the controls, and the secrets that let a browser in.

    Attributes:
        secret: Value of the cookie.
        token: Lets one browser in; None once it has.
        rejected: Messages that were malformed, too many, or from a page that only watches.
    """

    def __init__(self, action_size: int):
        self.action_size = action_size
        self.secret = secrets.token_urlsafe(32)
        self.token: str | None = None
        self.pages: dict[WebSocket, _Mailbox] = {}
        self.controller: WebSocket | None = None
        self.backend: SessionBackend | None = None
        self.loop: asyncio.AbstractEventLoop | None = None
        self.kept: dict[str, str | bytes] = {}
        self.rejected = 0
        self.on_empty: Callable[[], None] = lambda: None
        self.on_quit: Callable[[], None] = lambda: None

    def new_token(self) -> str:
        """A token for one more browser; an earlier unused one becomes void."""
        self.token = secrets.token_urlsafe(24)
        return self.token

    # from the session's thread

    def publish(self, message: dict[str, Any]) -> None:
        """To every page."""
        self._post(str(message["kind"]), as_json(message))

    def picture(self, number: int, jpeg: bytes) -> None:
        """To every page: four bytes of the frame's number, then the picture."""
        self._post("picture", number.to_bytes(4, "big") + jpeg)

    def _post(self, kind: str, message: str | bytes) -> None:
        if self.loop is not None and not self.loop.is_closed():
            with contextlib.suppress(RuntimeError):  # the loop is closing
                self.loop.call_soon_threadsafe(self._deliver, kind, message)

    # in the loop

    def _deliver(self, kind: str, message: str | bytes) -> None:
        self.kept[kind] = message
        for mailbox in self.pages.values():
            mailbox.put(kind, message)

    def join(self, page: WebSocket) -> _Mailbox:
        """Add a page and send it the present state."""
        assert self.backend is not None
        mailbox = self.pages[page] = _Mailbox()
        mailbox.put("about", as_json(self.backend.about()))
        mailbox.put("status", as_json(self.backend.status()))
        for kind in ("scene", "frame", "picture"):
            if kind in self.kept:
                mailbox.put(kind, self.kept[kind])
        if self.controller is None:
            self.controller = page
        self._tell_roles()
        return mailbox

    def leave(self, page: WebSocket) -> None:
        """Remove a page; the session pauses if it had the controls."""
        self.pages.pop(page, None)
        if page is self.controller:
            self.controller = None
            if self.backend is not None:
                self.backend.left()
        self._tell_roles()
        if not self.pages:
            self.on_empty()

    def _tell_roles(self) -> None:
        for page, mailbox in self.pages.items():
            role = {"kind": "role", "control": page is self.controller}
            role |= {"free": self.controller is None, "watching": len(self.pages) - 1}
            mailbox.put("role", as_json(role))

    def hear(self, page: WebSocket, text: str | bytes) -> None:
        """Check a message of a page and pass it on."""
        try:
            message = parse(text, self.action_size)
        except Malformed as error:
            self._reject(page, str(error))
            return
        if message == Order("control"):
            if self.controller is None:
                self.controller = page
                self._tell_roles()
            return
        if page is not self.controller:
            self._reject(page, "another page has the controls")
            return
        assert self.backend is not None
        self.backend.receive(message)
        if message == Order("quit"):
            self.on_quit()

    def _reject(self, page: WebSocket, why: str) -> None:
        self.rejected += 1
        if self.rejected % 100 == 1:  # one line for many
            self.pages[page].put("rejected", as_json({"kind": "rejected", "why": why}))


def make_app(hub: Hub, hosts: list[str]) -> Starlette:
    """The web application of a hub.

    Args:
        hub: The session's.
        hosts: Host names that requests may use; "*" for any.
    """

    def known(connection: HTTPConnection) -> bool:
        return _same(connection.cookies.get(COOKIE, ""), hub.secret)

    def icon(request: Request) -> Response:
        del request
        return Response(status_code=204, headers=HEADERS)

    def file(request: Request) -> Response:
        given = request.query_params.get("token")
        if given is not None:
            if hub.token is None or not _same(given, hub.token):
                return PlainTextResponse(
                    "This address has been used. With no page open, the terminal shows a new one.",
                    403,
                    HEADERS,
                )
            hub.token = None
            answer: Response = RedirectResponse("/", 303, HEADERS)
            answer.set_cookie(COOKIE, hub.secret, httponly=True, samesite="strict")
            return answer
        if not known(request):
            return PlainTextResponse("Open the address that the terminal shows.", 403, HEADERS)
        name, kind = FILES[request.url.path]
        return FileResponse(PAGE / name, media_type=kind, headers=HEADERS)

    async def talk(page: WebSocket) -> None:
        origin, host = page.headers.get("origin"), page.headers.get("host")
        if not known(page) or origin not in (f"http://{host}", f"https://{host}"):
            await page.close(REFUSED)
            return
        if len(hub.pages) >= MOST_PAGES:
            await page.close(REFUSED)
            return
        await page.accept()
        mailbox = hub.join(page)
        sender = asyncio.create_task(_send(page, mailbox))
        try:
            await _listen(page, hub)
        finally:
            sender.cancel()
            hub.leave(page)

    routes = [Route(path, file) for path in FILES] + [Route("/favicon.ico", icon)]
    return Starlette(
        routes=[*routes, WebSocketRoute("/talk", talk)],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=hosts)],
    )


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(), secret.encode())


async def _send(page: WebSocket, mailbox: _Mailbox) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # the page is gone
        while True:
            for message in await mailbox.take():
                if isinstance(message, bytes):
                    await page.send_bytes(message)
                else:
                    await page.send_text(message)


async def _listen(page: WebSocket, hub: Hub) -> None:
    allowance = Allowance(time.monotonic())
    while True:
        received = await page.receive()
        if received["type"] == "websocket.disconnect":
            return
        if not allowance.take(time.monotonic()):
            hub.rejected += 1
            continue
        hub.hear(page, received.get("text") or received.get("bytes") or "")


def listen(host: str, port: int, exposed: bool) -> socket.socket:
    """The socket to serve on.

    Raises:
        UserError: If others can reach the address and that was not asked for, or if it is not
            available.
    """
    if host not in LOOPBACK and not exposed:
        raise UserError(
            f"host must be one of {', '.join(LOOPBACK)}, got {host!r}: with --expose others on "
            "the network can reach the page (they need the address with its token, and nothing "
            "is encrypted)"
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    served = socket.socket(family, socket.SOCK_STREAM)
    served.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        served.bind((host, port))
        served.listen(64)  # a page that opens the address at once waits and is not refused
    except (OSError, OverflowError) as error:
        served.close()
        raise UserError(f"port: cannot listen on {host}:{port} ({error})") from error
    return served


def serve(
    hub: Hub,
    backend: SessionBackend,
    served: socket.socket,
    *,
    exposed: bool = False,
    tell: Callable[[str], None] = print,
) -> None:
    """Serve until the backend is over and the person has seen its end.

    Args:
        hub: The one that the backend publishes to.
        backend: Runs in a thread of its own.
        served: From `listen`.
        exposed: Accept requests under any host name.
        tell: Prints a line.

    Raises:
        Exception: The one that ended the backend.
    """
    serving = _Serving(hub, backend, served, exposed=exposed, tell=tell)
    with contextlib.suppress(KeyboardInterrupt):  # everything is saved by then
        serving.server.run(sockets=[served])
    if serving.failure is not None:
        raise serving.failure
    if hub.rejected:
        print(f"{hub.rejected} messages were rejected", file=sys.stderr)


class _Serving:
    """A backend in its thread and the web server beside it; either ends the other.

    Attributes:
        server: To be run.
        failure: The exception that ended the backend, or None.
    """

    def __init__(
        self,
        hub: Hub,
        backend: SessionBackend,
        served: socket.socket,
        *,
        exposed: bool,
        tell: Callable[[str], None],
    ):
        self.hub, self.backend, self.tell = hub, backend, tell
        host, port = served.getsockname()[:2]
        self.address = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        self.failure: BaseException | None = None
        self.over, self.seen = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self._run_backend)
        hub.backend = backend
        app = make_app(hub, ["*"] if exposed else [*LOOPBACK, "[::1]"])
        app.router.lifespan_context = self._lifespan
        self.server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_level="warning",
                ws="websockets-sansio",
                ws_max_size=4 * LONGEST,
                ws_ping_interval=5.0,
                ws_ping_timeout=10.0,
                limit_concurrency=64,
                timeout_graceful_shutdown=2,
                server_header=False,
            )
        )

    def _run_backend(self) -> None:
        try:
            self.backend.run()
        except BaseException as error:
            self.failure = error
        finally:
            self.over.set()
            if self.failure is not None or not self.backend.lingers or self.seen.is_set():
                self.server.should_exit = True

    def _invite(self) -> None:
        if not self.over.is_set():
            self.tell(f"open {self.address}?token={self.hub.new_token()}")

    def _quit_after_the_end(self) -> None:
        self.seen.set()
        if self.over.is_set():
            self.server.should_exit = True

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        del app
        self.hub.loop = asyncio.get_running_loop()
        self.hub.on_empty, self.hub.on_quit = self._invite, self._quit_after_the_end
        self._invite()
        self.thread.start()
        yield
        self.backend.stop()
        await asyncio.to_thread(self.thread.join, 60)
