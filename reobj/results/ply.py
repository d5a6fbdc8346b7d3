"""PLY files of solids, as coloured triangle meshes, and of points.

Coordinates are doubles: in float32 those of a map projection have a resolution of .5 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.files import atomic
from reobj.types import Array, IntArray, object_color

CYLINDER_SIDES = 48  # sides of the prism that approximates a cylinder: looks round
Mesh = tuple[Array, IntArray]  # points (P, 3), triangles (T, 3)


def write_ply(
    path: Path,
    ellipsoids: quadrics.Ellipsoids,
    object_id: Sequence[int],
    shapes: Sequence[str | None] | None = None,
) -> None:
    """Write solids as one coloured triangle mesh (PLY, binary little endian), in world.

    Each solid is closed, its triangles face outwards, and it shares no vertex with others.

    Args:
        shapes: kind of each, "box", "cylinder" or "ellipsoid"; None: all are ellipsoids.
    """
    meshes = [unit_mesh(shape) for shape in shapes or [None] * len(ellipsoids)]
    points = [
        half_axes * unit @ axes.T + center
        for (unit, _), half_axes, axes, center in zip(
            meshes, ellipsoids.half_axes, ellipsoids.world_from_obj, ellipsoids.center_in_world,
            strict=True,
        )
    ]  # fmt: skip
    start = np.cumsum([0, *map(len, points)])
    colors = [object_color(identity)[::-1] for identity in object_id]
    rgb = np.repeat(np.array(colors, np.uint8).reshape(-1, 3), np.diff(start), axis=0)
    corners = [triangles + first for (_, triangles), first in zip(meshes, start, strict=False)]
    faces = np.concatenate([np.empty((0, 3), np.int64), *corners])
    content = "ellipsoids" if shapes is None else "solids"
    xyz = np.concatenate([np.empty((0, 3)), *points])
    write_point_ply(path, xyz, rgb, f"comment reobj_track {content}\n", faces)


def write_point_ply(
    path: Path,
    points: Array,
    colors: npt.NDArray[np.uint8],
    comment: str = "",
    faces: IntArray | None = None,
) -> None:
    """Write points (N, 3) with RGB colours (N, 3) as PLY, binary little endian.

    Args:
        faces: (T, 3) triangles of the points. comment: a line of the header.
    """
    vertex = np.zeros(len(points), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    vertex["xyz"] = points
    vertex["rgb"] = colors
    names = [f"property double {n}\n" for n in "xyz"]
    names += [f"property uchar {n}\n" for n in ("red", "green", "blue")]
    header = f"ply\nformat binary_little_endian 1.0\n{comment}"
    header += f"element vertex {len(points)}\n{''.join(names)}"
    content = vertex.tobytes()
    if faces is not None:
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        face = np.zeros(len(faces), [("n", "u1"), ("i", "<i4", 3)])
        face["n"] = 3
        face["i"] = faces
        content += face.tobytes()
    with atomic(path) as part:
        part.write_bytes(f"{header}end_header\n".encode() + content)


def unit_mesh(shape: str | None, detail: int = 3) -> Mesh:
    """Triangulate a unit solid: points (P, 3), triangles (T, 3) facing outwards.

    Args:
        shape: "box" (half sides 1), "cylinder" (radius and half height 1), else a sphere.
        detail: of the sphere: 8 x 4^detail triangles.
    """
    if shape == "box":
        corners = (2 * np.indices((2, 2, 2)).reshape(3, 8).T - 1).astype(np.float64)
        quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4),
                          (1, 5, 7, 3)])  # fmt: skip
        return corners, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return _cylinder_mesh() if shape == "cylinder" else _sphere_mesh(detail)


def _cylinder_mesh() -> Mesh:
    """Triangulate the upright cylinder of radius and half height 1, facing outwards."""
    sides = CYLINDER_SIDES
    a = np.arange(sides)
    angle = 2 * np.pi * a / sides
    b = (a + 1) % sides
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = (np.column_stack([ring, np.full(sides, z)]) for z in (-1.0, 1.0))
    points = np.concatenate([low, high, [[0, 0, -1.0], [0, 0, 1.0]]])
    c = b + sides
    d = a + sides
    bottom = np.full(sides, 2 * sides)
    faces = [(a, b, c), (a, c, d), (bottom, b, a), (bottom + 1, d, c)]
    return points, np.concatenate([np.column_stack(f) for f in faces])


def _sphere_mesh(detail: int) -> Mesh:
    """Triangulate the unit sphere, a subdivided octahedron."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
                      [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])  # fmt: skip
    for _ in range(detail):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], 2).reshape(-1, 2)
        edges, edge_of = np.unique(edges, axis=0, return_inverse=True)
        middle = points[edges].sum(1)  # (E, 3)
        a, b, c = faces.T
        ab, bc, ca = len(points) + edge_of.reshape(-1, 3).T
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        faces = np.array([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])  # (4, 3, T)
        faces = faces.transpose(2, 0, 1).reshape(-1, 3)
    return points, faces
