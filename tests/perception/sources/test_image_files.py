"""Pictures are decoded as OpenCV does, and those that are damaged or claim too much are refused."""

import random
import struct
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from perception.sources.image_files import decoded
from tests.node.mugs import table_frame

BGR = np.ascontiguousarray(table_frame().rgb[..., ::-1])
KINDS = {
    "baseline": [],
    "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 8],
    "optimised": [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
}


def jpeg(kind: str = "baseline", image: np.ndarray = BGR) -> bytes:
    return cv2.imencode(".jpg", image, KINDS[kind])[1].tobytes()


def wrong_bits(data: bytearray, at: int, rng: random.Random) -> None:
    for _ in range(64):
        data[at + rng.randrange(512)] ^= 1 << rng.randrange(8)


def zeros(data: bytearray, at: int, _: random.Random) -> None:
    data[at : at + 512] = bytes(512)


def lost(data: bytearray, at: int, _: random.Random) -> None:
    del data[at : at + 512]


def noise(data: bytearray, at: int, rng: random.Random) -> None:
    data[at : at + 512] = rng.randbytes(512)


@pytest.mark.parametrize("kind", KINDS)
def test_a_jpeg_has_the_pixels_that_opencv_finds(kind: str) -> None:
    for image in (BGR, BGR[..., 0]):
        data = jpeg(kind, image)
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decoded(data), expected)
        np.testing.assert_array_equal(decoded(data + bytes(4096)), expected)  # a driver's buffer


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", [wrong_bits, zeros, lost, noise], ids=lambda damage: damage.__name__)
def test_a_jpeg_that_is_damaged_inside_is_refused(
    kind: str, damage: Callable[[bytearray, int, random.Random], None], capfd: pytest.CaptureFixture
) -> None:
    whole, refused = jpeg(kind), 0
    first = whole.index(b"\xff\xda")
    for seed in range(50):
        rng, data = random.Random(seed), bytearray(whole)
        damage(data, rng.randrange(first + 20, len(data) - 520), rng)
        try:
            assert decoded(bytes(data)).shape == BGR.shape
        except ValueError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused >= 40
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("filling", [bytes(651), b"\xff" * 40, b"\x12\x34\x56"])
def test_a_camera_may_fill_a_jpeg_up(filling: bytes) -> None:
    """Axis network cameras leave hundreds of bytes before the end, and Logitech webcams some before each restart."""
    data = jpeg()
    expected = decoded(data)
    np.testing.assert_array_equal(decoded(data[:-2] + filling + data[-2:]), expected)
    data = jpeg("restarts")
    np.testing.assert_array_equal(decoded(data.replace(b"\xff\xd3", b"\x12\x34\x56\xff\xd3")), decoded(data))


def test_a_jpeg_of_a_thousand_scans_is_refused_at_once() -> None:
    data = jpeg("progressive")
    last = data.rindex(b"\xff\xda")
    with pytest.raises(ValueError, match="more than 100 scans"):
        decoded(data[:-2] + 1000 * data[last:-2] + data[-2:])


def test_pictures_that_claim_too_much_are_refused_whatever_was_imported_before() -> None:
    """OpenCV reads its limit from the environment when it is imported, which another program may have done."""
    claims = {".jpg": bytearray(jpeg()), ".bmp": bytearray(cv2.imencode(".bmp", BGR)[1].tobytes())}
    at = claims[".jpg"].index(b"\xff\xc0")
    claims[".jpg"][at + 5 : at + 9] = struct.pack(">HH", 9000, 9000)
    claims[".bmp"][18:26] = struct.pack("<ii", 9000, 9000)
    claims[".webp"] = bytearray(cv2.imencode(".webp", np.zeros((8200, 8200), np.uint8))[1].tobytes())
    for data in claims.values():
        with pytest.raises(ValueError, match="larger than 67108864 pixels"):
            decoded(bytes(data))


def test_a_damaged_png_in_a_message_is_refused() -> None:
    data = bytearray(cv2.imencode(".png", BGR)[1].tobytes())
    data[len(data) // 2] ^= 4
    with pytest.raises(ValueError, match="damaged near byte"):
        decoded(bytes(data))
