"""Scenes of points without images, for the tests of what comes after features."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from pose_worlds import DotWorld

from reobj.poses.features import MatchedPairs

pycolmap = pytest.importorskip("pycolmap")


def wall(width, per_metre=150, seed=0):
    """Points (N, 3) in front of a camera that walks along x from 0."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-3, -2.5, 4], [width + 3, 2.5, 7], (int(per_metre * (width + 6)), 3))


class PointWorld:
    """Points with descriptors that K cameras observe, without any image.

    Image k has the id k + 1; its keypoints are the observed points, with noise.

    Attributes:
        observed: points (n,) of each image's keypoints. xy: (n, 2) pixels of each.
    """

    def __init__(self, cams, points, noise_px=0.3, seed=0, size=(480, 360)):
        rng = np.random.default_rng(seed)
        world = DotWorld(size=size)
        world.points = points
        self.size = size
        self.camera = world.camera
        self.points = points
        self.cams = np.asarray(cams)
        self.descriptors = rng.integers(0, 256, (len(points), 128)).astype(np.uint8)
        self.descriptors //= rng.integers(1, 9, (len(points), 128)).astype(np.uint8)
        self.observed = []
        self.xy = []
        for cam in self.cams:
            xy, seen = world.project(cam)
            in_front = points @ cam[2, :3] + cam[2, 3] > 1
            self.observed.append(np.flatnonzero(seen & in_front))
            noise = rng.normal(0, noise_px, (len(self.observed[-1]), 2))
            self.xy.append(xy[self.observed[-1]] + noise)

    def model(self, ids, similarity=None, noise=0.003, seed=0):
        """A `pycolmap.Reconstruction` of some images, moved by a `pycolmap.Sim3d`."""
        made = pycolmap.Reconstruction()
        camera = self.camera.to_pycolmap()
        camera.camera_id = 1
        made.add_camera_with_trivial_rig(camera)
        tracks = [[] for _ in self.points]
        for number in ids:
            image = pycolmap.Image(
                name=f"{number:06d}", keypoints=self.xy[number - 1], camera_id=1, image_id=number
            )
            pose = pycolmap.Rigid3d(self.cams[number - 1])
            made.add_image_with_trivial_frame(image, pose)
            for row, point in enumerate(self.observed[number - 1].tolist()):
                tracks[point].append(pycolmap.TrackElement(number, row))
        off = np.random.default_rng(seed).normal(0, noise, self.points.shape)
        for xyz, elements in zip(self.points + off, tracks, strict=True):
            if len(elements) > 1:
                made.add_point3D(xyz, pycolmap.Track(elements))
        if similarity is not None:
            made.transform(similarity)
        return made

    def match(self, one, other):
        """Keypoints (n, 2) of two images that observe the same points."""
        seen = self.observed[one - 1], self.observed[other - 1]
        _, a, b = np.intersect1d(*seen, return_indices=True)
        return np.column_stack([a, b])

    def pairs(self, reach=4):
        """Matches of all images at most `reach` apart, as `features.read_pairs` gives them."""
        count = len(self.cams)
        ids = [
            (a, b)
            for a in range(1, count + 1)
            for b in range(a + 1, min(a + reach, count) + 1)
            if len(self.match(a, b))
        ]
        inliers = [self.match(*pair) for pair in ids]
        keypoints = {k + 1: xy for k, xy in enumerate(self.xy)}
        F = np.array([self.fundamental(*pair) for pair in ids])
        return MatchedPairs(np.array(ids), inliers, keypoints, F)

    def fundamental(self, one, other):
        """The fundamental matrix (3, 3) of two images."""
        full = [np.vstack([cam, [0, 0, 0, 1]]) for cam in self.cams[[one - 1, other - 1]]]
        motion = full[1] @ np.linalg.inv(full[0])
        x, y, z = motion[:3, 3]
        inverse = np.linalg.inv(self.camera.K)
        return inverse.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3] @ inverse

    def write(self, database, ids, pairs=None):
        """Write images with keypoints and descriptors, and verified matches, into a database."""
        with contextlib.closing(pycolmap.Database.open(str(database))) as db:
            if not db.exists_camera(1):
                camera = self.camera.to_pycolmap()
                camera.camera_id = 1
                db.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=1)
                rig.add_ref_sensor(camera.sensor_id)
                db.write_rig(rig, use_rig_id=True)
            for number in ids:
                image = pycolmap.Image(name=f"{number:06d}", camera_id=1, image_id=number)
                db.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=number, rig_id=1)
                frame.add_data_id(image.data_id)
                db.write_frame(frame, use_frame_id=True)
                db.write_keypoints(number, self.xy[number - 1].astype(np.float32))
                rows = self.descriptors[self.observed[number - 1]]
                sift = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, rows)
                db.write_descriptors(number, sift)
            for row, pair in enumerate([] if pairs is None else pairs.image_ids.tolist()):
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
                geometry.F = pairs.fundamental[row]
                geometry.inlier_matches = pairs.inliers[row].astype(np.uint32)
                db.write_two_view_geometry(*pair, geometry)
