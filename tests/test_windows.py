"""Windows of keyframes: how they are cut, joined and mapped, on points with known poses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from point_worlds import PointWorld, wall
from pose_worlds import ate_percent, sideways

from reobj.cameras import invert_rigid
from reobj.poses import windows
from reobj.poses.features import MatchedPairs, read_pairs
from reobj.poses.mapping import Focal, MapperSearch
from reobj.poses.verification import FocalSource
from reobj.poses.windows import (
    WindowOptions,
    _merged_poses,
    _path,
    aligned,
    map_keyframes,
    split,
    triangulated,
)

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


@pytest.mark.parametrize("count", [281, 500, 1000, 5999])
def test_windows_cover_all_keyframes_overlap_and_are_even(count):
    ids = [3 * k for k in range(count)]
    windows = split(ids)
    assert len(windows) > 1 and sorted({*itertools.chain(*windows)}) == ids
    assert all(window == sorted(window) for window in windows)
    for one, other in itertools.pairwise(windows):
        assert one[-40:] == other[:40]
    sizes = [len(window) for window in windows]
    assert max(sizes) - min(sizes) <= 1 and 120 <= min(sizes) and max(sizes) <= 280


@pytest.mark.parametrize("count", [3, 39, 40, 41, 200, 250])
def test_few_keyframes_are_one_window(count):
    assert split(range(count)) == [list(range(count))]


def matched(ids, near):
    """Pairs of images with enough matches; `near` of two ids says which."""
    found = [pair for pair in itertools.combinations(sorted(ids), 2) if near(*pair)]
    matches = [np.zeros((50, 2), np.int64)] * len(found)
    return MatchedPairs(np.array(found), matches, dict.fromkeys(ids), np.ones((len(found), 3, 3)))


def test_keyframes_of_a_video_stay_in_the_order_of_time():
    """Also where a later part shows the first again, so that another order has nearer matches."""
    ids = numbers(1, 60)
    pairs = matched(ids, lambda a, b: b - a <= 3 or a + b == 61)
    assert _path(ids, pairs) == ids


def test_shuffled_photos_of_a_line_are_put_back_in_a_line():
    ids = numbers(5, 84)
    place = dict(zip(ids, np.random.default_rng(0).permutation(80).tolist(), strict=True))
    pairs = matched(ids, lambda a, b: abs(place[a] - place[b]) <= 3)
    found = _path(ids, replace(pairs, is_path=pairs.in_order(ids)))
    assert sorted(found) == ids
    assert np.abs(np.diff([place[i] for i in found])).max() <= 6
    for window in split(found, WindowOptions(size=20, overlap=5)):
        along = sorted(place[i] for i in window)
        assert along[-1] - along[0] <= len(along) + 6


# ---- Joints --------------------------------------------------------------------------------------


def test_pieces_that_share_images_are_aligned():
    world = walk(24)
    windows = [numbers(1, 10), numbers(8, 17), numbers(15, 24)]
    (group,) = aligned(pieces(world, windows), world.pairs())
    assert sorted(group) == [0, 1, 2] and error_of(group, world) < 0.005


def test_pieces_with_matches_and_no_common_image_are_aligned():
    world = walk(24)
    windows = [numbers(1, 12), numbers(13, 24)]
    (group,) = aligned(pieces(world, windows), world.pairs())
    assert sorted(group) == [0, 1] and error_of(group, world) < 0.005


def test_a_joint_needs_enough_common_points():
    world = walk(24)
    models = pieces(world, [numbers(1, 11), numbers(14, 24)])
    pairs = world.pairs()
    across = (pairs.image_ids[:, 0] <= 11) & (pairs.image_ids[:, 1] >= 14)
    common = {
        int(world.observed[pair[0] - 1][row])
        for pair, match in zip(pairs.image_ids[across], np.array(pairs.inliers, object)[across],
                               strict=True)
        for row in match[:, 0].tolist()
    }  # fmt: skip
    few, many = (aligned(models, pairs, WindowOptions(points=n)) for n in (len(common) + 1, 100))
    assert len(common) > 150 and len(few) == 2 and len(many) == 1


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


@pytest.mark.parametrize("reach, alike", [(3, 150), (3, 400)])
def test_a_false_joint_of_places_that_look_alike_is_dropped(reach, alike):
    """The end of the path looks like its beginning: matches of both say that the camera is back.

    Around the loop all four joints contradict each other; the false one has the fewest points, or
    others agree against it.
    """
    count = 48
    points = wall(STEP * count)
    shift = (count - 8) * STEP * np.array([1, 0.2, 0.1])
    first = np.flatnonzero(points[:, 0] < 1.5)[:alike]
    last = np.arange(len(points))[-alike:]
    points[last] = points[first] + shift
    world = PointWorld(sideways(count, STEP), points)
    pairs = world.pairs(reach)
    ids = pairs.image_ids.tolist()
    for a, b in itertools.product(numbers(1, 8), numbers(count - 7, count)):
        _, one, k = np.intersect1d(world.observed[a - 1], first, return_indices=True)
        _, m, other = np.intersect1d(last[k], world.observed[b - 1], return_indices=True)
        if len(m) >= 30:
            ids.append([a, b])
            pairs.inliers.append(np.column_stack([one[m], other]))
    pairs = MatchedPairs(np.array(ids), pairs.inliers, pairs.keypoints, np.empty((len(ids), 3, 3)))
    windows = split(numbers(1, count), WindowOptions(size=14, overlap=4))
    assert len(aligned(pieces(world, [windows[0], windows[-1]]), pairs)) == 1  # they look alike
    (group,) = aligned(pieces(world, windows), pairs)
    assert sorted(group) == [0, 1, 2, 3] and error_of(group, world) < 0.01


# ---- One model -----------------------------------------------------------------------------------


def error_percent(model, world):
    ids = sorted(model.reg_image_ids())
    poses = np.array([model.image(i).cam_from_world().matrix() for i in ids])
    return ate_percent(poses, world.cams[[i - 1 for i in ids]])


def test_joined_pieces_have_all_images_at_their_places_and_points_of_both(tmp_path):
    world = walk(16)
    pairs = world.pairs()
    world.write(tmp_path / "database.db", numbers(1, 16), pairs)
    windows = [numbers(1, 9), numbers(7, 16)]
    models = pieces(world, windows)
    (group,) = aligned(models, pairs)
    model = triangulated(*_merged_poses(models, group), tmp_path / "database.db", 0)
    assert sorted(model.reg_image_ids()) == numbers(1, 16)
    assert error_percent(model, world) < 0.5
    tracks = [{e.image_id for e in point.track.elements} for point in model.points3D.values()]
    across = [track for track in tracks if min(track) < 7 and max(track) > 9]
    assert len(tracks) > 500 and len(across) > 100
    assert model.compute_mean_reprojection_error() < 2


def test_triangulated_points_lie_where_they_are(tmp_path):
    world = walk(8)
    world.write(tmp_path / "database.db", numbers(1, 8), world.pairs())
    camera = world.model([1, 2]).camera(1)
    pose = {i: world.cams[i - 1] for i in numbers(2, 7)}
    model = triangulated(pose, camera, tmp_path / "database.db", 0)
    assert sorted(model.reg_image_ids()) == numbers(2, 7)
    off = []
    for point in model.points3D.values():
        seen = point.track.elements[0]
        true = world.points[world.observed[seen.image_id - 1][seen.point2D_idx]]
        off.append(np.linalg.norm(point.xyz - true))
    assert len(off) > 300 and np.median(off) < 0.05
    for i, cam in pose.items():
        np.testing.assert_allclose(model.image(i).cam_from_world().matrix(), cam, atol=1e-9)


# ---- All of it -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A walk of 20 images, its folder, and a function that maps it there with some options."""
    ids = numbers(1, 20)
    world = PointWorld(sideways(20, STEP), wall(STEP * 20, per_metre=100))
    folder = tmp_path_factory.mktemp("windows")

    def run(name, **options):
        database = folder / name / "database.db"
        if not database.exists():
            database.parent.mkdir()
            world.write(database, ids, world.pairs())
        pairs = read_pairs(database)
        focal = Focal(430 / 480, FocalSource.GIVEN)
        frames = {i: 10 * i for i in ids}
        search = MapperSearch(database, frames, pairs, focal, 0.9, 0)
        return map_keyframes(search, WindowOptions(**options))

    return world, folder, run, run("windows", size=12, overlap=4)


def test_a_walk_mapped_in_windows_is_that_mapped_at_once(mapped):
    world, folder, run, in_windows = mapped
    for (model,), messages, weak in (in_windows, run("whole")):
        assert messages == [] and weak == [] and sorted(model.reg_image_ids()) == numbers(1, 20)
        assert error_percent(model, world) < 0.3
    assert sorted(path.name for path in folder.glob("*/window*")) == ["window0", "window1"]


def test_a_second_call_reads_the_windows_that_are_finished(mapped, monkeypatch):
    """The same poses without any mapper; a window that is missing is mapped again, no other."""
    world, folder, run, ((first,), *_) = mapped
    ran = []
    search = MapperSearch.run

    def note(self):
        ran.append(list(self.ids))
        return search(self)

    monkeypatch.setattr(MapperSearch, "run", note)
    (again,), messages, _ = run("windows", size=12, overlap=4)
    assert ran == [] and messages == []
    for i in numbers(1, 20):
        found = (model.image(i).cam_from_world().matrix() for model in (again, first))
        np.testing.assert_allclose(*found, atol=1e-9)
    for lost in ("all", "window1"):
        (folder / "windows" / lost / "search.json").unlink()
    (again,), *_ = run("windows", size=12, overlap=4)
    assert ran == [numbers(9, 20)] and error_percent(again, world) < 0.3


def test_the_progress_of_windows_is_complete_when_the_last_one_is_verified(mapped, monkeypatch):
    _, _, run, _ = mapped
    events = []
    search = MapperSearch.run

    def note(self):
        found = search(self)
        events.append("verified")
        return found

    def send(step, done, total):
        events.append((step, done / total if total else 0.0))

    monkeypatch.setattr(MapperSearch, "run", note)
    monkeypatch.setattr(windows, "send_progress", send)
    run("shown", size=12, overlap=4)
    last = len(events) - events[::-1].index("verified")
    before = [event[1] for event in events[:last] if event != "verified"]
    assert before and max(before) < 1 and ("mapping", 1.0) in events[last:]
