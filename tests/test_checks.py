"""Supplied poses against tracks and images: direction, axes, no false alarm, two readings."""

from __future__ import annotations

import statistics

import numpy as np
import pytest
from pose_worlds import FOCAL, PINHOLE, SIZE, FakeVideo, motion, supplied
from reobj.poses.supplied.interpretation import PoseReading, by_images, by_tracks, check_poses
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.cameras import invert_rigid


def box_tracks(cams, noise_px, seed, objects=12):
    """Noisy centres of points in view, as tracks."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 0], [3, 3, 1.2], (objects, 3))
    K = np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])
    in_cam = np.einsum("fij,oj->ofi", cams[:, :, :3], points) + cams[None, :, :, 3]
    xy = np.einsum("ij,ofj->ofi", K, in_cam)
    xy = xy[..., :2] / xy[..., 2:]
    seen = (in_cam[..., 2] > 0.3) & (xy > 0).all(2) & (xy < SIZE).all(2)
    bias = rng.normal(0, noise_px, (objects, 1, 2))  # boxes are not centred on a point
    xy = (
        xy + rng.normal(0, noise_px, xy.shape) + bias * np.linspace(-1, 1, len(cams))[None, :, None]
    )
    return [(np.flatnonzero(s), xy[o][s]) for o, s in enumerate(seen) if s.any()]


GL3 = np.diag([1.0, -1, -1])
MISTAKES = {
    "direction": lambda c: invert_rigid(c),
    "axes": lambda c: GL3 @ c,
    "both": lambda c: invert_rigid(GL3 @ c),
}


@pytest.mark.parametrize("noise_px", [1, 8, 20])
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward", "still"])
def test_right_poses_raise_no_alarm(kind, noise_px):
    cams = motion(kind)
    for seed in range(10):
        tracks = box_tracks(cams, noise_px, seed)
        assert check_poses(supplied(cams), tracks) is None
        assert check_poses(supplied(cams), tracks[:4]) is None


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan"])
def test_wrong_poses_are_named(kind, mistake):
    cams = motion(kind)
    for seed in range(5):
        message = check_poses(supplied(MISTAKES[mistake](cams)), box_tracks(cams, 4, seed))
        assert message is not None
        named = {
            "direction": "world_from_cam given",
            "axes": "OpenGL axes (y up",
            "both": "inverted and with OpenGL",
        }
        assert named[mistake] in message


def test_quaternions_in_the_other_order_are_named():
    for kind in ("orbit", "walk", "pan"):
        cams = motion(kind)
        given = invert_rigid(cams)
        xyzw = Rotation.from_matrix(given[:, :, :3]).as_quat()
        for shift, named in ((1, "w first given as"), (-1, "w last given as")):
            given[:, :, :3] = Rotation.from_quat(np.roll(xyzw, shift, 1)).as_matrix()
            message = check_poses(supplied(invert_rigid(given)), box_tracks(cams, 4, 0))
            assert message is not None and named in message


@pytest.mark.parametrize("kind", ["orbit", "walk", "forward"])
def test_poses_of_other_frames_are_not_called_inverted(kind):
    """Every 6th pose given to every frame, another path, the path read backwards."""
    cams = motion(kind, 240)
    other = motion("walk" if kind == "orbit" else "orbit")
    for seed in range(5):
        tracks = box_tracks(cams[:60], 4, seed)
        for given in (cams[::4], other, cams[59::-1], cams[30:90]):
            assert check_poses(supplied(given), tracks) is None


def test_check_needs_tracks():
    assert check_poses(supplied(motion("orbit")), []) is None
    assert check_poses(supplied(motion("orbit")), [(np.array([1, 2]), np.ones((2, 2)))]) is None


def test_poses_that_fit_within_a_degree_are_accepted():
    """A camera that moves by 1 cm: the inverse direction fits better by chance."""
    cams = motion("still")
    for seed in range(5):
        assert check_poses(supplied(invert_rigid(cams)), box_tracks(cams, 0, seed)) is None


# ---- Which of two readings the boxes or the images say ---------------------------------------


def reading(key, poses):
    return PoseReading(key, f"rule {key}", poses)


def at(cams, shift, frames):
    """The frames have the poses of frames that are `shift` later."""
    moved = np.full_like(cams, np.nan)
    for i in frames:
        if 0 <= i + shift < len(cams):
            moved[i] = cams[i + shift]
    return supplied(moved)


def object_px(poses, frame, xyxy):
    """Median distance of the sides inside the image, one by one."""
    views = PINHOLE.K @ poses.cam_from_world[frame]
    fit = quadrics.fit_objects(xyxy[:, None], views, SIZE)
    if fit.status[0] == "rejected":
        return max(SIZE)
    fitted = quadrics.solid_boxes(fit.ellipsoids, list(fit.support), views)[:, 0]
    return statistics.median(
        abs(side - box[k])
        for box, sides in zip(xyxy, fitted, strict=True)
        for k, side in enumerate(sides)
        if 1 < box[k] < SIZE[k % 2] - 1 and np.isfinite(side)
    )


def sizes_by_boxes(one, other, frame, boxes):
    """Residuals of two readings, each as often as independent boxes show it."""
    found = []
    for xyxy in boxes:
        seen = [{i for i in frame if p.known[i]} for p in (one, other)]
        if len(seen[0] & seen[1]) >= 8:
            seen = [seen[0] & seen[1]] * 2
        if min(map(len, seen)) >= 8:
            pair = [object_px(p, sorted(s), xyxy[sorted(s)])
                    for p, s in zip((one, other), seen, strict=True)]  # fmt: skip
            found += [pair] * (min(map(len, seen)) // 5)
    size = np.exp(np.log(np.maximum(found, 1e-3)).mean(0)) if found else np.ones(2)
    return size, len(found)


@pytest.mark.parametrize(
    ("seen", "noise_px", "known", "chosen"),
    [
        (range(60), 2, None, True),
        (range(20), 2, None, False),
        (range(4, 60, 7), 0.02, None, True),
        (range(4, 53, 7), 0.02, None, False),
        (range(60), 0.02, (range(34), range(26, 60)), False),  # 8 frames have both poses
        (range(60), 0.02, (range(33), range(26, 60)), True),  # 7: every reading by its own frames
    ],
)
def test_boxes_choose_a_reading_by_the_sides_inside_the_image(seen, noise_px, known, chosen):
    """Every object in 5 boxes is one trial; boxes that are cut by the image end at its border."""
    cams = motion("orbit")
    solids = quadrics.Ellipsoids(
        np.array([[0.3, 0.2, 0.4], [1.2, 1.5, 0.5]]), np.array([[0.3, 0.2, 0.4], [0.9, 0.9, 0.5]]),
        np.tile(np.eye(3), (2, 1, 1)),
    )  # fmt: skip
    boxes = quadrics.solid_boxes(solids, "ellipsoid", PINHOLE.K @ cams).swapaxes(0, 1)
    boxes = boxes + noise_px * np.random.default_rng(0).choice([-1, 1], boxes.shape)
    boxes = boxes.clip(1, np.tile(SIZE, 2) - 1)
    frame = np.repeat(seen, 2)
    obj = np.tile([0, 1], len(seen))
    tracks = rt.Tracks(frame, obj, obj, boxes[obj, frame], np.ones(len(obj)), obj, obj)
    right, late = (at(cams, *one) for one in zip((0, -2), known or [range(60)] * 2, strict=True))
    found = by_tracks([reading("right", right), reading("late", late)], tracks)
    (one, other), trials = sizes_by_boxes(right, late, seen, boxes)
    assert (trials * np.log(other / one) > np.log(1000)) == chosen
    text = f"it fits the boxes within {one:.2g} px, by rule late {other:.2g} px"
    expected = [("right", text)] if chosen else [("right", ""), ("late", "")]
    assert [(f.key, f.measured) for f in found] == expected


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12),
                                        -1, 1)))  # fmt: skip


def telling_pairs(one, other):
    """Pairs of frames whose motion differs most between two readings, spread over the video."""
    both = np.flatnonzero(one.known & (other or one).known).tolist()
    scored = []
    for step in (1, 2, 5, 10):
        for i, j in zip(both, both[step:], strict=False):
            motions = []
            for poses in (one, other or one):
                first, second = (np.vstack([poses.cam_from_world[k], [0, 0, 0, 1]]) for k in (i, j))
                motions.append(second @ np.linalg.inv(first))
            turns = [Rotation.from_matrix(m[:3, :3]) for m in motions]
            angle = turns[0].magnitude()
            if other:
                angle = (turns[0].inv() * turns[1]).magnitude()
            score = np.degrees(angle)
            shifts = [m[:3, 3] for m in motions]
            if other and min(np.linalg.norm(t) for t in shifts) > 0:
                score += 0.1 * degrees_between(*shifts)
            if min(np.degrees(turn.magnitude()) for turn in turns) < 30:
                scored.append((min(score, 8), i, j))
    chosen = []
    for score, i, j in sorted(scored, key=lambda s: -s[0]):  # stable
        places = [abs(both.index(i) - both.index(a)) for a, _ in chosen]
        if score > 0 and len(chosen) < 20 and all(p >= len(both) / 40 for p in places):
            chosen.append((i, j))
    return chosen


class Looked(FakeVideo):
    """A video of blank images that notes which of them are looked at."""

    def __init__(self, count):
        super().__init__([np.zeros((48, 64, 3), np.uint8)] * count)
        self.looked = set()

    def __iter__(self):
        for index in range(self.frame_count):
            yield LookedFrame(self, index)


class LookedFrame:
    def __init__(self, video, index):
        self.video = video
        self.index = index

    @property
    def image(self):
        self.video.looked.add(self.index)
        return self.video.images[self.index]


@pytest.mark.parametrize(
    ("kind", "count", "shift", "known"),
    [
        ("walk", 90, 1, range(90)),
        ("pan", 120, -1, range(0, 120, 2)),
        ("pan", 60, 3, range(60)),  # turns by more than 30 degrees in 10 frames
        ("turn", 90, 2, range(5, 90)),  # on the spot: no direction of translation
        ("walk", 5, 1, range(5)),
        ("walk", 3, 1, range(3)),  # three pairs of one reading, of both too few
    ],
)
def test_images_are_compared_where_readings_differ_most(kind, count, shift, known):
    """Not all images are looked at: those of the best pairs, one by one as the text has it."""
    cams = motion("pan" if kind == "turn" else kind, count)
    if kind == "turn":
        cams[:, :, 3] = 0
    one = at(cams, 0, known)
    other = at(cams, shift, known)
    video = Looked(count)
    given = [reading("a", one), reading("b", other)]
    assert by_images(given, video) == given
    pairs = [telling_pairs(*both) for both in ((one, other), (one, None), (other, None))]
    assert video.looked == {i for some in pairs for pair in some for i in pair}
