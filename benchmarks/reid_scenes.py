"""Load scenes with labelled detections for the re-identification benchmark (rank_k.py).

Sources: rendered rooms, recordings with annotated or clustered identities, ScanNet, Matterport3D.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, os.environ.get("REOBJ_TRACK", str(Path(__file__).resolve().parent.parent)))
import quadrics
import reobj_track as rt
from reobj.cameras import viewing_rays
from reobj.files import atomic
from reobj.results.truth import Role, read_truth
from reobj.sources.recorded import NO_RUNS, rle_decode, rle_encode
from reobj.types import Array, Image, IntArray

# ---- Scenes --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Scene:
    """Images of one scene with labelled detections, as a struct of arrays (F frames, N rows).

    Attributes:
        images: F files. number: (F,) frame numbers in the recording.
        row: (N,) frame of each detection, an index of images. xyxy: (N, 4).
        name: (N,) class names. model: (N,) what looks identical, -1 unknown.
        identity: (N,) from 1; 0: not scored, only known not to be background.
        sight: (N, 3) unit vector from the camera to the object in world axes, NaN if unknown.
        runs: N run lengths of masks for images of `size` (w, h), empty where there is none.
    """

    title: str
    images: list[Path]
    number: IntArray
    row: IntArray
    xyxy: Array
    name: npt.NDArray[np.str_]
    model: IntArray
    identity: IntArray
    sight: Array
    runs: list[Any]
    size: tuple[int, int]

    def at(self, f: int) -> tuple[Image, rt.Detections, IntArray]:
        """Image of frame f, all its detections, and which of them are scored."""
        rows = np.flatnonzero(self.row == f)
        runs = [self.runs[i] for i in rows]
        masks = None
        if any(map(len, runs)):
            masks = np.stack([rle_decode(r, self.size) for r in runs])  # (D, H, W)
        classes = np.unique(self.name, return_inverse=True)[1][rows].astype(np.int64)
        found = rt.Detections(self.xyxy[rows], np.ones(len(rows)), classes, masks)
        return read_image(self.images[f]), found, np.flatnonzero(self.identity[rows] > 0)

    @property
    def scored(self) -> IntArray:
        """(n,) rows that are scored, in the order of frames."""
        order = np.argsort(self.row, kind="stable")
        return order[self.identity[order] > 0]

    def sampled(self, every: int) -> Scene:
        """Keep every n-th frame."""
        keep = np.arange(0, len(self.images), every)
        rows = np.isin(self.row, keep)
        arrays = {k: getattr(self, k)[rows] for k in ("xyxy", "name", "model", "identity", "sight")}
        return dataclasses.replace(
            self, **arrays, images=[self.images[f] for f in keep], number=self.number[keep],
            row=np.searchsorted(keep, self.row[rows]),
            runs=[r for r, kept in zip(self.runs, rows, strict=True) if kept],
        )  # fmt: skip


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any]:
    """Read an image (BGR by default); the error names an unreadable one."""
    image = cv2.imread(str(path), flags)
    if image is None:
        raise rt.ReobjError(f"{path}: cannot be read as an image")
    return np.asarray(image)


# ---- Rendered rooms ------------------------------------------------------------------------------


def room_scene(
    seed: int, cache: Path, every: int = 6, plan: str = "home", min_side: float = 24.0
) -> Scene:
    """A room of render_room.py, sampled widely; rendered once for each version of the renderer."""
    import render_room
    import rendering

    sources = sorted(Path(rendering.__file__).parent.glob("*.py"))
    version = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]
    folder = cache / f"{plan}_{seed}_{every}_{version}"
    if not (folder / "scene.npz").exists():
        config = render_room.RoomConfig(seed=seed)
        if plan != "home":
            changes: dict[str, Any] = {"plan": plan, "path": "tour"}
            config = dataclasses.replace(config, **changes)
        render_scene(config, folder, every)
    with np.load(folder / "scene.npz") as data:
        part = {k: data[k] for k in data.files}
    runs = np.split(part["mask_counts"], part["mask_offsets"][1:-1])
    side = (part["xyxy"][:, 2:] - part["xyxy"][:, :2]).min(1)
    clear = (part["visibility"] >= 0.3) & (side >= min_side)
    files = [folder / f"{n:05d}.jpg" for n in part["number"]]
    return Scene(
        f"{plan} {seed}", files, part["number"], part["row"], part["xyxy"], part["name"],
        part["model"], np.where(clear, part["identity"], 0), part["sight"], runs,
        (int(part["size"][0]), int(part["size"][1])),
    )  # fmt: skip


def render_scene(config: Any, folder: Path, every: int) -> None:
    """Render every n-th frame of a clip with detector-like boxes and masks into a folder."""
    import render_room as rr

    folder.mkdir(parents=True, exist_ok=True)
    seed, room, K = config.seed, rr.make_room(config), rr.camera_matrix(config)
    poses = rr.camera_path(room, config)
    rows: list[dict[str, Any]] = []
    numbers = np.arange(0, len(poses) - 1, every)
    for f, number in enumerate(numbers):
        own = dataclasses.replace(config, seed=1000 * seed + int(number))  # noise and exposure
        frame = next(rr.render_clip(room, own, poses[number : number + 2]))
        cv2.imwrite(str(folder / f"{number:05d}.jpg"), frame.image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        rng = np.random.default_rng([seed, 5, int(number)])
        found = rr.simulate_detections(
            room, frame.truth, frame.instance, rr.DetectorConfig(false_positives=0), rng
        )
        sight = viewing_rays(found.xyxy, K @ poses[number])
        for i, k in enumerate(found.truth_index):
            item = room.objects[k]
            rows.append({
                "row": f, "xyxy": found.xyxy[i], "name": item.class_name, "sight": sight[i],
                "model": item.twin_group, "identity": item.identity,
                "visibility": frame.truth.visibility[k], "run": rr.run_lengths(found.masks[i]),
            })  # fmt: skip
    lengths = [len(r["run"]) for r in rows]
    arrays: dict[str, Any] = {k: np.array([r[k] for r in rows]) for k in rows[0] if k != "run"}
    with atomic(folder / "scene.npz") as part, part.open("wb") as file:
        np.savez_compressed(
            file, **arrays, number=numbers, size=np.array([config.width, config.height]),
            mask_counts=np.concatenate([r["run"] for r in rows]),
            mask_offsets=np.concatenate([[0], np.cumsum(lengths)]),
        )  # fmt: skip


# ---- Recordings ----------------------------------------------------------------------------------


def recording_scene(folder: Path, every: int = 1, min_visibility: float = 0.0) -> Scene:
    """A folder with images/ and gt_mot.txt, gt.txt or gt/gt.txt (MOTChallenge, 1-based frames)."""
    known = [folder / n for n in ("gt_mot.txt", "gt.txt", "gt/gt.txt", "tracks.txt")]
    truth_file = next((p for p in known if p.is_file()), None)
    if truth_file is None:
        raise rt.ReobjError(f"{folder}: expected identities in gt_mot.txt, gt.txt or gt/gt.txt")
    files = image_files(folder)
    truth = read_truth(truth_file, rt.COCO_NAMES, min_visibility)
    truth = truth[truth.role != Role.ABSENT]
    if len(truth) and truth.frame.max() > len(files):
        raise rt.ReobjError(
            f"{truth_file}: frame {truth.frame.max()} of {len(files)} images in {folder}: give the "
            "folder that holds every frame"
        )
    size = read_image(files[0]).shape[1::-1]
    n = len(truth)
    scene = Scene(
        folder.name, files, np.arange(len(files)), truth.frame - 1, truth.xyxy, truth.name,
        np.full(n, -1), np.where(truth.role == Role.SCORED, truth.identity, 0),
        sights(folder, truth.frame - 1, truth.xyxy), [NO_RUNS] * n, (size[0], size[1]),
    )  # fmt: skip
    return scene.sampled(every)


def image_files(folder: Path) -> list[Path]:
    """Images of a recording in natural order."""
    for name in ("images", "img1", "color", "rgb", "undistorted_color_images"):
        files = [p for p in (folder / name).glob("*") if p.suffix.lower() in (".jpg", ".png")]
        if files:
            return sorted(files, key=lambda p: (len(p.stem), p.stem))
    raise rt.ReobjError(f"{folder}: expected images in images/, img1/, color/ or rgb/")


def sights(folder: Path, row: IntArray, xyxy: Array) -> Array:
    """View directions (N, 3) where poses_c2w.txt and intrinsics.json exist, else NaN."""
    sight = np.full((len(row), 3), np.nan)
    files = (folder / "poses_c2w.txt", folder / "intrinsics.json")
    if not all(p.is_file() for p in files):
        return sight
    cams = np.linalg.inv(np.loadtxt(files[0]).reshape(-1, 4, 4))[:, :3]  # (F, 3, 4)
    K = pinhole(json.loads(files[1].read_text()))
    for f in np.unique(row):
        sight[row == f] = viewing_rays(xyxy[row == f], K @ cams[f])
    return sight


def pinhole(numbers: dict[str, Any]) -> Array:
    """(3, 3) from fx, fy, cx, cy."""
    fx, fy, cx, cy = (float(numbers[k]) for k in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def depth_scene(folder: Path, min_score: float = 0.3, reach: float = 0.3) -> Scene:
    """Identities without annotation: detections of the frames that have depth, clustered in 3D.

    Its position is the median back-projected point of the middle of its box; detections of
    a class belong together if their positions chain within `reach` times 1 m (single linkage).
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    files = image_files(folder)
    found = np.loadtxt(next(folder.glob("detections_*.csv")), delimiter=",")
    found = found[found[:, 5] >= min_score]
    poses = np.loadtxt(folder / "poses_c2w.txt").reshape(-1, 4, 4)
    numbers = json.loads((folder / "intrinsics.json").read_text())
    stems = {p.stem: f for f, p in enumerate(files)}
    depths = {stems[p.stem]: p for p in sorted((folder / "depth").glob("*.png"))}
    found = found[np.isin(found[:, 0], list(depths))]
    position = np.array([
        center_in_world(rt_depth, box, poses[int(f)], numbers)
        for f, box in zip(found[:, 0], found[:, 1:5], strict=True)
        for rt_depth in [depths[int(f)]]
    ])  # (N, 3)  # fmt: skip
    good = np.isfinite(position).all(1)
    found = found[good]
    position = position[good]
    identity, count = np.zeros(len(found), np.int64), 0
    for c in np.unique(found[:, 6]):
        own = np.flatnonzero(found[:, 6] == c)
        labels = np.ones(1, int)
        if len(own) > 1:
            labels = fcluster(linkage(position[own], "average"), reach, "distance")
        identity[own] = labels + count
        count += int(labels.max())
    row = found[:, 0].astype(np.int64)
    size = read_image(files[0]).shape[1::-1]
    return Scene(
        f"{folder.name} (depth)", files, np.arange(len(files)), row, found[:, 1:5],
        np.array(rt.COCO_NAMES)[found[:, 6].astype(int)], np.full(len(row), -1), identity,
        sights(folder, row, found[:, 1:5]), [NO_RUNS] * len(row), (size[0], size[1]),
    )  # fmt: skip


def center_in_world(path: Path, xyxy: Array, world_from_cam: Array, numbers: Any) -> Array:
    """Median point (3,) of the middle of a box in a depth image (mm), NaN if there is no depth."""
    depth = read_image(path, cv2.IMREAD_UNCHANGED).astype(np.float64) / 1000  # (H, W) m
    K = pinhole(numbers.get("depth", numbers))
    shift = np.asarray(numbers.get("T_color_from_depth", [0, 0, 0]), float)
    rows, cols = np.nonzero((depth > 0.2) & (depth < 8))
    z = depth[rows, cols]
    points = np.stack([(cols + 0.5 - K[0, 2]) * z / K[0, 0], (rows + 0.5 - K[1, 2]) * z / K[1, 1],
                       z], 1) + shift  # (P, 3) in the colour camera  # fmt: skip
    pixels = points @ pinhole(numbers).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    middle, half = (xyxy[:2] + xyxy[2:]) / 2, (xyxy[2:] - xyxy[:2]) / 4
    inside = (np.abs(pixels - middle) <= half).all(1)
    if inside.sum() < 5:
        return np.full(3, np.nan)
    point = np.median(points[inside], 0)
    return np.asarray(world_from_cam[:3, :3] @ point + world_from_cam[:3, 3])


# ---- ScanNet and Matterport3D --------------------------------------------------------------------

COLOUR = {"ScanNet": "color", "Matterport3D": "undistorted_color_images"}  # folders of images
STRUCTURE = ("wall", "floor", "ceiling")  # labelled as instances, but no objects
MATTERPORT_NAME = re.compile(r"(\w+)_i(\d)_(\d)")  # panorama, camera 0-2, yaw 0-5
PANORAMA = 1000  # frame numbers from one panorama to the next: elsewhere, never "near in time"
EXPORT = (
    "python reader.py --filename SCENE.sens --output_path {} --export_color_images --export_poses "
    "--export_intrinsics  # SensReader/python of ScanNet"
)


def scannet_scene(
    folder: Path, every: int = 1, min_mask: int = 0, min_side: float = 0.0, views: int = 0
) -> Scene:
    """A scene of ScanNet (exported from .sens) or of Matterport3D, with label images.

    ScanNet: color/, pose/, intrinsic/ of SensReader, instance-filt/, SCENE.aggregation.json.
    Matterport3D: undistorted_color_images/, undistorted_camera_parameters/HOUSE.conf,
    house_segmentations/HOUSE.semseg.json; it has no label images: instance/STEM.png are rendered
    from HOUSE.ply by the user.

    Label images hold objectId + 1, 0 is nothing. Every visible object takes part; scored are those
    (walls, floor and ceiling aside) with `min_mask` pixels, a box side of `min_side` and fewer than
    two image borders touched (CLOVER), at most `views` evenly chosen ones of each instance.
    """
    names = instance_names(folder)
    files = labelled_images(folder)[::every]
    h, w = read_image(files[0]).shape[:2]
    boxes, labels, runs, rows, scored = [], [], [], [], []
    for f, path in enumerate(files):
        label = label_image(folder, path.stem, (w, h))
        for k in np.setdiff1d(np.unique(label), [0]):
            mask = label == k
            y, x = np.nonzero(mask)
            box = np.array([x.min(), y.min(), x.max() + 1, y.max() + 1], float)
            touched = int((box[:2] <= 0).sum() + (box[2:] >= (w, h)).sum())  # image borders
            good = len(x) >= min_mask and (box[2:] - box[:2]).min() >= min_side and touched < 2
            boxes.append(box)
            labels.append(int(k))
            runs.append(rle_encode(np.ascontiguousarray(mask)))
            rows.append(f)
            scored.append(good and int(k) in names and names[int(k)] not in STRUCTURE)
    identity = np.where(scored, labels, 0).astype(np.int64)
    if views:
        identity = evenly(identity, views)
    xyxy, row = np.array(boxes).reshape(-1, 4), np.array(rows, np.int64)
    sight = np.full((len(row), 3), np.nan)
    for f, img_from_world in enumerate(posed_images(folder, files, h)):
        if np.isfinite(img_from_world).all():
            sight[row == f] = viewing_rays(xyxy[row == f], img_from_world)
    class_name = np.array([names.get(k, "") for k in labels], str)
    return Scene(
        folder.name, files, frame_numbers(files), row, xyxy, class_name, np.full(len(row), -1),
        identity, sight, runs, (w, h),
    )  # fmt: skip


def labelled_images(folder: Path) -> list[Path]:
    """The colour images of a scene, or what to do to have them."""
    if any((folder / name).is_dir() for name in COLOUR.values()):
        return image_files(folder)
    expected = " or ".join(f"{name}/ ({of})" for of, name in COLOUR.items())
    hint = f"; export them: {EXPORT.format(folder)}" if any(folder.glob("*.sens")) else ""
    raise rt.ReobjError(f"{folder}: expected images in {expected}{hint}")


def frame_numbers(files: Sequence[Path]) -> IntArray:
    """Frame numbers: of ScanNet's N.jpg that of the video; panoramas are far from each other."""
    found = [MATTERPORT_NAME.fullmatch(p.stem) for p in files]
    panoramas = sorted({m[1] for m in found if m})
    numbers = []
    for position, (path, m) in enumerate(zip(files, found, strict=True)):
        if m:
            numbers.append(PANORAMA * panoramas.index(m[1]) + 6 * int(m[2]) + int(m[3]))
        else:
            own = re.fullmatch(r"(?:frame-)?(\d{1,9})(?:\.color)?", path.stem)
            numbers.append(int(own[1]) if own else position)
    return np.array(numbers, np.int64)


def evenly(identity: IntArray, views: int) -> IntArray:
    """Keep at most so many evenly spaced rows of each identity, 0 for the others."""
    kept = np.zeros_like(identity)
    for k in np.setdiff1d(np.unique(identity), [0]):
        rows = np.flatnonzero(identity == k)
        kept[rows[np.unique(np.linspace(0, len(rows) - 1, views).round().astype(int))]] = k
    return kept


def instance_names(folder: Path) -> dict[int, str]:
    """Class name of each label value, from ScanNet's aggregation or Matterport3D's semseg file.

    (Matterport3D's region_segmentations/ number the objects of each region anew: not read.)
    """
    known = ("*.aggregation.json", "house_segmentations/*.semseg.json", "*.semseg.json")
    files = [path for pattern in known for path in sorted(folder.glob(pattern))]
    if not files:
        raise rt.ReobjError(
            f"{folder}: expected SCENE.aggregation.json (ScanNet) or "
            "house_segmentations/HOUSE.semseg.json (Matterport3D)"
        )
    try:
        groups = json.loads(files[0].read_text())["segGroups"]
        return {
            int(g.get("objectId", g.get("id", i))) + 1: str(g["label"]).strip().lower()
            for i, g in enumerate(groups)
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise rt.ReobjError(f"{files[0]}: expected segGroups with objectId and label") from error


def label_image(folder: Path, stem: str, size: tuple[int, int]) -> IntArray:
    """The label image (H, W) of a frame, at the size (w, h) of its colour image."""
    for name in ("instance-filt", "instance", "instance-raw"):
        path = folder / name / f"{stem}.png"
        if path.is_file():
            label = read_image(path, cv2.IMREAD_UNCHANGED)
            if label.ndim != 2:
                raise rt.ReobjError(f"{path}: expected one channel, objectId + 1")
            if label.shape[::-1] != size:
                label = cv2.resize(label, size, interpolation=cv2.INTER_NEAREST)
            return np.asarray(label, np.int64)
    if (folder / COLOUR["Matterport3D"]).is_dir():
        raise rt.ReobjError(
            f"{folder}: expected instance/{stem}.png, objectId + 1 of each pixel: Matterport3D has "
            "no label images; render them from house_segmentations/*.ply with its cameras"
        )
    raise rt.ReobjError(f"{folder}: expected instance-filt/{stem}.png for color/{stem}")


def posed_images(folder: Path, files: Sequence[Path], height: int) -> Array:
    """K @ cam_from_world (F, 3, 4) of images, NaN where the pose is not known or was lost."""
    found = np.full((len(files), 3, 4), np.nan)
    config = sorted((folder / "undistorted_camera_parameters").glob("*.conf"))
    if config:
        known = matterport_cameras(config[0], height)
        for f, path in enumerate(files):
            found[f] = known.get(path.name, np.nan)
        return found
    intrinsic = folder / "intrinsic" / "intrinsic_color.txt"
    for f, path in enumerate(files):
        pose = folder / "pose" / f"{path.stem}.txt"
        if intrinsic.is_file() and pose.is_file():
            K = np.loadtxt(intrinsic)[:3, :3]
            found[f] = K @ np.linalg.inv(np.loadtxt(pose))[:3]  # of -inf (lost track): NaN
    return found


def matterport_cameras(path: Path, height: int) -> dict[str, Array]:
    """K @ cam_from_world (3, 4) of each image of HOUSE.conf, by the name of its file.

    Its cameras look along -z with y up, and its images have their origin at the lower left.
    """
    K, found = np.eye(3), {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        try:
            if words[:1] == ["intrinsics_matrix"]:
                K = np.array(words[1:], float).reshape(3, 3)
                K[1, 2] = height - K[1, 2]
            elif words[:1] == ["scan"]:
                world_from_cam = np.array(words[3:], float).reshape(4, 4) @ np.diag([1, -1, -1, 1])
                found[words[2]] = K @ np.linalg.inv(world_from_cam)[:3]
        except ValueError as error:
            expected = "scan DEPTH COLOUR and 16 numbers, intrinsics_matrix and 9"
            raise rt.ReobjError(f"{path}, line {number}: expected {expected}") from error
    return found


# ---- Detections instead of labels ----------------------------------------------------------------

MIN_OVERLAP = 0.5  # IoU from which a detection shows a labelled instance (PASCAL VOC)
Detect = Callable[[Image], rt.Detections]


def detected_scene(scene: Scene, detect: Detect, class_names: Sequence[str]) -> Scene:
    """The scene as a detector sees it, its detections associated with the labelled instances.

    A detection and an instance of one frame belong together when their labels mean one category
    and their boxes overlap by MIN_OVERLAP, one to one, for the largest sum of overlaps; the other
    detections are known, but not scored.
    """
    columns: dict[str, list[Any]] = {k: [] for k in ("row", "xyxy", "name", "source", "runs")}
    true_name, own_name = categories(scene.name.tolist()), categories(class_names)
    for f, path in enumerate(scene.images):
        found, own = detect(read_image(path)), np.flatnonzero(scene.row == f)
        names = own_name[found.class_id]  # (D,)
        same_class = names[:, None] == true_name[own]  # (D, T)
        overlap = np.where(same_class, quadrics.box_iou(found.xyxy[:, None], scene.xyxy[own]), 0.0)
        source = np.full(len(found), -1)
        d, t = linear_sum_assignment(np.where(overlap >= MIN_OVERLAP, overlap, 0.0), maximize=True)
        good = overlap[d, t] >= MIN_OVERLAP
        source[d[good]] = own[t[good]]
        columns["row"] += [f] * len(found)
        columns["xyxy"] += list(found.xyxy)
        columns["name"] += names.tolist()
        columns["source"] += source.tolist()
        columns["runs"] += [
            NO_RUNS if found.masks is None else rle_encode(np.ascontiguousarray(found.masks[i]))
            for i in range(len(found))
        ]
    source = np.array(columns["source"], np.int64)
    known = source >= 0
    identity, model, sight = (
        np.zeros(len(source), np.int64), np.full(len(source), -1), np.full((len(source), 3), np.nan)
    )  # fmt: skip
    for array, of_truth in ((identity, scene.identity), (model, scene.model), (sight, scene.sight)):
        array[known] = of_truth[source[known]]
    return dataclasses.replace(
        scene, row=np.array(columns["row"], np.int64), name=np.array(columns["name"], str),
        xyxy=np.array(columns["xyxy"], np.float64).reshape(-1, 4), identity=identity, model=model,
        sight=sight, runs=columns["runs"],
    )  # fmt: skip


def categories(names: Sequence[str]) -> npt.NDArray[np.str_]:
    """What labels mean: the category of priors.json ("office chair": chair), else the label."""
    priors = quadrics.load_priors()
    index = priors.index(names)
    keys = [priors.names[k] if k >= 0 else str(n) for n, k in zip(names, index, strict=True)]
    return np.array(keys, str)


def view_counts(title: str, scenes: Sequence[Scene]) -> list[dict[str, Any]]:
    """Scored views and instances of each class of a set (tables 3.1 and 3.2 of the thesis)."""
    views: dict[str, int] = {}
    instances: dict[str, set[tuple[int, int]]] = {}
    for number, scene in enumerate(scenes):
        for row in scene.scored:
            name = str(scene.name[row])
            views[name] = views.get(name, 0) + 1
            instances.setdefault(name, set()).add((number, int(scene.identity[row])))
    return [
        {"set": title, "class": name, "views": views[name], "instances": len(instances[name])}
        for name in sorted(views, key=lambda n: (-views[n], n))
    ]
