"""Image motion of the camera from one frame to the next, by sparse optical flow.

`CameraMotion` estimates a similarity transform for each new image; `CameraMotion.parallax` is the
residual motion near a point of a deep scene. Neither poses nor depth are needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from reobj.sources.video import shrunk
from reobj.types import Array, Floats, Image

FLOW_SIZE_PX = 320  # px, longer side of the image in which corners are followed: for speed


class CameraMotion:
    """Image motion of the camera between consecutive frames, as a 3x3 similarity transform.

    RANSAC fits the transform to corners followed by optical flow (as BoT-SORT does) or, if the step
    was too wide to follow any, to matched ORB points. It needs a number of inliers, not a majority:
    in wide steps most corners are lost. Without enough inliers the motion is the identity, so the
    tracker continues through frames without texture.

    Attributes:
        residual_flow: (K, 4) in a deep scene (see `parallax`), else (0, 4): x, y of the corners in
            the old image, and their residual motion x, y after the transform, pixels.
        gray, corners: the latest image, small and gray, and its corners (C, 1, 2); None at first.
            They are the whole state (`ARRAYS`).
    """

    ARRAYS = ("gray", "corners")

    def __init__(self) -> None:
        self.gray: Image | None = None
        self.corners: Floats | None = None
        self.residual_flow = np.empty((0, 4))

    def __call__(self, image: Image) -> Array:
        """Estimate new_from_old (3, 3) between the previous image and this one (H, W, 3) BGR.

        In pixels of `image`; the identity for a first image and after a change of size.
        """
        shrink = min(1.0, FLOW_SIZE_PX / max(image.shape[:2]))
        small = shrunk(image, FLOW_SIZE_PX)
        gray = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
        old = self.gray
        fit = None
        if old is not None and self.corners is not None and old.shape == gray.shape:
            moved, status, _ = cv2.calcOpticalFlowPyrLK(
                old, gray, self.corners, np.empty_like(self.corners)
            )  # (C, 1, 2), (C, 1)
            found = status.ravel() == 1
            fit = _fit_similarity(self.corners[found, 0], np.asarray(moved)[found, 0])
            fit = fit or _fit_similarity(*_orb_matches(old, gray))
        new_from_old, residual_flow = fit or (np.eye(3), np.empty((0, 4)))
        # number: for speed (BoT-SORT: 1000). Quality: strength over that of the strongest corner
        # (as BoT-SORT); the distance, px of the small image, spreads the corners
        good = cv2.goodFeaturesToTrack(gray, maxCorners=100, qualityLevel=0.01, minDistance=12)
        self.corners = None if good is None else np.asarray(good, np.float32)
        self.gray = gray
        self.residual_flow = residual_flow / shrink
        small_from_image = np.diag([shrink, shrink, 1.0])
        return np.asarray(np.linalg.inv(small_from_image) @ new_from_old @ small_from_image)

    def parallax(self, xy: Array, nearest: int = 5) -> Array:
        """Estimate the parallax at points of the old image: their residual motion.

        A scene is deep if less than half of the corners are inliers of the transform. There a point
        moves as the median of its nearest corners. Otherwise the outliers are objects that move by
        themselves, and the parallax is 0.

        Args:
            xy: (N, 2) pixels of the old image.
            nearest: number of nearest corners (measured, IoU of the true boxes with the moved ones,
                against the transform alone: rendered room v900 .76 -> .82, benchmarks/LOG.md).
        Returns:
            (N, 2) pixels, to be added to where `new_from_old` takes the points.
        """
        if not len(self.residual_flow):
            return np.zeros_like(xy)
        distance2 = ((xy[:, None] - self.residual_flow[:, :2]) ** 2).sum(-1)  # (N, K)
        corners = distance2.argsort(1)[:, :nearest]  # (N, nearest)
        return np.asarray(np.median(self.residual_flow[corners, 2:], 1))


def _orb_matches(old: Image, new: Image) -> tuple[Floats, Floats]:
    """Match ORB points of two gray images by mutual nearest descriptors, at any distance.

    Returns:
        positions (K, 2) in the old and in the new image.
    """
    # contrast of a corner, of 255: below OpenCV's 20 for poor texture
    orb = cv2.ORB.create(nfeatures=300, fastThreshold=7)
    (in_old, old_words), (in_new, new_words) = (
        orb.detectAndCompute(image, None) for image in (old, new)
    )
    pairs: Sequence[cv2.DMatch] = ()
    if old_words is not None and new_words is not None:
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(old_words, new_words)
    old_xy = np.array([in_old[m.queryIdx].pt for m in pairs], np.float32).reshape(-1, 2)
    new_xy = np.array([in_new[m.trainIdx].pt for m in pairs], np.float32).reshape(-1, 2)
    return old_xy, new_xy


# inliers that make a fit: in 450 pairs of frames of different videos at most 7 corners agreed
FLOW_MIN_INLIERS = 8


def _fit_similarity(old: Floats, new: Floats) -> tuple[Array, Array] | None:
    """Fit a similarity transform to points (K, 2) by RANSAC; None with too few inliers.

    Returns:
        new_from_old (3, 3), and the residual flow (K, 4) of `CameraMotion` in a deep scene, where
        most points are outliers; else (0, 4).
    """
    if len(old) < FLOW_MIN_INLIERS:
        return None
    cv2.setRNGSeed(0)
    # px of the small image (OpenCV: 3; not measured)
    affine, inliers = cv2.estimateAffinePartial2D(old, new, ransacReprojThreshold=2.0)
    if affine is None or inliers.sum() < FLOW_MIN_INLIERS:
        return None
    residual_flow = np.empty((0, 4))
    if inliers.mean() < 0.5:
        residual_flow = np.c_[old, new - old @ affine[:, :2].T - affine[:, 2]]
    return np.vstack([affine, [0, 0, 1]]), residual_flow
