"""Formats of other tools, read by a second library as well; each is skipped where it is missing."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.poses.supplied.readers import read_pose_file
from reobj.sources.detection_files import read_detections

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
LOWEST = rt.DetectConfig(min_score=0.0)


@pytest.fixture(scope="module")
def boxes() -> dict[str, np.ndarray]:
    """The first 300 detections of the example clip."""
    with np.load(ROOM / "detections.npz") as file:
        columns = {k: file[k][:300] for k in ("frame", "xyxy", "score", "class_id")}
        return {**columns, "names": file["class_names"]}


def assert_same(found: Any, frame: np.ndarray, xyxy: np.ndarray, error_px: float) -> None:
    """Compare boxes by frame, whatever their order."""
    ours, theirs = (np.column_stack([f, b]) for f, b in ((found.frame, found.xyxy), (frame, xyxy)))
    ours, theirs = (rows[np.lexsort(rows.round(1).T[::-1])] for rows in (ours, theirs))
    assert len(theirs) >= 300
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=error_px)


def test_coco_is_read_as_by_pycocotools(tmp_path: Path, boxes: dict[str, np.ndarray]) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    images = [{"id": f + 7, "file_name": f"{f:06d}.jpg", "width": 640, "height": 480}
              for f in range(240)]  # fmt: skip
    x1, y1, x2, y2 = boxes["xyxy"].astype(float).T
    columns = zip(boxes["frame"].tolist(), boxes["class_id"].tolist(), boxes["score"].tolist(),
                  np.stack([x1, y1, x2 - x1, y2 - y1], 1).tolist(), strict=True)  # fmt: skip
    rows = [{"image_id": f + 7, "category_id": c + 1, "score": s, "bbox": b}
            for f, c, s, b in columns]  # fmt: skip
    categories = [{"id": i + 1, "name": str(name)} for i, name in enumerate(boxes["names"])]
    dataset = {"images": images, "annotations": [], "categories": categories}
    (tmp_path / "instances.json").write_text(json.dumps(dataset))
    (tmp_path / "det.json").write_text(json.dumps(rows))
    with contextlib.redirect_stdout(io.StringIO()):
        loaded = coco.COCO(str(tmp_path / "instances.json")).loadRes(str(tmp_path / "det.json"))
    theirs = np.array([[a["image_id"] - 7, *a["bbox"]] for a in loaded.anns.values()])
    xyxy = np.hstack([theirs[:, 1:3], theirs[:, 1:3] + theirs[:, 3:]])
    found = read_detections(tmp_path / "det.json", rt.Video(ROOM / "room.mp4"), LOWEST)
    assert_same(found, theirs[:, 0], xyxy, 1e-9)


def test_yolo_labels_are_read_as_by_supervision(
    tmp_path: Path, boxes: dict[str, np.ndarray]
) -> None:
    sv = pytest.importorskip("supervision")
    images, labels = tmp_path / "images", tmp_path / "labels"
    images.mkdir(), labels.mkdir()
    low, high = boxes["xyxy"][:, :2], boxes["xyxy"][:, 2:]
    relative = np.hstack([(low + high) / 2, high - low]) / [640, 480, 640, 480]
    for f in range(240):
        cv2.imwrite(str(images / f"{f:06d}.png"), np.zeros((480, 640, 3), np.uint8))
        rows = np.flatnonzero(boxes["frame"] == f)
        lines = [f"{boxes['class_id'][i]} {' '.join(f'{v:.8f}' for v in relative[i])}"
                 for i in rows]  # fmt: skip
        (labels / f"{f:06d}.txt").write_text("\n".join(lines))
    names = tmp_path / "data.yaml"
    names.write_text(json.dumps({"names": [str(name) for name in boxes["names"]]}))
    dataset = sv.DetectionDataset.from_yolo(str(images), str(labels), str(names))
    parts = [np.column_stack([np.full(len(d), int(Path(name).stem)), d.xyxy])
             for name, _, d in dataset]  # fmt: skip
    theirs = np.vstack(parts)
    found = read_detections(labels, rt.Video(images), LOWEST)
    assert_same(found, theirs[:, 0], theirs[:, 1:], 1e-4)  # float32


@pytest.mark.parametrize("fmt", ["tum", "kitti", "euroc"])
def test_trajectories_are_read_as_by_evo(tmp_path: Path, fmt: str) -> None:
    files = pytest.importorskip("evo.tools.file_interface")
    rng = np.random.default_rng(0)
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (90, 3)), 0))
    centre = np.cumsum(rng.normal(0, 0.03, (90, 3)), 0)
    time_s = 1305031102.17 + np.arange(90) / 30
    path = tmp_path / ("data.csv" if fmt == "euroc" else "poses.txt")
    if fmt == "tum":
        np.savetxt(path, np.column_stack([time_s, centre, turn.as_quat()]), fmt="%.9f")
        theirs = files.read_tum_trajectory_file(str(path))
    elif fmt == "kitti":
        matrix = np.concatenate([turn.as_matrix(), centre[:, :, None]], 2)
        np.savetxt(path, matrix.reshape(90, 12), fmt="%.12e")
        theirs = files.read_kitti_poses_file(str(path))
    else:
        wxyz = turn.as_quat()[:, [3, 0, 1, 2]]
        rows = np.column_stack([np.round(time_s * 1e9), centre, wxyz, np.zeros((90, 9))])
        np.savetxt(path, rows, fmt=["%d"] + ["%.9f"] * 16, delimiter=",")
        theirs = files.read_euroc_csv_trajectory(str(path))
    ours = invert_rigid(read_pose_file(path, "auto", (640, 480)).cam_from_world)
    np.testing.assert_allclose(ours, np.array(theirs.poses_se3)[:, :3], rtol=0, atol=1e-12)
