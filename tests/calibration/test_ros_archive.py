"""The archive of ROS's cameracalibrator is a camera file and pictures, and nothing else of it is read."""

import io
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.camera_file import is_camera_file, read_camera
from foundation import archive
from perception.sources.pictures import open_pictures
from tests.calibration.test_camera_file import ROS

RGB = np.random.default_rng(0).integers(0, 256, (4, 12, 16, 3), dtype=np.uint8)
PNG = [cv2.imencode(".png", rgb[..., ::-1])[1].tobytes() for rgb in RGB]
ONE = {"left-0000.png": PNG[0], "left-0001.png": PNG[1], "ost.yaml": ROS.encode(), "ost.txt": b"# oST version 5.0"}
WIDE = ROS.replace("image_width: 640", "image_width: 800").encode()
TWO = {**dict(zip(("left-0000.png", "left-0001.png", "right-0000.png", "right-0001.png"), PNG, strict=True))}
TWO |= {"left.yaml": ROS.encode(), "right.yaml": WIDE, "ost.txt": b""}


def packed(path: Path, files: dict[str, bytes], links: dict[str, str] | None = None) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for name, target in (links or {}).items():
            info = tarfile.TarInfo(name)
            info.type, info.linkname = tarfile.SYMTYPE, target
            tar.addfile(info)
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def test_one_camera_and_two(tmp_path: Path) -> None:
    one, two = packed(tmp_path / "calibrationdata.tar.gz", ONE), packed(tmp_path / "two.tgz", TWO)
    for path, width, wanted in ((one, 640, RGB[:2]), (two, 640, RGB[:2]), (Path(f"{two}#right"), 800, RGB[2:])):
        assert is_camera_file(path) and read_camera(path).width == width
        pictures, count = open_pictures(path)
        assert count == 2
        np.testing.assert_array_equal([p.rgb for p in pictures], wanted)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["calibrationdata.tar.gz", "two.tgz"]


def test_only_plain_files_at_the_top_are_read(tmp_path: Path) -> None:
    (tmp_path / "secret.yaml").write_text(ROS)
    files = {"../left-0000.png": PNG[0], "/left-0001.png": PNG[0], "a/left-0002.png": PNG[0], "./left-0003.png": PNG[1]}
    path = packed(tmp_path / "a.tar.gz", files, {"ost.yaml": "secret.yaml", "left-0004.png": "left-0003.png"})
    assert [p.name for p in open_pictures(path)[0]] == ["left-0003.png"]
    with pytest.raises(ValueError, match=r"a\.tar\.gz holds no ost\.yaml or left\.yaml"):
        read_camera(path)


def test_what_is_too_large_cut_or_absent_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def says(path: Path, what: str) -> None:
        for read in (read_camera, lambda it: list(open_pictures(it)[0])):
            with pytest.raises((ValueError, FileNotFoundError), match=what) as caught:
                read(path)
            assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)

    path = packed(tmp_path / "a.tar.gz", ONE)
    says(tmp_path / "b.tar.gz", "no such archive")
    says(Path(f"{path}#right"), "holds no right")
    whole = path.read_bytes()
    (tmp_path / "cut.tar.gz").write_bytes(whole[: len(whole) // 3])
    says(tmp_path / "cut.tar.gz", "cannot be read as a .tar.gz")
    (tmp_path / "text.tar.gz").write_text("text")
    says(tmp_path / "text.tar.gz", "cannot be read as a .tar.gz")
    for limit, value in (("MOST_MEMBERS", 0), ("LARGEST_ARCHIVE", 600), ("LARGEST_MEMBER", 100)):
        with monkeypatch.context() as patch:
            patch.setattr(archive, limit, value)
            says(path, "more than")
