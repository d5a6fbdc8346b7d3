"""What is drawn over the video: in the right place, at the right scale, of the right objects."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import SIZE, chair_solids, fitted, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.results.overlay import (
    Overlay,
    VideoWriter,
    draw_ellipses,
    draw_tracks,
    ellipse_of_dual_conic,
)
from reobj.results.result import VideoInfo
from reobj.types import object_color


def grey(width: int = 200, height: int = 120) -> np.ndarray:
    return np.full((height, width, 3), 127, np.uint8)


def drawn_in(image: np.ndarray, color: tuple[int, int, int], spread: int = 0) -> np.ndarray:
    """Bounds x1, y1, x2, y2 of the pixels of a colour (within `spread`)."""
    y, x = np.nonzero((np.abs(image.astype(int) - color) <= spread).all(2))
    return np.array([x.min(), y.min(), x.max() + 1, y.max() + 1])


def one_row(box: tuple[float, ...], identity: int = 3, frame: int = 0) -> rt.Tracks:
    one = np.ones(1, np.int64)
    ids = (one * identity, one * identity)
    return rt.Tracks(one * frame, *ids, np.array([box], float), np.ones(1), one * 0, one * 0)


# ---- Boxes ----


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_boxes_are_drawn_in_place(scale: float) -> None:
    image = grey()
    draw_tracks(image, one_row((40, 60, 160, 110)), {3: ""}, scale)
    expected = np.array([40, 60, 160, 110]) * scale
    bounds = drawn_in(image, object_color(3))
    np.testing.assert_allclose(bounds[[0, 2, 3]], expected[[0, 2, 3]], atol=2.1)  # top: the label
    x, y = (expected[:2] + expected[2:]) / 2
    assert (image[int(y), int(x)] == 127).all()


@pytest.mark.parametrize("corner", [(-20.0, -20.0), (190.0, 5.0)])
def test_labels_stay_in_the_image(corner: tuple[float, float]) -> None:
    image = grey()
    box = (*corner, corner[0] + 60, corner[1] + 60)
    draw_tracks(image, one_row(box), {3: "3 dining table"}, 1.0)
    x1, y1, x2, _ = drawn_in(image[:20], object_color(3))
    assert x2 - x1 > 80 and x1 >= 0 and x2 <= 200 and y1 <= 4


def test_identities_have_colours_of_their_own() -> None:
    assert len({object_color(i) for i in range(1, 40)}) == 39


# ---- Ellipses ----

CAMERA = np.array([[300.0, 0, 100], [0, 300, 60], [0, 0, 1]]) @ np.eye(3, 4)
ALL = (np.ones(1, bool), [1], {1})  # one object, drawn and seen
TILTED = Rotation.from_euler("zyx", [50, 30, 10], degrees=True).as_matrix()


def projected(center: tuple[float, ...], half: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Dual conic of a tilted ellipsoid, and pixels (N, 2) of many points of its surface."""
    solid = quadrics.Ellipsoids(np.array([center]), np.array([half]), TILTED[None])
    dual_c, visible = quadrics.project(solid.dual_quadrics(), CAMERA[None])
    assert visible.all()
    sphere = np.random.default_rng(0).normal(size=(20000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = (sphere * half) @ TILTED.T + center
    pixels = np.c_[points, np.ones(len(points))] @ CAMERA.T
    return dual_c[0], pixels[:, :2] / pixels[:, 2:]


def test_an_ellipse_is_the_outline_of_the_surface() -> None:
    """No point of the surface projects outside, and all around some come near."""
    dual_c, pixels = projected((0.2, 0.1, 4.0), (0.2, 0.5, 0.9))
    center, axes, angle = ellipse_of_dual_conic(dual_c[0])
    turn = np.radians(angle)
    own = pixels - 0.5 - center  # OpenCV's pixels have their centre at 0
    along = own @ [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    radius = np.linalg.norm(along / (np.array(axes) / 2), axis=1)
    assert radius.max() <= 1 + 1e-9
    around = np.degrees(np.arctan2(*along.T)) // 15
    assert min(radius[around == sector].max() for sector in np.unique(around)) > 0.98
    assert axes[0] > 1.3 * axes[1]


@pytest.mark.parametrize(
    "dual_c",
    [
        np.diag([1.0, 1.0, 1.0]),  # no real point
        np.diag([-1.0, 1.0, -1.0]),  # a hyperbola
        np.full((3, 3), np.nan),
    ],
)
def test_what_is_no_ellipse_is_not_drawn(dual_c: np.ndarray) -> None:
    assert ellipse_of_dual_conic(dual_c) is None
    image = grey()
    draw_ellipses(image, dual_c[None], *ALL)
    assert (image == 127).all()


def test_ellipses_are_drawn_in_place_if_wanted() -> None:
    near, pixels = projected((0.2, 0.1, 4.0), (0.2, 0.3, 0.4))
    dual_c, ids = np.concatenate([near, near]), [1, 2]
    image = grey()
    draw_ellipses(image, dual_c, np.array([False, True]), ids, set())
    bounds = drawn_in(image, object_color(2), 60)
    np.testing.assert_allclose(bounds, [*pixels.min(0), *pixels.max(0)], atol=1.5)
    thin = (image != 127).any(2).sum()
    image = grey()
    draw_ellipses(image, dual_c, np.array([False, True]), ids, {2})
    assert (image != 127).any(2).sum() > 1.3 * thin  # of an object with a box


def test_huge_ellipses_are_left_out() -> None:
    """An object beside the camera: the outline would run through the whole picture."""
    image = grey()
    huge, _ = projected((0.67, 0.0, 0.74), (0.545, 0.545, 0.545))
    assert max(ellipse_of_dual_conic(huge[0])[1]) > 4 * 200
    draw_ellipses(image, np.diag([0.7, 0.7, 1]) @ huge @ np.diag([0.7, 0.7, 1]), *ALL)
    assert (image != 127).any()  # a smaller one is seen
    image = grey()
    draw_ellipses(image, huge, *ALL)
    assert (image == 127).all()


# ---- The film ----


def film(path: Path) -> tuple[list[np.ndarray], float]:
    capture = cv2.VideoCapture(str(path))
    fps, pictures = capture.get(cv2.CAP_PROP_FPS), []
    while (read := capture.read())[0]:
        pictures.append(read[1])
    return pictures, fps


def frames(folder: Path, count: int, size: tuple[int, int]) -> Path:
    folder.mkdir()
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:03d}.png"), grey(*size))
    return folder


def overlay_of(result: rt.Result, video: rt.Video, path: Path) -> tuple[list[np.ndarray], float]:
    overlay = Overlay(result, path, video)
    for frame in video:
        overlay.take(frame)
    overlay.close(True)
    return film(path)


@pytest.mark.parametrize("size", [(1601, 901), (321, 241)])
def test_large_videos_are_shrunk_and_boxes_with_them(tmp_path: Path, size: tuple[int, int]) -> None:
    """Also when the frames are read smaller than they are; the sides are even."""
    box = tuple(np.array([0.2, 0.4, 0.6, 0.8]) * [*size, *size])
    tracks = one_row(box, frame=1)
    video = rt.Video(frames(tmp_path / "f", 2, size), rt.InputConfig(max_size=300))
    result = rt.Result(tracks, (), VideoInfo("f", *size, 30.0))
    (empty, drawn), fps = overlay_of(result, video, tmp_path / "o.mp4")
    height, width = drawn.shape[:2]
    assert width <= 1280 and width % 2 == height % 2 == 0 and fps == 30
    assert width > 0.99 * min(1280, size[0]) and abs(width / height - size[0] / size[1]) < 0.02
    assert np.abs(empty.astype(int) - 127).max() < 8
    changed = np.abs(drawn.astype(int) - 127).max(2) > 60
    assert changed[int(0.6 * height)].any() and not changed[: int(0.3 * height)].any()
    columns = np.flatnonzero(changed[int(0.6 * height)])
    np.testing.assert_allclose(columns[[0, -1]] / width, [0.2, 0.6], atol=0.012)


def test_every_other_frame_plays_at_half_the_rate(tmp_path: Path) -> None:
    video = rt.Video(frames(tmp_path / "f", 6, (64, 48)), rt.InputConfig(every=2))
    result = rt.Result(rt.Tracks.empty(), (), VideoInfo("f", 64, 48, 30.0))
    pictures, fps = overlay_of(result, video, tmp_path / "o.mp4")
    assert len(pictures) == 3 and fps == 15


def conic_pixels(result: rt.Result, folder: Path, count: int) -> tuple[list[np.ndarray], rt.Result]:
    """Pictures with the ellipses alone: the boxes are taken away, the labels with them."""
    bare = dataclasses.replace(result, tracks=rt.Tracks.empty())
    video = rt.Video(frames(folder / "f", count, SIZE))
    return overlay_of(bare, video, folder / "o.mp4")[0], bare


def test_ellipses_lie_where_the_objects_are(chairs: rt.Result, tmp_path: Path) -> None:
    """The first object is rejected: the others keep their own places and colours."""
    result = dataclasses.replace(chairs)
    result.objects = [
        dataclasses.replace(chairs.objects[0], status="rejected"),
        *chairs.objects[1:],
    ]
    pictures, _ = conic_pixels(result, tmp_path, 2)
    poses = walk()
    solids = chair_solids()
    dual_c, _ = quadrics.project(solids.dual_quadrics(),
                                 poses.camera.K @ poses.cam_from_world[:2])  # fmt: skip
    truth = quadrics.boxes_from_dual_conics(dual_c)  # (2, 3, 4)
    for picture, boxes in zip(pictures, truth, strict=True):
        changed = np.abs(picture.astype(int) - 127).max(2) > 40
        y, x = np.nonzero(changed)
        expected = [*boxes[1:, :2].min(0), *boxes[1:, 2:].max(0)]
        np.testing.assert_allclose([x.min(), y.min(), x.max(), y.max()], expected, atol=8)
        assert boxes[0, 0] < expected[0] - 30  # the rejected one would show
        for number in (2, 3):
            hue = picture[changed].astype(int) - object_color(number)
            assert (np.abs(hue).max(1) < 60).any(), number


def test_ellipses_of_large_videos_are_shrunk(chairs: rt.Result, tmp_path: Path) -> None:
    """The same walk with a camera of three times the pixels; the overlay has twice as many."""
    small = walk(1).camera
    large = rt.Camera("PINHOLE", 1920, 1440, tuple(3 * p for p in small.params))
    result = dataclasses.replace(chairs, poses=dataclasses.replace(chairs.poses, camera=large))
    result.tracks = rt.Tracks.empty()
    video = rt.Video(frames(tmp_path / "f", 1, (1920, 1440)))
    (picture,), _ = overlay_of(result, video, tmp_path / "o.mp4")
    assert picture.shape == (960, 1280, 3)
    dual_c, _ = quadrics.project(chairs.fits.ellipsoids.dual_quadrics(),
                                 small.K @ chairs.poses.cam_from_world[:1])  # fmt: skip
    expected = 2 * quadrics.boxes_from_dual_conics(dual_c)[0]  # (3, 4)
    y, x = np.nonzero(np.abs(picture.astype(int) - 127).max(2) > 40)
    bounds = [x.min(), y.min(), x.max(), y.max()]
    np.testing.assert_allclose(bounds, [*expected[:, :2].min(0), *expected[:, 2:].max(0)], atol=4)


def test_priors_are_drawn_only_while_the_object_is_seen(chairs: rt.Result, tmp_path: Path) -> None:
    result = dataclasses.replace(chairs)
    result.objects = [dataclasses.replace(o, status="prior_dominated") for o in chairs.objects]
    pictures, bare = conic_pixels(result, tmp_path, 1)
    assert np.abs(pictures[0].astype(int) - 127).max() < 8
    seen = chairs.tracks[(chairs.tracks.frame == 0) & (chairs.tracks.track_id == 2)]
    bare.tracks = seen
    video = rt.Video(tmp_path / "f")
    (picture,), _ = overlay_of(bare, video, tmp_path / "o.mp4")
    middle = chairs.tracks.xyxy[1].reshape(2, 2).mean(0)
    x, y = np.round(middle).astype(int)
    inside = picture[y - 40 : y + 40, x - 60 : x + 60].astype(int)
    assert np.abs(inside - 127).max() > 60  # the ellipse lies in its box


def test_a_loaded_result_is_drawn_as_well(chairs: rt.Result, tmp_path: Path) -> None:
    dataclasses.replace(chairs).save(tmp_path / "out")
    pictures, _ = conic_pixels(rt.Result.load(tmp_path / "out"), tmp_path, 1)
    assert np.abs(pictures[0].astype(int) - 127).max() > 60


def test_frames_without_a_pose_have_boxes_only(tmp_path: Path) -> None:
    poses = walk(8)
    poses.cam_from_world[0] = np.nan
    result = fitted(tracks_of(poses), poses)
    pictures, _ = conic_pixels(result, tmp_path, 2)
    assert np.abs(pictures[0].astype(int) - 127).max() < 8
    assert np.abs(pictures[1].astype(int) - 127).max() > 60


def test_a_film_that_is_not_complete_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "o.mp4"
    path.write_text("of an earlier run")
    writer = VideoWriter(path, 30, (64, 48))
    writer.write(grey(64, 48))
    assert path.read_text() == "of an earlier run"  # until the new one is complete
    writer.close(False)
    assert path.read_text() == "of an earlier run"
    assert [p.name for p in tmp_path.iterdir()] == ["o.mp4"]


def test_a_film_that_lost_frames_is_an_error(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "o.mp4", 30, (64, 48))
    writer.write(grey(64, 48))
    writer.count += 1  # as a full disk does: OpenCV says nothing
    with pytest.raises(OSError, match="disk full"):
        writer.close(True)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot write"):
        VideoWriter(tmp_path / "nowhere" / "o.mp4", 30, (64, 48))


def test_sides_are_even(tmp_path: Path) -> None:
    """Most players refuse odd ones."""
    video = rt.Video(frames(tmp_path / "f", 1, (321, 241)))
    result = rt.Result(rt.Tracks.empty(), (), VideoInfo("f", 321, 241, 30.0))
    overlay = Overlay(result, tmp_path / "o.mp4", video)
    overlay.close(False)
    assert overlay.size == (320, 240) and overlay.scale == pytest.approx(320 / 321)
