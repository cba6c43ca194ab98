"""What decoders of PNG do not say: that pixels are missing or damaged, and how many are claimed."""

import zlib

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def check_png(data: bytes, most: int) -> None:
    """Raises `ValueError` for a PNG of more than `most` pixels, for one that is cut, damaged, or has fewer
    than it says.
    """
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    bits, colours, interlaced = data[24:25], data[25:26], data[28:29]
    if width * height > most:
        raise ValueError(f"it is {width}x{height} px; give at most {most} pixels")
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colours[0]) if colours else None
    wanted = height * (1 + (width * (channels or 0) * int.from_bytes(bits) + 7) // 8)
    counted = bool(channels) and interlaced == b"\0"  # an interlaced one's rows are counted otherwise
    at, kind, inflate, have = len(PNG_MAGIC), b"", zlib.decompressobj(), 0
    while kind != b"IEND":
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 12 + size
        if end > len(data):
            raise ValueError(f"it is cut short at byte {len(data)}")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ValueError(f"it is damaged near byte {at}")
        if kind == b"IDAT" and counted:
            try:
                have += len(inflate.decompress(data[at + 8 : end - 4], wanted + 1))
            except zlib.error:
                break
        at = end
    if counted and have < wanted:
        raise ValueError(f"its pixels end after {have} of {wanted} bytes")
