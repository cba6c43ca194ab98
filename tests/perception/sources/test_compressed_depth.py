"""Depth packed by ROS's compressedDepth transport, packed here by the papers' own words."""

import struct

import cv2
import numpy as np
import pytest

from perception.sources.compressed_depth import unpacked

RNG = np.random.default_rng(0)
COUNTS = RNG.integers(400, 5000, (24, 40), dtype=np.uint16)
COUNTS[RNG.random(COUNTS.shape) < 0.3] = 0
COUNTS[:3] = 0
COUNTS[-1] = 65535
HEADER = bytes(12)


def rvl(image: np.ndarray) -> bytes:
    """Wilson's encoder (2017, listing 1), a nibble at a time."""
    nibbles: list[int] = []

    def write(value: int) -> None:
        while True:
            nibble, value = value & 7, value >> 3
            nibbles.append(nibble | (8 if value else 0))
            if not value:
                return

    flat, at, previous = image.ravel().astype(int), 0, 0
    while at < len(flat):
        zeros = 0
        while at + zeros < len(flat) and flat[at + zeros] == 0:
            zeros += 1
        write(zeros)
        at += zeros
        several = 0
        while at + several < len(flat) and flat[at + several] != 0:
            several += 1
        write(several)
        for value in flat[at : at + several]:
            change, previous = int(value) - previous, int(value)
            write((change << 1) ^ (change >> 63))
        at += several
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack("<2I", image.shape[1], image.shape[0]) + struct.pack(f"<{len(words)}I", *words)


def packed(header: bytes, content: bytes) -> np.ndarray:
    return np.frombuffer(header + content, np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


@pytest.mark.parametrize("pack", [png, rvl])
def test_counts_come_back(pack) -> None:
    form = "16UC1; compressedDepth" + (" rvl" if pack is rvl else "")
    found = unpacked(form, packed(HEADER, pack(COUNTS)))
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, COUNTS)


@pytest.mark.parametrize("pack", [png, rvl])
def test_metres_come_back_to_a_count(pack) -> None:
    # the transport's defaults: quantization 100, at most 10 m
    a = 100.0 * (100.0 + 1.0)
    b = 1.0 - a / 10.0
    metres = RNG.uniform(0.3, 8.0, (24, 40)).astype(np.float32)
    metres[:2] = np.nan
    counts = np.nan_to_num(a / metres + b).astype(np.uint16)
    header = struct.pack("<I2f", 0, a, b)
    found = unpacked(
        "32FC1; compressedDepth png" if pack is png else "32FC1; compressedDepth rvl", packed(header, pack(counts))
    )
    assert found.dtype == np.float32 and np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2:], metres[2:], rtol=0.002, atol=0.0)


def test_what_is_cut_is_refused() -> None:
    content = rvl(COUNTS)
    for end in (0, 7, 8, 20, len(content) // 2, len(content) - 8):
        with pytest.raises(ValueError, match="RVL data is cut short"):
            unpacked("16UC1; compressedDepth rvl", packed(HEADER, content[:end]))


def test_sizes_are_looked_at_first() -> None:
    with pytest.raises(ValueError, match="says 4000000000x4000000000 px"):
        unpacked(
            "16UC1; compressedDepth rvl", packed(HEADER, struct.pack("<2I", 4_000_000_000, 4_000_000_000) + bytes(64))
        )


@pytest.mark.parametrize("seed", range(20))
def test_damage_is_an_error_or_a_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    content = np.frombuffer(rvl(COUNTS), np.uint8).copy()
    content[rng.integers(8, len(content), 20)] ^= rng.integers(1, 256, 20).astype(np.uint8)
    try:
        assert unpacked("16UC1; compressedDepth rvl", packed(HEADER, content.tobytes())).shape == COUNTS.shape
    except ValueError as error:
        assert "RVL data" in str(error)
