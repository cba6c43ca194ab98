"""Images of every encoding that drivers send become the same colours."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from perception.sources.ros_images import samples, to_rgb

ROWS, COLUMNS = np.mgrid[:48, :64]
SMOOTH = np.stack([60 + 2 * COLUMNS, 200 - 2 * ROWS, 40 + COLUMNS + ROWS], axis=-1).astype(np.uint8)


def message(array: np.ndarray, encoding: str, height: int = 48) -> SimpleNamespace:
    rows = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
    return SimpleNamespace(
        height=height, width=64, encoding=encoding, is_bigendian=0, step=rows.shape[1], data=rows.ravel()
    )


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_mosaic_by_its_pattern(pattern: str, bits: int) -> None:
    """The pattern names the colours of the first row's two pixels, then of the second's (sensor_msgs)."""
    mosaic = np.empty((48, 64), np.uint8)
    for i, colour in enumerate(pattern):
        y, x = divmod(i, 2)
        mosaic[y::2, x::2] = SMOOTH[y::2, x::2, "rgb".index(colour)]
    if bits == 16:
        sent = message(mosaic.astype(np.uint16) << 8, f"bayer_{pattern}16")
    else:
        sent = message(mosaic, f"bayer_{pattern}8")
    found = to_rgb(sent)
    apart = np.abs(found.astype(int) - SMOOTH)[2:-2, 2:-2]
    assert apart.max() <= 2


@pytest.mark.parametrize(("name", "first"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_pairs_that_share_their_colour(name: str, first: int) -> None:
    yuv = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV).astype(float)
    luma = 16 + yuv[..., 0] * 219 / 255
    u, v = (SMOOTH @ np.array(w) / 255 + 128 for w in ([-37.945, -74.494, 112.439], [112.439, -94.154, -18.285]))
    image = np.empty((48, 64, 2), np.uint8)
    image[..., first] = luma.round()
    chroma = image[..., 1 - first]
    chroma[:, ::2], chroma[:, 1::2] = u[:, ::2].round(), v[:, ::2].round()
    assert np.abs(to_rgb(message(image, name)).astype(int) - SMOOTH).max() <= 6


@pytest.mark.parametrize("name", ["nv12", "nv21"])
def test_planes_of_half_the_colour(name: str) -> None:
    planar = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    luma, u, v = planar[: 48 * 64], planar[48 * 64 : 60 * 64], planar[60 * 64 :]
    pair = (u, v) if name == "nv12" else (v, u)
    whole = np.concatenate([luma, np.stack(pair, axis=-1).ravel()]).reshape(72, 64)
    sent = message(whole, name)
    assert np.abs(to_rgb(sent).astype(int) - SMOOTH).max() <= 6
    assert samples(sent).shape == (48, 64)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("8UC3", SMOOTH[..., ::-1]),
        ("rgb16", SMOOTH.astype(np.uint16) << 8),
        ("bgra16", np.dstack([SMOOTH[..., ::-1], SMOOTH[..., :1]]).astype(np.uint16) << 8),
    ],
)
def test_other_samples(name: str, array: np.ndarray) -> None:
    np.testing.assert_array_equal(to_rgb(message(array, name)), SMOOTH)


def test_a_step_of_zero_is_rows_without_padding() -> None:
    sent = message(SMOOTH, "rgb8")
    sent.step = 0
    np.testing.assert_array_equal(to_rgb(sent), SMOOTH)
    sent.data = sent.data[:-1]
    with pytest.raises(ValueError, match="do not hold 64x48 px"):
        to_rgb(sent)
