"""The local web server of a session: one page, one socket each, one pair of hands at the controls.

Whoever opens the address with its one-time token gets a cookie; page and socket need it. The first
page has the controls, others watch. Needs the `ui` extra.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
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
    """What the server shows: a session, or the replay of one.

    Attributes:
        lingers: Its end is still to be seen when `run` is over.
    """

    lingers: bool

    def run(self) -> None:
        """Until it is over."""
        ...

    def receive(self, message: Message) -> None:
        """A message of the page that has the controls."""
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
    """What is still to be sent to a page: everything, but of frames and pictures the newest."""

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
    """The pages, who has the controls, and the keys to the door.

    Attributes:
        secret: Value of the cookie.
        token: Opens the door once; None when it has.
        rejected: Messages that were malformed, too many, or from a page that only watches.
    """

    def __init__(self, action_size: int):
        self.action_size = action_size
        self.secret, self.token = secrets.token_urlsafe(32), None
        self.pages: dict[WebSocket, _Mailbox] = {}
        self.controller: WebSocket | None = None
        self.performance: SessionBackend | None = None
        self.loop: asyncio.AbstractEventLoop | None = None
        self.kept: dict[str, str | bytes] = {}
        self.rejected = 0
        self.on_empty: Callable[[], None] = lambda: None
        self.on_quit: Callable[[], None] = lambda: None

    def new_token(self) -> str:
        """A token for one more browser; an unused one before it is void."""
        self.token = secrets.token_urlsafe(24)
        return self.token

    # from the session's thread

    def publish(self, message: dict[str, Any]) -> None:
        """To every page."""
        self._post(str(message["kind"]), json.dumps(message, separators=(",", ":")))

    def picture(self, number: int, jpeg: bytes) -> None:
        """To every page: four bytes of the frame's number, then the picture."""
        self._post("picture", number.to_bytes(4, "big") + jpeg)

    def _post(self, kind: str, message: str | bytes) -> None:
        if self.loop is not None and not self.loop.is_closed():
            with contextlib.suppress(RuntimeError):  # it closes
                self.loop.call_soon_threadsafe(self._deliver, kind, message)

    # in the loop

    def _deliver(self, kind: str, message: str | bytes) -> None:
        self.kept[kind] = message
        for mailbox in self.pages.values():
            mailbox.put(kind, message)

    def join(self, page: WebSocket) -> _Mailbox:
        """A page has come: tell it all it has to know."""
        assert self.performance is not None
        mailbox = self.pages[page] = _Mailbox()
        mailbox.put("about", json.dumps(self.performance.about()))
        mailbox.put("status", json.dumps(self.performance.status()))
        for kind in ("scene", "frame", "picture"):
            if kind in self.kept:
                mailbox.put(kind, self.kept[kind])
        if self.controller is None:
            self.controller = page
        self._tell_roles()
        return mailbox

    def leave(self, page: WebSocket) -> None:
        """A page is gone."""
        self.pages.pop(page, None)
        if page is self.controller:
            self.controller = None
            if self.performance is not None:
                self.performance.left()
        self._tell_roles()
        if not self.pages:
            self.on_empty()

    def _tell_roles(self) -> None:
        for page, mailbox in self.pages.items():
            role = {"kind": "role", "control": page is self.controller}
            role |= {"free": self.controller is None, "watching": len(self.pages) - 1}
            mailbox.put("role", json.dumps(role))

    def hear(self, page: WebSocket, text: str | bytes) -> None:
        """A page says something."""
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
        assert self.performance is not None
        self.performance.receive(message)
        if message == Order("quit"):
            self.on_quit()

    def _reject(self, page: WebSocket, why: str) -> None:
        self.rejected += 1
        if self.rejected % 100 == 1:  # one line for many
            self.pages[page].put("rejected", json.dumps({"kind": "rejected", "why": why}))


def make_app(hub: Hub, hosts: list[str]) -> Starlette:
    """The web application of a hub.

    Args:
        hub: Of the session.
        hosts: Names under which it may be asked for; "*" for any.
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
                    "This address was used already. The terminal shows a new one when no page is "
                    "open.",
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
        UserError: If the address is not of this machine alone and that was not asked for, or
            cannot be had.
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
        served.listen(64)  # whoever opens the address at once is kept waiting, not refused
    except (OSError, OverflowError) as error:
        served.close()
        raise UserError(f"port: cannot listen on {host}:{port} ({error})") from error
    return served


def serve(
    hub: Hub,
    performance: SessionBackend,
    served: socket.socket,
    exposed: bool = False,
    tell: Callable[[str], None] = print,
) -> None:
    """Serve until the performance is over and the person has seen it.

    Args:
        hub: That it publishes to.
        performance: Runs in a thread of its own.
        served: Of `listen`.
        exposed: Any name of this machine will do.
        tell: Prints a line.

    Raises:
        Exception: Whatever ended the performance.
    """
    host, port = served.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    hub.performance = performance
    failure: list[BaseException] = []

    def perform() -> None:
        try:
            performance.run()
        except BaseException as error:
            failure.append(error)
        finally:
            over.set()
            if failure or not performance.lingers or seen.is_set():
                server.should_exit = True

    def invite() -> None:
        if not over.is_set():
            tell(f"open http://{shown}:{port}/?token={hub.new_token()}")

    def quit_after_the_end() -> None:
        seen.set()
        if over.is_set():
            server.should_exit = True

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        del app
        hub.loop = asyncio.get_running_loop()
        hub.on_empty, hub.on_quit = invite, quit_after_the_end
        invite()
        thread.start()
        yield
        performance.stop()
        await asyncio.to_thread(thread.join, 60)

    over, seen = threading.Event(), threading.Event()
    thread = threading.Thread(target=perform)
    app = make_app(hub, ["*"] if exposed else [*LOOPBACK, "[::1]"])
    app.router.lifespan_context = lifespan
    server = uvicorn.Server(
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
    with contextlib.suppress(KeyboardInterrupt):  # what was to be saved is saved by then
        server.run(sockets=[served])
    if failure:
        raise failure[0]
    if hub.rejected:
        print(f"{hub.rejected} messages were rejected", file=sys.stderr)
