"""Image motion between frames that the camera makes, from sparse optical flow."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from reobj.sources.video import resized
from reobj.types import Array, Floats, Image

FLOW_SIZE_PX = 320  # longer side of the image for optical flow
FLOW_CORNERS = 100  # corners followed
FLOW_NEIGHBOURS = 5  # of these the nearest tell how a track moves besides, in a deep scene
FLOW_MIN_CORNERS = 8  # with fewer that agree, the camera is taken to stand still


class CameraMotion:
    """Global image motion between consecutive frames from sparse optical flow, as a 3x3 matrix.

    A similarity transform is fitted by RANSAC to corner tracks (as BoT-SORT does). What counts is
    how many agree, not their share: in wide steps most are lost, and in 450 pairs of frames of
    different videos at most 7 agreed. With fewer than flow_min_corners the identity is returned, so
    a textureless frame never stops the tracker.
    """

    def __init__(self) -> None:
        self._gray: Image | None = None
        self._corners: Any = None
        self.flow = np.empty((0, 4))  # (K, 4) corners of the old image and what they moved besides

    def __call__(self, image: Image) -> Array:
        """Return new_from_old (3, 3) in pixels of `image`."""
        shrink = min(1.0, FLOW_SIZE_PX / max(image.shape[:2]))
        small = resized(image, [round(side * shrink) for side in image.shape[1::-1]])
        gray = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
        new_from_old, self.flow = np.eye(3), np.empty((0, 4))
        if self._gray is not None and self._corners is not None and self._gray.shape == gray.shape:
            new_from_old = self._flow(gray)
        self._gray = gray
        self._corners = cv2.goodFeaturesToTrack(gray, FLOW_CORNERS, 0.01, 12)
        self.flow /= shrink
        to_small = np.diag([shrink, shrink, 1.0])
        return np.asarray(np.linalg.inv(to_small) @ new_from_old @ to_small)

    def parallax(self, xy: Array) -> Array:
        """What things at xy (N, 2) of the old image moved besides, (N, 2), in a deep scene: as the
        corners near them (median of the nearest).
        """
        if not len(self.flow):
            return np.zeros_like(xy)
        apart = ((xy[:, None] - self.flow[:, :2]) ** 2).sum(-1)  # (N, K)
        near = apart.argsort(1)[:, :FLOW_NEIGHBOURS]
        return np.asarray(np.median(self.flow[near, 2:], 1))

    def _flow(self, gray: Image) -> Array:
        """Fit the similarity small_new_from_small_old (3, 3): to the corners followed, or, where
        the step was too wide for that, to points that look alike.
        """
        assert self._gray is not None and self._corners is not None
        guess = np.empty_like(self._corners)
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(self._gray, gray, self._corners, guess)
        good = ok.ravel() == 1
        found = self._similarity(self._corners[good, 0], moved[good, 0])
        if found is None:
            found = self._similarity(*_alike_points(self._gray, gray))
        return np.eye(3) if found is None else found

    def _similarity(self, old: Floats, new: Floats) -> Array | None:
        """Fit (3, 3) to points (K, 2), None: too few agree. Where it holds for most of them, the
        others move by themselves; where not, the scene is deep, and `flow` says how they move.
        """
        if len(old) < FLOW_MIN_CORNERS:
            return None
        cv2.setRNGSeed(0)
        affine, inliers = cv2.estimateAffinePartial2D(old, new, ransacReprojThreshold=2.0)
        if affine is None or inliers.sum() < FLOW_MIN_CORNERS:
            return None
        if inliers.mean() < 0.5:
            self.flow = np.c_[old, new - old @ affine[:, :2].T - affine[:, 2]]
        return np.vstack([affine, [0, 0, 1]])


def _alike_points(old: Image, new: Image) -> tuple[Floats, Floats]:
    """Points (K, 2) of two gray images that look alike, wherever they are (ORB)."""
    orb = cv2.ORB.create(300, fastThreshold=7)
    (a, look_a), (b, look_b) = (orb.detectAndCompute(image, None) for image in (old, new))
    if look_a is None or look_b is None:
        return np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(look_a, look_b)
    index = np.array([(m.queryIdx, m.trainIdx) for m in pairs], np.int64).reshape(-1, 2)
    points = (np.array(cv2.KeyPoint.convert(found), np.float32) for found in (a, b))
    at_old, at_new = (xy[rows] for xy, rows in zip(points, index.T, strict=True))
    return at_old, at_new
