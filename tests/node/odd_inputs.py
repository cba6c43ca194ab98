"""Odd recordings and files, and what `farside segment` must make of each: the table of docs/tried.md.

`python -m tests.node.odd_inputs` writes the page. Each input shows the frame of `table_frame`, with two objects.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.sources.frame_folder import write_frame_folder
from tests.node.mugs import table_frame
from tests.perception.sources.test_compressed_depth import rvl
from tests.perception.sources.test_recording import maker, record

PAGE = Path(__file__).parents[2] / "docs" / "tried.md"
READ = "read"  # both objects are found
START, MS = 1_700_000_000_000_000_000, 1_000_000
COLOUR, DEPTH, INFO = "/cam/color/image_raw", "/cam/aligned_depth_to_color/image_raw", "/cam/color/camera_info"
MAKE, FRAME = maker("mcap"), table_frame()
RGB, K = FRAME.rgb, FRAME.camera.K
METRES = np.where(np.isfinite(FRAME.depth), FRAME.depth, 0.0).astype(np.float32)
MM = np.rint(1000.0 * METRES).astype(np.uint16)
HEIGHT, WIDTH = MM.shape
BROWN = [0.01, -0.01, 0.001, -0.001, 0.002]


@dataclass(frozen=True)
class Odd:
    """One input. `expected` is READ, or a part of the error or note."""

    kind: str
    name: str
    expected: str
    write: Callable[[Path], list[str]]  # into a folder; returns the arguments of `farside segment`


def info(stamp: int = START, model: str = "plumb_bob", d: Any = (0.0,) * 5, k: Any = K, **others: Any) -> Any:
    """A camera_info of the frame's camera. `others` are fields of the message."""
    message = MAKE.info(stamp, topic=INFO, size=(HEIGHT, WIDTH))
    sent = message[3]
    sent.k, sent.d, sent.distortion_model = np.ravel(k).astype(float), np.array(d, float), model
    sent.p = np.insert(sent.k, [3, 6, 9], 0.0)
    for name, value in others.items():
        if name == "roi":
            sent.roi.x_offset, sent.roi.y_offset, sent.roi.width, sent.roi.height = value
        else:
            setattr(sent, name, value)
    return message


def colour(array: np.ndarray = RGB, encoding: str = "rgb8", stamp: int = START, **others: Any) -> Any:
    """A colour image; `others` are fields of the message, or `maker`'s options."""
    fields = {name: others.pop(name) for name in ("height", "step", "encoding") if name in others}
    message = MAKE.image(others.pop("topic", COLOUR), stamp, array, encoding, **others)
    for name, value in fields.items():
        setattr(message[3], name, value)
    return message


def depth(array: np.ndarray = MM, encoding: str = "16UC1", **others: Any) -> Any:
    return MAKE.image(others.pop("topic", DEPTH), START, array, encoding, **others)


def packed(data: bytes, form: str, topic: str = f"{DEPTH}/compressedDepth") -> Any:
    return MAKE.compressed(topic, START, np.frombuffer(data, np.uint8), form)


def stamped(seconds: int) -> list[Any]:
    messages = [info(), colour(), depth()]
    for message in messages:
        message[3].header.stamp.sec = seconds
    return messages


def log(messages: list[Any]) -> Callable[[Path], list[str]]:
    """As one file: a folder's metadata take longer to read than all else."""
    return lambda folder: [str(next(record(folder / "log", "mcap", messages).glob("*.mcap")))]


def beside(name: str, text: str, option: str) -> Callable[[Path], list[str]]:
    """The frame, with a file given by an option."""

    def write(folder: Path) -> list[str]:
        (folder / name).write_text(text)
        np.savez(folder / "frame.npz", rgb=RGB, depth=FRAME.depth, K=K)
        return [str(folder / "frame.npz"), option, str(folder / name)]

    return write


def arrays(**changed: np.ndarray) -> Callable[[Path], list[str]]:
    def write(folder: Path) -> list[str]:
        np.savez(folder / "frame.npz", **{"rgb": RGB, "depth": FRAME.depth, "K": K} | changed)
        return [str(folder / "frame.npz")]

    return write


def damaged_jpeg() -> bytes:
    """The frame's colours with 700 bytes lost on the way."""
    jpeg = cv2.imencode(".jpg", RGB[..., ::-1])[1].tobytes()
    return jpeg[: len(jpeg) // 2] + jpeg[len(jpeg) // 2 + 700 :]


def folder_with_damaged_jpeg(folder: Path) -> list[str]:
    write_frame_folder(folder / "frame", FRAME)
    (folder / "frame" / "color.png").unlink()
    (folder / "frame" / "rgb.jpg").write_bytes(damaged_jpeg())
    return [str(folder / "frame")]


def odd_inputs() -> Iterator[Odd]:
    """All of them."""
    for kind, cases in (("colour", _colours()), ("depth", _depths()), ("camera", _cameras()), ("log", _logs())):
        for name, expected, messages in cases:
            yield Odd(kind, name, expected, log(messages))
    yield from _files()


def _colours() -> Iterator[tuple[str, str, list[Any]]]:
    bgr, grey = np.ascontiguousarray(RGB[..., ::-1]), cv2.cvtColor(RGB, cv2.COLOR_RGB2GRAY)
    planar = cv2.cvtColor(RGB, cv2.COLOR_RGB2YUV_I420)
    pair = np.dstack([np.full((HEIGHT, WIDTH), 128, np.uint8), planar[:HEIGHT]])
    planes = np.vstack([planar[:HEIGHT], np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    raw = {"8UC3": bgr, "BGR8": bgr, "bgra8": np.dstack([bgr, grey]), "rgb16": RGB.astype(np.uint16) << 8}
    raw |= {name: grey for name in ("mono8", "bayer_rggb8", "BAYER_GRBG8")} | {"bayer_gbrg16": grey.astype("<u2") << 8}
    raw |= {name: pair for name in ("uyvy", "yuv422", "UYVY")}
    raw |= {name: pair[..., ::-1] for name in ("yuyv", "yuv422_yuy2", "YUYV")}
    for name, array in raw.items():
        yield name, READ, [info(), colour(array, name), depth()]
    for name in ("nv12", "nv21", "NV12"):
        yield name, READ, [info(), colour(planes, name, height=HEIGHT), depth()]
    for name in ("32FC3", "nv24", "16UC3"):
        yield name, "no colour image", [info(), colour(encoding=name), depth()]
    yield "rows with padding", READ, [info(), colour(pad=7), depth()]
    yield "step 0", READ, [info(), colour(step=0), depth()]
    yield "step too small", "mend the driver's step", [info(), colour(step=WIDTH), depth()]
    yield "step of 4 GB", "mend the driver's step", [info(), colour(step=2**32 - 1), depth()]
    jpeg = cv2.imencode(".jpg", bgr)[1].tobytes()
    topic = f"{COLOUR}/compressed"
    for form in ("jpeg", "", "rgb8; jpeg compressed bgr8", "bgr8;jpeg compressed", "mjpeg", "image/jpeg"):
        yield f"JPEG, format {form!r}", READ, [info(), packed(jpeg, form, topic), depth()]
    damaged = [packed(bytes(data), "jpeg", topic) for data in (damaged_jpeg(), jpeg)]
    damaged[1][3].header.stamp.nanosec += 500 * MS
    after = [depth(), depth()]
    after[1][3].header.stamp.nanosec += 500 * MS
    yield "JPEG, damaged in the middle", "damaged: Corrupt JPEG data", [info(), damaged[0], depth()]
    yield "JPEG, the first of two damaged", "1 image that cannot be read left out", [info(), *damaged, *after]
    for ending in ("png", "tiff", "webp", "bmp"):
        data = cv2.imencode(f".{ending}", bgr)[1].tobytes()
        yield f"{ending} in a message", READ, [info(), packed(data, f"rgb8; {ending} compressed bgr8", topic), depth()]
    yield "H.264 called h264", "cannot decode", [info(), packed(b"\0\0\0\1g" * 99, "h264", topic), depth()]


def _depths() -> Iterator[tuple[str, str, list[Any]]]:
    nan = np.where(METRES > 0, METRES, np.nan).astype(np.float32)
    raw = {"32FC1": nan, "mono16": MM}
    for name, array in raw.items():
        yield name, READ, [info(), colour(), depth(array, name)]
    yield (
        "32FC1, unknown is infinite",
        READ,
        [info(), colour(), depth(np.where(METRES > 0, METRES, np.float32(np.inf)), "32FC1")],
    )
    yield "16UC1, unknown is 65535", READ, [info(), colour(), depth(np.where(MM > 0, MM, np.uint16(65535)))]
    yield "16UC1 big-endian", READ, [info(), colour(), depth(MM.astype(">u2"), big=1)]
    yield (
        "16UC1, wrong byte order",
        "correct the depth's unit|no support plane",
        [info(), colour(), depth(MM.byteswap())],
    )
    yield "millimetres as 32FC1", "its median is", [info(), colour(), depth(1000 * nan, "32FC1")]
    yield "negative", "negative", [info(), colour(), depth(-nan, "32FC1")]
    yield "nothing known", "no pixel .* has depth", [info(), colour(), depth(nan * np.float32(np.nan), "32FC1")]
    yield (
        "tenths of millimetres",
        "correct the depth's unit",
        [info(), colour(), depth(np.minimum(10 * MM.astype(int), 65534).astype(np.uint16))],
    )
    yield "other size", "aligned to colour", [info(), colour(), depth(MM[::2, ::2])]
    yield "other frame_id", "is not aligned", [info(), colour(), depth(frame="depth_frame")]
    for name, array in {"64FC1": nan.astype(float), "16SC1": MM.astype(np.int16), "Z16": MM}.items():
        yield name, "is not read as depth", [info(), colour(), depth(array, name)]
    png, runs, header = cv2.imencode(".png", MM)[1].tobytes(), rvl(MM), bytes(12)
    for form, data in {
        "16UC1; compressedDepth": png,
        "16UC1; compressedDepth png": png,
        "compressedDepth": png,
        "16UC1; compressedDepth rvl": runs,
    }.items():
        yield f"{form!r}", READ, [info(), colour(), packed(header + data, form)]
    yield (
        "compressedDepth without a header",
        "cannot decode",
        [info(), colour(), packed(png, "16UC1; compressedDepth png")],
    )
    yield "compressedDepth without a format", "is not read as depth", [info(), colour(), packed(header + png, "")]


def _cameras() -> Iterator[tuple[str, str, list[Any]]]:
    def of(name: str, expected: str = READ, **fields: Any) -> tuple[str, str, list[Any]]:
        return name, expected, [info(**fields), colour(), depth()]

    for model, d in (
        *(
            ("plumb_bob", BROWN[:4]),
            ("plumb_bob", [*BROWN, 0.01, 0.01, 0.01]),
            ("Plumb-Bob", BROWN),
            ("radtan", BROWN[:4]),
        ),
        *(("rational_polynomial", [*BROWN, *[0.0] * n]) for n in (0, 3, 5, 7, 9)),
        *(("inverse_brown_conrady", BROWN), ("Inverse Brown-Conrady", BROWN), ("modified_brown_conrady", BROWN)),
        *(("", [0.0] * 5), ("none", []), ("", BROWN), ("sphere", [0.0] * 5)),
    ):
        yield of(f"{model!r}, {len(d)} coefficients{'' if np.any(d) else ', all zero'}", model=model, d=d)
    yield of("unknown lens", "is unknown", model="double_sphere", d=[0.5, 0.1])
    yield of("coefficients that are not finite", "finite", d=[np.nan] * 5)
    yield of("coefficients of 1e300", "has no ray for", d=[1e300] * 5)
    yield of("K in parts of the picture", "focal length is", k=K / [[WIDTH], [HEIGHT], [1.0]])
    yield of("K of another resolution", "of another resolution", k=K * [[3.0], [3.0], [1.0]])
    yield of("K transposed", "is it transposed", k=K.T)
    yield of("no width and height", "both must be positive", width=0, height=0)
    shifted = K + np.array([[0, 0, 30], [0, 0, 20], [0, 0, 0]])
    yield of("part of the sensor (roi)", k=shifted, width=400, height=300, roi=(30, 20, WIDTH, HEIGHT))
    double = K * [[2.0], [2.0], [1.0]] + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    whole = {"width": 400, "height": 300}
    yield of("roi of zeros with an offset", roi=(30, 20, 0, 0))
    yield of("roi that is the whole sensor", roi=(0, 0, WIDTH, HEIGHT))
    yield of("cropped without a roi", "camera_info says 400x300 px with roi 0x0 at 0, 0", k=shifted, **whole)
    yield of("roi beyond the sensor", "principal point", k=shifted, roi=(300, 200, WIDTH, HEIGHT), **whole)
    yield of("binning of what is binned already", "and binning 2x2, by which", binning_x=2, binning_y=2)
    yield of("binning 1x0", binning_x=1)
    yield of("binned", k=double, width=2 * WIDTH, height=2 * HEIGHT, binning_x=2, binning_y=2)
    rectified = colour(topic="/cam/color/image_rect_color")
    yield "rectified, P zero", READ, [info(p=np.zeros(12)), rectified, depth()]


def _logs() -> Iterator[tuple[str, str, list[Any]]]:
    yield "no camera_info", "has no camera_info", [colour(), depth()]
    yield "camera_info empty at first", READ, [info(k=np.zeros(9)), info(START + 1), colour(), depth()]
    yield "camera_info at the end", READ, [colour(), depth(), info(START + 5000 * MS)]
    yield "stamps of zero", "stamps .* are empty", stamped(0)
    yield "stamps before 1970", "the stamp is", stamped(-5)
    yield "stamps of 2038", READ, stamped(2**31 - 1)
    for name in ("/", "/a b/[red]c[/x]", "/cam/:smile:", "/x\ny", "/cam/ünï"):
        yield f"colour on {name!r}", READ, [info(), colour(topic=name), depth()]
    second = [colour(topic="/cam2/color/image_raw", frame="cam2"), depth(topic="/cam2/depth/image_raw", frame="cam2")]
    yield "two cameras", "choose with --colour-topic", [info(), colour(), depth(), *second]
    yield "infrared beside", READ, [info(), colour(), depth(), depth(topic="/cam/infra1/image_rect_raw")]


def _files() -> Iterator[Odd]:
    merged = "a0: &a0 {k: v}\n" + "".join(
        f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 11)
    )
    laughs = 'a0: &a0 "ha"\n' + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 11))
    texts = {"merge keys that multiply": (merged, "merged"), "aliases that multiply": (laughs, "aliases")}
    texts |= {"50,000 brackets": ("[" * 50_000, "too deep"), "a megabyte": ("a: 1\n" * 200_000, "more than 256 kB")}
    texts |= {
        "a tag that calls": ("a: !!python/name:os.system x", "constructor"),
        "a tag that does not fit": ("a: !!int x", "YAML"),
    }
    for name, (text, expected) in texts.items():
        for what, option in (("camera file", "--camera"), ("configuration", "--config")):
            yield Odd("file", f"{what}: {name}", expected, beside("a.yaml", text, option))
    yield Odd(
        "file", "frame folder: JPEG damaged in the middle", "damaged: Corrupt JPEG data", folder_with_damaged_jpeg
    )
    turned = np.eye(4)
    turned[3, 0] = 0.1
    yield Odd("file", "npz: pose transposed", "no rotation", arrays(T_world_camera=turned))
    yield Odd("file", "npz: pose not finite", "no rotation", arrays(T_world_camera=np.full((4, 4), np.nan)))
    yield Odd("file", "npz: colour not finite", "uint8", arrays(rgb=np.full(RGB.shape, np.nan)))
    yield Odd("file", "npz: depth of 8 bits", "holds uint8", arrays(depth=MM.astype(np.uint8)))
    yield Odd("file", "npz: depth as text", "save numbers", arrays(depth=METRES.astype(str)))
    yield Odd("file", "npz: depth big-endian", READ, arrays(depth=FRAME.depth.astype(">f4")))


def page() -> str:
    """The page: what was tried, by kind."""
    lines = [
        "# What was tried",
        "",
        "Odd recordings and files, each given to `farside segment` by `tests/node/test_odd_inputs.py`. *read*: both",
    ]
    lines += ["objects are found. Otherwise: what the error or the note says, in one line.", ""]
    lines += ["| kind | input | outcome |", "|---|---|---|"]
    for case in odd_inputs():
        name = json.dumps(case.name, ensure_ascii=False)[1:-1].replace("|", "\\|")
        told = (
            "*read*" if case.expected == READ else "“" + case.expected.replace(".*", "…").replace("|", "” or “") + "”"
        )
        lines.append(f"| {case.kind} | {name} | {told} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
