"""Place a recording in a map: match features to the map's points, PnP, one similarity a component.

Each selected image is matched to the points of the map (one descriptor a point) and located by PnP.
The images of a component of the trajectory must agree on one similarity transform from its world
to that of the map; the component is then moved as a whole. Its cameras relative to each other stay
as they are. Axes: N points of the map, L located images, H hypotheses.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from reobj.cameras import Camera, Poses, import_pycolmap, invert_rigid
from reobj.files import Progress
from reobj.maps.fusion import alignment_jacobian
from reobj.maps.room_map import MapPoints
from reobj.poses.features import root_sift
from reobj.sources.video import Video, shrunk
from reobj.types import Array, BoolArray, Floats, Frame, IntArray

T = TypeVar("T")

COMPARED = 40  # images of a component that are matched to the map; time grows with it
MORE = 200  # images that are compared where fewer do not place a recording
DESCRIBED_POINTS = 20_000  # of a recording, the ones in most images
MATCHED_POINTS = 15_000  # of the map, first points on no object; time grows with it
RATIO = 0.8  # of angles to the best point and to the best one elsewhere (Lowe, IJCV 2004)
ELSEWHERE = 0.03  # distance of such a point, over that of the best one from the camera
# Largest error of an inlier of PnP, px of an image of 640 px (COLMAP: 4; 12 for localisation: two
# reconstructions deform differently)
ERROR_PX = 6.0
# Least inliers of an image. (Of 7,728 images against the maps of other rooms 3 had 8, and no two
# agreed. In the right room wrong images had up to 9.)
INLIERS = 8
AGREEING = 5  # least images that agree on one similarity; of few images, half
# Largest difference between PnP and the similarity: of the orientation, of the position over the
# median depth of the points
TURN_DEG = 5.0
SHIFT = 0.1
SHOWN = 50  # points of the map that an image should show again, to count as a view of it
# Least fraction that agrees of the images that should show the map. (Recordings of the room:
# .6 to 1, one with mirrored images .03.)
CONFIRMED = 0.25
RIVAL = 0.5  # fraction of the images that agree, elsewhere, that makes both positions ambiguous


# ---- Features ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImageFeatures:
    """Features of an image.

    Attributes:
        row: of the frame in the poses. xy: (n, 2) native pixels, COLMAP's. descriptor: (n, 128).
    """

    row: int
    xy: Array
    descriptor: npt.NDArray[np.uint8]


def keyframe_rows(poses: Poses) -> IntArray:
    """Choose every second keyframe, all of few, at most MORE; return their rows in the poses.

    Every second one shows .95 to .98 of the sparse points (measured on four recordings). Without
    observed points: images spread over all frames.
    """
    rows = np.unique(poses.visibility[:, 0])
    rows = rows[poses.measured[rows]] if len(rows) else np.arange(len(poses.frame))
    step = max(2 if len(rows) > COMPARED else 1, -(-len(rows) // MORE))
    return np.asarray(rows[::step], np.int64)


def of_frames(
    video: Video, frames: Collection[int], work: Callable[[Frame], T], line: Progress
) -> Iterator[T]:
    """Apply a function to some frames of a video, in their order, in two threads."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    chosen = (frame for frame in video if frame.index in frames)
    with ThreadPoolExecutor(2) as pool:
        while batch := list(itertools.islice(chosen, 8)):
            yield from pool.map(work, batch)
            line.step(len(batch))
    cv2.setNumThreads(threads)


def image_features(
    poses: Poses, video: Video, rows: IntArray, size_px: int, line: Progress
) -> list[ImageFeatures]:
    """Extract RootSIFT features of the frames in given rows of the poses.

    Args:
        size_px: longer side of the images for features, as in the reconstruction.
    """
    row_of = {int(poses.frame[row]): int(row) for row in rows}
    size = np.array(video.size, np.float64)

    def describe(frame: Frame) -> ImageFeatures:
        image = shrunk(frame.image, size_px)
        xy, descriptor = root_sift(image, np.empty((0, 4)))
        return ImageFeatures(row_of[frame.index], xy * (size / image.shape[1::-1]), descriptor)

    return list(of_frames(video, row_of, describe, line))


def points_with_descriptors(poses: Poses, features: Sequence[ImageFeatures]) -> MapPoints:
    """Describe the sparse points of a recording by the mean descriptor of their keypoints.

    A keypoint belongs to the observed point that projects within 1.5 px (of images of 640 px) of
    it.

    Returns:
        points of session 0, on no object.
    """
    count = len(poses.points)
    sums = np.zeros((count, 128), np.float32)
    ray = np.zeros((count, 3))
    number = np.zeros(count, np.int64)
    distance = np.zeros(count)
    centre = invert_rigid(poses.cam_from_world)[:, :, 3]
    near_px = 1.5 * max(poses.camera.width, poses.camera.height) / 640
    for image in features:
        seen = poses.visibility[poses.visibility[:, 0] == image.row, 1]
        xy = poses.camera.project(transformed(poses.cam_from_world[image.row], poses.points[seen]))
        shown = np.isfinite(xy).all(1)
        if not shown.any() or not len(image.xy):
            continue
        gap, keypoint = cKDTree(image.xy).query(xy[shown])
        seen = seen[shown][gap < near_px]
        sums[seen] += unit_descriptors(image.descriptor[keypoint[gap < near_px]])
        away = poses.points[seen] - centre[image.row]
        length = np.linalg.norm(away, axis=1)
        ray[seen] += away / length[:, None]
        distance[seen] += length
        number[seen] += 1
    kept = np.argsort(-number, kind="stable")[:DESCRIBED_POINTS]
    kept = np.sort(kept[number[kept] > 0])
    mean = distance[kept] / number[kept]
    return described_points(poses.points[kept], sums[kept], ray[kept], mean)


def transformed(b_from_a: Array, xyz: Array) -> Array:
    """Transform points (N, 3) by a rigid transform (3, 4)."""
    return np.asarray(xyz @ b_from_a[:, :3].T + b_from_a[:, 3])


def described_points(
    xyz: Array, descriptor: Floats, ray: Array, distance: Array, object_id: int = 0
) -> MapPoints:
    """Return points (n) of session 0 from sums of unit descriptors (n, 128) and rays (n, 3)."""
    return MapPoints(
        xyz,
        np.minimum(unit_descriptors(descriptor) * 512, 255).astype(np.uint8),
        np.zeros(len(xyz), np.int64),
        np.full(len(xyz), object_id),
        ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-9),
        distance,
    )


def _largest(values: Floats, count: int) -> IntArray:
    """Return the columns (n, count) of the largest of (n, N) values in each row, unordered.

    They lie in the `count` blocks of columns with the largest maxima. (Partitioning whole rows of
    15,000 takes eight times as long.)
    """
    width = 64 if values.shape[1] > 64 * count else 1
    missing = -values.shape[1] % width
    blocks = np.pad(values, ((0, 0), (0, missing)), constant_values=-np.inf)
    blocks = blocks.reshape(len(values), -1, width)
    chosen = np.argpartition(-blocks.max(2), count - 1, axis=1)[:, :count]
    inside = np.take_along_axis(blocks, chosen[:, :, None], 1).reshape(len(values), -1)
    best = np.argpartition(-inside, count - 1, axis=1)[:, :count]
    return np.take_along_axis(chosen, best // width, 1) * width + best % width


def unit_descriptors(rows: npt.NDArray[np.generic]) -> Floats:
    """Scale descriptors to unit length."""
    values = rows.astype(np.float32)
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-9))


def best_features(rows: IntArray, point: IntArray, angle: Array) -> IntArray:
    """Choose the feature with the smallest angle for each point that some rows of features match.

    Args:
        point, angle: (n,) of all features.
    """
    nearest = rows[np.argsort(angle[rows], kind="stable")]
    _, first = np.unique(point[nearest], return_index=True)
    return np.sort(nearest[first])


# ---- Images in the map -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LocatedImage:
    """An image that PnP located in the map.

    Attributes:
        row: of the frame in the poses. cam_from_map: (3, 4).
        xy: (n, 2) native pixels of its inliers. point: (n,) rows of the map's points.
        depth: median depth of the inliers.
    """

    row: int
    cam_from_map: Array
    xy: Array
    point: IntArray
    depth: float


class PointMatcher:
    """Matches the features of images to the points of a map, and locates the images by PnP.

    Args:
        points: N, of the map. camera: of the images. error_px: largest error of an inlier of PnP.
    """

    def __init__(self, points: MapPoints, camera: Camera, error_px: float) -> None:
        self.points = points
        self.camera = camera
        self.error_px = error_px
        self.descriptor = unit_descriptors(points.descriptor)

    def match(self, image: ImageFeatures) -> tuple[IntArray, IntArray]:
        """Return rows of features (n,) and of points (n,) that match by the ratio test.

        The second best point is the best of those that lie elsewhere: a point may be in the map
        several times, from several sessions. Each point keeps its best feature.
        """
        few = 6  # best points of a feature, among which one elsewhere is looked for
        if len(image.xy) < 2 or len(self.points) <= few:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        cosine = unit_descriptors(image.descriptor) @ self.descriptor.T  # (n, N)
        best = _largest(cosine, few)  # (n, few)
        value = np.take_along_axis(cosine, best, 1)
        order = np.argsort(-value, axis=1)
        best = np.take_along_axis(best, order, 1)
        angle = np.arccos(np.take_along_axis(value, order, 1).clip(-1, 1))  # (n, few)
        apart = np.linalg.norm(self.points.xyz[best] - self.points.xyz[best[:, :1]], axis=2)
        elsewhere = apart > ELSEWHERE * self.points.distance[best[:, :1]]
        second = np.where(elsewhere, angle, np.inf).min(1)
        second = np.minimum(second, np.where(elsewhere.any(1), np.inf, angle[:, -1]))
        good = np.flatnonzero((angle[:, 0] < RATIO * second) & (angle[:, 0] < 0.9))
        feature = best_features(good, best[:, 0], angle[:, 0])
        return feature, best[feature, 0]

    def locate(self, image: ImageFeatures) -> LocatedImage | None:
        """Locate an image by PnP on its matches; None with too few inliers."""
        feature, point = self.match(image)
        if len(feature) < INLIERS:
            return None
        xy = image.xy[feature]
        xyz = self.points.xyz[point]
        estimate = import_pycolmap().estimate_and_refine_absolute_pose(
            xy, xyz, self.camera.to_pycolmap(),
            estimation_options={"ransac": {"max_error": self.error_px, "random_seed": 0}},
        )  # fmt: skip
        if estimate is None:
            return None
        pose = np.array(estimate["cam_from_world"].matrix(), np.float64)
        inlier = np.asarray(estimate["inlier_mask"], bool)
        depth = xyz @ pose[2, :3] + pose[2, 3]
        away = xyz - invert_rigid(pose)[:, 3]  # a surface is seen from one side only
        inlier &= (depth > 0) & ((away * self.points.viewing_ray[point]).sum(1) > 0)
        if inlier.sum() < INLIERS or not np.isfinite(pose).all():
            return None
        middle = float(np.median(depth[inlier]))
        return LocatedImage(image.row, pose, xy[inlier], point[inlier], middle)

    def in_view(self, cam_from_map: Array) -> BoolArray:
        """Mark points (N,) in an image that were seen from a similar direction and distance.

        Similar: less than 30 degrees and a factor 1.5 apart, where SIFT is repeatable
        (Mikolajczyk et al., IJCV 2005).
        """
        camera = self.camera
        in_cam = transformed(cam_from_map, self.points.xyz)
        length = np.linalg.norm(in_cam, axis=1)
        z = np.where(in_cam[:, 2] > 1e-9, in_cam[:, 2], np.nan)
        xy = in_cam[:, :2] / z[:, None] @ camera.K[:2, :2].T + camera.K[:2, 2]
        inside = ((xy > 0) & (xy < (camera.width, camera.height))).all(1)
        ray = in_cam @ cam_from_map[:, :3] / length[:, None].clip(1e-9)  # in map axes
        turned = (ray * self.points.viewing_ray).sum(1) > np.cos(np.radians(30))
        near = np.abs(np.log(length.clip(1e-9) / self.points.distance.clip(1e-9))) < np.log(1.5)
        return np.asarray(inside & turned & near, bool)


# ---- One similarity a component ----------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Similarity:
    """Similarity transform map_from_session: x_map = scale * rotation @ x + translation.

    Attributes:
        cov: (7, 7) of (rotation vector, translation, log scale) of a transform applied after it, in
            the world of the map.
    """

    scale: float
    rotation: Array
    translation: Array
    cov: Array = field(default_factory=lambda: np.zeros((7, 7)))

    def apply(self, xyz: Array) -> Array:
        """Transform points (..., 3)."""
        return np.asarray(self.scale * xyz @ self.rotation.T + self.translation)

    def poses(self, cam_from_session: Array) -> Array:
        """Transform poses (F, 3, 4) of cameras; their unit of length becomes the map's."""
        rotation = cam_from_session[:, :, :3] @ self.rotation.T
        moved = self.scale * cam_from_session[:, :, 3] - rotation @ self.translation
        return np.concatenate([rotation, moved[:, :, None]], 2)


DIRECTIONS_ONLY = "its cameras have directions only, and a map needs their positions"
NOT_MOVED = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class ComponentPlacement:
    """How a component of the trajectory was placed in the map, or why it was not.

    Attributes:
        tried: images compared. refused: the reason; "": placed. images: that agree.
        similarity: to the world of the map.
    """

    tried: int
    refused: str = ""
    images: Sequence[LocatedImage] = ()
    similarity: Similarity = NOT_MOVED


def place_component(
    poses: Poses, tried: Sequence[ImageFeatures], matcher: PointMatcher
) -> ComponentPlacement:
    """Place a component of the trajectory in the map.

    Args:
        poses: of the whole recording. tried: features of images of this component.
    """
    with ThreadPoolExecutor(2) as pool:
        located = [image for image in pool.map(matcher.locate, tried) if image is not None]
    needed = max(2, min(AGREEING, -(-len(tried) // 2)))
    refused = partial(ComponentPlacement, len(tried))
    if len(located) < needed:
        text = f"{len(located)} of {len(tried)} images match points of the map"
        return refused(f"{text}, {needed} are needed")
    guess, agrees, rival = _agreement(poses, located)
    agreeing = [located[k] for k in np.flatnonzero(agrees)]
    count = f"{len(agreeing)} of {len(tried)} images agree on a position in the map"
    if len(agreeing) >= needed:
        cam_from_map = guess.poses(poses.cam_from_world[[image.row for image in tried]])
        shows = sum(matcher.in_view(pose).sum() >= SHOWN for pose in cam_from_map)
        count += f", where {shows} should show points of it"
        needed = max(needed, int(np.ceil(CONFIRMED * shows)))
    if len(agreeing) < needed:
        return refused(f"{count}, {needed} are needed")
    if rival >= max(2, RIVAL * len(agreeing)):
        return refused(f"two positions in the map are alike ({len(agreeing)} and {rival} images)")
    similarity = refine_similarity(guess, poses, agreeing, matcher.points.xyz)
    return ComponentPlacement(len(tried), "", agreeing, similarity)


def _agreement(poses: Poses, images: Sequence[LocatedImage]) -> tuple[Similarity, BoolArray, int]:
    """Find the similarity on which most images agree.

    Each pair of images with a baseline is a hypothesis: rotation of one, scale and translation of
    both.

    Returns:
        the similarity; (L,) images that agree; images that agree on the best placement elsewhere
        (by more than a fifth of the depth or .3 rad).
    """
    row = np.array([image.row for image in images])
    depth = np.array([image.depth for image in images])  # (L,) map units
    in_map = invert_rigid(np.stack([image.cam_from_map for image in images]))  # (L, 3, 4)
    in_session = invert_rigid(poses.cam_from_world[row])
    turn = in_map[:, :, :3] @ np.swapaxes(in_session[:, :, :3], 1, 2)  # (L, 3, 3)
    a = in_session[:, :, 3]
    b = in_map[:, :, 3]
    i, j = np.nonzero(~np.eye(len(images), dtype=bool))
    length_a = np.linalg.norm(a[i] - a[j], axis=1)
    length_b = np.linalg.norm(b[i] - b[j], axis=1)
    usable = (length_b > 0.02 * depth[i]) & (length_a > 0)  # a shorter baseline gives no scale
    chosen = spread_over(np.flatnonzero(usable), 3000)  # hypotheses; more take longer
    if not len(chosen):
        return NOT_MOVED, np.zeros(len(images), bool), 0
    i = i[chosen]
    scale = length_b[chosen] / length_a[chosen]  # (H,)
    rotation = turn[i]
    shift = b[i] - scale[:, None] * np.einsum("hij,hj->hi", rotation, a[i])
    predicted = scale[:, None, None] * np.einsum("hij,lj->hli", rotation, a) + shift[:, None]
    off = np.linalg.norm(predicted - b, axis=2) / depth  # (H, L)
    cosine = (np.einsum("hij,lij->hl", rotation, turn) - 1) / 2
    good = (off < SHIFT) & (cosine > np.cos(np.radians(TURN_DEG)))
    best = int(np.argmax(good.sum(1) - 0.5 * np.where(good, off / SHIFT, 0).mean(1)))
    middle = predicted[best]
    apart = np.linalg.norm(predicted - middle, axis=2).min(1) / np.median(depth) > 0.2
    other_turn = (np.einsum("hij,ij->h", rotation, rotation[best]) - 1) / 2 < np.cos(0.3)
    rival = int(good[apart | other_turn].sum(1).max(initial=0))
    guess = Similarity(float(scale[best]), rotation[best], shift[best])
    return guess, good[best], rival


def refine_similarity(
    guess: Similarity, poses: Poses, images: Sequence[LocatedImage], xyz: Array
) -> Similarity:
    """Minimise the reprojection errors of the map's points in the moved cameras.

    The covariance is that of independent errors, times the ratio by which errors common to an image
    (such as the deformation of a reconstruction) raise the variance on average: that of the
    estimator with one cluster an image, which alone needs many more images than parameters.
    """
    image = np.repeat(np.arange(len(images)), [len(im.point) for im in images])
    points = xyz[np.concatenate([im.point for im in images])]  # (n, 3) in the map
    xy = poses.camera.undistort(np.concatenate([im.xy for im in images]))
    pose = poses.cam_from_world[[im.row for im in images]]  # (L, 3, 4)
    K = poses.camera.K
    origin = points.mean(0)  # rotation and scale about it are independent of the translation
    known = np.isfinite(xy).all(1)
    image = image[known]
    points = points[known]
    xy = xy[known]

    def corrected(x: Array) -> Similarity:
        """Apply a correction (7,) about the origin: rotation vector, translation, log scale."""
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        grow = float(np.exp(x[6]))
        translation = grow * turn @ (guess.translation - origin) + origin + x[3:6]
        return Similarity(guess.scale * grow, turn @ guess.rotation, translation)

    def residual(x: Array) -> Array:
        now = corrected(x)
        in_session = (points - now.translation) @ now.rotation / now.scale
        in_cam = np.einsum("nij,nj->ni", pose[image][:, :, :3], in_session) + pose[image][:, :, 3]
        depth = np.where(in_cam[:, 2] > 1e-9, in_cam[:, 2], 1e-9)
        found = in_cam[:, :2] / depth[:, None] @ K[:2, :2].T + K[:2, 2]
        return np.asarray((found - xy).clip(-1e4, 1e4).ravel())

    spread = float(np.linalg.norm(points - origin, axis=1).mean())
    scales = np.array([1, 1, 1, spread, spread, spread, 1.0])
    loss_px = 1.0 * max(poses.camera.width, poses.camera.height) / 640
    fit = least_squares(
        residual, np.zeros(7), loss="soft_l1", f_scale=loss_px, x_scale=scales, max_nfev=50
    )
    J = fit.jac.reshape(-1, 2, 7)  # of the second order approximation of the loss
    error = residual(fit.x).reshape(-1, 2)
    bent = 1 + (error / loss_px) ** 2
    # soft_l1: the derivative of the loss, and the plain Jacobian
    gradient = np.einsum("nij,ni->nj", J, error / np.sqrt(bent) * bent**0.75)  # (n, 7)
    of_image = np.zeros((len(images), 7))
    np.add.at(of_image, image, gradient)
    bread = np.linalg.pinv(np.einsum("nij,nik->jk", J, J))
    independent = float((gradient**2).sum() / max((J**2).sum(), 1e-300))  # px^2
    common = float(np.trace(bread @ of_image.T @ of_image)) / 7  # px^2
    cov = bread * max(independent, len(images) / max(len(images) - 1, 1) * common)
    about = np.eye(7)  # from a small similarity about the centre of the points to one about 0
    about[3:6] = alignment_jacobian(-origin[None])[0]
    return dataclasses.replace(corrected(fit.x), cov=about @ cov @ about.T)


# ---- The recording -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Placement:
    """A recording placed in a map.

    Attributes:
        poses: placed components are one component, the first, in the world of the map; the others
            follow as they are. components: how each was placed, in their order before.
        refused: why no component was placed; "": some was.
    """

    poses: Poses
    components: tuple[ComponentPlacement, ...]
    refused: str = ""

    @property
    def best(self) -> ComponentPlacement:
        """The placed component with most images that agree."""
        return max(self.components, key=lambda c: len(c.images))


def place(
    poses: Poses,
    features: Sequence[ImageFeatures],
    points: MapPoints,
    size_px: int = 640,
    most: int = COMPARED,
    report: Callable[[int], None] = lambda _: None,
) -> Placement:
    """Place the components of a recording in a map.

    Args:
        features: of some images of each component. points: of the map.
        size_px: longer side of the images that have the features. most: images of a component
            that are compared. report: gets the number of images that were compared.
    """
    camera = poses.camera
    error_px = ERROR_PX * max(max(camera.width, camera.height) / size_px, 1.0)
    matcher = PointMatcher(_matched(points), camera, error_px)
    components = list[ComponentPlacement]()
    for k in range(poses.part_count):
        if poses.direction_sigma[k]:
            components.append(ComponentPlacement(0, DIRECTIONS_ONLY))
            continue
        usable = [im for im in features if poses.part[im.row] == k and poses.known[im.row]]
        tried = usable[:: max(1, -(-len(usable) // most))]
        components.append(place_component(poses, tried, matcher))
        report(len(tried))
    placed = [k for k, found in enumerate(components) if not found.refused]
    if not placed:
        return Placement(poses, tuple(components), components[0].refused)
    return Placement(joined(poses, components, placed), tuple(components))


def spread_over(rows: IntArray, most: int) -> IntArray:
    """Choose rows at equal distances, `most` of them if there are more."""
    if len(rows) <= most:
        return rows
    return np.asarray(rows[np.linspace(0, len(rows) - 1, most).astype(int)], np.int64)


def _matched(points: MapPoints) -> MapPoints:
    """Choose MATCHED_POINTS spread over the map: points on no object, then others."""
    others = spread_over(np.flatnonzero(points.object_id <= 0), MATCHED_POINTS)
    on_objects = np.flatnonzero(points.object_id > 0)
    chosen = [others, spread_over(on_objects, MATCHED_POINTS - len(others))]
    return points[np.sort(np.concatenate(chosen))]


def joined(poses: Poses, components: Sequence[ComponentPlacement], placed: Sequence[int]) -> Poses:
    """Move the placed components into the world of the map, as one component, the first."""
    cam_from_world = poses.cam_from_world.copy()
    points = poses.points.copy()
    component = np.zeros_like(poses.part)
    others = sorted({*range(poses.part_count)} - {*placed})
    for number, k in enumerate(others, 1):
        component[poses.part == k] = number
    observer, point = poses.visibility.T
    for k in placed:
        similarity = components[k].similarity
        rows = poses.part == k
        cam_from_world[rows] = similarity.poses(cam_from_world[rows])
        # unobserved points belong to the only component
        seen = point[rows[observer]] if poses.part_count > 1 else np.arange(len(points))
        points[seen] = similarity.apply(points[seen])
    return dataclasses.replace(
        poses,
        cam_from_world=cam_from_world,
        points=points,
        part=component,
        direction_sigma=np.append(0.0, poses.direction_sigma[others]),
    )
