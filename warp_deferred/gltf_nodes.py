"""The node hierarchy of a glTF file: which nodes a scene shows, and where each stands in the world.

Node graphs are checked before they are walked: cycles are errors, and the number of primitives that a walk would place
is counted first (a child under several parents counts once for each path to it, so that a few dozen nodes can ask for
2^26; a node without a mesh counts as one), which bounds time and memory whatever the file says. Nothing here recurses.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .gltf_file import GltfFile

__all__ = ["MAX_PLACED", "walk_nodes"]

#: Primitives (or bare nodes) a file may place in the world, each path to a shared child counted.
MAX_PLACED = 1_000_000


def walk_nodes(file: GltfFile) -> Iterator[tuple[int, dict[str, Any], np.ndarray]]:
    """Yield (index, node, world matrix (4, 4) float64) of the default scene, parents first, in node order of the file.

    A file without scenes shows every node that is no child.

    Raises:
        LoadError: For cycles, children that are not there, too many nodes, or a transform that is none.
    """
    nodes = file.items("nodes")
    children = [_children(file, index, node) for index, node in enumerate(nodes)]
    roots = _roots(file, children)
    _check_graph(file, children, roots)
    local: dict[int, np.ndarray] = {}
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        if index not in local:
            local[index] = _local_matrix(file, index, nodes[index])
        with np.errstate(over="ignore", invalid="ignore"):
            world = parent @ local[index]
        if not np.isfinite(world).all():
            mend = "rescale the scene"
            raise file.report.error(f"/nodes/{index}", "a finite world transform", "an overflow", mend)
        yield index, nodes[index], world
        stack.extend((child, world) for child in reversed(children[index]))


def _children(file: GltfFile, index: int, node: dict[str, Any]) -> list[int]:
    place = f"/nodes/{index}/children"
    found = node.get("children", [])
    if not isinstance(found, list):
        raise file.report.error(place, "a list of node indices", type(found).__name__)
    for child in found:
        file.item("nodes", child, place)
    return found


def _roots(file: GltfFile, children: list[list[int]]) -> list[int]:
    scenes = file.items("scenes")
    if scenes:
        scene = file.item("scenes", file.json.get("scene", 0), "/scene")
        place = f"/scenes/{file.json.get('scene', 0)}/nodes"
        roots = scene.get("nodes", [])
        if not isinstance(roots, list):
            raise file.report.error(place, "a list of node indices", type(roots).__name__)
        for root in roots:
            file.item("nodes", root, place)
        return roots
    inner = {child for found in children for child in found}
    roots = [index for index in range(len(children)) if index not in inner]
    if children and not roots:
        raise file.report.error("/nodes", "a tree", "a cycle: every node is some node's child", "break the cycle")
    return roots


def _check_graph(file: GltfFile, children: list[list[int]], roots: list[int]) -> None:
    """Refuse cycles and walks past `MAX_PLACED`; a depth-first search gives the order in which to count."""
    state = [0] * len(children)
    finished: list[int] = []
    for root in roots:
        stack = [(root, iter(children[root]))] if state[root] == 0 else []
        state[root] = state[root] or 1
        while stack:
            index, rest = stack[-1]
            child = next(rest, None)
            if child is None:
                state[index] = 2
                finished.append(index)
                stack.pop()
            elif state[child] == 1:
                got = f"a cycle: node {child} is its own descendant"
                raise file.report.error(f"/nodes/{index}/children", "a tree", got, "break the cycle")
            elif state[child] == 0:
                state[child] = 1
                stack.append((child, iter(children[child])))
    paths = [0] * len(children)
    for root in roots:
        paths[root] += 1
    total = 0
    for index in reversed(finished):
        total += paths[index] * _weight(file, index)
        if total > MAX_PLACED:
            mend = "share fewer children, or place the copies in Python"
            raise file.report.error(
                "/nodes", f"at most {MAX_PLACED} placed primitives", "more, by shared children", mend
            )
        for child in children[index]:
            paths[child] += paths[index]


def _weight(file: GltfFile, index: int) -> int:
    """Return how many primitives a node places, at least 1."""
    node = file.items("nodes")[index]
    if "mesh" not in node:
        return 1
    found = file.item("meshes", node["mesh"], f"/nodes/{index}/mesh").get("primitives")
    return max(1, len(found)) if isinstance(found, list) else 1


def _local_matrix(file: GltfFile, index: int, node: dict[str, Any]) -> np.ndarray:
    """Return a node's matrix: `matrix` (column-major) or translation, rotation (quaternion x y z w) and scale."""
    place = f"/nodes/{index}"
    if "matrix" in node:
        matrix = _numbers(file, f"{place}/matrix", node["matrix"], 16).reshape(4, 4).T.copy()
        if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-6):
            raise file.report.error(f"{place}/matrix", "an affine matrix", f"last row {matrix[3].tolist()}")
        matrix[3] = (0.0, 0.0, 0.0, 1.0)
        return matrix
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = quaternion = _numbers(file, f"{place}/rotation", node["rotation"], 4)
        norm = float(quaternion @ quaternion)
        if not norm > 0.0:
            raise file.report.error(f"{place}/rotation", "a quaternion of length 1", quaternion.tolist(), "use 0 0 0 1")
        # Dividing by the squared length here makes any length but zero give a pure rotation.
        s = 2.0 / norm
        matrix[:3, :3] = (
            (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
            (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
            (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
        )
    if "scale" in node:
        matrix[:3, :3] *= _numbers(file, f"{place}/scale", node["scale"], 3)
    if "translation" in node:
        matrix[:3, 3] = _numbers(file, f"{place}/translation", node["translation"], 3)
    return matrix


def _numbers(file: GltfFile, place: str, value: Any, count: int) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise file.report.error(place, f"{count} finite numbers", repr(value), "correct the node")
    return array
