"""`farside view`: the frame that `replay` keeps, the picture, and the page, in a browser where there is one."""

import re
import socket
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.request import urlopen

import cv2
import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence

import node.commands.replay
from node.__main__ import main
from node.figures.turning import draw_turning
from node.viewer.page import Page
from node.viewer.page_guard import HOST
from node.viewer.scene3d import camera_view
from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import load_scene, save
from perception.observation.segmentation import segment
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder, write_frame_folder
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.browser import CHROMIUM, FLAGS, needs_browser
from tests.node.mugs import mug_hypotheses, table_frame, write_folder
from tests.node.pretend_inference import Asked


@pytest.fixture(scope="module")
def frame() -> Frame:
    return replace(table_frame(), stamp_ns=1_790_000_000_000_000_000)


@pytest.fixture(scope="module")
def mug(frame: Frame) -> Hypotheses:
    return mug_hypotheses(frame, segment(frame, 1)[0], [2.0, -2.0], [0.625, 0.375], T_world_camera=frame.T_world_camera)


@pytest.fixture
def results(tmp_path: Path, frame: Frame, mug: Hypotheses) -> Path:
    """What `replay` leaves of two objects."""
    for i in (1, 2):
        save(tmp_path / "out" / f"object_{i}.npz", replace(mug, object_id=i))
    write_frame_folder(tmp_path / "out" / "frame", frame)
    return tmp_path / "out"


def test_replay_keeps_the_frame_it_used(
    tmp_path: Path, frame: Frame, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The folder's frame is that of its objects, whatever was there; a replay of that very folder leaves it."""
    monkeypatch.setattr(node.commands.replay, "draw_object", lambda path, *_: path.touch())

    monkeypatch.setattr(node.commands.replay, "inference_of", Asked())
    prior, out = tmp_path / "tiny.safetensors", tmp_path / "out"
    save_prior(prior, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    run = ["--prior", str(prior), "--out", str(out), "--stages", "1"]
    first = write_folder(tmp_path / "first", frame)
    paler = write_folder(tmp_path / "second", replace(frame, rgb=frame.rgb // 2))
    for folder, source in ((first, first), (paler, paler), (paler, out / "frame")):
        assert main(["replay", str(source), *run]) == 0
        kept, given = read_frame_folder(out / "frame"), read_frame_folder(folder)
        for name in ("rgb", "depth", "label"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(given, name))
        assert camera_view(kept, load_scene(out)).segments.keys() == {1, 2}


def test_out_draws_a_picture_and_opens_no_page(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("node.commands.view.open_page", None)
    one = tmp_path / "a.png"
    assert main(["view", str(results / "object_1.npz"), "--out", str(one)]) == 0
    assert "log evidence" in capsys.readouterr().out
    with_view = cv2.imread(str(one))
    (results / "frame" / "meta.json").unlink()
    assert main(["view", str(results / "object_1.npz"), "--out", str(one)]) == 0
    assert (cv2.imread(str(one)) != with_view).any(axis=2).mean() > 0.01  # the camera's view is part of the picture
    assert main(["view", str(results / "object_1.npz"), "--out", str(tmp_path / "a.jpg")]) == 1
    assert f"a.jpg is no name for a picture; give --out a name such as {one}" in capsys.readouterr().err
    assert main(["view", str(results), "--out", str(one)]) == 1
    assert f"holds 2 objects; give one file, or a folder for --out, not {one}" in capsys.readouterr().err
    monkeypatch.setattr(
        "node.commands.view.draw_object", lambda path, *_: path.parent.mkdir(exist_ok=True) or path.touch()
    )
    assert main(["view", str(results), "--out", str(tmp_path / "both")]) == 0
    assert sorted(p.name for p in (tmp_path / "both").iterdir()) == ["object_1.png", "object_2.png"]


def test_out_draws_turning_hypotheses(
    results: Path, tmp_path: Path, mug: Hypotheses, capsys: pytest.CaptureFixture
) -> None:
    """A readable GIF beside whose still view (the first panel) the shapes turn."""
    moving = tmp_path / "new" / "mug.gif"
    frame = read_frame_folder(results / "frame")
    draw_turning(moving, mug, frame, steps=3)
    with Image.open(moving) as picture:
        pictures = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(picture)]
    assert len(pictures) == 3 and [p.name for p in moving.parent.iterdir()] == ["mug.gif"]
    side = pictures[0].shape[0]
    for other in pictures[1:]:
        changed = (np.abs(other - pictures[0]).max(axis=2) > 30).mean(axis=0)
        assert changed[: side // 2].max() == 0.0 and changed[side:].max() > 0.1
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("node.commands.view.draw_turning", lambda *given: calls.append(given))
        assert main(["view", str(results / "object_1.npz"), "--out", str(moving)]) == 0
    assert calls[0][0] == moving and str(moving) in capsys.readouterr().out


@pytest.mark.parametrize(("change", "says"), [("stamp", "but object 1 is of"), ("cut", "it is cut short at byte 200")])
def test_a_frame_that_is_not_the_objects_is_left_out(
    results: Path, frame: Frame, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, change: str, says: str
) -> None:
    drawn = []
    monkeypatch.setattr("node.commands.view.draw_object", lambda *given: drawn.append(given[2:]))
    if change == "stamp":
        write_frame_folder(results / "frame", replace(frame, stamp_ns=5))
    else:
        data = (results / "frame" / "color.png").read_bytes()
        (results / "frame" / "color.png").write_bytes(data[:200])
    assert main(["view", str(results / "object_1.npz"), "--out", "a.png"]) == 0
    note = capsys.readouterr().err
    assert note.startswith("note: the picture is left out: ") and says in note and drawn == [(None, None)]


@pytest.mark.parametrize("token", [[], ["--token"]])
def test_view_opens_the_page_until_ctrl_c(
    results: Path, token: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    loaded: list[bytes] = []

    class Interrupted:
        def wait(self) -> None:
            address, path = re.search(rf"(http://{HOST}:\d+)(\S*) shows it", capsys.readouterr().out).groups()
            assert bool(path) == bool(token)
            if token:
                with pytest.raises(HTTPError, match="403"):
                    urlopen(address, timeout=20)
            address += path
            loaded.append(urlopen(address, timeout=20).read())
            raise KeyboardInterrupt

    monkeypatch.setattr("node.commands.view.threading", SimpleNamespace(Event=Interrupted))
    assert main(["view", str(results), "--port", "0", *token]) == 0
    assert b"<html" in loaded[0]
    assert sorted(p.name for p in results.iterdir()) == ["frame", "object_1.npz", "object_2.npz"]  # nothing is drawn


def test_a_busy_port_is_named(results: Path, capsys: pytest.CaptureFixture) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", str(results), "--port", str(port)]) == 1
    error = capsys.readouterr().err
    assert error.splitlines() == [f"farside: error: port {port} of {HOST} is in use; give another, or 0 for a free one"]


def test_the_page_listens_on_this_machine_alone_and_shows_from_any_thread(frame: Frame, mug: Hypotheses) -> None:
    with Page(0) as page:
        port = int(page.address.rsplit(":", 1)[1])
        assert page.address == f"http://{HOST}:{port}"
        with socket.socket() as other:  # 127.0.0.2 is this machine too, and no one listens there
            assert other.connect_ex(("127.0.0.2", port)) != 0
        scenes = [[mug], [mug, replace(mug, object_id=2)], [replace(mug, object_id=3)]] * 2
        view = camera_view(frame, [mug])
        threads = [threading.Thread(target=page.show, args=(s, view if i % 2 else None)) for i, s in enumerate(scenes)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        page.show([mug])
        page.show([mug], camera_view(replace(frame, depth=None), [mug]))
        with pytest.raises(ValueError, match="no object to show"):
            page.show([])
    with socket.socket() as gone:
        assert gone.connect_ex((HOST, port)) != 0


@pytest.mark.slow
@needs_browser
def test_the_page_answers_in_a_browser(frame: Frame, mug: Hypotheses) -> None:
    """It loads nothing from elsewhere; stepping shows another mesh; dragging the box's arrow asks anew."""
    from playwright.sync_api import expect, sync_playwright

    with Page(0) as page, sync_playwright() as play:
        page.show([mug], camera_view(frame, [mug]))
        with play.chromium.launch(executable_path=CHROMIUM, args=FLAGS) as browser:
            tab = browser.new_page(viewport={"width": 1100, "height": 760})
            tab.set_default_timeout(100_000)
            expect.set_options(timeout=100_000)
            asked: list[str] = []
            tab.on("request", lambda request: asked.append(request.url))
            tab.on("websocket", lambda opened: asked.append(opened.url))
            tab.goto(page.address)
            corners = tab.get_by_text("--box")
            expect(tab.get_by_text("hypothesis 1 of 2, weight 62.5%")).to_be_visible()
            expect(corners).to_be_visible()
            (client,) = page._server.get_clients().values()
            while not np.allclose(client.camera.position, page._server.initial_camera.position, atol=1e-3):
                tab.wait_for_timeout(200)
            first = _canvas(tab)
            tab.get_by_role("button", name="next", exact=True).click()
            expect(tab.get_by_text("hypothesis 2 of 2, weight 37.5%")).to_be_visible()
            second = _canvas(tab)
            assert (np.abs(first - second).max(axis=2) > 40).sum() > 300  # the handle is on the other side
            before, odds = corners.inner_text(), tab.get_by_text("P(free) =").first
            said = odds.inner_text()
            _drag_up(tab, client.camera, np.array(page._gizmo.position), page._gizmo.scale)
            expect(corners).not_to_have_text(before)
            low, high = (float(re.findall(r"-?\d+\.\d+", text)[2]) for text in (before, corners.inner_text()))
            assert high > low + 0.005
            expect(odds).not_to_have_text(said)
            assert asked and all(re.match(rf"(blob:)?(http|ws)://{HOST}:", url) for url in asked), asked


def _canvas(tab) -> np.ndarray:
    tab.wait_for_timeout(2000)
    png = np.frombuffer(tab.locator("canvas").first.screenshot(), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_COLOR).astype(int)


def _drag_up(tab, camera, centre: np.ndarray, arrow: float) -> None:
    """Pull the box's upward arrow with the mouse."""
    area = tab.locator("canvas").first.bounding_box()
    w, x, y, z = camera.wxyz
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

    def pixel(point: np.ndarray) -> np.ndarray:
        u, v, depth = (point - camera.position) @ R
        focal = 0.5 * area["height"] / np.tan(0.5 * camera.fov)
        middle = np.array([area["x"] + 0.5 * area["width"], area["y"] + 0.5 * area["height"]])
        return middle + focal * np.array([u, v]) / depth

    start, end = (pixel(centre + np.array([0, 0, far * arrow])) for far in (0.7, 1.4))
    tab.mouse.move(*start)
    tab.wait_for_timeout(1000)
    tab.mouse.down()
    for share in np.linspace(0.1, 1.0, 10):
        tab.mouse.move(*(start + share * (end - start)))
        tab.wait_for_timeout(100)
    tab.mouse.up()
