"""Checks of a reconstruction: focal length, connecting points, neighbouring images."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reobj.poses.bundle import read_arrays
from reobj.poses.features import MIN_MATCHES, MatchedPairs, focal_from_pairs
from reobj.poses.verification import consistent_groups, count_explained

pycolmap = pytest.importorskip("pycolmap")

SIZE = (640, 480)
CAMERA = pycolmap.Camera(
    camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[500.0, 320.0, 240.0]
)


def cross(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def poses_of(count, rng):
    """cam_from_world (count, 3, 4) of a walk to the right past a wall, with camera shake."""
    turn = Rotation.from_rotvec(rng.normal(0, 0.03, (count, 3))).as_matrix()
    centre = np.column_stack([0.25 * np.arange(count), rng.normal(0, 0.05, (count, 2))])
    return np.concatenate([turn, -turn @ centre[:, :, None]], 2)


# ---- The focal length ----------------------------------------------------------------------------


def fundamental(focal, count, seed=0):
    """Fundamental matrices (count, 3, 3) of general pairs at a focal length over the width."""
    rng = np.random.default_rng(seed)
    K = np.array([[focal * 640, 0, 320], [0, focal * 640, 240], [0, 0, 1]])
    turn = Rotation.from_rotvec(rng.normal(0, 0.2, (count, 3))).as_matrix()
    E = np.array([cross(t) for t in rng.normal(size=(count, 3))]) @ turn
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    return F / np.linalg.norm(F, axis=(1, 2), keepdims=True)


def pairs_of(F, matches=50):
    ids = np.column_stack([np.arange(len(F)), np.arange(len(F)) + 1]) + 1
    return MatchedPairs(ids, [np.zeros((matches, 2), np.int64)] * len(F), {}, F)


@pytest.mark.parametrize(
    "focal, count, matches, planar, found",
    [
        (0.5, 40, 50, 0, True),
        (1.4, 40, 50, 0, True),
        (0.8, 10, 50, 0, True),  # the least number
        (0.8, 9, 50, 0, False),
        (0.8, 10, 29, 0, False),  # of few matches
        (0.8, 10, 50, 1, False),  # one without a fundamental matrix
        (3.5, 40, 50, 0, False),  # out of range
    ],
)
def test_the_focal_length_is_that_of_the_fundamental_matrices(focal, count, matches, planar, found):
    F = fundamental(focal, count)
    F[:planar] = np.nan
    value = focal_from_pairs(pairs_of(F, matches), SIZE)
    assert value == (pytest.approx(focal, rel=0.01) if found else None)


def test_nearly_half_of_the_pairs_may_be_outliers():
    wrong = np.random.default_rng(3).normal(size=(18, 3, 3)) / [[320, 320, 1]]  # any matrices
    wrong = wrong / np.array([320, 320, 1])[:, None]
    F = np.concatenate([fundamental(0.8, 22), wrong])
    assert focal_from_pairs(pairs_of(F), SIZE) == pytest.approx(0.8, rel=0.02)


def test_pairs_of_few_matches_do_not_outvote_those_of_many():
    """As between photos without an order, which are matched with many that see little of it."""
    right = pairs_of(fundamental(0.8, 22), matches=200)
    wrong = pairs_of(fundamental(0.6, 60), matches=40)
    pairs = MatchedPairs(
        np.concatenate([right.image_ids, wrong.image_ids]),
        right.inliers + wrong.inliers,
        {},
        np.concatenate([right.fundamental, wrong.fundamental]),
        is_path=False,
    )
    assert focal_from_pairs(pairs, SIZE) == pytest.approx(0.8, rel=0.02)


# ---- Connected groups of images ------------------------------------------------------------------


class Scene:
    """Images of points on a wall, with the model and the matches computed from them.

    Attributes:
        seen: (R, N) whether an image observes a point. poses: (R, 3, 4), those of the model.
    """

    def __init__(self, count=12, points=900, seed=0):
        rng = np.random.default_rng(seed)
        self.truth = self.poses = poses_of(count, rng)
        low, high = [-3, -2, 3.5], [3 + 0.25 * count, 2, 5]
        self.xyz = rng.uniform(low, high, (points, 3))
        self.xy = np.array([self.project(pose)[0] for pose in self.truth])  # (R, N, 2)
        self.seen = np.array([self.project(pose)[1] for pose in self.truth])  # (R, N)
        self.matched = np.where(self.seen, np.arange(points), -1)  # (R, P) keypoint of each point

    def project(self, pose):
        at = (self.xyz @ pose[:, :3].T + pose[:, 3]) @ CAMERA.calibration_matrix().T
        xy = at[:, :2] / at[:, 2:]
        return xy, (at[:, 2] > 0) & ((xy > 0) & (xy < SIZE)).all(1)

    def untie(self, first, ties):
        """Split points observed on both sides of `first` into two, except for some."""
        both = np.flatnonzero(self.seen[:first].any(0) & self.seen[first:].any(0))
        cut = both[ties:]
        before = self.seen[:, cut] & (np.arange(len(self.seen)) < first)[:, None]
        after = self.seen[:, cut] & ~before
        self.seen[:, cut] = before
        late = np.arange(len(self.seen)) >= first
        again = self.seen.shape[1] + np.arange(len(cut))
        self.matched[:, cut] = np.where(late[:, None] & after, again, self.matched[:, cut])
        self.seen, self.xy = np.hstack([self.seen, after]), np.hstack([self.xy, self.xy[:, cut]])
        self.xyz = np.vstack([self.xyz, self.xyz[cut]])

    def model(self):
        made = pycolmap.Reconstruction()
        made.add_camera_with_trivial_rig(CAMERA)
        tracks = [[] for _ in self.xyz]
        for i, (pose, seen) in enumerate(zip(self.poses, self.seen, strict=True)):
            rows = np.flatnonzero(seen)
            image = pycolmap.Image(
                name=f"{i}.jpg", keypoints=self.xy[i], camera_id=1, image_id=i + 1
            )
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
            for row in rows:
                tracks[row].append((i + 1, int(row)))
        for xyz, found in zip(self.xyz, tracks, strict=True):
            if len(found) >= 2:
                elements = [pycolmap.TrackElement(*element) for element in found]
                made.add_point3D(xyz, pycolmap.Track(elements))
        return made

    def pairs(self, across=False):
        """Match neighbours and next neighbours; across: also the split points."""
        ids, inliers = [], []
        count = len(self.seen)
        for a, b in [(a, a + step) for step in (1, 2) for a in range(count - step)]:
            both = np.flatnonzero(self.seen[a] & self.seen[b])
            match = np.column_stack([both, both])
            if across:
                both = (self.matched[a] >= 0) & (self.matched[b] >= 0)
                match = np.column_stack([self.matched[a, both], self.matched[b, both]])
            ids.append((a + 1, b + 1))
            inliers.append(match)
        keypoints = {i + 1: self.xy[i] for i in range(count)}
        return MatchedPairs(np.array(ids), inliers, keypoints, np.full((len(ids), 3, 3), np.nan))

    def groups(self, across=False):
        found = consistent_groups(read_arrays(self.model()), self.pairs(across))
        return [ids.tolist() for ids in found]


def numbers(*ends):
    return [list(range(a, b)) for a, b in ends]


@pytest.mark.parametrize(
    "first, ties, found",
    [
        (7, 3000, [(1, 13)]),
        (7, MIN_MATCHES - 1, [(1, 8), (8, 13)]),
        (7, 0, [(1, 8), (8, 13)]),
        (10, MIN_MATCHES - 1, [(1, 11)]),  # fewer than three images form no group
    ],
)
def test_groups_connected_by_too_few_points_are_separated(first, ties, found):
    scene = Scene()
    scene.untie(first, ties)
    assert scene.groups() == numbers(*found)


@pytest.mark.parametrize("ties, found", [(60, [(1, 8), (8, 13)]), (3000, [(1, 13)])])
def test_points_not_redetected_in_nearby_views_separate_groups(ties, found):
    """Enough points connect them, but few or many of the expected ones are observed by both."""
    scene = Scene(points=10_000)
    scene.untie(7, ties)
    assert scene.groups() == numbers(*found)


@pytest.mark.parametrize("back, found", [(1.5, [(1, 13)]), (12.0, [(1, 8), (8, 13)])])
def test_points_common_to_distant_views_only_connect_nothing(back, found):
    """Features do not match at a distance 12 m larger: such matches are accidental."""
    scene = Scene()
    scene.poses[7:, 2, 3] += back
    scene.xy[7:] = [scene.project(pose)[0] for pose in scene.poses[7:]]
    scene.untie(7, 2 * MIN_MATCHES)
    assert scene.groups() == numbers(*found)


def test_split_points_between_neighbours_separate_a_sequence():
    """Two halves connected by 200 points far from the seam, as after mixing up look-alikes."""
    scene = Scene(points=10_000)
    scene.untie(6, 200)
    assert scene.groups() == numbers((1, 13))  # nothing was matched, so nothing is missing
    assert scene.groups(across=True) == numbers((1, 7), (7, 13))


def mismatched(pairs, rows):
    """Let the matches of some pairs go to other keypoints: no point of the model is matched."""
    for k in rows:
        pairs.inliers[k] = np.column_stack([pairs.inliers[k][:, 0], pairs.inliers[k][::-1, 1]])
    return pairs


@pytest.mark.parametrize("is_path", [True, False])
def test_an_image_whose_matches_are_not_in_the_model_is_left_out(is_path):
    """It splits nothing. Of a path: those with its neighbours; of photos: with all."""
    scene = Scene()
    pairs = scene.pairs() if is_path else shuffled(scene)
    step = np.abs(np.diff(pairs.image_ids, axis=1)[:, 0])
    own = (pairs.image_ids == 5).any(1) & ((step == 1) | (not is_path))
    mismatched(pairs, np.flatnonzero(own))
    (found,) = consistent_groups(read_arrays(scene.model()), pairs)
    assert found.tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12]


def shuffled(scene, seed=1):
    """Put the images of a scene into another order; pairs that also match neighbours in it.

    The latter are wrong, as on repeated texture: no point of the model is matched.
    """
    order = np.random.default_rng(seed).permutation(len(scene.seen))
    scene.poses = scene.poses[order]
    scene.xy = scene.xy[order]
    scene.seen = scene.seen[order]
    ids = []
    inliers = []
    for a, b in itertools.combinations(range(len(order)), 2):
        both = np.flatnonzero(scene.seen[a] & scene.seen[b])
        near = abs(order[a] - order[b]) <= 2
        if near or b - a == 1:
            ids.append((a + 1, b + 1))
            inliers.append(np.column_stack([both, both if near else np.roll(both, 1)]))
    keypoints = {i + 1: xy for i, xy in enumerate(scene.xy)}
    unknown = np.full((len(ids), 3, 3), np.nan)
    return MatchedPairs(np.array(ids), inliers, keypoints, unknown, is_path=False)


@pytest.mark.parametrize("is_path", [False, True])
def test_wrong_matches_with_the_next_photo_of_a_list_separate_nothing(is_path):
    """Those with the next image of a path do."""
    scene = Scene()
    pairs = replace(shuffled(scene), is_path=is_path)
    groups = consistent_groups(read_arrays(scene.model()), pairs)
    assert (len(groups) == 1 and len(groups[0]) == 12) != is_path


@pytest.mark.parametrize("one_is_tied, found", [(False, [(1, 7), (7, 13)]), (True, [(1, 13)])])
def test_photos_are_separated_where_no_strong_pair_across_is_in_the_model(one_is_tied, found):
    """Two halves with 200 common points far from the seam; the pairs across have many more."""
    scene = Scene(points=10_000)
    scene.untie(6, 200)
    pairs = replace(scene.pairs(across=True), is_path=False)
    if one_is_tied:  # of images 5 and 7, the matches that are points of the model
        row = pairs.image_ids.tolist().index([5, 7])
        pairs.inliers[row] = scene.pairs().inliers[row]
        assert len(pairs.inliers[row]) >= MIN_MATCHES
    arrays = read_arrays(scene.model())
    assert [ids.tolist() for ids in consistent_groups(arrays, pairs)] == numbers(*found)


def keyframes_dropped(scene, model, dropped):
    """Remove images from a model, as if a mapper could not register them."""
    for image in dropped:
        model.deregister_frame(model.image(image).frame_id)
    return model


@pytest.mark.parametrize(
    "dropped, blurred, found",
    [
        ([7, 8], [], [[1, 2, 3, 4, 5, 6], [9, 10, 11, 12]]),  # 6 and 9 were never matched
        ([7], [], [[1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12]]),  # 6 and 8 were, with common points
        ([7], [7], [[1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12]]),  # 7 matches nothing
    ],
)
def test_an_unregistered_keyframe_separates_unconnected_neighbours(dropped, blurred, found):
    """Those between were matched with both sides and could not be registered."""
    scene = Scene()
    model, pairs = keyframes_dropped(scene, scene.model(), dropped), scene.pairs()
    for k in np.flatnonzero(np.isin(pairs.image_ids, blurred).any(1)):
        pairs.inliers[k] = pairs.inliers[k][:29]
    assert [ids.tolist() for ids in consistent_groups(read_arrays(model), pairs)] == found


@pytest.mark.parametrize("step, found", [(0.25, [(1, 17)]), (0.0, [(1, 9), (9, 17)])])
def test_points_seen_under_pure_rotation_connect_no_groups(step, found):
    """Images 7-10 observe the same new points: with a baseline these get a depth."""
    scene = Scene(count=16, points=4000)
    for image in (7, 8, 9):
        scene.poses[image] = scene.poses[6]
        scene.poses[image, 0, 3] -= step * (image - 6)
        scene.xy[image], scene.seen[image] = scene.project(scene.poses[image])
    first, last = scene.seen.copy(), scene.seen.copy()
    first[8:], last[:8] = False, False
    one_side = np.arange(4000) % 2 == 0
    seen = np.where(one_side, first, last)
    turning = np.arange(4000) % 4 == 1  # 1000 points observed by these four only
    seen[:, turning] = False
    seen[6:10, turning] = True
    scene.seen = seen
    assert scene.groups() == numbers(*found)


def test_explained_matches_are_counted():
    scene = Scene()
    model, pairs = scene.model(), scene.pairs()
    total = [len(match) for match in pairs.inliers]
    assert count_explained(read_arrays(model), pairs).tolist() == total
    half = len(pairs.inliers[0]) // 2  # of the first pair's matches go to others
    pairs.inliers[0][:half, 1] = np.roll(pairs.inliers[0][:half, 1], 1)
    found = count_explained(read_arrays(model), pairs)
    assert 0.4 * total[0] < found[0] < 0.7 * total[0] and found[1:].tolist() == total[1:]
    without = keyframes_dropped(scene, model, [1])
    found = count_explained(read_arrays(without), pairs)
    assert ((found == 0) == (pairs.image_ids == 1).any(1)).all()
