"""Bags, weights, configurations, cameras, poses, pictures, meshes and messages as bad disks or attackers make them.

Each is read, or refused in one line that names it, within seconds and bounded memory. Seeded; more of them by
`MANGLED=2000 pytest tests/properties`.
"""

import json
import random
import struct
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest
import trimesh
import yaml

from calibration.camera_file import read_camera, write_camera
from calibration.pose_files import read_robot_poses
from node.commands.config_file import load_config
from node.commands.options import LiveConfig
from node.ros.messages import HYPOTHESES, QUERY_REGION, decode, encode, frame_messages, hypotheses_from, make
from node.ros.messages import hypotheses_message as message_of
from perception.sources.image_files import decoded
from perception.sources.ros_camera import to_camera
from perception.sources.ros_images import to_depth, to_rgb
from probnerf.objects.mesh import read_folder
from probnerf.prior.checkpoint import load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.shapes import body_with_handle
from tests.perception.cylinders import CAN, picture
from tests.perception.sources.test_recording import maker, record
from tests.properties.mangling import COUNT, another, bounded, mangled, refused, seeds, told

LIVE = Path(__file__).parents[2] / "launch" / "live.yaml"


@pytest.fixture(autouse=True)
def memory() -> Iterator[None]:
    with bounded():
        yield


@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_bags(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """A ROS 1 bag; a ROS 2 folder of sqlite, its database or its metadata damaged."""
    make, frame, out, codes = maker(kind), picture(CAN), tmp_path / "out.mcap", []
    depth = np.nan_to_num(frame.depth)
    messages = []
    for stamp in (10**18, 10**18 + 10**8):
        messages += [make.info(stamp), make.image("/c/color/image_raw", stamp, frame.rgb, "rgb8")]
        messages.append(make.image("/c/depth/image_raw", stamp, depth, "32FC1"))
    path = record(tmp_path / ("a.bag" if kind == "bag" else "a"), kind, messages)
    files = [path] if kind == "bag" else [next(path.glob("*.db3")), path / "metadata.yaml"]
    whole = {file: file.read_bytes() for file in files}
    told(["record", str(path), "--out", str(out)], path, out, capfd)
    for seed in seeds(COUNT // 2):
        rng = random.Random(seed)
        file = rng.choice(files)
        file.write_bytes(mangled(whole[file], rng))
        codes.append(told(["record", str(path), "--out", str(out)], path, out, capfd))
        file.write_bytes(whole[file])
    assert any(codes)


def test_weights(tmp_path: Path) -> None:
    """safetensors: bytes, and the header's types, shapes, offsets and metadata."""
    path, codes = tmp_path / "p.safetensors", []
    save_prior(path, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    whole = path.read_bytes()
    size = struct.unpack("<Q", whole[:8])[0]
    header, data = json.loads(whole[8 : 8 + size]), whole[8 + size :]
    for seed in seeds():
        rng = random.Random(seed)
        if seed % 3 == 0:
            path.write_bytes(mangled(whole, rng))
        else:
            changed = another(header, rng)
            if seed % 3 == 1:
                name = rng.choice([name for name in header if name != "__metadata__"])
                key, value = rng.choice(
                    [("dtype", "F64"), ("dtype", "BOOL"), ("shape", [2**40]), ("shape", [0, 2**62])]
                )
                changed = header | {name: header[name] | {key: value}}
            text = json.dumps(changed).encode()
            path.write_bytes(struct.pack("<Q", rng.choice([len(text)] * 4 + [2**40, 2**63])) + text + data)
        codes.append(refused(lambda: load_prior(path), str(path)))
    assert sum(codes) > 0.4 * COUNT


def test_configurations(tmp_path: Path) -> None:
    path, codes, whole = tmp_path / "live.yaml", [], LIVE.read_bytes()
    values = json.loads(json.dumps(asdict(LiveConfig()), default=str))
    for seed in seeds():
        rng = random.Random(seed)
        if seed % 3 == 0:
            path.write_bytes(mangled(whole, rng))
        else:
            path.write_text(yaml.safe_dump(another(values, rng)))
        codes.append(refused(lambda: load_config(path, LiveConfig), str(path)))
    assert sum(codes) > 0.3 * COUNT


def test_cameras(tmp_path: Path) -> None:
    path, codes = tmp_path / "camera.yaml", []
    write_camera(path, picture(CAN).camera)
    whole = path.read_bytes()
    for seed in seeds(2 * COUNT):
        rng = random.Random(seed)
        changed = mangled(whole, rng) if seed % 2 else yaml.safe_dump(another(yaml.safe_load(whole), rng)).encode()
        path.write_bytes(changed)
        codes.append(refused(lambda: read_camera(path), str(path)))
    assert sum(codes) > 0.3 * COUNT


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb"])
def test_meshes(suffix: str, tmp_path: Path) -> None:
    """A broken mesh costs itself alone: it is left out with a reason in one line."""
    box = trimesh.creation.box((0.1, 0.2, 0.1))
    whole, other = tmp_path / f"a.{suffix}", tmp_path / "other.ply"
    box.export(whole)
    box.export(other)
    data = whole.read_bytes()
    for seed in seeds(COUNT // 2):
        whole.write_bytes(mangled(data, random.Random(seed)))
        found = dict(read_folder(tmp_path))
        assert isinstance(found["other"], trimesh.Trimesh)
        assert isinstance(found["a"], trimesh.Trimesh) or "\n" not in found["a"]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tiff", ".webp", ".bmp"])
def test_pictures(suffix: str) -> None:
    """As a message or a file holds them."""
    whole, codes = cv2.imencode(suffix, picture(CAN).rgb)[1].tobytes(), []
    for seed in seeds(2 * COUNT):
        data = mangled(whole, random.Random(seed))
        codes.append(refused(lambda data=data: decoded(data), ""))  # type: ignore[misc]
    assert sum(codes) > (0.4 * COUNT if suffix in (".jpg", ".png") else 0)


@pytest.mark.parametrize("suffix", ["csv", "json", "yaml"])
def test_poses(suffix: str, tmp_path: Path) -> None:
    """The robot's, for a hand-eye calibration."""
    path, codes = tmp_path / f"poses.{suffix}", []
    poses = [{"position": [0.1, 0.2, 0.3], "orientation": {"x": 0.0, "y": 0.6, "z": 0.0, "w": 0.8}}] * 3
    text = "\n".join(["a.png,0.1,0.2,0.3,0,0.6,0,0.8"] * 3) if suffix == "csv" else json.dumps(poses)
    for seed in seeds(2 * COUNT):
        rng = random.Random(seed)
        if seed % 2 or suffix == "csv":
            path.write_bytes(mangled(text.encode(), rng))
        else:
            path.write_text(json.dumps(another(poses, rng)))
        codes.append(refused(lambda: read_robot_poses(path), str(path)))
    assert sum(codes) > 0.4 * COUNT


def test_messages() -> None:
    """What comes on the bus is a message, or a ValueError of one line; and what is read of a message, too."""
    frame = picture(CAN)
    sent = [*frame_messages(frame).values(), message_of(body_with_handle()), make(f"{QUERY_REGION}_Request")]
    codes = []
    for seed in seeds(2 * COUNT):
        rng = random.Random(seed)
        message: Any = rng.choice(sent)
        kind, data = message.__msgtype__, bytes(encode(message))
        head = rng.choice([len(data), 200])  # the numbers that say how long the rest is stand at the front
        data = mangled(data[:head], rng) + data[head:]

        def read(data: bytes = data, kind: str = kind) -> None:
            got = decode(data, kind)
            if kind == HYPOTHESES:
                hypotheses_from(got)
            elif kind.endswith("CameraInfo"):
                to_camera(got, False)
            elif kind.endswith("Image"):
                (to_depth if got.encoding == "32FC1" else to_rgb)(got)

        codes.append(refused(read, ""))
    assert sum(codes) > 0.2 * COUNT
