"""The web server with real sockets: who gets in, who is heard, who has the controls."""

import http.client
import json
import threading
import time
from contextlib import contextmanager

import pytest

pytest.importorskip("uvicorn")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from experiments.engine.runtime import UserError
from experiments.ui.protocol import Input, Order
from experiments.ui.server import COOKIE, Hub, listen, serve


class Echo:
    """A backend that only notes its messages."""

    lingers = False

    def __init__(self):
        self.heard, self.lefts = [], 0
        self.over = threading.Event()

    def run(self):
        self.over.wait(60)

    def receive(self, message):
        self.heard.append(message)
        if message == Order("quit"):
            self.over.set()

    def left(self):
        self.lefts += 1

    def stop(self):
        self.over.set()

    def about(self):
        return {"kind": "about", "env": "probe"}

    def status(self):
        return {"kind": "status", "stage": "running"}


class Broken(Echo):
    """A backend that fails."""

    def run(self):
        raise ZeroDivisionError


class Served:
    def __init__(self):
        self.echo, self.hub, self.told = Echo(), Hub(2), []
        self.socket = listen("127.0.0.1", 0, exposed=False)
        self.port = self.socket.getsockname()[1]
        self.thread = threading.Thread(
            target=serve,
            args=(self.hub, self.echo, self.socket),
            kwargs={"tell": self.told.append},
        )

    @property
    def token(self):
        return self.told[-1].split("token=")[1]

    def get(self, path, host=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        headers = {"Host": host or f"127.0.0.1:{self.port}"} | headers
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer, body

    def enter(self):
        answer, _ = self.get(f"/?token={self.token}")
        assert answer.status == 303
        return answer.headers["set-cookie"].split(";")[0]

    def page(self, cookie, origin=None):
        return connect(
            f"ws://127.0.0.1:{self.port}/talk",
            origin=Origin(origin or f"http://127.0.0.1:{self.port}"),
            additional_headers={"Cookie": cookie},
        )


@contextmanager
def served():
    made = Served()
    with made.socket:
        made.thread.start()
        until(lambda: made.told)
        try:
            yield made
        finally:
            made.echo.over.set()
            made.thread.join(30)
            assert not made.thread.is_alive()


def until(what, seconds=20):
    end = time.time() + seconds
    while not what():
        assert time.time() < end, "waited too long"
        time.sleep(0.01)


def next_of(page, kind):
    while True:
        message = json.loads(page.recv(timeout=10))
        if message["kind"] == kind:
            return message


def test_the_door_opens_once_and_to_its_key_alone():
    with served() as it:
        assert it.get("/")[0].status == 403
        assert it.get("/?token=wrong")[0].status == 403
        assert it.get("/?token=%C3%A9")[0].status == 403
        token = it.token
        cookie = it.enter()
        assert it.get(f"/?token={token}")[0].status == 403  # used
        answer, body = it.get("/", Cookie=cookie)
        assert answer.status == 200
        assert b"<canvas" in body
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert answer.headers["cache-control"] == "no-store"
        for path in ("/page.js", "/hands.js", "/road.js", "/style.css"):
            assert it.get(path, Cookie=cookie)[0].status == 200
            assert it.get(path)[0].status == 403
        assert it.get("/../pyproject.toml", Cookie=cookie)[0].status == 404
        assert it.get("/", Cookie=f"{COOKIE}=guess")[0].status == 403
        assert it.get("/", host="evil.example", Cookie=cookie)[0].status == 400
        set_cookie = "HttpOnly; Path=/; SameSite=strict"
        it.hub.new_token()
        answer, _ = it.get(f"/?token={it.hub.token}")
        assert answer.headers["set-cookie"].endswith(set_cookie)


def test_a_socket_needs_cookie_and_origin():
    with served() as it:
        cookie = it.enter()
        for bad in (
            {"cookie": f"{COOKIE}=guess"},
            {"cookie": cookie, "origin": "http://evil.example"},
            {"cookie": cookie, "origin": f"http://127.0.0.1:{it.port + 1}"},
        ):
            with pytest.raises(InvalidStatus):
                it.page(**bad)
        with it.page(cookie) as page:
            assert next_of(page, "about")["env"] == "probe"
            assert next_of(page, "role")["control"]


def test_one_has_the_controls_and_others_watch():
    with served() as it:
        cookie = it.enter()
        hands = json.dumps({"kind": "input", "seen": 1, "takeover": True, "action": [1, 0]})
        with it.page(cookie) as first:
            assert next_of(first, "role")["control"]
            with it.page(cookie) as second:
                assert not next_of(second, "role")["control"]
                second.send(hands)
                assert "another page" in next_of(second, "rejected")["why"]
                second.send(json.dumps({"kind": "order", "order": "control"}))  # not free
                first.send(hands)
                until(lambda: it.echo.heard)
                assert it.echo.heard == [Input(1, True, (1.0, 0.0))]
                it.hub.publish({"kind": "frame", "number": 1})
                it.hub.picture(7, b"jpeg")
                for page in (first, second):
                    assert next_of(page, "frame")["number"] == 1
                    assert page.recv(timeout=10) == b"\x00\x00\x00\x07jpeg"
                first.close()
                until(lambda: it.echo.lefts == 1)
                role = next_of(second, "role")
                while not role["free"]:
                    role = next_of(second, "role")
                second.send(json.dumps({"kind": "order", "order": "control"}))
                assert next_of(second, "role")["control"]
        until(lambda: len(it.told) == 2)  # everybody left: a new address
        assert it.get(f"/?token={it.token}")[0].status == 303


def test_hostile_messages_do_not_end_the_session():
    with served() as it:
        cookie = it.enter()
        with it.page(cookie) as page:
            assert next_of(page, "role")["control"]
            for hostile in ("", "{", "[" * 3000, b"\x00\xff", "x" * 5000, '{"kind": "order"}'):
                page.send(hostile)
            page.send(json.dumps({"kind": "order", "order": "pause"}))
            until(lambda: it.echo.heard == [Order("pause")])
            assert it.hub.rejected == 6
            for _ in range(1500):  # a flood: what is too much is not read
                page.send("{")
            time.sleep(1.5)
            page.send(json.dumps({"kind": "order", "order": "save"}))
            until(lambda: it.echo.heard[-1] == Order("save"))
        with it.page(cookie) as page:
            page.send("x" * 100_000)
            with pytest.raises(ConnectionClosed):
                next_of(page, "nothing more")
        with it.page(cookie) as page:  # and the next is welcome
            assert next_of(page, "role")["control"]


def test_a_new_page_sees_where_things_stand():
    with served() as it:
        cookie = it.enter()
        for message in ({"kind": "scene", "number": 3}, {"kind": "frame", "number": 9}):
            it.hub.publish(message)
        until(lambda: "frame" in it.hub.kept)
        with it.page(cookie) as page:
            kinds = [json.loads(page.recv(timeout=10))["kind"] for _ in range(5)]
            assert sorted(kinds) == ["about", "frame", "role", "scene", "status"]


def test_only_this_machine_unless_asked_for():
    with pytest.raises(UserError, match="--expose"):
        listen("0.0.0.0", 0, exposed=False)
    with listen("127.0.0.1", 0, exposed=False) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match="port: cannot listen"):
            listen("127.0.0.1", port, exposed=False)


def test_a_backend_that_breaks_ends_the_server():
    hub, echo = Hub(2), Broken()
    with listen("127.0.0.1", 0, exposed=False) as socket, pytest.raises(ZeroDivisionError):
        serve(hub, echo, socket, tell=lambda line: None)
