"""Ellipsoids as a coloured triangle mesh: the PLY files of a result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.files import atomic
from reobj.types import Array, object_color

PLY_DETAIL = 2  # subdivisions of an octahedron: 512 triangles an ellipsoid


def write_ply(path: Path, ellipsoids: quadrics.Ellipsoids, object_id: Sequence[int]) -> None:
    """Write ellipsoids as one coloured triangle mesh (PLY, binary little endian), in world."""
    sphere, faces = _sphere_mesh(PLY_DETAIL)  # (P, 3), (T, 3)
    half = ellipsoids.half_axes[:, None] * sphere  # (O, P, 3)
    points = half @ np.swapaxes(ellipsoids.world_from_obj, 1, 2)
    points += ellipsoids.center_in_world[:, None]
    colors = np.array([object_color(i)[::-1] for i in object_id], np.uint8).reshape(-1, 3)  # RGB
    vertex = np.zeros(points.shape[:2], [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertex["xyz"], vertex["rgb"] = points, colors[:, None]
    face = np.zeros((len(points), len(faces)), [("n", "u1"), ("i", "<i4", 3)])
    face["n"], face["i"] = 3, faces + (np.arange(len(points)) * len(sphere))[:, None, None]
    names = [f"property float {n}\n" for n in "xyz"]
    names += [f"property uchar {n}\n" for n in ("red", "green", "blue")]
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment reobj_track ellipsoids\n"
        f"element vertex {vertex.size}\n{''.join(names)}"
        f"element face {face.size}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with atomic(path) as part:
        part.write_bytes(header.encode() + vertex.tobytes() + face.tobytes())


def _sphere_mesh(detail: int) -> tuple[Array, npt.NDArray[np.int64]]:
    """Triangulate the unit sphere: points (P, 3), triangles (T, 3) of a divided octahedron."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
                      [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])  # fmt: skip
    for _ in range(detail + 1):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], 2).reshape(-1, 2)
        edges, edge_of = np.unique(edges, axis=0, return_inverse=True)
        middle = points[edges].sum(1)  # (E, 3)
        (a, b, c), (ab, bc, ca) = faces.T, len(points) + edge_of.reshape(-1, 3).T
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        faces = np.array([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])  # (4, 3, T)
        faces = faces.transpose(2, 0, 1).reshape(-1, 3)
    return points, faces
