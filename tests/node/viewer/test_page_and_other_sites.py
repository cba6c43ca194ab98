"""A browser with the page open, and a web site that wants the scene: the page works, and the site gets nothing."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest
import viser
from websockets.sync.server import ServerConnection, serve

from node.viewer.page_guard import HOST, GuardedServer
from tests.node.browser import CHROMIUM, FLAGS, needs_browser

# What any web site can do in the browser of who has the page open: the bytes of the scene that it gets.
STEAL = """async ([address, version]) => {
    const socket = new WebSocket(address.replace('http', 'ws'), version);
    socket.binaryType = 'arraybuffer';
    let stolen = 0;
    await new Promise((resolve) => {
        socket.onmessage = (event) => { stolen += event.data.byteLength; if (stolen > 60000) resolve(); };
        socket.onclose = resolve;
        setTimeout(resolve, 15000);
    });
    return stolen;
}"""
FORBIDDEN = """
window.forbidden = [];
document.addEventListener('securitypolicyviolation', (event) => forbidden.push(event.blockedURI));
"""
FETCH = "(address) => fetch(address).then((answer) => answer.text()).then((text) => text.length, () => 0)"
FRAME = """(address) => new Promise((resolve) => {
    const frame = document.createElement('iframe');
    frame.onload = () => resolve();
    frame.src = address;
    document.body.append(frame);
})"""


class _Site(BaseHTTPRequestHandler):
    """A page of another origin."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html><body>a site</body></html>")

    def log_message(self, *_: Any) -> None: ...


@contextmanager
def site() -> Iterator[int]:
    """Its port."""
    with ThreadingHTTPServer((HOST, 0), _Site) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def lure(callers: list[str]) -> Iterator[int]:
    """The port of a WebSocket server that an attacker wants the page to obey."""

    def call(connection: ServerConnection) -> None:
        callers.append(connection.request.headers["Origin"])

    with serve(call, HOST, 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("token", [False, True])
def test_the_page_works_and_other_sites_get_nothing(token: bool) -> None:
    from playwright.sync_api import sync_playwright

    def stolen(address: str) -> int:
        return tab.evaluate(STEAL, [address, f"viser-v{viser.__version__}"])

    callers: list[str] = []
    with ExitStack() as stack:
        open_to_all, page = viser.ViserServer(HOST, 0, verbose=False), GuardedServer(0, token)
        for server in (open_to_all, page):
            stack.callback(server.stop)
            server.scene.add_point_cloud("/secret", np.zeros((5000, 3)), (1, 2, 3), precision="float32")
        elsewhere, trap = stack.enter_context(site()), stack.enter_context(lure(callers))
        play = stack.enter_context(sync_playwright())
        flags = [*FLAGS, f"--host-resolver-rules=MAP evil.example {HOST}"]
        browser = stack.enter_context(play.chromium.launch(executable_path=CHROMIUM, args=flags))
        tab = browser.new_page()

        # The page itself, and the frames of its WebSocket.
        got: list[int] = []
        tab.add_init_script(FORBIDDEN)
        tab.on("websocket", lambda ws: ws.on("framereceived", lambda data: got.append(len(data))))
        tab.goto(page.address)
        for _ in range(200):
            if max(got, default=0) > 60_000 and page.get_clients():
                break
            tab.wait_for_timeout(50)
        assert max(got) > 60_000 and len(page.get_clients()) == 1
        tab.reload()  # by the address that viser's client has made of it
        for _ in range(200):
            if sum(size > 60_000 for size in got) > 1:
                break
            tab.wait_for_timeout(50)
        assert sum(size > 60_000 for size in got) > 1
        assert set(tab.evaluate("forbidden")) <= {"eval"}  # which it can do without

        # Nobody reaches another server through it.
        tab.goto(f"{page.address}?websocket=ws://{HOST}:{trap}")
        tab.wait_for_timeout(1000)
        tab.goto(f"http://{HOST}:{open_to_all.get_port()}?websocket=ws://{HOST}:{trap}")
        for _ in range(200):
            if callers:
                break
            tab.wait_for_timeout(50)
        assert set(callers) == {f"http://{HOST}:{open_to_all.get_port()}"}  # and so the trap works

        # Another site, by another port and by another name; the same against viser as it is.
        bare = f"http://{HOST}:{page.get_port()}"
        for origin in (f"http://{HOST}:{elsewhere}", f"http://evil.example:{elsewhere}"):
            tab.goto(origin)
            assert stolen(f"http://{HOST}:{open_to_all.get_port()}") > 60_000
            for address in (page.address, bare):
                assert stolen(address) == 0
                assert tab.evaluate(FETCH, address) == 0
            tab.evaluate(FRAME, page.address)
            assert tab.frames[1].evaluate("document.documentElement.innerText").count("refused") == 1

        # A name that its owner made point to this machine.
        tab.goto(f"http://evil.example:{open_to_all.get_port()}")
        assert stolen(f"http://evil.example:{open_to_all.get_port()}") > 60_000
        answer = tab.goto(page.address.replace(HOST, "evil.example"))
        assert answer is not None and answer.status == 403
        assert stolen(page.address.replace(HOST, "evil.example")) == 0
