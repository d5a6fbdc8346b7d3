"""Features in the boxes of objects, and the points that several views of them give."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from map_worlds import CAMERA
from test_map_motion import HALF, PLACE, descriptors, poses, surface

from reobj.cameras import invert_rigid
from reobj.files import Progress
from reobj.maps.object_points import ObjectView, object_views, triangulated
from reobj.maps.room_map import MapPoints
from reobj.types import Array, Tracks


def located(half: Array = HALF) -> Any:
    """An object with a shape."""
    return SimpleNamespace(
        id=7, center=PLACE, half_axes=half, quat_wxyz=np.array([1.0, 0, 0, 0]), part=0
    )


def views_of(xyz: Array, code: np.ndarray, rng: np.random.Generator) -> list[ObjectView]:
    """Features at the projections of points, .3 px of noise, and ten wrong ones a view."""
    views = []
    for row, cam in enumerate(poses().cam_from_world):
        in_cam = xyz @ cam[:, :3].T + cam[:, 3]
        xy = (in_cam @ CAMERA.K.T)[:, :2] / in_cam[:, 2:] + rng.normal(0, 0.3, (len(xyz), 2))
        low = xy.min(0)
        high = xy.max(0)
        xy = np.concatenate([xy, rng.uniform(low, high, (10, 2))])
        noisy = (code + rng.normal(0, 5, code.shape)).clip(0, 255).astype(np.uint8)
        of_all = np.concatenate([noisy, descriptors(rng, 10)])
        views.append(ObjectView(row, 7, np.concatenate([low, high]), xy, of_all))
    return views


def points_of(xyz: Array, code: np.ndarray, rows: slice = slice(None)) -> MapPoints:
    views = views_of(xyz, code, np.random.default_rng(3))
    return triangulated([located()], views[rows], poses())


def test_features_that_views_have_in_common_become_points_of_the_object() -> None:
    rng = np.random.default_rng(0)
    xyz = surface(rng, 30) + PLACE
    code = descriptors(rng, 30)
    found = points_of(xyz, code)
    gap = np.linalg.norm(found.xyz[:, None] - xyz, axis=2)  # (n, 30)
    assert len(found) == 30 and len(set(gap.argmin(1))) == 30 and gap.min(1).max() < 0.02
    assert (found.object_id == 7).all()
    of_true = code[gap.argmin(1)].astype(float)
    cosine = (found.descriptor * of_true).sum(1)
    cosine /= np.linalg.norm(found.descriptor, axis=1) * np.linalg.norm(of_true, axis=1)
    assert cosine.min() > 0.95
    middle = invert_rigid(poses().cam_from_world)[:, :, 3].mean(0)
    ray = found.xyz - middle
    assert ((ray * found.viewing_ray).sum(1) > 0.95 * np.linalg.norm(ray, axis=1)).all()


def test_points_need_views_and_a_place_inside_the_object() -> None:
    rng = np.random.default_rng(0)
    xyz = surface(rng, 30) + PLACE
    code = descriptors(rng, 30)
    assert len(points_of(xyz, code, slice(3))) > 10
    assert len(points_of(xyz, code, slice(2))) == 0
    behind = xyz + np.array([0, 2 * HALF[1] + 0.3, 0])
    assert len(points_of(behind, code)) == 0


def test_small_boxes_are_enlarged_and_described_from_different_directions() -> None:
    """Blobs of 3 px on an object of 24 px: features lie on them, at native positions."""
    cams = poses(40)
    image = np.full((480, 640, 3), 90, np.uint8)
    middle = np.array([[205, 105], [213, 112], [219, 104], [208, 120], [220, 121]])
    for x, y in middle:
        cv2.circle(image, (16 * int(x) - 8, 16 * int(y) - 8), 24, (240, 240, 240), -1, 16, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    frame = np.asarray(cams.frame)
    box = np.tile([200.0, 100, 224, 126], (40, 1))
    ids = np.full(40, 7)
    tracks = Tracks(frame, ids, np.arange(40), box, np.ones(40), ids * 0, ids * 0 - 1)
    tracks = dataclasses.replace(tracks, detection_index=np.arange(40))
    video: Any = [SimpleNamespace(index=int(f), image=image) for f in frame]
    seen = object_views([located()], cams, tracks, video, Progress("test"))
    rows = sorted(v.row for v in seen)
    assert len(seen) == 12 and rows[0] <= 1 and rows[-1] >= 38
    gap = np.linalg.norm(seen[0].xy[:, None] - middle, axis=2).min(0)  # to each blob
    assert gap.max() < 0.7
