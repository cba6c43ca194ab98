"""Files as a bad cable, disk or hand leaves them: each is read, or refused in one line that names it.

Seeded; more of them by `MANGLED=2000 pytest tests/properties/test_mangled_files.py`.
"""

import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from perception.answers.hypotheses_file import save
from perception.observation.segmentation import segment
from perception.sources.frame_folder import write_frame_folder
from perception.sources.recorder import write_log
from tests.node.mugs import mug_hypotheses, table_frame
from tests.perception.cylinders import CAN, picture
from tests.properties.mangling import COUNT, VALUES, mangled, seeds, told

KEYS = ("camera_matrix_std_px", "rms_px", "distortion_std", "depth_camera_matrix_px", "T_color_depth", "T_world_camera")


@pytest.fixture
def frame_folder(tmp_path: Path) -> Path:
    write_frame_folder(tmp_path / "whole", picture(CAN))
    return tmp_path / "whole"


def test_frame_folders(frame_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    folder, out, codes = tmp_path / "f", tmp_path / "out.mcap", []
    for seed in seeds():
        rng = random.Random(seed)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(frame_folder, folder)
        file = folder / rng.choice(["color.png", "depth.png", "label.png", "meta.json"])
        file.write_bytes(mangled(file.read_bytes(), rng))
        codes.append(told(["record", str(folder), "--out", str(out)], folder, out, capfd))
    assert sum(codes) > 0.5 * COUNT


def test_values_of_meta_json(frame_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    out, whole = tmp_path / "out.mcap", (frame_folder / "meta.json").read_text()
    for seed in seeds():
        rng, meta = random.Random(seed), json.loads(whole)
        key, value = rng.choice([*meta, *KEYS]), rng.choice(VALUES)
        inner = meta.get(key)
        while isinstance(inner, list) and isinstance(inner[0], list):
            inner = rng.choice(inner)
        if isinstance(inner, list) and rng.random() < 0.6:
            inner[rng.randrange(len(inner))] = value
        else:
            meta[key] = value
        (frame_folder / "meta.json").write_text(json.dumps(meta))
        told(["record", str(frame_folder), "--out", str(out)], frame_folder, out, capfd)


def test_recordings(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    path, out, codes = tmp_path / "a.mcap", tmp_path / "out.mcap", []
    write_log(path, [picture(CAN)])
    whole = path.read_bytes()
    for seed in seeds():
        path.write_bytes(mangled(whole, random.Random(seed)))
        codes.append(told(["record", str(path), "--out", str(out)], path, out, capfd))
    assert sum(codes) > 0.5 * COUNT


def test_hypotheses(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    path, box = tmp_path / "object_1.npz", ["--box", "-0.05", "-0.05", "0", "0.05", "0.05", "0.05", "--json"]
    frame = table_frame()
    save(path, mug_hypotheses(frame, segment(frame, 1)[0], [1.0, -1.0], [0.75, 0.25], 16))
    whole = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    for seed in seeds():
        rng = random.Random(seed)
        if seed % 2:
            path.write_bytes(mangled(whole, rng))
        else:
            np.savez(path, **_changed(arrays, rng))
        told(["query", str(path), *box], path, tmp_path / "none", capfd)


def _changed(arrays: dict[str, np.ndarray], rng: random.Random) -> dict[str, np.ndarray]:
    """The arrays of a hypotheses file, one field of the header or one array of them changed."""
    if rng.random() < 0.6:
        header = json.loads(arrays["header"].tobytes())
        key = rng.choice([*header])
        inner = header[key] if key == "diagnostics" and rng.random() < 0.7 else header
        inner[rng.choice([*inner]) if inner is not header else key] = rng.choice(VALUES)
        return arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    name = rng.choice([name for name in arrays if name != "header"])
    array = arrays[name]
    other = rng.choice(
        [
            array.astype(complex),
            array.astype(np.float32),
            array.ravel()[: array.size // 2],
            np.full(array.shape, np.nan),
            np.full(array.shape, -3),
            array[:0],
            np.array(5),
        ]
    )
    return arrays | {name: other}
