"""Files that appear whole or not at all: written beside their place, then moved there."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import NamedTemporaryFile

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the place to write the file at; it is moved to `path` when the block ends without an error.

    After an error `path` is as it was before, and nothing else is left. Makes the folder where there is none. Raises
    OSError naming `path` and the remedy where there is no room, whatever a library makes of that.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.uname().nodename}.{os.getpid()}.part")  # a folder may be of many machines
    try:
        yield part
        part.replace(path)
    except Exception as error:
        if (full := _without_room(error)) is None:
            raise
        raise OSError(f"{path} cannot be written ({full.strerror}); make room or give another place") from None
    finally:
        part.unlink(missing_ok=True)


def _without_room(error: BaseException | None) -> OSError | None:
    """The error of a full disk, quota or file among an error and those that led to it."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return error
        error = error.__context__
    return None


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all; text is written as UTF-8."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def check_folder(folder: Path) -> None:
    """Raises `ValueError`, one line with the remedy, if no file can be written into a folder. Leaves nothing there.

    To be asked before long work, whose results would have no place.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=folder):
            pass
    except NotADirectoryError:
        raise ValueError(f"{folder} is a file, or in one; give a folder for the results") from None
    except FileExistsError:
        raise ValueError(f"{folder} is a file; give a folder for the results") from None
    except OSError as error:
        raise ValueError(f"{folder} cannot be written to ({error.strerror}); give another folder") from None
    finally:
        for f in missing:
            with suppress(OSError):
                f.rmdir()
