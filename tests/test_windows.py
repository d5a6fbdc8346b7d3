"""Windows of keyframes: how they are cut, joined and mapped, on points with known poses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from point_worlds import PointWorld, wall
from pose_worlds import ate_percent, sideways

from reobj.cameras import invert_rigid
from reobj.poses.features import MatchedPairs, read_pairs
from reobj.poses.mapping import (
    Focal,
    MapperSearch,
    _path,
    aligned,
    map_keyframes,
    split,
)
from reobj.poses.verification import FocalSource

pycolmap = pytest.importorskip("pycolmap")
STEP = 0.35


def walk(count, seed=0):
    """Images along a wall."""
    return PointWorld(sideways(count, STEP), wall(STEP * count, seed=seed), seed=seed)


def numbers(first, last):
    return list(range(first, last + 1))


def similarity(k):
    """Any similarity, a different one for each k."""
    rng = np.random.default_rng(k)
    turn = pycolmap.Rotation3d(rng.normal(size=3))
    return pycolmap.Sim3d(rng.uniform(0.3, 3), turn, rng.normal(0, 5, 3))


def error_of(group, world):
    """Largest error of all cameras in the models of `pieces`, over the extent of the path.

    Each similarity of the group brings cameras of its piece into the frame of one of them.
    """
    centre = invert_rigid(world.cams)[:, :, 3]
    extent = STEP * len(centre)
    (root, *_) = (k for k, found in group.items() if np.allclose(found.matrix(), np.eye(3, 4)))
    expected = similarity(root) * centre
    errors = [group[k] * (similarity(k) * centre) - expected for k in group]
    return np.linalg.norm(errors, axis=2).max() / extent / similarity(root).scale


def pieces(world, windows):
    """Models of some images, each in a frame and scale of its own."""
    return [world.model(ids, similarity(k), seed=k) for k, ids in enumerate(windows)]


# ---- Windows -------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 40, 250, 281, 1000, 5999])
def test_windows_cover_all_keyframes_overlap_and_are_even(count):
    ids = [3 * k for k in range(count)]
    windows = split(ids)
    assert sorted({*itertools.chain(*windows)}) == ids and (len(windows) > 1) == (count > 280)
    assert all(one[-40:] == other[:40] for one, other in itertools.pairwise(windows))
    sizes = [len(window) for window in windows]
    assert max(sizes) - min(sizes) <= 1 and min(120, count) <= min(sizes) <= max(sizes) <= 280


def matched(ids, near):
    """Pairs of images with enough matches; `near` of two ids says which."""
    found = [pair for pair in itertools.combinations(sorted(ids), 2) if near(*pair)]
    matches = [np.zeros((50, 2), np.int64)] * len(found)
    return MatchedPairs(np.array(found), matches, dict.fromkeys(ids), np.ones((len(found), 3, 3)))


def test_shuffled_photos_of_a_line_are_put_back_in_a_line():
    ids = numbers(5, 84)
    place = dict(zip(ids, np.random.default_rng(0).permutation(80).tolist(), strict=True))
    pairs = matched(ids, lambda a, b: abs(place[a] - place[b]) <= 3)
    found = _path(ids, replace(pairs, is_path=pairs.in_order(ids)))
    assert sorted(found) == ids
    assert np.abs(np.diff([place[i] for i in found])).max() <= 6
    for window in split(found, 20, 5):
        along = sorted(place[i] for i in window)
        assert along[-1] - along[0] <= len(along) + 6


# ---- Joints --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "ends, groups",
    [
        ([(1, 10), (8, 17), (15, 24)], 1),  # common images
        ([(1, 12), (13, 24)], 1),  # matches alone
        ([(1, 10), (15, 24)], 2),  # too few common points
    ],
)
def test_pieces_with_enough_common_points_are_aligned(ends, groups):
    world = walk(24)
    found = aligned(pieces(world, [numbers(*end) for end in ends]), world.pairs())
    assert len(found) == groups and sum(map(len, found)) == len(ends)
    if groups == 1:
        assert error_of(found[0], world) < 0.005


def test_common_points_that_no_similarity_explains_join_nothing():
    """Matches are mixed up at random."""
    world = walk(24)
    pairs = world.pairs(reach=1)
    rng = np.random.default_rng(0)
    for row, (a, b) in enumerate(pairs.image_ids.tolist()):
        if a <= 12 < b:
            pairs.inliers[row] = np.column_stack(
                [pairs.inliers[row][:, 0], rng.permutation(pairs.inliers[row][:, 1])]
            )
    groups = aligned(pieces(world, [numbers(1, 12), numbers(13, 24)]), pairs)
    assert [list(group) for group in groups] == [[0], [1]]


def test_two_scenes_stay_two_groups_the_larger_first():
    one = walk(12)
    other = walk(16, seed=1)
    aside = np.array([500, 0, 0])
    cams = np.concatenate([one.cams, other.cams])
    cams[12:, :, 3] -= cams[12:, :, :3] @ aside
    world = PointWorld(cams, np.concatenate([one.points, other.points + aside]))
    windows = [numbers(1, 7), numbers(5, 12), numbers(13, 21), numbers(19, 28)]
    groups = aligned(pieces(world, windows), world.pairs())
    assert [sorted(group) for group in groups] == [[2, 3], [0, 1]]
    assert all(error_of(group, world) < 0.01 for group in groups)


def test_a_false_joint_of_places_that_look_alike_is_dropped():
    """The end of the path looks like its beginning: matches of both say that the camera is back.

    Around the loop all four joints contradict each other; the false one has the fewest points, or
    others agree against it.
    """
    count = 48
    points = wall(STEP * count)
    shift = (count - 8) * STEP * np.array([1, 0.2, 0.1])
    first = np.flatnonzero(points[:, 0] < 1.5)[:400]
    last = np.arange(len(points))[-400:]
    points[last] = points[first] + shift
    world = PointWorld(sideways(count, STEP), points)
    pairs = world.pairs(reach=3)
    ids = pairs.image_ids.tolist()
    for a, b in itertools.product(numbers(1, 8), numbers(count - 7, count)):
        _, one, k = np.intersect1d(world.observed[a - 1], first, return_indices=True)
        _, m, other = np.intersect1d(last[k], world.observed[b - 1], return_indices=True)
        if len(m) >= 30:
            ids.append([a, b])
            pairs.inliers.append(np.column_stack([one[m], other]))
    pairs = MatchedPairs(np.array(ids), pairs.inliers, pairs.keypoints, np.empty((len(ids), 3, 3)))
    windows = split(numbers(1, count), 14, 4)
    assert len(aligned(pieces(world, [windows[0], windows[-1]]), pairs)) == 1  # they look alike
    (group,) = aligned(pieces(world, windows), pairs)
    assert sorted(group) == [0, 1, 2, 3] and error_of(group, world) < 0.01


# ---- One model -----------------------------------------------------------------------------------


def error_percent(model, world):
    ids = sorted(model.reg_image_ids())
    poses = np.array([model.image(i).cam_from_world().matrix() for i in ids])
    return ate_percent(poses, world.cams[[i - 1 for i in ids]])


# ---- All of it -----------------------------------------------------------------------------------


@pytest.mark.parametrize("size, windows", [(12, ["window0", "window1"]), (200, [])])
def test_a_walk_mapped_in_windows_is_that_mapped_at_once(tmp_path, size, windows):
    ids = numbers(1, 20)
    world = PointWorld(sideways(20, STEP), wall(STEP * 20, per_metre=100))
    database = tmp_path / "database.db"
    world.write(database, ids, world.pairs())
    focal = Focal(430 / 480, FocalSource.GIVEN)
    frames = {i: 10 * i for i in ids}
    search = MapperSearch(database, frames, read_pairs(database), focal, 0.9, 0)
    (model,), messages, weak, _ = map_keyframes(search, size, 4)
    assert messages == [] and weak == [] and sorted(model.reg_image_ids()) == ids
    assert error_percent(model, world) < 0.3
    assert sorted(path.name for path in tmp_path.glob("window*")) == windows
