"""XXH3, 128 bits, seed 0, of texts of more than 16 bytes: what `rmw_zenoh_cpp` makes its entities' ids with.

After the XXH3 specification (github.com/Cyan4973/xxHash, doc/xxhash_spec.md).
"""

_SECRET = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671fcb79e64eccc0e578825ad07dccff7221b8084674f743248e"
    "e03590e6813a264c3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8a8fa763fe39c343ff9dcbbc7c70b4f1d8a"
    "51e04bcdb45931c89f7ec9d9787364eac5ac8334d3ebc3c581a0fffa1363eb170ddd51b7f0da49d316552629d4689e2b16be587d47a1fc8f"
    "f8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
_P32 = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
_P64 = (0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5)
_M = (1 << 64) - 1
_STRIPE = 64  # bytes that the long form takes at a time
_STRIPES = (len(_SECRET) - _STRIPE) // 8  # of a block


def xxh3_128(data: bytes) -> tuple[int, int]:
    """The hash of more than 16 bytes as (low, high) 64 bits. Raises ValueError for fewer."""
    if len(data) <= 16:
        raise ValueError(f"{len(data)} bytes are too few to hash; give more than 16")
    return _middle(data) if len(data) <= 240 else _long(data)


def _u64(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 8], "little")


def _fold(a: int, b: int) -> int:
    product = a * b
    return (product & _M) ^ (product >> 64)


def _mix16(data: bytes, at: int, secret: int) -> int:
    return _fold(_u64(data, at) ^ _u64(_SECRET, secret), _u64(data, at + 8) ^ _u64(_SECRET, secret + 8))


def _avalanche(h: int) -> int:
    h ^= h >> 37
    h = h * 0x165667919E3779F9 & _M
    return h ^ h >> 32


def _middle(data: bytes) -> tuple[int, int]:
    """17 to 240 bytes."""
    n = len(data)
    low, high = n * _P64[0] & _M, 0

    def mix(first: int, second: int, secret: int) -> None:
        nonlocal low, high
        low = (low + _mix16(data, first, secret) & _M) ^ (_u64(data, second) + _u64(data, second + 8) & _M)
        high = (high + _mix16(data, second, secret + 16) & _M) ^ (_u64(data, first) + _u64(data, first + 8) & _M)

    if n <= 128:
        for i in reversed(range((n - 1) // 32 + 1)):
            mix(16 * i, n - 16 * (i + 1), 32 * i)
    else:
        for i in range(4):
            mix(32 * i, 32 * i + 16, 32 * i)
        low, high = _avalanche(low), _avalanche(high)
        for i in range(4, n // 32):
            mix(32 * i, 32 * i + 16, 3 + 32 * (i - 4))
        mix(n - 16, n - 32, 136 - 17 - 16)
    return _avalanche(low + high & _M), -_avalanche(low * _P64[0] + high * _P64[3] + n * _P64[1] & _M) & _M


def _long(data: bytes) -> tuple[int, int]:
    """More than 240 bytes."""
    acc = [_P32[2], *_P64[:4], _P32[1], _P64[4], _P32[0]]

    def accumulate(at: int, secret: int) -> None:
        for i in range(8):
            value = _u64(data, at + 8 * i)
            key = value ^ _u64(_SECRET, secret + 8 * i)
            acc[i ^ 1] = acc[i ^ 1] + value & _M
            acc[i] = acc[i] + (key & 0xFFFFFFFF) * (key >> 32) & _M

    def merged(secret: int, start: int) -> int:
        folds = (
            _fold(acc[2 * i] ^ _u64(_SECRET, secret + 16 * i), acc[2 * i + 1] ^ _u64(_SECRET, secret + 16 * i + 8))
            for i in range(4)
        )
        return _avalanche(start + sum(folds) & _M)

    n = len(data)
    for stripe in range((n - 1) // _STRIPE):
        accumulate(_STRIPE * stripe, 8 * (stripe % _STRIPES))
        if stripe % _STRIPES == _STRIPES - 1:
            for i, a in enumerate(acc):
                acc[i] = (a ^ a >> 47 ^ _u64(_SECRET, len(_SECRET) - _STRIPE + 8 * i)) * _P32[0] & _M
    accumulate(n - _STRIPE, len(_SECRET) - _STRIPE - 7)
    return merged(11, n * _P64[0] & _M), merged(len(_SECRET) - _STRIPE - 11, ~(n * _P64[1]) & _M)
