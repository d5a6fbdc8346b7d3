"""Kalman filter, association, re-identification and identities of the tracker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import mahalanobis
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.types import box_iou

CHAIR, CUP = 56, 41


def rows(*boxes: tuple[float, ...], score: float = 0.9, class_id: int = CHAIR) -> rt.Detections:
    """Detections from x1, y1, x2, y2 (and optionally score, class) tuples."""
    table = [
        (*b[:4], b[4] if len(b) > 4 else score, b[5] if len(b) > 5 else class_id) for b in boxes
    ]
    return rt.Detections.from_array(table)


LARGE = rows((100, 100, 200, 200))
TALL = rows((100, 100, 110, 350))


def unit(rng: np.random.Generator, n: int, dim: int = 64) -> np.ndarray:
    vectors = rng.normal(size=(n, dim))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def update(tracker: rt.Tracker, *args: Any, **known: Any) -> rt.Tracks:
    """Track one frame; the tentative tracks too."""
    tracker.update(*args, **known)
    return tracker.latest


def repeat(count: int, tracker: rt.Tracker, *args: Any, **known: Any) -> rt.Tracks:
    """Track the same input for some frames; the tracks of the last one."""
    tracks = rt.Tracks.empty()
    for _ in range(count):
        tracks = tracker.update(*args, **known)
    return tracks


NOTHING = rt.Detections.empty()
CORNER = rows((0, 0, 50, 50))
BOX = rows((100, 100, 150, 150))
# ---- Kalman filter ----


def noise_scale(mean: np.ndarray) -> np.ndarray:
    """Reference length of the noise (T, 4): mean side for x and y, the side itself for w and h."""
    size = np.maximum(mean[:, 2:, 0], 1)
    side = np.sqrt(size[:, :1] * size[:, 1:])
    return np.concatenate([side, side, size], 1)


def filterpy_of(state: rt.TrackState, i: int) -> KalmanFilter:
    """The same model as an 8-state filterpy filter: cx, cy, w, h, then their velocities."""
    kf = KalmanFilter(dim_x=8, dim_z=4)
    kf.F = np.eye(8) + np.eye(8, k=4)
    kf.H = np.eye(4, 8)
    kf.x[:, 0] = state.mean[i].T.ravel()
    kf.P = np.diag(np.concatenate([state.cov[i, :, 0], state.cov[i, :, 2]]))
    return kf


def spawned(box: np.ndarray, config: rt.TrackerConfig) -> rt.TrackState:
    return rt.TrackState.spawn(box, np.arange(len(box)), 0, config)


@pytest.mark.parametrize(
    "config", [rt.TrackerConfig(), rt.TrackerConfig(std_position=0.11, std_velocity=0.03)]
)
def test_kalman_equals_filterpy(config: rt.TrackerConfig) -> None:
    rng = np.random.default_rng(0)
    state = spawned(rng.uniform(50, 200, (5, 4)), config)
    scale = noise_scale(state.mean)
    np.testing.assert_allclose(state.cov[..., 0], (2 * config.std_position * scale) ** 2)
    np.testing.assert_allclose(state.cov[..., 2], (0.2 * scale) ** 2)
    filters, mean, cov = [filterpy_of(state, i) for i in range(5)], state.mean, state.cov
    for _ in range(30):
        scale = noise_scale(mean)
        mean, cov = rt.kalman_predict(mean, cov, config)
        for i, kf in enumerate(filters):
            std = np.concatenate([config.std_position * scale[i], config.std_velocity * scale[i]])
            kf.predict(Q=np.diag(std**2))
        measured = mean[..., 0] + rng.normal(0, 4, (5, 4))
        noise = 0.05 * noise_scale(mean)
        mean, cov = rt.kalman_update(mean, cov, measured, noise)
        for i, kf in enumerate(filters):
            kf.update(measured[i], R=np.diag(noise[i] ** 2))
    for i, kf in enumerate(filters):
        np.testing.assert_allclose(mean[i].T.ravel(), kf.x[:, 0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(cov[i, :, 0], np.diag(kf.P)[:4], atol=1e-9)
        np.testing.assert_allclose(cov[i, :, 1], np.diag(kf.P[:4, 4:]), atol=1e-9)
        np.testing.assert_allclose(cov[i, :, 2], np.diag(kf.P)[4:], atol=1e-9)


def test_gate_is_the_distance_over_the_whole_innovation() -> None:
    """S = H P H' + R, R of a box at score .8: 5 % of the mean side, in x and in y."""
    config = rt.TrackerConfig()
    state = spawned(np.array([[100, 100, 80, 20], [300, 50, 30, 90.0]]), config)
    mean, cov = rt.kalman_predict(state.mean, state.cov, config)
    center = np.array([[104, 97], [280, 60], [301, 55.0]])
    residual = center.T[:, None] - mean[:, :2, 0].T[..., None]  # (2, 2, 3)
    found = rt.squared_mahalanobis(residual, rt.center_variance(mean, cov).T[..., None])
    for i, j in np.ndindex(2, 3):
        kf = filterpy_of(state, i)
        std = noise_scale(state.mean)[i] * [[config.std_position], [config.std_velocity]]
        kf.predict(Q=np.diag(std.ravel() ** 2))
        noise = (0.05 * noise_scale(mean)[i, :2]) ** 2
        inverse = np.linalg.inv(kf.P[:2, :2] + np.diag(noise))
        assert found[i, j] == pytest.approx(mahalanobis(center[j], kf.x[:2, 0], inverse) ** 2)


def test_states_are_scaled_by_the_local_area_of_a_homography() -> None:
    """The scale is the square root of the area ratio of a small square under the homography."""
    homography = np.array([[1.05, 0.02, 4], [-0.03, 0.97, 8], [2e-4, -3e-4, 1]])
    mean, cov = np.ones((2, 4, 2)), np.ones((2, 4, 3))
    mean[:, :2, 0] = [[50, 400], [600, 30]]
    moved, spread = rt.warp_states(mean, cov, homography)
    for i in range(2):
        corners = mean[i, :2, 0] + 0.01 * np.array([[0, 0], [1, 0], [0, 1.0]])
        x0, x1, x2 = cv2.perspectiveTransform(corners[None], homography)[0]
        np.testing.assert_allclose(moved[i, :2, 0], x0, atol=1e-9)
        edges = np.linalg.det([x1 - x0, x2 - x0])
        assert moved[i, 2, 0] == pytest.approx(np.sqrt(edges) / 0.01, rel=1e-3)
        assert spread[i, 3, 2] == pytest.approx(edges / 1e-4, rel=1e-3)


# ---- Association ----


def random_pairs(seed: int, rows: int, columns: int, density: float) -> tuple:
    """(M, 2) row and column of the allowed pairs, and their costs (M,)."""
    rng = np.random.default_rng(seed)
    pairs = np.argwhere(rng.random((rows, columns)) < density)
    return pairs, rng.random(len(pairs))


@pytest.mark.parametrize("density", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize(("rows", "columns"), [(0, 3), (1, 1), (6, 9), (30, 20)])
def test_most_pairs_then_least_cost(rows: int, columns: int, density: float) -> None:
    """Equals scipy on the full matrix with a prohibitive cost for pairs that are not allowed."""
    for seed in range(10):
        pairs, cost = random_pairs(seed, rows, columns, density)
        whole = np.full((rows, columns), 1e3)
        whole[tuple(pairs.T)] = cost
        row, column = linear_sum_assignment(whole)
        expected = {(r, c) for r, c in zip(row, column, strict=True) if whole[r, c] < 1e3}
        assert {tuple(p) for p in pairs[rt.assign(*pairs.T, cost)]} == expected


@pytest.mark.parametrize("density", [0.0, 0.2, 0.7])
def test_rivals_cost_little_more_than_the_best_of_track_and_detection(density: float) -> None:
    """Equals the same rule on the full matrix."""
    for seed in range(10):
        pairs, cost = random_pairs(seed, 8, 7, density)
        rng = np.random.default_rng(seed)
        same, possible = rng.random((2, len(pairs))) < 0.8
        given = rt.Pairs(*pairs.T, cost, cost, cost, same)
        whole = np.full((8, 7), np.inf)
        whole[tuple(pairs[possible].T)] = cost[possible]
        near = whole <= np.minimum(whole.min(0)[None], whole.min(1)[:, None]) + 0.3
        of_class = np.zeros((8, 7), bool)
        of_class[tuple(pairs[same & possible].T)] = True
        rivals = near & of_class
        several = (rivals.sum(0) > 1)[None] | (rivals.sum(1) > 1)[:, None]
        for found, expected in zip(
            rt.ambiguous_pairs(given, possible, 0.3), (rivals & several, rivals), strict=True
        ):
            whole_found = np.zeros((8, 7), bool)
            whole_found[tuple(pairs[found].T)] = True
            np.testing.assert_array_equal(whole_found, expected)


# ---- The camera's motion ----


def textured(rng: np.random.Generator) -> np.ndarray:
    return cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8), (0, 0), 3)


def test_identity_survives_a_camera_jerk() -> None:
    """The view jumps by 100 px: without motion compensation the gate loses the object."""
    image = textured(np.random.default_rng(2))
    jerk = np.float64([[1, 0, -60], [0, 1, 0]])
    moved = cv2.warpAffine(image, jerk, (640, 480), borderMode=cv2.BORDER_REFLECT)
    found = {}
    for on in (True, False):
        tracker = rt.Tracker(rt.TrackerConfig(camera_motion=on))
        repeat(10, tracker, rows((200, 200, 230, 230)), image)
        for _ in range(4):
            found[on] = tracker.update(rows((140, 200, 170, 230)), moved).track_id.tolist()
    assert found[True] == [1]
    assert found[False] != [1]


def test_tracks_move_with_the_parallax_of_a_deep_scene() -> None:
    """Four bands of the image move sideways; a track in the last one moves with it."""
    image, tracker = textured(np.random.default_rng(6)), rt.Tracker()
    repeat(4, tracker, rows((300, 420, 340, 460)), image)
    bands = zip(np.split(image, 4), (4, 22, 10, 16), strict=True)
    moved = np.concatenate([np.roll(band, shift, 1) for band, shift in bands])
    tracker.update(NOTHING, moved)
    np.testing.assert_allclose(tracker.state.tracks.mean[0, :2, 0], [336, 440], atol=1.5)


def test_known_pose_replaces_the_image_motion() -> None:
    """A pan by a known rotation moves the box exactly as the homography K R K^-1 says."""
    camera = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1))
    for step in range(8):
        angle = np.radians(3.0 * step)
        turn = np.array(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        )
        pose = np.c_[turn, np.zeros(3)]
        center = camera.K @ turn @ np.array([0.2, 0, 1.0])
        x, y = center[:2] / center[2]
        tracks = tracker.update(
            rows((x - 15, y - 15, x + 15, y + 15)), cam_from_world=pose, camera=camera
        )
        assert tracks.track_id.tolist() == [1]


# ---- Identities ----


@pytest.mark.parametrize(
    ("score", "low", "first"), [(0.5, 0.5, 2), (0.74, 0.74, 2), (0.75, 0.75, 1), (0.6, 0.31, 3)]
)
def test_a_new_track_is_tentative_until_its_scores_sum_to_n_init_halves(
    score: float, low: float, first: int
) -> None:
    """Tracks of the first frame are confirmed immediately."""
    tracker = rt.Tracker(rt.TrackerConfig(n_init=3))
    known, new = (0, 0, 50, 50), (100, 0, 150, 50)
    assert tracker.update(rows(known)).track_id.tolist() == [1]
    scores = (score, low, low, low, low)
    ids = [tracker.update(rows(known, (*new, s))).track_id.tolist() for s in scores]
    assert ids == [[1]] * first + [[1, 2]] * (5 - first)


def test_a_return_is_confirmed_one_detection_earlier() -> None:
    views = unit(np.random.default_rng(12), 2)
    tracker = rt.Tracker()
    repeat(12, tracker, CORNER, embeddings=views[:1])
    repeat(60, tracker, NOTHING)
    both = rows((300, 0, 350, 50), (500, 0, 550, 50), score=0.6)
    ids = [tracker.update(both, embeddings=views).track_id.tolist() for _ in range(3)]
    assert ids == [[], [1], [1, 2]]


def test_crossing_objects_keep_their_identity_by_appearance() -> None:
    """Two objects swap positions between frames: motion contradicts the embeddings."""
    views = unit(np.random.default_rng(3), 2)
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1, appearance_weight=0.8))
    repeat(5, tracker, rows((100, 100, 150, 150), (108, 100, 158, 150)), embeddings=views)
    tracks = tracker.update(
        rows((102, 100, 152, 150), (106, 100, 156, 150)), embeddings=views[::-1]
    )
    assert tracks.track_id.tolist() == [2, 1]


@pytest.mark.parametrize(("left", "score", "kind"), [(120, 0.2, CHAIR), (112, 0.9, CUP)])
def test_a_weak_match_requires_a_similar_appearance(left: int, score: float, kind: int) -> None:
    """Low scores and changed classes may continue a track, but not one of another object."""
    seen, other = unit(np.random.default_rng(13), 2)
    for view, expected in ((seen, [1]), (other, [])):
        tracker = rt.Tracker()
        repeat(12, tracker, BOX, embeddings=seen[None])
        found = rows((left, 100, left + 50, 150), score=score, class_id=kind)
        assert tracker.update(found, embeddings=view[None]).track_id.tolist() == expected


def away_and_back(
    tracker: rt.Tracker, views: np.ndarray, back: np.ndarray, gap: int = 200
) -> list[int]:
    """Show objects on the left, nothing for a while, then objects on the right with other sizes."""
    left = [(60 * i, 50, 60 * i + 40, 110) for i in range(len(views))]
    repeat(12, tracker, rows(*left), embeddings=views)
    repeat(gap, tracker, NOTHING)
    right = [(900 + 90 * i, 400, 960 + 90 * i, 440) for i in range(len(back))]
    tracks = repeat(6, tracker, rows(*right), embeddings=back)
    return tracks.track_id.tolist()


def test_objects_that_return_elsewhere_get_their_identity_back() -> None:
    """After 200 frames, at the other side of the image, with another shape: no overlap gate."""
    rng = np.random.default_rng(4)
    views = unit(rng, 4)
    back = views[::-1] + 0.05 * unit(rng, 4)
    assert away_and_back(rt.Tracker(), views, back) == [4, 3, 2, 1]


def test_a_new_object_does_not_take_an_old_identity() -> None:
    rng = np.random.default_rng(5)
    assert away_and_back(rt.Tracker(), unit(rng, 3), unit(rng, 3)) == [4, 5, 6]


def test_an_ambiguous_return_gets_a_new_identity() -> None:
    """One of two identical objects returns and fits both equally well: left to the linker."""
    rng = np.random.default_rng(6)
    base = unit(rng, 1)
    pair = np.concatenate([base + 0.02 * unit(rng, 1), base + 0.02 * unit(rng, 1)])
    assert away_and_back(rt.Tracker(), pair, base) == [3]


def test_identical_objects_are_distinguished_by_their_background() -> None:
    """Same foreground, different surroundings."""
    rng = np.random.default_rng(7)
    same = np.repeat(unit(rng, 1), 3, 0)
    around = unit(rng, 3)
    both = rt.Embeddings(same, around)
    tracker = rt.Tracker()
    boxes = [(60 * i, 50, 60 * i + 40, 110) for i in range(3)]
    repeat(12, tracker, rows(*boxes), embeddings=both)
    repeat(100, tracker, NOTHING)
    for _ in range(5):
        moved = [(500 + 60 * i, 50, 540 + 60 * i, 110) for i in range(3)]
        tracks = tracker.update(rows(*moved), embeddings=rt.Embeddings(same, around[[2, 0, 1]]))
    assert tracks.track_id.tolist() == [3, 1, 2]


K640 = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
AT_ORIGIN = np.eye(4)[:3]
BEYOND = np.c_[np.eye(3), [1e200, 0, 0]]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"detections": np.ones((2, 5))}, r"expected \(N, 6\)"),
        ({"frame": np.zeros((48, 64), np.uint8)}, "expected a BGR image"),
        ({"frame": np.zeros((48, 65, 3), np.uint8)}, r"masks of \(h, w\) \(48, 64\), expected"),
        ({"embeddings": np.ones((3, 4))}, "one row per detection"),
        ({"embeddings": np.ones((2, 5))}, "width 5, expected 4, as in earlier frames"),
        ({"cam_from_world": np.eye(4)}, r"shape \(4, 4\), expected \(3, 4\)"),
        ({"cam_from_world": BEYOND}, "units away"),
        ({"cam_from_world": np.zeros((3, 4))}, "3x3 block is not a rotation"),
        ({"camera": None}, r"camera=None: expected rt.Camera"),
        ({"camera": rt.Camera("PINHOLE", 0, 0, (500.0, 500.0, 0.0, 0.0))}, "with a size"),
        ({"points": np.ones(3)}, r"points of shape \(3,\), expected \(N, 3\)"),
        ({"part": -1}, "part -1, expected"),
    ],
)
def test_invalid_input_leaves_the_tracker_unchanged(wrong: dict[str, Any], message: str) -> None:
    found = rows((10, 10, 50, 90), (60, 10, 90, 90))
    found = rt.Detections(found.xyxy, found.score, found.class_id, np.ones((2, 48, 64), bool))
    good = {
        "detections": found,
        "frame": np.zeros((48, 64, 3), np.uint8),
        "embeddings": np.eye(2, 4),
        "cam_from_world": AT_ORIGIN,
        "camera": K640,
        "points": np.ones((5, 3)),
    }
    tracker, untouched = (rt.Tracker(rt.TrackerConfig(n_init=1)) for _ in range(2))
    for each in (tracker, untouched):
        each.update(**good)
    with pytest.raises(rt.ReobjError, match=message) as caught:
        tracker.update(**good | wrong)
    assert "\n" not in str(caught.value)
    after, expected = tracker.update(**good), untouched.update(**good)
    np.testing.assert_array_equal(after.to_array(), expected.to_array())
    assert after.frame.tolist() == [1, 1]


def test_a_new_object_does_not_take_over_a_missed_track() -> None:
    """An object is missed and another one appears beside it: if similar, the track continues; else
    the detection starts a new track and the missed object returns to its own.
    """
    views = unit(np.random.default_rng(14), 3)
    here, beside = (100, 100, 160, 160), (125, 105, 185, 165)
    for newcomer, expected in ((views[0], [1]), (views[2], [2])):
        tracker = rt.Tracker(rt.TrackerConfig(n_init=1))
        repeat(20, tracker, rows(here), embeddings=views[:1])
        found = repeat(3, tracker, rows(beside), embeddings=newcomer[None])
        assert found.track_id.tolist() == expected
    both = tracker.update(rows(here, beside), embeddings=views[[0, 2]])
    assert both.track_id.tolist() == [1, 2]


# ---- Saved state ----


def test_matching_options_are_applied_and_saved(tmp_path: Path) -> None:
    """A box that has doubled its width is another object to a tracker of motion alone."""
    for size, names in ((1.5, [2]), (3.0, [1])):
        matching = rt.MatchingOptions(motion_only_size=size)
        rt.Tracker(rt.TrackerConfig(n_init=1), matching=matching).save(tmp_path / "state.npz")
        tracker = rt.Tracker.load(tmp_path / "state.npz")
        assert tracker.matching == matching
        tracker.update(CORNER)
        assert tracker.update(rows((0, 0, 100, 50))).track_id.tolist() == names


def test_invalid_saved_trackers_are_refused(tmp_path: Path) -> None:
    """Missing, no npz, another npz, another version."""
    np.savez(tmp_path / "other.npz", a=1)
    np.savez(tmp_path / "old.npz", facts='{"version": 0, "config": {}}')
    (tmp_path / "text.npz").write_text("hello")
    rt.Tracker().save(tmp_path / "cut.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:2000])
    for name in ("none", "other", "old", "text", "cut"):
        with pytest.raises(rt.ReobjError, match=rf"{name}\.npz: not the state of a tracker"):
            rt.Tracker.load(tmp_path / f"{name}.npz")


# ---- With poses ----

CAMERA = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
BALLS = quadrics.Ellipsoids(  # two in a row, an identical one far to the right
    np.array([[-0.5, 0, 4.0], [0.5, 0.1, 4.2], [3.5, 0, 4.0]]),
    np.full((3, 3), 0.2),
    np.repeat(np.eye(3)[None], 3, 0),
)


def pose_at(x: float, turn_deg: float = 0.0) -> np.ndarray:
    """cam_from_world of a camera at (x, 0, 0), turned to the right."""
    a = np.radians(turn_deg)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    return np.c_[turn, turn @ [-x, 0, 0]]


def balls_seen(pose: np.ndarray) -> tuple[rt.Detections, np.ndarray]:
    """Detections of the balls in the image, and which ones they are."""
    dual_c, before = quadrics.project(BALLS.dual_quadrics(), (CAMERA.K @ pose)[None])
    boxes = quadrics.boxes_from_dual_conics(dual_c[0])
    inside = before[0] & (boxes[:, :2] > 0).all(1) & (boxes[:, 2:] < (640, 480)).all(1)
    return rows(*map(tuple, boxes[inside])), np.flatnonzero(inside)


def walk(tracker: rt.Tracker, poses: list[np.ndarray], posed: bool = True) -> list[dict[int, int]]:
    """Identity of every ball in every frame."""
    inputs = [{"cam_from_world": p, "camera": CAMERA} if posed else {} for p in poses]
    result = []
    for pose, known in zip(poses, inputs, strict=True):
        found, which = balls_seen(pose)
        tracks = tracker.update(found, **known)
        ids = zip(which[tracks.detection_index].tolist(), tracks.track_id.tolist(), strict=True)
        result.append(dict(ids))
    return result


PAST = [pose_at(0.02 * i - 0.5) for i in range(50)]
AWAY = [pose_at(0.5, 3.0 * i) for i in range(60)]  # half a turn
HOME = [pose_at(0.5 - 0.01 * i, 180 - 3.0 * i) for i in range(61)]


@pytest.mark.parametrize("posed", [True, False])
def test_with_poses_objects_are_reidentified_by_position(posed: bool) -> None:
    """No appearance: the camera turns away for 100 frames and returns at another position."""
    seen = walk(rt.Tracker(), PAST + AWAY + HOME, posed)
    before, after = seen[49], seen[-1]
    assert sorted(before) == sorted(after) == [0, 1]
    assert (before == after) is posed


def test_a_frame_without_pose_changes_no_ellipsoid() -> None:
    tracker = rt.Tracker()
    walk(tracker, PAST)
    before = tracker.ellipsoid_map.dual_q.copy()
    assert tracker.ellipsoid_map.known.sum() == 2
    repeat(20, tracker, NOTHING, cam_from_world=np.full((3, 4), np.nan), camera=CAMERA)
    np.testing.assert_array_equal(tracker.ellipsoid_map.dual_q, before)


def points_on_balls(scale: float) -> np.ndarray:
    """Sparse points: 40 on each of the balls, 60 on a wall behind them."""
    rng = np.random.default_rng(2)
    balls = BALLS.center_in_world[:, None] + 0.2 * unit(rng, 120, 3).reshape(3, 40, 3)
    wall = np.c_[rng.uniform(-3, 3, (60, 2)), np.full(60, 7.0)]
    return scale * np.concatenate([balls.reshape(-1, 3), wall])


@pytest.mark.parametrize("scale", [1.0, 37.0])
def test_identical_objects_keep_identities_over_wide_steps(scale: float) -> None:
    """Two balls that look the same, 125 px apart and 50 wide; the camera moves by 100 px, so each
    appears beside the last position of the other. Given poses of any unit, and a few points.
    """
    tracker, points = rt.Tracker(), points_on_balls(scale)
    seen, alone, last = [], rt.Tracker(), None
    for x in [-1.6, -0.8, 0.0, 0.8, 1.6, 0.8, 0.0, -0.8, -1.6, -0.8, 0.0, 0.8]:
        pose = pose_at(x)
        found, which = balls_seen(pose)
        two = which < 2
        found, which = found[two], which[two]
        if last is not None:
            own = box_iou(found.xyxy, last)
            assert np.diag(own).max() == 0  # of each ball with itself
        last = found.xyxy
        view = np.ones((2, 8))
        scaled = np.c_[pose[:, :3], scale * pose[:, 3]]
        tracks = tracker.update(
            found, embeddings=view, cam_from_world=scaled, camera=CAMERA, points=points
        )
        seen.append(dict(zip(which[tracks.detection_index], tracks.track_id, strict=True)))
        alone.update(found, embeddings=view)
    assert seen == [{0: 1, 1: 2}] * len(seen)
    assert (
        len(alone.state.last_seen) != 2
        or len(alone.latest) < 2
        or alone.state.tracks.tracklet.max() > 2
    )


def test_a_new_component_does_not_use_ellipsoids_of_another() -> None:
    """Half a second without a new image, then the poses continue in another component: rotated,
    moved and scaled. Tracks continue; back in the first one its ellipsoids are used again.
    """
    tracker = rt.Tracker()
    walk(tracker, PAST)
    first = tracker.ellipsoid_map
    assert first.known.sum() == 2
    turn = Rotation.from_euler("xyz", [40, 70, -20], degrees=True).as_matrix()
    for x in np.linspace(0.5, 0.1, 21):
        pose = pose_at(x)
        other = np.c_[pose[:, :3] @ turn, 0.3 * (pose[:, 3] + pose[:, :3] @ [3.0, -2, 5])]
        found, _ = balls_seen(pose)
        tracks = tracker.update(found, cam_from_world=other, camera=CAMERA, part=1)
        assert tracks.track_id.tolist() == [1, 2] and tracks.tracklet_id.tolist() == [1, 2]
    assert tracker.ellipsoid_map is not first and tracker.ellipsoid_map.known.sum() == 2
    assert not np.allclose(tracker.ellipsoid_map.ends[:2], first.ends[:2], atol=0.1)
    before = first.frame.copy()
    found, _ = balls_seen(pose_at(0.1))
    tracks = tracker.update(found, cam_from_world=pose_at(0.1), camera=CAMERA)
    assert tracks.track_id.tolist() == [1, 2] and tracker.ellipsoid_map is first
    assert (first.frame != before).sum() <= 2  # nothing of the other component was added


# ---- Rules of the association ----


class Counted:
    """An embedder that records the requested rows of each frame."""

    def __init__(self, tracker: rt.Tracker | None = None) -> None:
        self.asked: list[tuple[int, list[int]]] = []
        self.tracker = tracker

    def __call__(self, frame: Any, detections: rt.Detections, rows: np.ndarray) -> rt.Embeddings:
        assert self.tracker is not None
        self.asked.append((self.tracker.state.frame_number, rows.tolist()))
        own = np.eye(1, 8).repeat(len(rows), 0)
        return rt.Embeddings(own, own)


def counted(config: rt.TrackerConfig) -> tuple[rt.Tracker, Counted]:
    embedder = Counted()
    embedder.tracker = rt.Tracker(config, embedder)  # type: ignore[arg-type]
    return embedder.tracker, embedder


@pytest.mark.parametrize("every", [4])
def test_unambiguous_matches_are_embedded_at_intervals(every: int) -> None:
    """All of them in one pass every n-th frame, a new track twice before it is confirmed, and weak
    matches: nothing else is embedded.
    """
    tracker, embedder = counted(rt.TrackerConfig(embed_every=every, camera_motion=False))
    image = np.zeros((300, 400, 3), np.uint8)
    for i in range(3 * every):
        boxes = [(100, 100, 150, 150), (200, 100, 250, 150)][: 1 + (i >= 2 * every + 1)]
        tracker.update(rows(*boxes, score=0.6), image)
    expected = [(i * every, [0]) for i in range(3)]
    expected += [(2 * every + 2, [1]), (2 * every + 3, [1])]
    assert embedder.asked == expected
    tracker.update(rows((103, 101, 153, 151), (202, 100, 252, 150)), image)
    assert embedder.asked[len(expected) :] == [(3 * every, [0, 1])]
    tracker.update(rows((128, 101, 178, 151), (202, 100, 252, 150)), image)
    assert embedder.asked[-1] == (3 * every + 1, [0])


@pytest.mark.parametrize(("seen", "gap", "same"), [(1, 1, True), (1, 2, False), (2, 2, True)])
def test_tentative_tracks_wait_as_long_as_they_were_seen(seen: int, gap: int, same: bool) -> None:
    tracker = rt.Tracker(rt.TrackerConfig(n_init=4))
    known, new = (0, 0, 50, 50), (200, 0, 250, 50)
    tracker.update(rows(known))
    for _ in range(seen):
        before = update(tracker, rows(known, new)).tracklet_id[1]
    repeat(gap, tracker, rows(known))
    assert (update(tracker, rows(known, new)).tracklet_id[1] == before) == same


@pytest.mark.parametrize(("gap", "same"), [(5, True), (6, False)])
def test_tracks_wait_for_coast_frames(gap: int, same: bool) -> None:
    tracker = rt.Tracker(rt.TrackerConfig(coast_frames=5))
    repeat(4, tracker, BOX)
    repeat(gap, tracker, NOTHING)
    assert (update(tracker, BOX).tracklet_id == 1).tolist() == [same]


def test_missed_identities_have_predicted_boxes() -> None:
    """One continues at 4 px per frame undetected, the other is detected; tentative: none."""
    tracker = rt.Tracker()
    assert not len(tracker.predicted())
    for f in range(20):
        tracker.update(rows((100 + 4 * f, 100, 150 + 4 * f, 180), (400, 100, 450, 180, 0.9, CUP)))
        assert not len(tracker.predicted())
    tracker.update(rows((400, 100, 450, 180, 0.9, CUP), (600, 300, 650, 380)))  # a new track
    for f in range(21, 27):
        tracker.update(rows((400, 100, 450, 180, 0.9, CUP)))
        found = tracker.predicted()
        assert len(found) == (f < 25) and len(tracker.predicted(2)) == (f < 22)
        if len(found):
            assert found.xyxy[0] == pytest.approx([100 + 4 * f, 100, 150 + 4 * f, 180], abs=4)
            assert (found.frame, found.track_id, found.tracklet_id) == (f, 1, 1)
            assert (found.score, found.class_id, found.detection_index) == (0, CHAIR, -1)


@pytest.mark.parametrize(
    ("shift", "score", "kind", "unseen", "same"),
    [
        (36, 0.9, CHAIR, 15, True),  # IoU .16: the gate after some missed frames
        (36, 0.9, CHAIR, 0, False),
        (22, 0.3, CHAIR, 0, True),  # IoU .39: enough for a low score
        (30, 0.3, CHAIR, 0, False),  # IoU .25
        (22, 0.9, CUP, 0, True),  # enough for a change of class
        (22, 0.9, CUP, 15, True),
        (30, 0.9, CUP, 15, False),
        (30, 0.9, CHAIR, 0, True),
    ],
)
def test_the_limit_of_the_matching_distance(
    shift: int, score: float, kind: int, unseen: int, same: bool
) -> None:
    """A box of 50 px that moved; no appearance."""
    tracker = rt.Tracker()
    repeat(6, tracker, BOX)
    repeat(unseen, tracker, NOTHING)
    found = rows((100 + shift, 100, 150 + shift, 150), score=score, class_id=kind)
    assert (1 in update(tracker, found).tracklet_id) == same


# ---- Rules with poses ----


def test_tracks_of_known_position_do_not_expire_out_of_view() -> None:
    """Half a turn and back takes longer than `coast_frames`; the same tracklets continue."""
    tracker = rt.Tracker(rt.TrackerConfig(coast_frames=5))
    walk(tracker, PAST)
    before = tracker.latest.tracklet_id.tolist()
    walk(tracker, AWAY)
    assert not len(tracker.predicted())  # nothing is missed
    walk(tracker, [pose_at(0.5, 180 - 3.0 * i) for i in range(61)])
    assert tracker.latest.tracklet_id.tolist() == before


def test_a_missed_track_of_known_position_follows_its_projection() -> None:
    """No detections while the camera moves sideways by three ball widths."""
    tracker = rt.Tracker()
    walk(tracker, PAST)
    before = tracker.latest.tracklet_id.tolist()
    for x in (0.3, 0.0, -0.3, -0.6):
        pose = pose_at(x)
        tracker.update(NOTHING, cam_from_world=pose, camera=CAMERA)
    walk(tracker, [pose])
    assert tracker.latest.tracklet_id.tolist() == before


# ---- Appearance: comparison and stored embeddings ----


@pytest.mark.parametrize(("kind", "pairs"), [(CHAIR, 2), (CUP, 0)])
def test_simultaneous_objects_of_a_class_calibrate_the_similarity(kind: int, pairs: int) -> None:
    """Two chairs are compared with each other; a chair and a cup are not used."""
    views = unit(np.random.default_rng(33), 2)
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1, embed_every=1))
    both = rows((0, 0, 50, 50), (90, 0, 140, 50, 0.9, kind))
    counts = []
    for _ in range(3):
        tracker.update(both, embeddings=views)
        different, same = tracker.state.match_calibration.moments[:, 0, 0]
        counts.append((different - 10, same - 10))  # beyond the prior's
    assert counts == [(0, 0), (pairs, 2), (2 * pairs, 4)]


# ---- Identities by 3D position ----


@pytest.mark.parametrize(("shift", "look", "found"), [(0, 1, 1), (0.3, 1, 3), (0.3, 0, 1)])
def test_half_the_overlap_does_not_outweigh_appearance(shift: float, look: int, found: int) -> None:
    """After frames without detections: a box at an object's projection is that object; one that
    overlaps half of it and looks different is new."""
    views = unit(np.random.default_rng(35), 3)
    tracker = rt.Tracker(rt.TrackerConfig(coast_frames=5))
    for pose in PAST:
        boxes = balls_seen(pose)[0]
        tracker.update(boxes, embeddings=views[[0, 2]], cam_from_world=pose, camera=CAMERA)
    repeat(10, tracker, NOTHING, cam_from_world=PAST[-1], camera=CAMERA)
    x0, y0, x1, y1 = boxes.xyxy[0]
    moved = rows((x0 + shift * (x1 - x0), y0 + shift * (y1 - y0), x1, y1))
    tracks = repeat(
        4,
        tracker,
        moved,
        embeddings=views[[0 if look == 0 else 1]],
        cam_from_world=PAST[-1],
        camera=CAMERA,
    )
    assert tracks.track_id.tolist() == [found]


def test_a_restored_tracker_continues_identically(tmp_path: Path) -> None:
    """Images, appearance and poses in two components; a reset tracker is like a new one."""
    rng = np.random.default_rng(35)
    views = unit(rng, 3)
    image = textured(rng)
    inputs: list[dict[str, Any]] = []
    for i, pose in enumerate(PAST + AWAY[:20]):
        found, which = balls_seen(pose)
        posed = {"cam_from_world": pose, "camera": CAMERA, "part": int(i < 5)}
        inputs.append({"detections": found, "embeddings": views[which], **posed})
        inputs[-1]["frame"] = np.roll(image, 3 * i, 1)
    whole = rt.Tracker()
    expected = [update(whole, **given).to_array() for given in inputs]
    tracker = rt.Tracker()
    for given in inputs[:45]:
        tracker.update(**given)
    tracker.save(tmp_path / "state.npz")
    for one in (tracker, rt.Tracker.load(tmp_path / "state.npz")):
        found_later = [update(one, **given).to_array() for given in inputs[45:]]
        for later, true in zip(found_later, expected[45:], strict=True):
            np.testing.assert_array_equal(later, true)
        np.testing.assert_array_equal(one.state.tracks.mean, whole.state.tracks.mean)
        np.testing.assert_array_equal(one.state.gallery.rows, whole.state.gallery.rows)
    assert whole.ellipsoid_map.known.any()
    tracker.reset()
    for given, true in zip(inputs, expected, strict=True):
        np.testing.assert_array_equal(update(tracker, **given).to_array(), true)


@pytest.mark.parametrize("seed", range(2))
def test_a_duplicate_box_does_not_take_the_identity(seed: int) -> None:
    """The track of the second box has no embedding yet, which is no evidence."""
    rng = np.random.default_rng(seed)
    tracker = rt.Tracker()
    own = (100, 100, 140, 200)
    beside = (300, 100, 340, 200)
    second = (105, 100, 145, 200)
    common = unit(rng, 2)
    seen = []
    for step in range(30):
        boxes = [own if step <= 24 else second, beside] + [second] * (step == 24)
        view = common[[0, 1, 0][: len(boxes)]] + 0.9 * unit(rng, len(boxes))  # cosine .55
        seen.append(tracker.update(rows(*boxes), embeddings=view).track_id.tolist())
    assert seen[23] == [1, 2]
    assert seen[25:] == [[1, 2]] * 5


def test_another_class_never_takes_over_an_identity() -> None:
    view = unit(np.random.default_rng(8), 1)
    tracker = rt.Tracker()
    repeat(5, tracker, CORNER, embeddings=view)
    repeat(60, tracker, NOTHING)
    tracks = repeat(5, tracker, rows((300, 0, 350, 50), class_id=CUP), embeddings=view)
    assert tracks.track_id.tolist() == [2]


def test_with_poses_an_identical_object_elsewhere_is_new() -> None:
    """All balls look the same. The third appears while the others are out of view."""
    tracker = rt.Tracker()
    view = unit(np.random.default_rng(15), 1)
    ids: dict[int, set[int]] = {}
    for pose in (
        PAST + [pose_at(0.5, t) for t in range(60)] + [pose_at(0.5, 60 - t) for t in range(61)]
    ):
        found, which = balls_seen(pose)
        tracks = tracker.update(
            found, embeddings=view.repeat(len(found), 0), cam_from_world=pose, camera=CAMERA
        )
        for ball, track in zip(which[tracks.detection_index], tracks.track_id, strict=True):
            ids.setdefault(int(ball), set()).add(int(track))
    assert [len(ids[k]) for k in range(3)] == [1, 1, 1]
    assert len(set.union(*ids.values())) == 3


@pytest.mark.parametrize(
    ("box", "same"),
    [
        ((103, 100, 113, 350), True),
        ((72, 170, 138, 280), False),  # at the same position, but of another shape
    ],
)
def test_without_appearance_boxes_must_be_similar(box: tuple[float, ...], same: bool) -> None:
    tracker = rt.Tracker()
    repeat(5, tracker, TALL)
    assert (update(tracker, rows(box)).tracklet_id == 1).tolist() == [same]


@pytest.mark.parametrize(("left", "same"), [(103, True), (111, False)])
def test_without_appearance_boxes_must_overlap(left: int, same: bool) -> None:
    """After some missed frames, a position beside so tall a box is well within the gate."""
    tracker = rt.Tracker()
    repeat(5, tracker, TALL)
    repeat(12, tracker, NOTHING)
    found = update(tracker, rows((left, 100, left + 10, 350)))
    assert (found.tracklet_id == 1).tolist() == [same]


def test_confirmed_tracks_are_matched_first() -> None:
    """One detection between two tracks, a little nearer to the tentative one."""
    tracker = rt.Tracker()
    known = (100, 100, 200, 200)
    tentative = (110, 100, 210, 200)
    repeat(8, tracker, rows(known))
    for _ in range(2):
        tracks = update(tracker, rows(known, tentative, score=0.6))
    assert tracks.track_id.tolist() == [1, 0]
    assert tracker.update(rows((107, 100, 207, 200))).track_id.tolist() == [1]


@pytest.mark.parametrize(("score", "found"), [(0.09, []), (0.11, [1])])
def test_scores_below_the_low_one_continue_nothing(score: float, found: list[int]) -> None:
    tracker = rt.Tracker()
    tracker.update(BOX)
    assert tracker.update(rows((101, 100, 151, 150), score=score)).track_id.tolist() == found


def test_low_scores_are_matched_after_high_ones() -> None:
    """A low score exactly on the track, a high one beside it: the high one continues it."""
    tracker = rt.Tracker()
    repeat(5, tracker, LARGE)
    tracks = tracker.update(rows((100, 100, 200, 200, 0.3), (115, 100, 215, 200, 0.9)))
    assert tracks.detection_index.tolist() == [1]


def gone(tracker: rt.Tracker, view: np.ndarray, frames: int = 60) -> None:
    """Show one chair of this appearance on the left for 12 frames, then nothing."""
    repeat(12, tracker, CORNER, embeddings=view)
    repeat(frames, tracker, NOTHING)


def test_an_identity_goes_to_one_of_two_newcomers() -> None:
    """Both look like the absent object; even with a low threshold one gets a new identity."""
    view = unit(np.random.default_rng(23), 1)
    tracker = rt.Tracker(rt.TrackerConfig(return_probability=0.01))
    gone(tracker, view)
    for _ in range(5):
        both = rows((300, 0, 350, 50), (500, 0, 550, 50))
        tracks = tracker.update(both, embeddings=view.repeat(2, 0))
    assert sorted(tracks.track_id.tolist()) == [1, 2]


def test_simultaneous_objects_are_different() -> None:
    """The new object appears in the last frame of an identical one, and is missed once; a third
    one appears a frame later, so that both are confirmed simultaneously.
    """
    views = unit(np.random.default_rng(24), 2)
    old, new, third = (0, 0, 50, 50), (300, 0, 350, 50), (600, 0, 650, 50)
    tracker = rt.Tracker()
    repeat(12, tracker, rows(old), embeddings=views[:1])
    tracker.update(rows(old, new), embeddings=views[[0, 0]])
    tracker.update(rows(third), embeddings=views[1:])
    tracks = repeat(3, tracker, rows(new, third), embeddings=views)
    assert sorted(tracks.track_id.tolist()) == [2, 3]


def test_a_return_ends_the_track_that_still_coasts() -> None:
    """Its object is elsewhere: a detection at the old position is another one."""
    views = unit(np.random.default_rng(25), 2)
    old, new = (0, 0, 50, 50), (400, 0, 450, 50)
    tracker = rt.Tracker()
    gone(tracker, views[:1], frames=5)
    tracks = repeat(4, tracker, rows(new), embeddings=views[:1])
    assert tracks.track_id.tolist() == [1] and tracker.state.tracks.identity.tolist() == [0]
    tracks = repeat(4, tracker, rows(new, old), embeddings=views)
    assert tracks.track_id.tolist() == [1, 2]


def test_a_track_votes_for_its_class() -> None:
    """Most of its score is a cup's: it may match the lost cup, although it last was a chair."""
    view = unit(np.random.default_rng(26), 1)
    tracker = rt.Tracker()
    repeat(12, tracker, rows((0, 0, 50, 50), class_id=CUP), embeddings=view)
    repeat(60, tracker, NOTHING)
    for kind, score in ((CUP, 0.9), (CHAIR, 0.6)):
        found = rows((300, 0, 350, 50), score=score, class_id=kind)
        tracks = tracker.update(found, embeddings=view)
    assert tracks.track_id.tolist() == [1]


def test_tracks_follow_their_positions_under_camera_jerks() -> None:
    """The camera jumps to and fro by more than a ball's width; no track is lost for a frame."""
    tracker = rt.Tracker()
    walk(tracker, PAST)
    assert tracker.ellipsoid_map.known.sum() == 2
    tracklets = tracker.latest.tracklet_id.tolist()
    for i in range(12):
        pose = pose_at(0.5 - 0.5 * (i % 2))
        found, _ = balls_seen(pose)
        tracks = tracker.update(found, cam_from_world=pose, camera=CAMERA)
        assert sorted(tracks.tracklet_id.tolist()) == sorted(tracklets)
        assert tracks.track_id.tolist() == [1, 2]


def test_embedding_of_a_track_is_a_running_mean() -> None:
    """A fifth of the new one, four fifths of the old mean."""
    first, second = np.eye(2, 8)
    tracker = rt.Tracker(rt.TrackerConfig(embed_every=1))
    for view in (first, second):
        tracker.update(CORNER, embeddings=view[None])
    expected = (0.8 * first + 0.2 * second) / np.hypot(0.8, 0.2)
    np.testing.assert_allclose(tracker.state.tracks.embedding[0], expected, atol=1e-6)
