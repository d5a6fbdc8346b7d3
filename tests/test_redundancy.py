"""Keyframes that repeat a view, of a path whose views are known."""

from __future__ import annotations

import numpy as np
import pytest
from point_worlds import PointWorld, wall
from pose_worlds import sideways, turn_deg
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.poses.features import find_repeated, register

pytest.importorskip("pycolmap")
# At position p the camera is .45 p along the wall; the next position is 35 px of 480 away, more
# than the flow of a repeated view. Forth to position 25, back past position 1 to -5.
PLACE = np.array([*range(1, 26), *range(24, -6, -1)])
IDS = list(range(1, len(PLACE) + 1))
BACK = range(26, 50)  # ids of views that were there before


def walk() -> PointWorld:
    """The path forth and back, never at exactly the same place again."""
    cams = sideways(31, 0.45)[PLACE + 5]
    cams[:, :, 3] += np.random.default_rng(0).uniform(-0.02, 0.02, (len(cams), 3))
    return PointWorld(cams, wall(31 * 0.45, per_metre=100))


def find(world, database, ids=IDS, before=(), map_all_of=20):
    world.write(database, ids)
    return find_repeated(database, ids, 480, 0, dict(before), map_all_of, 6)


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    database = tmp_path_factory.mktemp("there") / "database.db"
    world = walk()
    return world, database, find(world, database)


def test_the_way_back_repeats_the_views_of_the_way_forth(there):
    _, database, view_of = there
    assert [i for i in IDS if view_of[i] == i] == [i for i in IDS if i not in BACK]
    assert [PLACE[view - 1] for view in view_of.values()] == PLACE.tolist()
    added = {**view_of, 60: 60}  # the steps between the first ones were too wide
    assert find_repeated(database, [*IDS, 60], 480, 0, view_of) == added


def test_few_keyframes_are_all_mapped(tmp_path):
    assert find(walk(), tmp_path / "db", map_all_of=len(IDS)) == {i: i for i in IDS}


def test_views_of_a_camera_held_upright_repeat_none_of_one_held_level(tmp_path):
    """All points match, and are elsewhere in the image."""
    world = walk()
    cams = world.cams.copy()
    cams[25:] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix() @ cams[25:]
    ids = [*range(8, 26), *range(26, 40)]
    assert find(PointWorld(cams, world.points), tmp_path / "db", ids) == {i: i for i in ids}


def test_repeated_keyframes_are_registered_with_their_poses(there):
    world, database, view_of = there
    model = world.model([i for i in IDS if view_of[i] == i])
    points = {k: point.xyz.copy() for k, point in model.points3D.items()}
    assert register(model, database, list(BACK), 0) == list(BACK)
    found = np.array([model.image(i).cam_from_world().matrix() for i in BACK])
    truth = world.cams[np.array(BACK) - 1]
    off = invert_rigid(found)[:, :, 3] - invert_rigid(truth)[:, :, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.01 and turn_deg(found, truth).max() < 0.1
    assert all((model.point3D(k).xyz == xyz).all() for k, xyz in points.items())


def test_an_image_whose_points_the_model_does_not_have_is_not_registered(there):
    world, database, view_of = there
    model = world.model([i for i in IDS if view_of[i] == i])
    for k in [k for k, point in model.points3D.items() if point.xyz[0] > 8]:
        model.delete_point3D(k)
    far = [i for i in BACK if PLACE[i - 1] > 20]
    near = [i for i in BACK if PLACE[i - 1] <= 5]
    assert register(model, database, [*far, *near], 0) == near
