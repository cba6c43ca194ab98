"""Points from a text file."""

from pathlib import Path

import numpy as np

from perception.answers.regions import Points


def read_points(path: str | Path) -> Points:
    """Read an .xyz file: one point a line, x y z in metres; further columns and # comments are left out.

    Raises FileNotFoundError, or ValueError naming the line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a text file with x y z (metres) on each line")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file; write x y z (metres) on each line") from error
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            x, y, z = map(float, words[:3])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: '{line[:60]}' is not a point; write x y z (metres)") from error
        if not np.isfinite(x + y + z):
            raise ValueError(f"{path}, line {number}: '{line[:60]}' is not finite; leave the line out")
        rows.append((x, y, z))
    if not rows:
        raise ValueError(f"{path} holds no points; write x y z (metres) on each line")
    return Points(np.array(rows))
