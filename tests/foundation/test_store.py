"""A store's file is there whole, or what was there before is, on this machine and elsewhere."""

from importlib.util import find_spec
from pathlib import Path

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from foundation.store import Store, StoreError, bytes_of, entries, local_copy, matches

NO_S3 = pytest.mark.skipif(find_spec("s3fs") is not None, reason="s3fs is there")


class Plain(MemoryFileSystem):
    """Another machine's disk: a file is seen while it is written."""

    protocol = "plain"
    store: dict = {}  # noqa: RUF012
    pseudo_dirs = [""]  # noqa: RUF012

    def pipe_file(self, path: str, value: bytes, **how) -> None:
        super().pipe_file(path, value[:2])
        if value == b"cut off":
            raise ConnectionError("the cable is out")
        super().pipe_file(path, value)


fsspec.register_implementation("plain", Plain, clobber=True)


@pytest.fixture(params=["local", "memory", "plain"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "plain":
        return f"plain://{tmp_path.name}/out"
    return str(tmp_path / "out [1]") if request.param == "local" else f"memory://{tmp_path.name}/out [1]"


def test_what_is_written_is_there(url: str) -> None:
    store = Store(url)
    assert store.sizes() == {}
    store.check()
    assert store.sizes() == {}
    for name, content in (("b/c.json", b"{}"), ("a", b"1234"), ("b/c.json", b"{ }")):
        store.write(name, content)
    assert store.sizes() == {"a": 4, "b/c.json": 3}
    assert store.read(["b/c.json", "a"]) == {"b/c.json": b"{ }", "a": b"1234"}
    store.remove("a")
    assert list(store.sizes()) == ["b/c.json"] and store.has("b/c.json") and not store.has("a")
    assert bytes_of([store.path("b")]) == {store.path("b"): 3}
    with pytest.raises(StoreError, match="a cannot be read"):
        store.read(["a"])


def test_a_file_that_was_cut_off_is_not_there() -> None:
    store = Store("plain://cut")
    store.write("a", b"before")
    with pytest.raises(StoreError, match=r"^plain://.*/a cannot be written \(the cable is out\)$"):
        store.write("a", b"cut off")
    assert store.read(["a"]) == {"a": b"before"}


def test_places_are_found_and_copied(url: str) -> None:
    store = Store(url)
    for name in ("day/a.mcap", "day/b.mcap", "day/c/x", "odd*.mcap"):
        store.write(name, name.encode())
    day = store.path("day")
    assert entries(day) == {f"{day}/a.mcap": False, f"{day}/b.mcap": False, f"{day}/c": True}
    assert entries(f"{day}/a.mcap") is None
    assert matches(f"{day}/a.mcap") == [f"{day}/a.mcap"] and matches(f"{day}/none.mcap") == []
    assert matches(store.path("odd*.mcap")) == [store.path("odd*.mcap")]  # a name before it is a pattern
    with local_copy(f"{day}/b.mcap") as path:
        assert path.name == "b.mcap" and path.read_bytes() == b"day/b.mcap"
    with local_copy(day) as folder:
        assert (folder / "c" / "x").read_bytes() == b"day/c/x"
    assert store.local == folder.exists()


def test_a_pattern_matches_in_order(tmp_path: Path) -> None:
    store = Store(f"memory://{tmp_path.name}")
    for name in ("b.mcap", "a.mcap", "a.txt"):
        store.write(name, b"")
    assert matches(store.path("*.mcap")) == [store.path("a.mcap"), store.path("b.mcap")]


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("nope://a", "Protocol not known: nope.*give a path, or a URL"),
        pytest.param("s3://a/b", "Install s3fs", marks=NO_S3),
    ],
)
def test_a_place_that_cannot_be_is_named(url: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Store(url)


def test_an_unwritable_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"is a file; give a folder|is a file, or in one"):
        Store(str(tmp_path / "file" / "out")).check()


def test_what_another_removed_is_no_fault(url: str) -> None:
    store = Store(url)
    store.write("a.json", b"{}")
    store.remove("a.json")
    store.remove("a.json")
    assert not store.has("a.json")


def test_a_folder_behind_a_link_is_one(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "link").symlink_to(tmp_path / "there")
    (tmp_path / "logs" / "file.mcap").write_bytes(b"x")
    found = entries(str(tmp_path / "logs"))
    assert found is not None and list(found.values()) == [False, True]
