"""The logs that `farside batch` is given: paths, folders and globs, here or at a URL."""

from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath

from foundation.store import entries, matches
from perception.sources.frame_folder import COLOURS

_FILES = (".mcap", ".db3", ".bag", ".npz")  # what a folder is searched for
_ONE = {"metadata.yaml", "meta.json", *COLOURS}  # a folder with one of these is one log


def find_logs(given: Sequence[str], out: str) -> list[str]:
    """The logs that these paths, URLs and globs name, each once, in order; local ones as absolute paths.

    A folder is one log if it is a frame folder or a bag (it has metadata.yaml), else all logs in it and below, hidden
    ones and those in the folder of the results, `out`, excepted. A file is a log whatever its name. Raises
    `FileNotFoundError` or `ValueError` with the remedy where one of them names no log.
    """
    if not given:
        raise ValueError("there are no logs; give recordings, folders of them, or globs")
    found = set[str]()
    for each in given:
        if not (places := matches(each)):
            what = "matches nothing" if set("*?[") & set(each) else "does not exist"
            raise FileNotFoundError(f"{each} {what}; give recordings, folders of them, or globs")
        logs = [log for place in places for log in _logs_of(place, out)]
        if not logs:
            raise ValueError(f"{each} holds no log ({', '.join(_FILES)}, frame folder, bag); give another folder")
        found.update(logs)
    return sorted(found)


def _logs_of(place: str, out: str) -> Iterator[str]:
    inside = entries(place)
    if inside is None or _ONE & {PurePosixPath(each).name for each in inside}:
        yield place
        return
    for each, is_folder in inside.items():
        name = PurePosixPath(each).name
        if name.startswith(".") or each.rstrip("/") == out.rstrip("/"):
            continue
        if is_folder:
            yield from _logs_of(each, out)
        elif name.lower().endswith(_FILES):
            yield each
