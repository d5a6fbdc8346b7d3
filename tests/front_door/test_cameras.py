"""`poses` on small rendered walks in which some images cannot be registered."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pose_worlds import ate_percent, textured_room
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import load_poses

pytest.importorskip("pycolmap")
COUNT = 30


@pytest.fixture(scope="module")
def walk():
    """Images of a walk in equal steps with camera shake of 5 px at 320 px; true poses."""
    return textured_room(COUNT, 0.12, -0.8, size=(320, 240))


def cameras(folder: Path, images, capsys, caplog) -> tuple[rt.Poses, str]:
    """Write images, run `poses` on them; return the poses and the printed text."""
    (folder / "in").mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / "in" / f"{k:03d}.png"), image)
    assert rt.main(["poses", str(folder / "in"), "-o", str(folder / "out")]) == 0
    text = "".join(capsys.readouterr()) + caplog.text
    found = list((folder / "out" / "cache").glob("poses*.npz"))
    video = rt.Video(folder / "in")
    poses = load_poses(found[0]) if found else rt.estimate_poses(video, rt.PosesConfig(), folder)
    return poses, text


def other_scene(k: int) -> np.ndarray:
    return textured_room(1, 0, seed=7 + k % 2, size=(320, 240))[0][0]


def test_unrelated_images_do_not_affect_the_other_poses(
    walk, tmp_path, monkeypatch, capsys, caplog
):
    """Black images and images of another scene: the others get the poses they get without these."""
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)  # fewer than pictures: by flow
    images, truth = (values[:24] for values in walk)
    lost = [*range(5, 9), *range(15, 19)]
    images = [other_scene(k) if k in lost else im for k, im in enumerate(images)]
    images[5:9] = [image * 0 for image in images[5:9]]
    poses, text = cameras(tmp_path, images, capsys, caplog)
    own = ~np.isin(np.arange(24), lost)
    assert poses.known[own].all() and not poses.known[~own].any() and poses.part_count == 1
    assert ate_percent(poses.cam_from_world[own], truth[own]) < 1.0
    assert "cameras: 16 of 24 frames (pycolmap)," in text and "015.png" in text


def test_only_gaps_with_a_small_error_are_interpolated(walk, tmp_path, monkeypatch, capsys, caplog):
    """Camera shake gives an error of 2 px over one lost frame and 8 px over five; both reported."""
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
    images, truth = walk
    lost = [7, *range(15, 20)]
    images = [cv2.GaussianBlur(im, (0, 0), 25) if k in lost else im for k, im in enumerate(images)]
    poses, text = cameras(tmp_path, images, capsys, caplog)
    assert np.flatnonzero(poses.status == "interpolated").tolist() == [7]
    assert np.flatnonzero(~poses.known).tolist() == [*range(15, 20)]
    assert "cameras: 25 of 30 frames (pycolmap), 1 interpolated" in text
    assert "5 of 30 frames have no camera: frames 15-19" in text
    assert ate_percent(poses.cam_from_world[poses.known], truth[poses.known]) < 1.5


def test_a_pure_rotation_gives_directions_only(tmp_path, capsys, caplog):
    images, truth = textured_room(12, 0, 4, size=(320, 240))
    poses, text = cameras(tmp_path, images, capsys, caplog)
    assert poses.known.all() and poses.is_spot and len(poses.points) == 0
    assert 0 < poses.direction_sigma[0] < np.radians(1)
    assert "frames 0-11 have directions only: the camera turns on one spot" in text
    one, true = (p[-1, :, :3] @ p[0, :, :3].T for p in (poses.cam_from_world, truth))
    assert np.degrees(Rotation.from_matrix(one @ true.T).magnitude()) < 1
