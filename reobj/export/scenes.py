"""3D scenes of a result: glTF (trimesh), OpenUSD (usd-core), PLY, and cameras for nerfstudio."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from reobj import __version__
from reobj.cameras import CV_FROM_GL, Poses, invert_rigid
from reobj.export.source import (
    UprightWorld,
    centred,
    distortion,
    image_files,
    largest_component,
    upright_world,
    video_of,
)
from reobj.files import atomic, staged
from reobj.results.ply import write_ply, write_point_ply
from reobj.results.result import Result
from reobj.sources.image_files import IMAGE_FPS
from reobj.types import Array, ReobjError, object_color, visible_name


def world_from_gl(poses: Poses) -> Array:
    """Return the poses (F, 4, 4) of cameras that look along -z with y up; NaN without a pose."""
    world_from_cam = np.tile(np.eye(4), (len(poses.frame), 1, 1))
    world_from_cam[:, :3] = invert_rigid(poses.cam_from_world)
    world_from_cam[:, :3, :3] = world_from_cam[:, :3, :3] @ CV_FROM_GL
    return world_from_cam


# ---- glTF and PLY ------------------------------------------------------------------------------


def export_glb(result: Result, path: Path) -> None:
    """Write binary glTF 2.0 with trimesh: a mesh per object, the sparse points, the camera path.

    The nodes are named "CLASS ID"; `extras` of a mesh has data of its object. (x, z, -y) of the
    upright frame of the other exports, as y is up in glTF; metres if the scale is known.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ReobjError("trimesh is not installed: pip install trimesh") from error
    world = upright_world(result, path, float32=True)
    turn = np.eye(4)
    if world.upright:
        turn = turn[[0, 2, 1, 3]] * [[1], [1], [-1], [1]]  # z up to y up: x, z, -y
    scene: Any = trimesh.Scene(metadata={"origin_in_world": world.origin.tolist()})
    solids = world.ellipsoids
    columns = solids.world_from_obj * solids.half_axes[:, None]  # (O, 3, 3)
    for o, axes, center in zip(world.objects, columns, solids.center_in_world, strict=True):
        mesh = trimesh.creation.icosphere(subdivisions=3)
        name = f"{o.class_name} {o.id}"
        mesh.visual.face_colors = [*object_color(o.id)[::-1], 255]
        entry = o.to_json()
        mesh.metadata = {k: entry[k] for k in ("id", "class", "status", "support", "size_m")}
        world_from_sphere = np.eye(4)
        world_from_sphere[:3, :3] = axes
        world_from_sphere[:3, 3] = center
        scene.add_geometry(mesh, name, name, transform=turn @ world_from_sphere)
    poses = world.poses
    if poses is not None and len(poses.points):
        make_cloud: Any = trimesh.PointCloud
        cloud = make_cloud(poses.points, colors=poses.colors)
        scene.add_geometry(cloud, "points", "points", transform=turn)
    if poses is not None and poses.known.sum() > 1:
        centers = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]
        scene.add_geometry(trimesh.load_path(centers), "cameras", "cameras", transform=turn)
    with atomic(path) as part:
        part.write_bytes(scene.export(file_type="glb"))


def export_ply(result: Result, path: Path) -> None:
    """Write the solids as one coloured, closed triangle mesh (trimesh, Open3D, MeshLab).

    In the world and units of poses.txt: the fitted boxes, cylinders and ellipsoids.
    """
    result = largest_component(result, path)
    if not result.located:
        raise ReobjError(f"{path}: nothing to export: the result has no solids, see `run`")
    located = result.located
    write_ply(path, result.ellipsoids(), [o.id for o in located], [o.support for o in located])


# ---- OpenUSD -----------------------------------------------------------------------------------


def export_usd(result: Result, path: Path) -> None:
    """Write .usda for usdview, Blender and Isaac Sim: z up, metres if the scale is known.

    /World/objects has a Cube, Cylinder or Sphere per object, /World/points the sparse points,
    /World/camera a camera with a time sample per pose (time codes are frame numbers).

    Ref: openusd.org, the schemas UsdGeom and UsdSemantics.
    """
    try:
        from pxr import Gf, Usd, UsdGeom
    except ImportError as error:
        raise ReobjError("usd-core is not installed: pip install usd-core") from error
    world = upright_world(result, path, float32=True)
    stage = Usd.Stage.CreateInMemory()
    root = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind("assembly")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    layer = stage.GetRootLayer()
    layer.documentation = f"reobj_track {__version__}"
    units = "m" if world.metric else "arbitrary"
    origin = Gf.Vec3d(*world.origin.tolist())
    layer.customLayerData = {"units": units, "origin_in_world": origin}
    _add_usd_objects(stage, world)
    poses = world.poses
    if poses is not None and len(poses.points):
        _add_usd_points(stage, poses)
    if poses is not None and poses.known.any():
        _add_usd_camera(stage, poses, result.video.fps or IMAGE_FPS)
    with atomic(path) as part:
        part.write_text(layer.ExportToString(), encoding="utf-8")


def linear_color(rgb: Any) -> Array:
    """Return the colours (..., 3) of USD, which are linear, of bytes; gamma is 2.2."""
    return np.asarray((np.array(rgb) / 255.0) ** 2.2)


def _add_usd_objects(stage: Any, world: UprightWorld) -> None:
    """Add the objects, each as the shape within [-1, 1]^3 scaled by its half axes."""
    from pxr import Gf, Sdf, UsdGeom, UsdSemantics

    kinds = {"box": UsdGeom.Cube, "cylinder": UsdGeom.Cylinder}
    double = UsdGeom.XformOp.PrecisionDouble
    UsdGeom.Scope.Define(stage, "/World/objects")
    solids = world.ellipsoids
    rows = zip(world.objects, solids.center_in_world.tolist(), world.quat_xyzw.tolist(),
               solids.half_axes.tolist(), strict=True)  # fmt: skip
    for found, center, (x, y, z, w), half_axes in rows:
        class_name = visible_name(found.class_name)
        name = re.sub(r"[^A-Za-z0-9_]", "_", class_name)  # identifiers of USD before 24.03
        name = f"_{name}" if name[:1].isdigit() else name
        kind = kinds.get(found.support or "", UsdGeom.Sphere)
        shape = kind.Define(stage, f"/World/objects/{name}_{found.id}")
        shape.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
        shape.CreateDisplayColorAttr([linear_color(object_color(found.id)[::-1]).tolist()])
        shape.AddTranslateOp().Set(Gf.Vec3d(*center))
        shape.AddOrientOp(double).Set(Gf.Quatd(w, x, y, z))
        shape.AddScaleOp(double).Set(Gf.Vec3d(*half_axes))
        prim = shape.GetPrim()
        prim.SetDisplayName(f"{class_name} {found.id}")
        UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr([class_name])
        types = Sdf.ValueTypeNames
        facts = [
            ("id", types.Int64, found.id), ("class", types.String, class_name),
            ("status", types.String, found.status), ("confidence", types.Double, found.confidence),
            ("size", types.Double3, Gf.Vec3d(*half_axes) * 2),
        ]  # fmt: skip
        for key, kind, value in facts:  # Blender imports userProperties as custom properties
            if value is not None:
                prim.CreateAttribute(f"userProperties:{key}", kind, True).Set(value)


def _add_usd_points(stage: Any, poses: Poses) -> None:
    """Add the sparse points; their width is 1/500 of the extent: visible in a view, and apart."""
    from pxr import UsdGeom

    width = float(np.linalg.norm(np.ptp(poses.points, axis=0))) / 500 or 0.01
    points = UsdGeom.Points.Define(stage, "/World/points")
    points.CreatePointsAttr(poses.points.tolist())
    points.CreateWidthsAttr([width])
    points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    low_high = [poses.points.min(0) - width / 2, poses.points.max(0) + width / 2]
    points.CreateExtentAttr(np.array(low_high).tolist())
    colors = points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colors.Set(linear_color(poses.colors).tolist())


def _add_usd_camera(stage: Any, poses: Poses, fps: float) -> None:
    """Add the moving camera; only ratios of its lengths matter, in mm of a 35 mm camera."""
    from pxr import Gf, UsdGeom

    K = poses.camera.K
    width = 36.0
    focal = K[0, 0] * width / poses.camera.width
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    camera.CreateFocalLengthAttr(focal)
    camera.CreateHorizontalApertureAttr(width)
    camera.CreateVerticalApertureAttr(poses.camera.height * focal / K[1, 1])
    camera.CreateHorizontalApertureOffsetAttr((0.5 - K[0, 2] / poses.camera.width) * width)
    camera.CreateVerticalApertureOffsetAttr((K[1, 2] / poses.camera.height - 0.5) * focal
                                            * poses.camera.height / K[1, 1])  # fmt: skip
    camera.CreateClippingRangeAttr((0.01, 10000))
    frames = poses.frame[poses.known].tolist()
    move = camera.AddTransformOp()
    for frame, pose in zip(frames, world_from_gl(poses)[poses.known], strict=True):
        move.Set(Gf.Matrix4d(pose.T.tolist()), frame)  # USD has row vectors
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[-1])


# ---- nerfstudio --------------------------------------------------------------------------------


def export_nerfstudio(result: Result, path: Path) -> None:
    """Write transforms.json for nerfstudio, with initial points and the images of a video.

    The world is that of poses.txt. Images of a folder are referenced; frames of a video are written
    to images/ beside the file.

    Ref: docs.nerf.studio, "Data conventions": camera axes of OpenGL, world_from_cam.
    """
    result, origin = centred(largest_component(result, path))
    poses = result.poses
    video = video_of(result)
    if poses is None or not poses.known.any():
        raise ReobjError(f"{path}: the result has no cameras, see `run`")
    if video is None or not video.has_images:
        why = "the video was moved or deleted" if video is None else "this run had none"
        raise ReobjError(f"{path}: nerfstudio needs the images, but {why}; try --to rrd")
    camera = poses.camera
    fisheye = "FISHEYE" in camera.model
    K = camera.K.tolist()
    data: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    data |= {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    data |= {"w": camera.width, "h": camera.height}
    terms = ("k1", "k2", *(("k3", "k4") if fisheye else ("p1", "p2")))
    data |= distortion(camera, terms, path, "nerfstudio")
    with staged(path.parent, ".part-nerfstudio") as folder:
        files = image_files(video, poses.frame[poses.known].tolist(), path.parent, folder)
        data["frames"] = [
            {"file_path": files[frame], "transform_matrix": pose.tolist()}
            for frame, pose in zip(poses.frame.tolist(), world_from_gl(poses), strict=True)
            if frame in files and np.isfinite(pose).all()
        ]
        if origin.any():  # nerfstudio has float32
            data["applied_transform"] = np.column_stack([np.eye(3), -origin]).tolist()
        if len(poses.points):
            write_point_ply(folder / "sparse_pc.ply", poses.points, poses.colors)
            data["ply_file_path"] = "sparse_pc.ply"
        text = json.dumps(data, indent=1) + "\n"
        (folder / path.name).write_text(text, encoding="utf-8")
