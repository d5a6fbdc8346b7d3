"""Keyframes that repeat a view, of a path whose views are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from point_worlds import PointWorld, wall
from pose_worlds import sideways, turn_deg
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.poses.features import find_repeated, match_pairs, register

pytest.importorskip("pycolmap")
# At position p the camera is .45 p along the wall; the next position is 35 px of 480 away, more
# than the flow of a repeated view. Forth to position 25, back past position 1 to -5.
PLACE = np.array([*range(1, 26), *range(24, -6, -1)])
IDS = list(range(1, len(PLACE) + 1))
BACK = range(26, 50)  # ids of views that were there before


class There:
    """A path forth and back, its database, and which features were extracted."""

    def __init__(self, folder):
        cams = sideways(31, 0.45)[PLACE + 5]
        rng = np.random.default_rng(0)
        cams[:, :, 3] += rng.uniform(-0.02, 0.02, (len(cams), 3))  # not at the same place again
        self.world = PointWorld(cams, wall(31 * 0.45, per_metre=100))
        self.database = folder / "database.db"
        self.extracted = []

    def extract(self, ids):
        new = [i for i in ids if i not in self.extracted]
        self.world.write(self.database, new)
        self.extracted += new

    def find(self, ids=IDS, is_video=True, before=(), **limits):
        limits = {"map_all_of": 20, "block": 6} | limits
        return find_repeated(
            self.database, ids, self.extract, 480, 0, is_video, dict(before), **limits
        )


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    made = There(tmp_path_factory.mktemp("there"))
    return made, made.find()


def place(number):
    return int(PLACE[number - 1])


def test_the_way_back_repeats_the_views_of_the_way_forth(there):
    _, view_of = there
    assert sorted(view_of) == IDS
    mapped = [i for i in IDS if view_of[i] == i]
    assert mapped == [i for i in IDS if i not in BACK]  # new views at both ends too
    repeated = [i for i in BACK if view_of[i]]
    assert repeated == [26, *range(27, 50, 2)]
    assert [place(view_of[i]) for i in repeated] == [place(i) for i in repeated]


def test_only_keyframes_between_two_repeats_are_left_out_and_cost_no_features(there):
    made, view_of = there
    left_out = [i for i in IDS if view_of[i] == 0]
    assert left_out == list(range(28, 49, 2))
    assert sorted(made.extracted) == [i for i in IDS if i not in left_out]


def test_few_keyframes_are_all_mapped(tmp_path):
    made = There(tmp_path)
    view_of = made.find(map_all_of=len(IDS))
    assert view_of == {i: i for i in IDS} and made.extracted == IDS


def test_photos_are_never_left_out(tmp_path):
    """No frame between them would show what they show."""
    made = There(tmp_path)
    view_of = made.find(is_video=False)
    assert sorted(made.extracted) == IDS and 0 not in view_of.values()
    assert [place(view) for view in view_of.values()] == PLACE.tolist()


def test_more_keyframes_are_mapped_and_leave_earlier_decisions_as_they_are(tmp_path):
    made = There(tmp_path)
    first = [i for i in IDS if i % 7]
    before = made.find(first)
    extracted = list(made.extracted)
    assert {0, 1, 2} <= {*before.values()}
    view_of = made.find(before=before)
    assert {i: view_of[i] for i in first} == before
    added = [i for i in IDS if i % 7 == 0]
    assert made.extracted == extracted + added
    assert all(view_of[i] == i for i in added)  # the steps between the first ones were too wide


def test_keyframes_added_where_many_are_mapped_are_only_registered(tmp_path):
    """Mapping a long path again would take minutes."""
    made = There(tmp_path)
    first = IDS[::3]
    before = made.find(first, is_video=False)
    limits = {"map_all_of": 10, "map_more_to": 5}
    view_of = made.find(IDS[:30], is_video=False, before=before, **limits)
    mapped = {i for i in first if before[i] == i}
    assert {view for view in view_of.values()} <= mapped
    match_pairs(made.database, list(itertools.pairwise(sorted(mapped))), 0)
    added = [i for i in IDS[:30] if i not in first]
    model = made.world.model(sorted(mapped))
    assert register(model, made.database, added, 0) == added


def test_views_of_a_camera_held_upright_repeat_none_of_one_held_level(tmp_path):
    """All points match, and are elsewhere in the image."""
    made = There(tmp_path)
    roll = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    cams = made.world.cams.copy()
    cams[25:] = roll @ cams[25:]
    made.world = PointWorld(cams, made.world.points)
    ids = [*range(8, 26), *range(26, 40)]
    assert made.find(ids) == {i: i for i in ids}


def test_repeated_keyframes_are_registered_with_their_poses(there):
    made, view_of = there
    mapped = [i for i in IDS if view_of[i] == i]
    repeated = [i for i in BACK if view_of[i]]
    model = made.world.model(mapped)
    points = {k: point.xyz.copy() for k, point in model.points3D.items()}
    assert register(model, made.database, repeated, 0) == repeated
    assert sorted(model.reg_image_ids()) == sorted([*mapped, *repeated])
    found = np.array([model.image(i).cam_from_world().matrix() for i in repeated])
    truth = made.world.cams[np.array(repeated) - 1]
    off = invert_rigid(found)[:, :, 3] - invert_rigid(truth)[:, :, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.01 and turn_deg(found, truth).max() < 0.1
    assert min(model.image(i).num_points3D for i in repeated) > 100
    assert set(points) == set(model.points3D)
    assert all((model.point3D(k).xyz == xyz).all() for k, xyz in points.items())


def test_an_image_whose_points_the_model_does_not_have_is_not_registered(there):
    made, view_of = there
    model = made.world.model([i for i in IDS if view_of[i] == i])
    for k in [k for k, point in model.points3D.items() if point.xyz[0] > 8]:
        model.delete_point3D(k)
    far = [i for i in BACK if view_of[i] and place(i) > 20]
    near = [i for i in BACK if view_of[i] and place(i) <= 5]
    assert far and near and register(model, made.database, far + near, 0) == near
