"""Who is not the page gets nothing of the scene: other web sites, other names, other users, garbage, a crowd."""

import http.client
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from node.viewer import page_guard
from node.viewer.page_guard import CLIENTS, HEADERS, HOST, GuardedServer

VERSION = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def server() -> Iterator[GuardedServer]:
    with_scene = GuardedServer(0)
    with_scene.scene.add_point_cloud("/secret", np.zeros((1000, 3)), (1, 2, 3), precision="float32")
    yield with_scene
    with_scene.stop()


def opened(server: GuardedServer, origin: str | None, host: str | None = None, path: str = "") -> ClientConnection:
    """A WebSocket to the server, as a browser on this machine opens it."""
    raw = socket.create_connection((HOST, server.get_port()), timeout=20)
    where = f"ws://{host or f'{HOST}:{server.get_port()}'}/{path}"
    return connect(where, sock=raw, origin=origin, subprotocols=[VERSION], compression=None, max_size=None, proxy=None)


def status(server: GuardedServer, *hosts: str, origin: str | None = None, path: str = "/") -> int:
    """Of an HTTP request with these Host headers."""
    return response(server, *hosts, origin=origin, path=path)[0]


def response(
    server: GuardedServer, *hosts: str, origin: str | None = None, path: str = "/"
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Its status, headers and body."""
    with closing(http.client.HTTPConnection(HOST, server.get_port(), timeout=20)) as client:
        client.putrequest("GET", path, skip_host=True)
        for host in hosts:
            client.putheader("Host", host)
        if origin is not None:
            client.putheader("Origin", origin)
        client.endheaders()
        with client.getresponse() as answer:
            return answer.status, answer.headers, answer.read()


def holds_scene(client: Connection) -> bool:
    """The scene comes."""
    return any(len(client.recv(timeout=3)) > 12_000 for _ in range(20))


@pytest.mark.parametrize("name", [HOST, "localhost", "LOCALHOST"])
@pytest.mark.parametrize("port", ["", ":9000"])  # through a tunnel, too
@pytest.mark.parametrize("browser", [True, False])
def test_the_page_and_programs_are_served(server: GuardedServer, name: str, port: str, browser: bool) -> None:
    host = f"{name}{port}"
    origin = f"http://{host}".lower() if browser else None
    assert status(server, host, origin=origin) == 200
    with opened(server, origin, host) as client:
        assert holds_scene(client)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("{own}", "http://evil.example"),
        ("{own}", "http://127.0.0.1:1"),  # another server of this machine
        ("{own}", "http://127.0.0.1"),
        ("{own}", "http://localhost:{port}"),
        ("{own}", "https://{own}"),
        ("{own}", "http://{own}.evil.example"),
        ("{own}", "null"),  # a sandboxed frame
        ("{own}", ""),
        ("evil.example:{port}", "http://evil.example:{port}"),  # DNS rebinding
        ("evil.example:{port}", None),
        ("127.0.0.1.evil.example", None),
        ("127.0.0.1:{port}@evil.example", None),
        ("127.0.0.2:{port}", None),
        ("[::1]:{port}", None),
    ],
)
def test_other_sites_and_names_get_nothing(server: GuardedServer, host: str, origin: str | None) -> None:
    port = server.get_port()
    fill = {"own": f"{HOST}:{port}", "port": port}
    host, origin = host.format(**fill), None if origin is None else origin.format(**fill)
    refused, _, body = response(server, host, origin=origin)
    assert refused == 403 and len(body) < 100
    request = [
        "GET / HTTP/1.1",
        f"Host: {host}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Sec-WebSocket-Protocol: {VERSION}",
        *([] if origin is None else [f"Origin: {origin}"]),
    ]
    answer = sent(server, "\r\n".join([*request, "", ""]).encode())
    assert answer.startswith(b"HTTP/1.1 403 ") and len(answer) < 400


def test_a_request_names_one_host_and_one_origin(server: GuardedServer) -> None:
    own = f"{HOST}:{server.get_port()}"
    assert status(server) == status(server, own, "evil.example") == status(server, own, own) == 403
    twice = f"GET / HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nOrigin: http://evil.example\r\n\r\n"
    assert sent(server, twice.encode()).startswith(b"HTTP/1.1 403 ")


def test_the_page_may_connect_nowhere_else(server: GuardedServer) -> None:
    """viser's client would otherwise obey a link to it that names another server, whose scene may hold scripts."""
    served, headers, _ = response(server, HOST, path="/?websocket=ws://evil.example")
    assert served == 200 and {name: headers[name] for name in HEADERS} == HEADERS
    rules = dict(rule.strip().split(" ", 1) for rule in HEADERS["Content-Security-Policy"].split(";"))
    assert rules["frame-ancestors"] == "'none'" and "connect-src" not in rules
    assert not any(source.startswith(("http", "ws", "*")) for source in rules["default-src"].split())


def sent(server: GuardedServer, data: bytes) -> bytes:
    """What the server answers to these bytes, until it hangs up."""
    with socket.create_connection((HOST, server.get_port()), timeout=20) as raw:
        raw.sendall(data)
        if b"\r\n\r\n" not in data:  # the server would wait for the rest
            raw.shutdown(socket.SHUT_WR)
        answer = b""
        try:
            while part := raw.recv(1 << 16):
                answer += part
        except ConnectionResetError:
            pass
        return answer


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
        b"\xff" * 5000,
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
        b"GET /%ff%00\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nUpgrade: websocket\r\n\r\n",
    ],
)
def test_garbage_for_a_request_is_no_traceback(
    server: GuardedServer, data: bytes, capfd: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
) -> None:
    answer = sent(server, data)
    assert answer == b"" or (answer.startswith(b"HTTP/1.1 ") and b" 200 " not in answer.partition(b"\r\n")[0])
    assert status(server, HOST) == 200
    assert capfd.readouterr() == ("", "") and not caplog.records


CAMERA = ("wxyz", "position", "fov", "near", "far", "look_at", "up_direction", "image_height", "image_width")


def packed(**fields: str) -> bytes:
    """A small map in MessagePack."""
    texts = [text.encode() for item in fields.items() for text in item]
    return bytes([0x80 | len(fields)]) + b"".join(bytes([0xA0 | len(text)]) + text for text in texts)


@pytest.mark.parametrize(
    "message",
    [
        "text",
        b"",
        b"\xc1garbage",
        b"\x92\x01\x02",  # a list
        packed(type="NoSuchMessage"),
        packed(type="GuiUpdateMessage"),
        bytes(page_guard.MAX_MESSAGE + 1),
    ],
)
def test_garbage_for_a_message_ends_that_client_alone(
    server: GuardedServer, message: str | bytes, capfd: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
) -> None:
    with opened(server, None) as other:
        with opened(server, None) as client:
            assert holds_scene(client)
            client.send(message)
            with pytest.raises(ConnectionClosed):
                for _ in range(100):
                    client.recv(timeout=20)
        assert holds_scene(other)
    with opened(server, None) as client:  # what is no value of a camera breaks a task, and not the connection
        client.send(packed(type="ViewerCameraMessage", **dict.fromkeys(CAMERA, "x")))
        assert holds_scene(client)
    with connect(server.address.replace("http", "ws"), subprotocols=[Subprotocol("viser-v0.0.1")], proxy=None) as old:
        with pytest.raises(ConnectionClosed, match="another version"):
            old.recv(timeout=20)
    assert capfd.readouterr() == ("", "") and not caplog.records


def test_a_crowd_is_limited(server: GuardedServer) -> None:
    """Of a hundred at once so many are served, whole; the page still answers, and there is room when they are gone."""
    clients: list[ClientConnection] = []
    try:
        with ThreadPoolExecutor(100) as crowd:
            tries = [crowd.submit(opened, server, None) for _ in range(100)]
        for attempt in tries:
            try:
                clients.append(attempt.result())
            except InvalidStatus as error:
                assert error.response.status_code == 503
        assert len(clients) == CLIENTS
        begun = time.monotonic()
        assert status(server, HOST) == 200
        assert time.monotonic() - begun < 5.0
        assert all(holds_scene(client) for client in clients)
    finally:
        for client in clients:
            client.close()
    with opened(server, None) as later:
        assert holds_scene(later)


def test_with_a_token_only_its_address_answers() -> None:
    server, other = GuardedServer(0, token=True), GuardedServer(0, token=True)
    try:
        path, strange = server.address.split("/", 3)[3], other.address.split("/", 3)[3]
        assert path != strange and len(path) > 20
        for right in (f"/{path}", f"/{path[:-1]}", f"/{path}?a=b", f"/{path}index.html"):
            assert status(server, HOST, path=right) == 200
        with opened(server, f"http://{HOST}:{server.get_port()}", path=path[:-1]) as client:
            assert client.subprotocol == VERSION
        for wrong in ("", strange, path[:-2], f"{path[:-1]}a", path.upper(), f"?{path}", f"x/{path}", "%ff", "é"):
            assert sent(server, f"GET /{wrong} HTTP/1.1\r\nHost: {HOST}\r\n\r\n".encode()).startswith(b"HTTP/1.1 403 ")
        for wrong in ("", strange, path[:-2]):
            with pytest.raises(InvalidStatus, match="403"):
                opened(server, None, path=wrong)
        with pytest.raises(InvalidStatus, match="403"):
            opened(server, "http://evil.example", path=path)
    finally:
        server.stop()
        other.stop()


def test_a_viser_that_cannot_be_guarded_serves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port = probe.getsockname()[1]
    monkeypatch.setattr(page_guard._Guard, "_serve", page_guard._SERVE)
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        GuardedServer(port)
    with pytest.raises((OSError, InvalidMessage)):
        connect(f"ws://{HOST}:{port}", proxy=None)
