"""Octrees are in OctoMap's stream: read by its published format, and byte for byte as OctoMap 1.10 writes them."""

import struct

import numpy as np
import pytest

from node.ros.octree import LEVELS, octree_data

# Of the cells (0, 0, 0), (1, 0, 0) and (-3, 2, 7) with log-odds 1.5, -1.5 and 0.25: octomap-python 1.10.0.0's
# OcTree(0.05).updateNode at their centres, then write(), from behind "data\n".
WRITTEN = "0000c03fc00000803e02" + "0000803e02" * 11 + "0000803e200000803e400000803e200000803e00"
WRITTEN += "0000c03f01" * 14 + "0000c03f030000c03f000000c0bf00"


def leaves(data: bytes) -> dict[tuple[int, int, int], tuple[int, float]]:
    """Each leaf's least cell, its edge in cells and its log-odds; inner nodes must have their children's largest."""
    found, at = {}, 0

    def node(corner: tuple[int, int, int], edge: int) -> float:
        nonlocal at
        value, children = struct.unpack_from("<fB", data, at)
        at += 5
        if not children:
            found[corner] = (edge, value)
            return value
        half, values = edge // 2, []
        for child in range(8):
            if children >> child & 1:
                bits = (child & 1, child >> 1 & 1, child >> 2)
                values.append(node(tuple(c + half * bit for c, bit in zip(corner, bits, strict=True)), half))
        assert value == max(values)
        return value

    if data:
        node((-(1 << LEVELS - 1),) * 3, 1 << LEVELS)
    assert at == len(data)
    return found


def test_the_bytes_are_octomaps() -> None:
    cells = np.array([[0, 0, 0], [1, 0, 0], [-3, 2, 7]])
    assert octree_data(cells, np.array([1.5, -1.5, 0.25])).hex() == WRITTEN
    assert octree_data(np.zeros((0, 3), int), np.zeros(0)) == b""


@pytest.mark.parametrize("reach", [3, 40, (1 << LEVELS - 1) - 1])
def test_what_is_written_is_read(reach: int) -> None:
    rng = np.random.default_rng(0)
    cells = np.unique(rng.integers(-reach - 1, reach + 1, (500, 3)), axis=0)
    values = rng.choice(np.float32([-1.5, 0.25, 2.0]), len(cells))
    order = rng.permutation(len(cells))
    found = leaves(octree_data(cells[order], values[order]))
    spread = {}
    for corner, (edge, value) in found.items():
        for offset in np.ndindex(edge, edge, edge):
            spread[tuple(np.add(corner, offset).tolist())] = value
    assert spread == dict(zip(map(tuple, cells.tolist()), values.tolist(), strict=True))


def test_eight_equal_leaves_are_one_and_the_larger_log_odds_count() -> None:
    block = np.argwhere(np.ones((4, 4, 4))) - 4
    data = octree_data(np.concatenate([block, block]), np.repeat([-2.0, 1.0], 64))
    assert leaves(data) == {(-4, -4, -4): (4, 1.0)} and len(data) == 5 * (LEVELS - 1)
    values = np.ones(64)
    values[0] = 0.5
    assert len(leaves(octree_data(block, values))) == 7 + 8


def test_a_cell_outside_of_the_tree_is_refused() -> None:
    for far in (1 << LEVELS - 1, -(1 << LEVELS - 1) - 1):
        with pytest.raises(ValueError, match="32768 cells from the origin; give wider cells"):
            octree_data(np.array([[0, far, 0]]), np.ones(1))


def test_octomap_reads_it() -> None:
    """Where octomap-python is installed, which has no wheel for every machine."""
    octomap = pytest.importorskip("octomap")
    rng = np.random.default_rng(1)
    cells = np.unique(rng.integers(-20, 20, (300, 3)), axis=0)
    values = rng.choice([-1.5, 0.25, 2.0], len(cells))
    data = octree_data(cells, values)
    tree = octomap.OcTree.read(b"# Octomap OcTree file\nid OcTree\nsize %d\nres 0.05\ndata\n" % (len(data) // 5) + data)
    read = [tree.search((cell + 0.5) * 0.05).getLogOdds() for cell in cells]
    np.testing.assert_allclose(read, values)
    written = tree.write()
    assert written[written.index(b"data\n") + 5 :] == data
