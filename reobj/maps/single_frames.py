"""Locate the frames of a recording in a map one by one, where the recording has no poses.

Frames spread over the recording are matched to the points of the map and located by PnP. Without
intrinsics their common focal length is estimated first. The frames between them are located by PnP
on the points of the map, tracked from the located frames (`reobj.poses.localize`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from reobj.cameras import Camera, Poses, SparseModel
from reobj.files import Progress
from reobj.maps.placement import (
    ComponentPlacement,
    ImageFeatures,
    LocatedImage,
    Placement,
    PlacementOptions,
    PointMatcher,
    Similarity,
    refine_similarity,
)
from reobj.maps.room_map import MapPoints
from reobj.poses.keyframes import ResizedVideo
from reobj.poses.localize import fill_gaps, locate_between
from reobj.sources.video import Video
from reobj.types import Array


@dataclass(frozen=True, slots=True)
class SingleFrameOptions:
    """When single images are located, and when they place a recording.

    Measured on 55 images against the maps of other rooms: at most 5 inliers, with known and with
    free focal length. Of 40 images of the right room those that were located had 15 or more, and
    found 4 to 47 % of the points in view again.

    Attributes:
        inliers: least of an image. (More than in the placement: nothing else confirms an image.)
        alone: least inliers of an image that places a recording without a second one.
        found_again: least fraction of the points in view that are found again, median over the
            images (chosen: half of the least measured).
        for_focal: images with the most certain focal lengths, whose median is taken.
        focal_sigma: largest relative standard deviation of the focal length (as in mapping). Of
            one photo of a wall, seen from the front, focal length and distance are not determined.
    """

    inliers: int = 15
    alone: int = 40
    found_again: float = 0.02
    for_focal: int = 15
    focal_sigma: float = 0.03


def locate_frames(
    poses: Poses,
    features: Sequence[ImageFeatures],
    points: MapPoints,
    camera: Camera | None = None,
    options: PlacementOptions | None = None,
    single: SingleFrameOptions | None = None,
    report: Callable[[int], None] = lambda _: None,
) -> Placement:
    """Locate images of a recording without poses in a map.

    The recording is placed if at least `PlacementOptions.frames` images have enough inliers (of
    fewer images all, and at least two), or one image has many.

    Args:
        poses: frames of the recording, without poses. features: of images spread over them.
        points: N, of the map. camera: intrinsics; None: the focal length is estimated.
        report: gets the number of images that were compared.
    Returns:
        poses in the world of the map, of status "pnp" for the images that were located. Their
        points are those of the map, and their observations the inliers of PnP. The similarity of
        the component is the identity, with the covariance that the images have in common.
    """
    single = single or SingleFrameOptions()
    options = dataclasses.replace(options or PlacementOptions(), inliers=single.inliers)
    matcher = PointMatcher(points, options)
    with ThreadPoolExecutor(2) as pool:
        matches = list(pool.map(matcher.match, features))
    report(len(features))
    pairs = list(zip(features, matches, strict=True))
    sigma = 0.0
    if camera is None:
        guess = poses.camera
        found = [matcher.solve(image, *match, guess, free_focal=True) for image, match in pairs]
        calibrated = [image for image in found if image is not None]
        camera, sigma = common_camera(calibrated, guess, points.xyz, single)
    found = [matcher.solve(image, *match, camera) for image, match in pairs]
    located = [image for image in found if image is not None]
    reason = _refusal(located, len(features), options, single)
    if not reason and sigma > single.focal_sigma:
        reason = (
            f"the {len(located)} images that match points of the map do not determine the focal "
            "length; give --camera"
        )
    if reason:
        component = ComponentPlacement(None, tuple(located), len(features), reason)
        return Placement(poses, (component,), reason)
    placed = _with_images(poses, located, points, camera)
    identity = Similarity(1.0, np.eye(3), np.zeros(3), np.zeros((7, 7)))
    cov = refine_similarity(identity, placed, located, points.xyz).cov
    component = ComponentPlacement(
        dataclasses.replace(identity, cov=cov), tuple(located), len(features),
        support=_found_again(located),
    )  # fmt: skip
    return Placement(placed, (component,))


def common_camera(
    images: Sequence[LocatedImage], guess: Camera, xyz: Array, options: SingleFrameOptions
) -> tuple[Camera, float]:
    """Return the camera with the median of the most certain focal lengths of the images.

    Args:
        images: each located with a focal length of its own. guess: camera of the recording, whose
            size is kept; returned without images. xyz: (N, 3) points of the map.
    Returns:
        the camera, and the relative standard deviation of its focal length.
    """
    if not images:
        return guess, np.inf
    size = (guess.width, guess.height)
    sigma = np.array([_focal_sigma(image, xyz[image.point], size) for image in images])
    best = np.argsort(sigma, kind="stable")[: options.for_focal]
    focal = float(np.median([images[k].focal for k in best]))
    camera = Camera("SIMPLE_PINHOLE", *size, (focal, size[0] / 2, size[1] / 2))
    return camera, float((sigma[best] ** -2).sum() ** -0.5)


def _focal_sigma(image: LocatedImage, xyz: Array, size: tuple[int, int]) -> float:
    """Return the relative standard deviation of the focal length of an image.

    Args:
        image: located with this focal length. xyz: (n, 3) points of its inliers. size: px.
    """
    x, y, z = image.cam_from_map[:, :3] @ xyz.T + image.cam_from_map[:, 3:]  # (n,) each
    u, v = image.focal * np.stack([x, y]) / z
    zero = np.zeros_like(z)
    d_point = image.focal / z * np.array([[1 + zero, zero, -x / z], [zero, 1 + zero, -y / z]])
    # of a small rotation w and translation t of the camera: w x X + t
    d_turn = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]])
    turn = np.einsum("ajn,jkn->akn", d_point, d_turn)  # (2, 3, n)
    J = np.concatenate([turn, d_point, np.stack([u, v])[:, None]], 1)  # (2, 7, n)
    error = np.stack([u, v]).T + np.array(size) / 2 - image.xy  # (n, 2)
    variance = (error**2).sum() / max(2 * len(xyz) - 7, 1)  # px^2
    information = np.einsum("ain,ajn->ij", J, J)
    scale = 1 / np.sqrt(np.diag(information)).clip(1e-12)
    scaled = information * np.outer(scale, scale)
    least = np.linalg.eigvalsh(scaled)[0]
    if least < 1e-12:
        return np.inf
    return float(np.sqrt(variance * np.linalg.inv(scaled)[6, 6]) * scale[6])


def _refusal(
    located: Sequence[LocatedImage],
    tried: int,
    options: PlacementOptions,
    single: SingleFrameOptions,
) -> str:
    """Say why the located images do not place the recording; "": they do."""
    needed = max(2, min(options.frames, tried))
    most = max((len(image.point) for image in located), default=0)
    if len(located) < needed and most < single.alone:
        return (
            f"{len(located)} of {tried} images match points of the map, {needed} are needed, or "
            f"one with {single.alone} matches"
        )
    if _found_again(located) < single.found_again:
        return (
            f"{len(located)} of {tried} images show only {100 * _found_again(located):.1f} % of "
            "the points that they should show"
        )
    return ""


def _found_again(located: Sequence[LocatedImage]) -> float:
    """Return the fraction of the points in view that were found again, median over images."""
    return float(np.median([len(im.point) / max(im.in_view, 1) for im in located]))


def _with_images(
    poses: Poses, located: Sequence[LocatedImage], points: MapPoints, camera: Camera
) -> Poses:
    """Return the poses of the located images, with the points of the map and their inliers."""
    rows = np.array([image.row for image in located])
    cam_from_world = np.full_like(poses.cam_from_world, np.nan)
    cam_from_world[rows] = [image.cam_from_map for image in located]
    status = np.full(len(poses.frame), "none", "<U12")
    status[rows] = "pnp"
    seen = [np.column_stack([np.full(len(im.point), im.row), im.point]) for im in located]
    return dataclasses.replace(
        poses,
        camera=camera,
        cam_from_world=cam_from_world,
        status=status,
        source="map",
        points=points.xyz,
        colors=np.full((len(points), 3), 128, np.uint8),  # a map has no colours
        visibility=np.concatenate(seen),
        part=np.zeros(len(poses.frame), np.int64),
    )


def locate_rest(placement: Placement, video: Video, line: Progress, size_px: int = 640) -> Poses:
    """Locate the frames between the located images by tracked points, and interpolate short gaps.

    Args:
        placement: of `locate_frames`. size_px: longer side of the images in which points are
            tracked.
    """
    poses = placement.poses
    images = placement.components[0].images
    rows = np.array([image.row for image in images])
    obs_point = np.concatenate([image.point for image in images])
    model = SparseModel(
        names=("",) * len(images),
        cameras=[poses.camera] * len(images),
        cam_from_world=poses.cam_from_world[rows],
        points=poses.points,
        colors=poses.colors,
        track_length=np.bincount(obs_point, minlength=len(poses.points)),
        obs_image=np.repeat(np.arange(len(images)), [len(image.point) for image in images]),
        obs_point=obs_point,
        obs_xy=np.concatenate([image.xy for image in images]),
    )
    resized = ResizedVideo(video, size_px)
    resized.frames = poses.frame.tolist()
    none = np.empty(0, np.int64)
    located = locate_between(model, rows, none, resized, 0, line)
    shrink = min(1.0, size_px / max(poses.camera.width, poses.camera.height))
    cam_from_world, status = fill_gaps(located, poses.frame, poses.time_s, shrink)
    status[rows] = "pnp"
    return dataclasses.replace(poses, cam_from_world=cam_from_world, status=status)
