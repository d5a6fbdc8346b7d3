"""Own points of objects: triangulated, and recognised where an object moved, stayed or left."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from map_worlds import CAMERA, a_map, descriptors, observed, true_shape
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Poses, invert_rigid
from reobj.files import Progress
from reobj.maps.compare import FoundObject, PointMotion
from reobj.maps.fusion import ObjectState, object_state
from reobj.maps.object_points import ObjectView, object_views, point_motions, triangulated
from reobj.maps.room_map import MapPoints
from reobj.types import Array, Tracks

HALF = np.array([0.15, 0.12, 0.2])
PLACE = np.array([0.6, 3.0, 0.9])
ELSEWHERE = np.array([-0.7, 3.0, 0.9])
LAMP = np.array([1.2, 3.4, 0.9])
TURN = Rotation.from_euler("z", 35, degrees=True).as_matrix()
X = np.array([1.0, 0, 0])
UP = np.array([0.0, 0.0, 1.0])


def surface(rng: np.random.Generator, count: int) -> Array:
    """Points (count, 3) of an ellipsoid about the origin, not below three quarters of its depth."""
    ray = rng.normal(size=(count, 3))
    ray[:, 2] = np.abs(ray[:, 2]) - 0.3
    return ray / np.linalg.norm(ray, axis=1, keepdims=True) * HALF


def poses(count: int = 8) -> Poses:
    """Cameras 1.3 m high on an arc, looking along y."""
    cams = []
    for a in np.linspace(-0.35, 0.35, count):
        forward = np.array([np.sin(a), np.cos(a), -0.12])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, UP)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cams.append(np.column_stack([rotation, -rotation @ [-1.5 * np.sin(a), 0, 1.3]]))
    known = {name: np.full(count, value) for name, value in (("measured", True), ("known", True))}
    return SimpleNamespace(  # type: ignore[return-value]
        camera=CAMERA, cam_from_world=np.array(cams), frame=10 * np.arange(count),
        part=np.zeros(count, np.int64), **known,
    )  # fmt: skip


def project(xyz: Array, cam: Array) -> Array:
    in_cam = xyz @ cam[:, :3].T + cam[:, 3]
    return np.asarray((in_cam @ CAMERA.K.T)[:, :2] / in_cam[:, 2:])


def features(
    rng: np.random.Generator, xy: Array, code: np.ndarray, sigma_px: float, wrong: Any, count: int
) -> tuple[Array, np.ndarray]:
    """Noisy features at projections, and some random ones."""
    xy = np.concatenate([xy + rng.normal(0, sigma_px, xy.shape), rng.uniform(*wrong, (count, 2))])
    noisy = (code + rng.normal(0, 5, code.shape)).clip(0, 255).astype(np.uint8)
    return xy, np.concatenate([noisy, descriptors(rng, count)])


class World:
    """A room with a background, and objects that are put somewhere and seen by eight cameras.

    Attributes:
        points: of the map. states: its objects. seen: (position now, descriptor) of what is there.
    """

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.poses = poses()
        wall = self.rng.uniform([-3, 5, 0], [3, 6, 2.5], (300, 3))
        self.xyz = [wall]
        self.code = [descriptors(self.rng, 300)]
        self.owner = [np.zeros(300, np.int64)]
        self.seen = [(wall, self.code[0])]
        self.states: list[ObjectState] = []
        self.found: list[FoundObject] = []

    def add(
        self, name: str, center: Array, code: np.ndarray | None = None, half: Array = HALF
    ) -> tuple[Array, np.ndarray]:
        """Add an object with 40 points to the map; return them, about its centre."""
        shape = true_shape(center=center, half_axes=half, yaw_deg=0)
        room = a_map([[observed(1, "new", shape, classes={name: 9.0})]])
        number = len(self.states) + 1
        self.states.append(dataclasses.replace(object_state(room.objects[0], room), id=number))
        points = surface(np.random.default_rng(5), 40) * half / HALF
        code = descriptors(self.rng, 40) if code is None else code
        self.tag(number, points + center, code)
        return points, code

    def tag(self, number: int, xyz: Array, code: np.ndarray) -> None:
        """Add points of the map that are tagged with an object."""
        self.xyz.append(xyz)
        self.code.append(code)
        self.owner.append(np.full(len(xyz), number))

    def put(self, points: Array, code: np.ndarray, center: Array, turn: Array = TURN) -> None:
        """Let the recording show points about a centre."""
        self.seen.append((points @ turn.T + center, code))

    def find(self, name: str, center: Array, half: Array = HALF, off: float = 0.02) -> None:
        """Add a found object with its centre a little off."""
        none = np.empty(0, np.float32)
        self.found.append(FoundObject(
            101 + len(self.found), {name: 9.0}, "box", center + off * X, half,
            np.array([1.0, 0, 0, 0]), np.diag([3e-4] * 3 + [0.01] * 6), none, none, 9, 0.9, {},
        ))  # fmt: skip

    @property
    def points(self) -> MapPoints:
        xyz = np.concatenate(self.xyz)
        owner = np.concatenate(self.owner)
        ray = xyz - [0, 0, 1.3]
        distance = np.linalg.norm(ray, axis=1)
        return MapPoints(
            xyz, np.concatenate(self.code), np.ones(len(xyz), np.int64), owner,
            ray / distance[:, None], distance,
        )  # fmt: skip

    def views(self) -> list[ObjectView]:
        """Features in the boxes of found objects: .5 px of noise, 40 wrong ones an image."""
        xyz = np.concatenate([p for p, _ in self.seen])
        code = np.concatenate([c for _, c in self.seen])
        views = []
        for row, cam in enumerate(self.poses.cam_from_world):
            xy, of_all = features(self.rng, project(xyz, cam), code, 0.5, (0, 480), 40)
            for o in self.found:
                shape = quadrics.Ellipsoids(
                    o.center[None], 1.1 * o.half_axes[None], np.eye(3)[None]
                )
                box = quadrics.solid_boxes(shape, "box", (CAMERA.K @ cam)[None])[0, 0]
                rows = ((xy >= box[:2]) & (xy <= box[2:])).all(1)
                views.append(ObjectView(row, o.id, xy[rows], of_all[rows]))
        return views

    def motions(self, images: Sequence[int] = range(8)) -> list[dict[int, PointMotion]]:
        views = [v for v in self.views() if v.row in images]
        return point_motions(self.points, self.states, self.found, views, self.poses, UP)


def moved_world() -> World:
    """An object that moved by 1.3 m and turned by 35 degrees, and one that stayed."""
    world = World()
    points, code = world.add("radio", PLACE)
    still, other = world.add("lamp", LAMP)
    world.put(points, code, ELSEWHERE)
    world.put(still, other, LAMP, np.eye(3))
    world.find("radio", ELSEWHERE)
    world.find("lamp", LAMP, off=0.07)
    return world


@pytest.mark.parametrize(("name", "compared"), [("sofa", 0), ("couch", 0), ("lamp", 1)])
def test_an_object_in_its_place_needs_no_points(name: str, compared: int) -> None:
    """Unless it has another class; a synonym is the same class."""
    world = World()
    points, code = world.add("sofa", LAMP)
    world.put(points, code, LAMP, np.eye(3))
    world.find(name, LAMP, off=0.0)
    (motions,) = world.motions()
    assert len(motions) == compared


def test_points_of_a_moved_object_give_its_motion_and_those_of_another_that_it_stayed() -> None:
    radio, lamp = moved_world().motions()
    assert set(radio) == {1} and set(lamp) == {2}
    motion = radio[1]
    assert motion.inliers >= 30 and motion.images == 8
    assert motion.shift == pytest.approx(ELSEWHERE - PLACE, abs=0.01)
    error = motion.shift - (ELSEWHERE - PLACE)
    assert error @ np.linalg.solve(motion.cov, error) < 25
    assert lamp[2].inliers >= 15 and not lamp[2].shift.any()
    assert 0.005 < np.sqrt(lamp[2].cov[0, 0]) < 0.02  # 3 px at 3 m: 1.8 cm, uniform


def still_lamp(world: World, views: Sequence[ObjectView], scale: int) -> PointMotion:
    """The motion of the lamp in images that are `scale` times as large."""
    world.poses.camera = CAMERA.resized((640 * scale, 480 * scale))
    found = point_motions(world.points, world.states, world.found, views, world.poses, UP)
    return found[1][2]


def test_pixels_of_large_images_are_finer() -> None:
    """The same noise, relative to the image: the limits of the errors grow with its size."""
    world = moved_world()
    views = world.views()
    fine = [dataclasses.replace(v, xy=4 * v.xy) for v in views]
    usual = still_lamp(world, views, 1)
    large = still_lamp(world, fine, 4)
    assert large.inliers == usual.inliers >= 15
    np.testing.assert_allclose(large.cov, usual.cov)


def test_sigma_of_a_motion_includes_the_errors_of_the_points_of_the_map() -> None:
    """They are 5 mm, .8 px, in each of the three axes, and common to all images."""
    squares = []
    for seed in range(5):
        world = World(seed)
        points, code = world.add("radio", PLACE)
        world.xyz[-1] += world.rng.normal(0, 0.005, points.shape)
        world.put(points, code, ELSEWHERE)
        world.find("radio", ELSEWHERE)
        motion = world.motions()[0][1]
        error = motion.shift - (ELSEWHERE - PLACE)
        squares.append(error @ np.linalg.solve(motion.cov, error) / 3)
    assert 0.12 < np.mean(squares) < 1.5


def test_a_few_points_do_not_turn_an_object_over() -> None:
    """Eight of its points are seen as those of an object that lies on its side."""
    turned = Rotation.from_euler("xz", [80, 35], degrees=True).as_matrix()
    for count, known in ((8, set()), (40, {1})):
        world = World()
        points, code = world.add("radio", PLACE)
        world.put(points[:count], code[:count], ELSEWHERE, turned)
        world.find("radio", ELSEWHERE, np.full(3, 0.2))
        assert set(world.motions()[0]) == known


def test_table_points_at_the_foot_are_no_evidence_for_what_replaced_the_object() -> None:
    """Points of the table lie inside the enlarged ellipsoid of the object and are tagged too."""
    world = World()
    world.add("radio", PLACE)
    foot = PLACE + np.column_stack(
        [world.rng.uniform(-0.05, 0.05, (12, 2)), np.full(12, -1.02 * HALF[2])]
    )
    code = descriptors(world.rng, 12)
    world.tag(1, foot, code)
    world.seen.append((foot, code))
    world.put(surface(world.rng, 40), descriptors(world.rng, 40), PLACE)  # another radio
    world.find("radio", PLACE)
    assert world.motions() == [{}]


def test_what_stands_on_a_moved_table_is_not_the_table() -> None:
    """The box of the table shows the points of the radio on it."""
    world = World()
    points, code = world.add("radio", PLACE)
    world.put(points, code, ELSEWHERE)
    table = np.array([0.7, 0.5, 0.45])
    world.find("table", ELSEWHERE - [0, 0, table[2]], table)
    assert world.motions() == [{}]
    world.find("radio", ELSEWHERE)
    assert [set(m) for m in world.motions()] == [set(), {1}]


@pytest.mark.parametrize(("other", "known"), [("radio", {1, 2}), ("lamp", set())])
def test_identical_instances_do_not_compete_and_objects_of_other_classes_do(
    other: str, known: set[int]
) -> None:
    world = World()
    points, code = world.add("radio", PLACE)
    world.add(other, LAMP, code)
    world.put(points, code, ELSEWHERE)
    world.find("radio", ELSEWHERE)
    assert set(world.motions()[0]) == known


# ---- Points of the objects of a recording ----


def located(half: Array = HALF) -> Any:
    """An object with a shape."""
    return SimpleNamespace(
        id=7, center=PLACE, half_axes=half, quat_wxyz=np.array([1.0, 0, 0, 0]), part=0
    )


def views_of(xyz: Array, code: np.ndarray, rng: np.random.Generator) -> list[ObjectView]:
    """Features at the projections of points, .3 px of noise, and ten wrong ones a view."""
    views = []
    for row, cam in enumerate(poses().cam_from_world):
        xy = project(xyz, cam)
        views.append(ObjectView(row, 7, *features(rng, xy, code, 0.3, (xy.min(0), xy.max(0)), 10)))
    return views


def points_of(xyz: Array, code: np.ndarray, rows: slice = slice(None)) -> MapPoints:
    views = views_of(xyz, code, np.random.default_rng(3))
    return triangulated([located()], views[rows], poses())


def test_features_that_views_have_in_common_become_points_of_the_object() -> None:
    rng = np.random.default_rng(0)
    xyz = surface(rng, 30) + PLACE
    code = descriptors(rng, 30)
    found = points_of(xyz, code)
    gap = np.linalg.norm(found.xyz[:, None] - xyz, axis=2)  # (n, 30)
    assert len(found) == 30 and len(set(gap.argmin(1))) == 30 and gap.min(1).max() < 0.02
    assert (found.object_id == 7).all()
    of_true = code[gap.argmin(1)].astype(float)
    cosine = (found.descriptor * of_true).sum(1)
    cosine /= np.linalg.norm(found.descriptor, axis=1) * np.linalg.norm(of_true, axis=1)
    assert cosine.min() > 0.95
    at = invert_rigid(poses().cam_from_world)[:, :, 3]
    ray = found.xyz - at.mean(0)
    assert ((ray * found.viewing_ray).sum(1) > 0.95 * np.linalg.norm(ray, axis=1)).all()
    distance = np.linalg.norm(found.xyz[:, None] - at, axis=2)  # (n, 8)
    np.testing.assert_allclose(found.distance, np.median(distance, axis=1), rtol=0.02)
    # they need views, and a place inside the object
    assert len(points_of(xyz, code, slice(3))) > 10
    assert len(points_of(xyz, code, slice(2))) == 0
    behind = xyz + np.array([0, 2 * HALF[1] + 0.3, 0])
    assert len(points_of(behind, code)) == 0


def test_small_boxes_are_enlarged_and_described_from_different_directions() -> None:
    """Blobs of 3 px on an object of 24 px: features lie on them, at native positions."""
    cams = poses(40)
    image = np.full((480, 640, 3), 90, np.uint8)
    middle = np.array([[205, 105], [213, 112], [219, 104], [208, 120], [220, 121]])
    for x, y in middle:
        cv2.circle(image, (16 * int(x) - 8, 16 * int(y) - 8), 24, (240, 240, 240), -1, 16, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    frame = np.asarray(cams.frame)
    box = np.tile([200.0, 100, 224, 126], (40, 1))
    ids = np.full(40, 7)
    tracks = Tracks(frame, ids, np.arange(40), box, np.ones(40), ids * 0, ids * 0 - 1)
    tracks = dataclasses.replace(tracks, detection_index=np.arange(40))
    video: Any = [SimpleNamespace(index=int(f), image=image) for f in frame]
    seen = object_views([located()], cams, tracks, video, Progress("test"))
    rows = sorted(v.row for v in seen)
    assert len(seen) == 12 and rows[0] <= 1 and rows[-1] >= 38
    gap = np.linalg.norm(seen[0].xy[:, None] - middle, axis=2).min(0)  # to each blob
    assert gap.max() < 0.7
