"""Scenes for the tests of reobj.poses: videos in memory, camera trajectories, rendered walls."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import invert_rigid

SIZE, FOCAL = (640, 480), 500.0
PINHOLE = rt.Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, 320.0, 240.0))
FRAMES = 6


class FakeVideo:
    """Images in memory with the attributes of rt.Video that reobj.poses reads."""

    def __init__(self, images, names=(), fps=30.0, files=()):
        self.images, self.names, self.fps = images, list(names), fps
        self.size = (images[0].shape[1], images[0].shape[0]) if len(images) else SIZE
        self.expected = self.frame_count = len(images)
        self.files = list(files)
        self.fingerprint = ""
        self.config = rt.InputConfig()

    def __iter__(self):
        for i, image in enumerate(self.images):
            yield rt.Frame(i, i / self.fps, image)


def blank(count, names=()):
    return FakeVideo([np.zeros((SIZE[1], SIZE[0], 3), np.uint8)] * count, names)


def some_cameras(count=FRAMES):
    """cam_from_world (F, 3, 4) of a camera that walks and turns."""
    turn = Rotation.from_rotvec(np.linspace([0.1, -0.3, 0.05], [0.2, 0.5, -0.1], count)).as_matrix()
    centre = np.linspace([-1, 0.2, 0.1], [1.3, -0.1, 0.4], count)
    return np.concatenate([turn, -turn @ centre[:, :, None]], 2)


def look_at(centre, target):
    """cam_from_world (3, 4) looking from centre to target, y down."""
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    return np.column_stack([rotation, -rotation @ centre])


def motion(kind, count=60):
    """cam_from_world (F, 3, 4) of a hand-held camera."""
    s = np.linspace(0, 1, count)
    if kind == "orbit":
        centres = np.column_stack([3 * np.cos(2.5 * s), 3 * np.sin(2.5 * s), 1.5 + 0 * s])
        targets = np.zeros((count, 3))
    elif kind == "walk":
        centres = np.column_stack([4 * s - 2, -4 + 0 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.8])
    elif kind == "pan":
        centres = np.column_stack([0.6 * s, -0.5 + 0.3 * s, 1.5 + 0.1 * np.sin(9 * s)])
        targets = centres + np.column_stack([3 * np.cos(4 * s), 3 * np.sin(4 * s), -0.8 + 0 * s])
    elif kind == "forward":
        centres = np.column_stack([0.1 * np.sin(9 * s), -4 + 3 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.5])
    else:  # nearly still
        centres = np.column_stack([0.01 * s, -4 + 0 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.8])
    wobble = 0.3 * np.column_stack([np.sin(11 * s), np.cos(7 * s), np.sin(5 * s)])  # hand-held
    return np.array(
        [look_at(c, t) for c, t in zip(centres, targets + wobble * (kind != "still"), strict=True)]
    )


def supplied(cams, camera=PINHOLE):
    """Poses of frames 0, 1, ... that are all known."""
    count = len(cams)
    times, status = np.arange(count) / 30, np.full(count, "supplied")
    return rt.Poses(camera, np.arange(count), times, cams, status, "user")


def textured_room(count, step, turn_deg=0.0, seed=0, size=(480, 360)):
    """Images of a textured corner (two planes) from a walk or a pure rotation; true poses."""
    rng = np.random.default_rng(seed)
    walls = [
        cv2.GaussianBlur(rng.integers(0, 255, (700, 1400, 3), np.uint8), (0, 0), 2)
        for _ in range(2)
    ]
    walls = [cv2.normalize(w, None, 0, 255, cv2.NORM_MINMAX) for w in walls]
    focal = 0.9 * size[0]
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    texel = 0.01  # metres; wall 0: z = 6, wall 1: a slanted floor
    planes = [
        np.array([[texel, 0, -7], [0, texel, -3.5], [0, 0, 6]]),
        np.array([[texel, 0, -7], [0, 0, 1.2], [0, -texel, 7.5]]),
    ]
    images, poses = [], []
    for i in range(count):
        rotation = Rotation.from_euler("y", turn_deg * i, degrees=True).as_matrix()
        centre = np.array([step * (i - count / 2), 0.1 * np.sin(i), 0])
        image = np.zeros((size[1], size[0], 3), np.uint8)
        for wall, plane in zip(walls, planes, strict=True):
            homography = K @ rotation @ (plane - np.outer(centre, [0, 0, 1]))
            warped = cv2.warpPerspective(wall, homography, size, flags=cv2.INTER_AREA)
            hit = (
                cv2.warpPerspective(np.full(wall.shape[:2], 255, np.uint8), homography, size) == 255
            )
            image[hit] = warped[hit]
        images.append(image)
        poses.append(np.column_stack([rotation, -rotation @ centre]))
    return images, np.array(poses)


def ate_percent(found, truth):
    """RMSE of aligned camera centres over the extent of the path (Umeyama, PAMI 1991)."""
    a, b = invert_rigid(found)[:, :, 3], invert_rigid(truth)[:, :, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a0**2).sum()
    error = b0 - scale * a0 @ (u @ flip @ vt).T
    return 100 * np.sqrt((error**2).sum(1).mean()) / np.linalg.norm(np.ptp(b, axis=0))


class DotWorld:
    """A cloud of soft dots, drawn exactly: pixels (x + .5, y + .5) are COLMAP's, as is `camera`."""

    def __init__(self, seed=0, count=350, size=(480, 360), focal=430.0):
        rng = np.random.default_rng(seed)
        self.size = size
        self.camera = rt.Camera("PINHOLE", *size, (focal, focal, size[0] / 2, size[1] / 2))
        self.points = rng.uniform([-5, -3, 4], [5, 3, 7], (count, 3))
        self.height = rng.choice([-1.0, 1.0], count) * rng.uniform(60, 110, count)
        self.sigma_px = rng.uniform(1.8, 3.5, count)

    def project(self, cam_from_world):
        """Pixels (N, 2) of all points and whether they are well inside the image."""
        in_cam = self.points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
        xy = in_cam @ self.camera.K.T
        xy = xy[:, :2] / xy[:, 2:]
        return xy, ((xy > 8) & (xy < np.array(self.size) - 8)).all(1)

    def image(self, cam_from_world):
        """Draw the world, (h, w, 3) BGR."""
        gray = np.full(self.size[::-1], 128.0)
        xy, _ = self.project(cam_from_world)
        for (x, y), height, sigma in zip(xy - 0.5, self.height, self.sigma_px, strict=True):
            left, top = int(x) - 12, int(y) - 12
            u, v = np.arange(max(left, 0), left + 25), np.arange(max(top, 0), top + 25)
            u, v = u[u < self.size[0]], v[v < self.size[1]]
            if len(u) and len(v):
                blob = np.exp(-((v[:, None] - y) ** 2 + (u - x) ** 2) / (2 * sigma**2))
                gray[v[0] : v[-1] + 1, u[0] : u[-1] + 1] += height * blob
        return np.repeat(gray.clip(0, 255).round().astype(np.uint8)[:, :, None], 3, 2)


def sideways(count, step=0.02):
    """cam_from_world (F, 3, 4) of a walk to the right that turns a little."""
    turn = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.02, -0.04, 0.01], count)).as_matrix()
    centre = np.arange(count)[:, None] * np.array([step, 0.2 * step, 0.1 * step])
    return np.concatenate([turn, -turn @ centre[:, :, None]], 2)


def turn_deg(a, b):
    """Angles between the orientations of poses (N, 3, 4)."""
    return np.degrees(Rotation.from_matrix(a[:, :, :3] @ b[:, :, :3].swapaxes(1, 2)).magnitude())


def arc(count: int) -> np.ndarray:
    """cam_from_world (F, 3, 4) on an arc of 90 degrees around the origin, z up, 3.5 m off."""
    angle = np.radians(np.linspace(-45, 45, count))
    eye = np.stack([3.5 * np.sin(angle), -3.5 * np.cos(angle), np.full(count, 1.6)], 1)
    forward = [0, 0, 0.4] - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    turn = np.stack([right, np.cross(forward, right), forward], 1)  # (F, 3, 3)
    return np.concatenate([turn, -turn @ eye[:, :, None]], 2)
