"""OpenUSD text of a result: shapes, points and the moving camera, without the USD library."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from reobj import __version__
from reobj.cameras import CV_FROM_GL, Poses, invert_rigid
from reobj.files import atomic
from reobj.results.entries import Object
from reobj.results.export_source import UprightWorld, upright_world
from reobj.results.result import Result
from reobj.sources.image_files import IMAGE_FPS
from reobj.types import Array, object_color, visible_name

# schema and attributes of the shape within [-1, 1]^3
_SHAPES = {
    "box": ("Cube", ["double size = 2"]),
    "cylinder": (
        "Cylinder", ['uniform token axis = "Z"', "double height = 2", "double radius = 1"],
    ),
    "ellipsoid": ("Sphere", ["double radius = 1"]),
}  # fmt: skip


def export_usd(result: Result, path: Path) -> None:
    """Write .usda for usdview, Blender and Isaac Sim: z up, metres if the scale is known.

    /World/objects has a Cube, Cylinder or Sphere per object, /World/points the sparse points,
    /World/camera a camera with a time sample per pose (time codes are frame numbers).

    Ref: openusd.org, "USDA File Format" and the schemas UsdGeom and UsdSemantics.
    """
    world = upright_world(result, path, float32=True)
    units = "m" if world.metric else "arbitrary"
    head = ['defaultPrim = "World"', f"doc = {_text(f'reobj_track {__version__}')}",
            "metersPerUnit = 1", 'upAxis = "Z"',
            "customLayerData = {", f"    double3 origin_in_world = {_tuple(world.origin)}",
            f"    string units = {_text(units)}", "}"]  # fmt: skip
    prims = [_objects(world)]
    poses = world.poses
    if poses is not None and len(poses.points):
        prims.append(_points(poses))
    if poses is not None and poses.known.any():
        prims.append(_camera(poses))
        fps = result.video.fps or IMAGE_FPS
        frames = poses.frame[poses.known]
        head += [f"timeCodesPerSecond = {fps:.12g}", f"framesPerSecond = {fps:.12g}",
                 f"startTimeCode = {frames[0]}", f"endTimeCode = {frames[-1]}"]  # fmt: skip
    body = _prim("Xform", "World", [], prims, 'kind = "assembly"')
    header = "\n".join(["#usda 1.0", "(", *_indented(head), ")", ""])
    with atomic(path) as part:
        part.write_text("\n".join([header, *body, ""]), encoding="utf-8")


def _objects(world: UprightWorld) -> list[str]:
    """Describe the objects, each as its shape scaled by its half axes."""
    prims = []
    half_axes = world.ellipsoids.half_axes
    for i, found in enumerate(world.objects):
        kind, shape = _SHAPES[found.support or "ellipsoid"]
        quat = np.roll(world.quat_xyzw[i], 1)  # wxyz
        attributes = [
            *shape,
            "float3[] extent = [(-1, -1, -1), (1, 1, 1)]",
            f"color3f[] primvars:displayColor = [{_tuple(linear_color(found.id))}]",
            f"double3 xformOp:translate = {_tuple(world.ellipsoids.center_in_world[i])}",
            f"quatd xformOp:orient = {_tuple(quat)}",
            f"double3 xformOp:scale = {_tuple(half_axes[i])}",
            'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", '
            '"xformOp:scale"]',
            *_facts(found, 2 * half_axes[i]),
        ]
        class_name = visible_name(found.class_name)
        name = re.sub(r"[^A-Za-z0-9_]", "_", class_name)  # identifiers of USD before 24.03
        name = f"_{name}" if name[:1].isdigit() else name
        label = f"displayName = {_text(f'{class_name} {found.id}')}"
        semantics = 'prepend apiSchemas = ["SemanticsLabelsAPI:class"]'
        prims.append(_prim(kind, f"{name}_{found.id}", attributes, [], label, semantics))
    return _prim("Scope", "objects", [], prims)


def _facts(found: Object, size: Array) -> list[str]:
    """List facts about an object; Blender imports userProperties as custom properties."""
    user = "custom {} userProperties:{} = {}".format
    facts = [
        f"token[] semantics:labels:class = [{_text(visible_name(found.class_name))}]",
        user("int64", "id", found.id),
        user("string", "class", _text(visible_name(found.class_name))),
        user("string", "status", _text(visible_name(found.status))),
        user("double3", "size", _tuple(size)),
    ]
    if found.confidence is not None:
        facts.append(user("double", "confidence", f"{found.confidence:.9g}"))
    return facts


def linear_color(identity: int) -> Array:
    """Return the RGB colour (3,) of an identity for USD, whose colours are linear; gamma is 2.2."""
    return np.asarray((np.array(object_color(identity)[::-1]) / 255.0) ** 2.2)


def _points(poses: Poses) -> list[str]:
    """Describe the sparse points."""
    points = poses.points
    low = points.min(0)
    high = points.max(0)
    # 1/500 of the extent: visible in a view of all points, and apart
    width = float(np.linalg.norm(high - low)) / 500 or 0.01
    colors = (poses.colors / 255.0) ** 2.2  # linear
    attributes = [
        f"point3f[] points = {_array(points)}",
        f"float3[] extent = {_array(np.stack([low - width / 2, high + width / 2]))}",
        f"float[] widths = [{width:.6g}] (",
        '    interpolation = "constant"',
        ")",
        f"color3f[] primvars:displayColor = {_array(colors, 4)} (",
        '    interpolation = "vertex"',
        ")",
    ]
    return _prim("Points", "points", attributes, [])


def _camera(poses: Poses) -> list[str]:
    """Describe the camera: USD looks along -z with y up, and stores transforms of row vectors."""
    world_from_cam = np.tile(np.eye(4), (int(poses.known.sum()), 1, 1))
    world_from_cam[:, :3] = invert_rigid(poses.cam_from_world[poses.known])
    world_from_cam[:, :3, :3] = world_from_cam[:, :3, :3] @ CV_FROM_GL
    samples = [
        f"    {frame}: ({', '.join(map(_tuple, pose.T))}),"
        for frame, pose in zip(poses.frame[poses.known].tolist(), world_from_cam, strict=True)
    ]
    camera = poses.camera
    K = camera.K
    # Only ratios matter: the sensor is as wide as that of a 35 mm camera
    width = 36.0
    focal = K[0, 0] * width / camera.width
    height = camera.height * focal / K[1, 1]
    right = (0.5 - K[0, 2] / camera.width) * width
    above = (K[1, 2] / camera.height - 0.5) * height
    attributes = [
        f"float focalLength = {focal:.9g}",
        f"float horizontalAperture = {width:.9g}",
        f"float verticalAperture = {height:.9g}",
        f"float horizontalApertureOffset = {right:.9g}",
        f"float verticalApertureOffset = {above:.9g}",
        "float2 clippingRange = (0.01, 10000)",
        "matrix4d xformOp:transform.timeSamples = {",
        *samples,
        "}",
        'uniform token[] xformOpOrder = ["xformOp:transform"]',
    ]
    return _prim("Camera", "camera", attributes, [])


# ---- Text --------------------------------------------------------------------------------------


def _prim(
    kind: str, name: str, attributes: list[str], children: list[list[str]], *metadata: str
) -> list[str]:
    """Return the lines of a prim."""
    head = f'def {kind} "{name}"'
    lines = [head, "{"]
    if metadata:
        lines = [f"{head} (", *_indented(metadata), ")", "{"]
    for child in ([*attributes], *children):
        lines += _indented(child)
    return [*lines, "}"]


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _text(value: str) -> str:
    """Quote a string without control characters; USD escapes quotes and backslashes as JSON."""
    return json.dumps(value, ensure_ascii=False)


def _tuple(values: Any, digits: int = 9) -> str:
    return f"({', '.join(f'{value:.{digits}g}' for value in np.asarray(values).tolist())})"


def _array(rows: Array, digits: int = 9) -> str:
    return f"[{', '.join(_tuple(row, digits) for row in rows)}]"
