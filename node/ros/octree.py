"""Voxels as an octree in OctoMap's stream of nodes, the `data` of octomap_msgs/Octomap with full probabilities.

The format is that of OctoMap's `OcTree::writeData` (OcTreeBaseImpl.hxx): depth first, for each node its log-odds
(float32, little-endian) and a byte with one bit for each child that follows. Child 1 is the one with larger x, 2 with
larger y, 4 with larger z. The tree has 16 levels below its root. The origin is the corner where its eight largest parts
meet.
"""

import numpy as np
from jaxtyping import Float, Int

ID = "OcTree"  # OctoMap's name of this kind of tree
LEVELS = 16
_CENTRE = 1 << (LEVELS - 1)
_NODE = np.dtype([("log_odds", "<f4"), ("children", "u1")])


def octree_data(cells: Int[np.ndarray, "n 3"], log_odds: Float[np.ndarray, "n"]) -> bytes:
    """The stream of a tree in which each cell (i, j, k), which begins at width (i, j, k), has its log-odds.

    All else is unknown. Of a cell that is given twice the larger log-odds count. An inner node has the largest of its
    children's, as in OctoMap, and eight equal leaves become one. Without cells there are no bytes, which is OctoMap's
    empty tree. Raises ValueError for a cell outside of the tree.
    """
    if not len(cells):
        return b""
    keys = np.asarray(cells, np.int64) + _CENTRE
    if keys.min() < 0 or keys.max() >= 2 * _CENTRE:
        raise ValueError(f"a cell is more than {_CENTRE} cells from the origin; give wider cells")
    codes = sum(_spread(keys[:, axis]) << axis for axis in range(3))
    codes, values = _largest(np.asarray(codes), np.asarray(log_odds, np.float32))
    masks = np.zeros(len(codes), np.uint8)
    levels = [(codes, values, masks)]  # from the leaves to the root
    for _ in range(LEVELS):
        parents, starts = np.unique(codes >> 3, return_index=True)
        children = np.bitwise_or.reduceat(np.left_shift(1, codes & 7).astype(np.uint8), starts)
        largest, least = np.maximum.reduceat(values, starts), np.minimum.reduceat(values, starts)
        leaf = (children == 255) & (largest == least) & (np.bitwise_or.reduceat(masks, starts) == 0)
        if leaf.any():
            kept = ~np.repeat(leaf, np.diff(np.append(starts, len(codes))))
            levels[-1] = (codes[kept], values[kept], masks[kept])
        codes, values, masks = parents, largest, np.where(leaf, 0, children).astype(np.uint8)
        levels.append((codes, values, masks))
    # Depth first is by the first cell that a node could have; of nodes with the same one, the larger comes first.
    first = np.concatenate([codes << (3 * height) for height, (codes, _, _) in enumerate(levels)])
    height = np.repeat(np.arange(len(levels)), [len(codes) for codes, _, _ in levels])
    nodes = np.empty(len(first), _NODE)
    nodes["log_odds"] = np.concatenate([values for _, values, _ in levels])
    nodes["children"] = np.concatenate([masks for _, _, masks in levels])
    return nodes[np.lexsort((-height, first))].tobytes()


def _spread(key: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Bit b of each key at bit 3 b."""
    return np.asarray(sum(((key >> bit) & 1) << (3 * bit) for bit in range(LEVELS)))


def _largest(
    codes: Int[np.ndarray, "n"], values: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Codes in order, each once, with the largest of its values."""
    order = np.argsort(codes, kind="stable")
    codes, starts = np.unique(codes[order], return_index=True)
    return codes, np.maximum.reduceat(values[order], starts)
