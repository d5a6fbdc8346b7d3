"""The overlay video: position, scale and identity of everything drawn."""

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
from reobj.results.changes import Change, Changes, Shape
from reobj.results.overlay import (
    CHANGE_COLORS,
    FormerPlaces,
    Overlay,
    _former_surface,
    change_label,
    draw_ellipses,
    draw_legend,
    draw_tracks,
    draw_wireframes,
    ellipse_of_dual_conic,
    film_layers,
    outline_of,
    place_labels,
    surface_points,
    wireframes,
)
from reobj.results.result import VideoInfo
from reobj.types import box_iou, object_color


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


def test_identities_have_distinct_colours() -> None:
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
def test_other_conics_are_not_drawn(dual_c: np.ndarray) -> None:
    assert ellipse_of_dual_conic(dual_c) is None
    image = grey()
    draw_ellipses(image, dual_c[None], *ALL)
    assert (image == 127).all()


def test_ellipses_are_drawn_if_enabled() -> None:
    near, pixels = projected((0.2, 0.1, 4.0), (0.2, 0.3, 0.4))
    dual_c, ids = np.concatenate([near, near]), [1, 2]
    image = grey()
    draw_ellipses(image, dual_c, np.array([False, True]), ids, set())
    bounds = drawn_in(image, object_color(2), 60)
    np.testing.assert_allclose(bounds, [*pixels.min(0), *pixels.max(0)], atol=1.5)
    thin = (image != 127).any(2).sum()
    image = grey()
    draw_ellipses(image, dual_c, np.array([False, True]), ids, {2})
    wide = (image != 127).any(2).sum()
    assert 1.7 * thin < wide < 2.1 * thin  # of an object with a box


def test_huge_ellipses_are_not_drawn() -> None:
    """An object beside the camera: the outline would run through the whole picture."""
    image = grey()
    huge, _ = projected((0.67, 0.0, 0.74), (0.545, 0.545, 0.545))
    assert max(ellipse_of_dual_conic(huge[0])[1]) > 4 * 200
    draw_ellipses(image, np.diag([0.7, 0.7, 1]) @ huge @ np.diag([0.7, 0.7, 1]), *ALL)
    assert (image != 127).any()  # a smaller one is drawn
    image = grey()
    draw_ellipses(image, huge, *ALL)
    assert (image == 127).all()


# ---- Boxes and cylinders in 3D ----


def one_solid(kind: str, center: tuple[float, ...], half: tuple[float, ...], turn=TILTED):
    """A solid, its bounds by the geometry's own projection, and its edges."""
    solid = quadrics.Ellipsoids(np.array([center]), np.array([half]), np.array([turn]))
    bounds = quadrics.solid_boxes(solid, kind, CAMERA[None])[0, 0]
    return wireframes(solid, [kind]), bounds


PINHOLE = rt.Camera("PINHOLE", 200, 120, (300.0, 300.0, 100.0, 60.0))
STILL = np.eye(3, 4)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
@pytest.mark.parametrize("turn", [TILTED, np.eye(3), TILTED.T])
def test_edges_span_the_projection_of_the_object(kind: str, turn: np.ndarray) -> None:
    frames, bounds = one_solid(kind, (0.2, 0.1, 4.0), (0.2, 0.5, 0.9), turn)
    ends, _, _ = frames.segments(STILL)
    pixels = PINHOLE.project(ends).reshape(-1, 2)
    found = [*pixels.min(0), *pixels.max(0)]
    np.testing.assert_allclose(found, bounds, atol=0.5 if kind == "cylinder" else 1e-9)


@pytest.mark.parametrize(
    ("center", "turn", "shown"),
    [
        ((0.0, 0.0, 4.0), np.eye(3), 4),  # straight on: the front face
        ((0.0, 2.0, 4.0), np.eye(3), 7),  # from above: two faces
        ((2.0, 2.0, 4.0), np.eye(3), 9),  # three faces
        ((0.0, 0.0, 0.1), np.eye(3), 0),  # from within
    ],
)
def test_a_box_occludes_back_edges(center: tuple[float, ...], turn: np.ndarray, shown: int) -> None:
    frames, _ = one_solid("box", center, (0.5, 0.5, 0.5), turn)
    ends, edge, front = frames.segments(STILL)
    assert front.sum() == shown
    if shown == 9:  # the three others meet in the farthest corner
        occluded = np.round(ends[~front], 6).reshape(-1, 3)
        corner = np.array(center) + 0.5
        assert len(edge) == 12 and (np.abs(occluded - corner).max(1) < 1e-6).sum() == 3


def test_a_cylinder_has_two_sides_and_half_an_occluded_rim() -> None:
    """Upright in front of a camera that looks down (y is down): half the bottom rim is occluded."""
    upright = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    frames, _ = one_solid("cylinder", (0.0, 1.0, 4.0), (0.5, 0.5, 0.6), upright)
    ends, edge, front = frames.segments(STILL)
    sides = ~frames.crease[edge]
    assert sides.sum() == 2 and front[sides].all()
    np.testing.assert_allclose(sorted(ends[sides][:, 0, 0]), [-0.49, 0.49], atol=0.02)
    rim = ends.mean(1)[~sides]
    top, depth = rim[:, 1] < 1, rim[:, 2]
    assert front[~sides][top].all() and not front[~sides][~top & (depth > 4.1)].any()
    assert front[~sides][~top & (depth < 3.8)].all()


def test_edges_beside_the_camera_are_cut() -> None:
    """A long box beside the camera: edges are clipped behind the camera."""
    frames, _ = one_solid("box", (1.0, 0.0, 0.0), (0.5, 0.5, 6.0), np.eye(3))
    ends, edge, _ = frames.segments(STILL)
    assert (ends[:, :, 2] > 0.29).all() and len(edge) == 8
    whole = frames.points[frames.edges[edge]]
    across = np.cross(ends[:, :1] - whole[:, :1], whole[:, 1:] - whole[:, :1])
    np.testing.assert_allclose(across, 0, atol=1e-9)
    behind, _ = one_solid("box", (0.0, 0.0, -4.0), (0.5, 0.5, 0.5))
    assert len(behind.segments(STILL)[0]) == 0


def test_ellipsoids_have_no_edges() -> None:
    solids = chair_solids()
    frames = wireframes(solids, ["ellipsoid", "box", None])
    assert set(frames.solid) == {1} and len(frames.edges) == 12
    assert len(wireframes(solids, [None] * 3).segments(STILL)[0]) == 0


def test_projections_are_distorted() -> None:
    """Equals OpenCV's projection."""
    lens = rt.Camera("OPENCV", 200, 120, (300.0, 300.0, 100.0, 60.0, -0.3, 0.1, 0.001, -0.002))
    points = np.random.default_rng(0).uniform([-1, -0.6, 3], [1, 0.6, 5], (40, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K,
                                 np.array(lens.params[4:]))[0][:, 0]  # fmt: skip
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-6)
    straight = PINHOLE.project(points)
    assert np.abs(straight - expected).max() > 1


def drawn(frames, seen: set[int], wanted: bool = True, camera: rt.Camera = PINHOLE) -> np.ndarray:
    image, count = grey(), int(frames.solid.max()) + 1
    mask = np.full(count, wanted)
    draw_wireframes(image, frames, camera, STILL, 1.0, range(1, count + 1), mask, seen)
    return image


def test_edges_are_drawn_if_enabled() -> None:
    frames, bounds = one_solid("box", (0.2, 0.1, 4.0), (0.2, 0.3, 0.4))
    image = drawn(frames, {1})
    np.testing.assert_allclose(drawn_in(image, object_color(1), 60), bounds, atol=2)
    dim = np.array(object_color(1)) * 0.6
    assert (np.abs(image.astype(float) - dim).max(2) < 12).any()  # occluded edges
    unseen = drawn(frames, set())
    assert (image != 127).any(2).sum() > 1.5 * (unseen != 127).any(2).sum()
    assert not (np.abs(unseen.astype(float) - dim).max(2) < 12).any()
    assert (drawn(frames, {1}, wanted=False) == 127).all()


def test_edges_are_distorted() -> None:
    """The middle of a long edge is distorted, not interpolated between its ends."""
    lens = rt.Camera("OPENCV", 200, 120, (300.0, 300.0, 100.0, 60.0, -0.9, 0.0, 0.0, 0.0))
    half = np.array([[1.2, 0.7, 0.2]])
    center = np.array([[0, 0, 4.0]])
    frames = wireframes(quadrics.Ellipsoids(center, half, np.eye(3)[None]), ["box"])
    image = drawn(frames, {1}, camera=lens)
    ends = lens.project(np.array([[-1.2, 0.7, 3.8], [1.2, 0.7, 3.8]]))
    x, y = np.round(lens.project(np.array([[0, 0.7, 3.8]]))[0] - 0.5).astype(int)
    assert y > ends[:, 1].max() + 3
    assert (image[y, x] == object_color(1)).all()
    assert (image[int(ends[0, 1]), x] != object_color(1)).any()


def test_edges_beyond_the_fold_of_the_lens_are_not_drawn() -> None:
    """A plank from the image to far beside it: its lines end where the lens shows no more.

    The model turns back at 1.05 times the focal length, and far points of the plank would be
    projected across the image.
    """
    lens = rt.Camera("OPENCV", 200, 120, (90.0, 90.0, 60.0, 60.0, -0.3, 0.0, 0.0, 0.0))
    center = np.array([[9.8, 0.0, 4.0]])
    half = np.array([[10.0, 0.3, 0.2]])
    frames = wireframes(quadrics.Ellipsoids(center, half, np.eye(3)[None]), ["box"])
    image = drawn(frames, {1}, camera=lens)
    y, x = np.nonzero((image != 127).any(2))
    steps = np.linspace(-1, 1, 2001)
    ends = frames.points[frames.edges]
    line = ends.mean(1, keepdims=True) + steps[:, None] * np.diff(ends, axis=1) / 2
    shown = lens.project(line).reshape(-1, 2)
    shown = shown[np.isfinite(shown).all(1)] - 0.5
    gap = np.linalg.norm(np.c_[x, y][:, None] - shown[::7], axis=2).min(1)
    assert gap.max() < 3
    assert x.max() > shown[:, 0].max() - 2.5 and x.min() < 60


def test_huge_objects_are_not_drawn_with_a_fold_either() -> None:
    lens = rt.Camera("OPENCV", 200, 120, (90.0, 90.0, 60.0, 60.0, -0.3, 0.0, 0.0, 0.0))
    frames, _ = one_solid("box", (0.6, 0.0, 0.3), (0.5, 0.5, 0.5), np.eye(3))
    assert (drawn(frames, {1}, camera=lens) == 127).all()


def test_objects_far_off_the_axis_of_a_lens_without_a_fold_are_not_drawn() -> None:
    """There the terms of the distortion are larger than any image."""
    lens = rt.Camera("RADIAL", 200, 120, (90.0, 60.0, 60.0, 0.0, 0.01))
    assert lens.fold_radius == np.inf
    frames, _ = one_solid("box", (900.0, 0.0, 3.0), (0.5, 0.5, 0.01), np.eye(3))
    assert (drawn(frames, {1}, camera=lens) == 127).all()


def test_former_places_end_at_the_fold_of_the_lens() -> None:
    lens = rt.Camera("OPENCV", 200, 120, (90.0, 90.0, 60.0, 60.0, -0.3, 0.0, 0.0, 0.0))
    steps = np.linspace(-1, 11, 1200)
    points = np.concatenate([np.c_[steps, 0 * steps + y, 0 * steps + 4] for y in (-0.3, 0.3)])
    outline = outline_of(lens, STILL, points - [3.5, 0, 0])
    assert outline is not None and np.isfinite(outline).all()
    rim = 60 + 90 * 2 / 3 / np.sqrt(0.9)  # r (1 - .3 r^2) at its maximum
    assert outline[:, 0].max() == pytest.approx(rim, abs=0.5)


def test_nearer_solids_are_drawn_over_farther_ones() -> None:
    centers = np.array([[0, 0, 3.0], [0, 0, 6.0]])
    half = np.full((2, 3), 0.3)
    for order in ([0, 1], [1, 0]):
        solids = quadrics.Ellipsoids(centers[order], half * centers[order][:, 2:] / 3,
                                     np.tile(np.eye(3), (2, 1, 1)))  # fmt: skip
        image = drawn(wireframes(solids, ["box", "box"]), {1, 2})
        near = 1 + order.index(0)
        x, y = 100 - 300 * 0.3 / 2.7, 60  # on the left edge of the near face
        found = image[y, int(x) - 1 : int(x) + 2].astype(int)
        assert (np.abs(found - object_color(near)).max(1) < 60).any()


def test_huge_objects_are_not_drawn() -> None:
    frames, _ = one_solid("box", (0.6, 0.0, 0.3), (0.5, 0.5, 0.5), np.eye(3))
    assert (drawn(frames, {1}) == 127).all()


# ---- Labels, trails, legend ----


def test_labels_never_cover_each_other() -> None:
    """Random boxes: every label lies inside the image and overlaps no other."""
    rng = np.random.default_rng(3)
    for count in (2, 12, 60):
        boxes = rng.integers(-20, 300, (count, 2))
        boxes = np.concatenate([boxes, boxes + rng.integers(5, 120, (count, 2))], 1)
        sizes = np.column_stack([rng.integers(30, 110, count), np.full(count, 17)])
        spots = place_labels(range(count), sizes, boxes, (320, 240), {})
        kept = [(x, y, x + w, y + h) for (x, y), (w, h) in
                ((s, size) for s, size in zip(spots, sizes, strict=True) if s)]  # fmt: skip
        shown = np.array(kept, float)
        assert (shown[:, :2] >= 0).all() and (shown[:, 2:] <= (320, 240)).all()
        overlap = box_iou(shown, shown) - np.eye(len(shown))
        assert overlap.max() == 0 and len(shown) >= min(count, 8)


def test_labels_never_cover_small_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cups side by side: labels lie around the group, with lines to their cups."""
    boxes = np.array([[x, y, x + 24, y + 24] for y in (90, 118) for x in (100, 128, 156)])
    sizes = np.array([[60, 17]] * 6)
    spots = place_labels(range(6), sizes, boxes, (320, 240), {})
    labels = np.array([(x, y, x + 60, y + 17) for x, y in filter(None, spots)], float)
    assert len(labels) == 6 and box_iou(labels, boxes.astype(float)).max() == 0
    gap = np.maximum(boxes[:, :2] - labels[:, 2:], labels[:, :2] - boxes[:, 2:]).max(1)
    (away,) = np.nonzero(gap > 2)
    assert len(away)
    image = grey(320, 240)
    ids = np.arange(6)
    rows = rt.Tracks(ids * 0, ids, ids, boxes.astype(float), np.ones(6), ids * 0, ids * 0)
    texts = dict.fromkeys(range(6), "1234567")  # labels of about 60 px
    draw_tracks(image, rows, texts, 1.0)
    plain = grey(320, 240)
    monkeypatch.setattr("reobj.results.overlay._draw_leader", lambda *_: None)
    draw_tracks(plain, rows, texts, 1.0)
    y, x = np.nonzero((image != plain).any(2))  # the lines
    line = np.column_stack([x, y])
    gap = np.maximum(boxes[:, None, :2] - line, line - boxes[:, None, 2:]).max(2).min(1)  # (6,)
    number = int(gap.argmin())
    assert gap[number] <= 1 and len(line) > 10
    assert (np.abs(image[y, x].astype(int) - object_color(number)) < 40).all(1).any()


def test_a_label_keeps_its_position_while_it_is_free() -> None:
    sizes, boxes = np.array([[60, 17]] * 2), np.array([[50, 50, 90, 90]] * 2)
    positions: dict[int, int] = {}
    first = place_labels([1, 2], sizes, boxes, (320, 240), positions)
    alone = place_labels([2], sizes[:1], boxes[:1], (320, 240), positions)
    assert first[0] != first[1] == alone[0]
    assert place_labels([3], sizes[:1], boxes[:1], (320, 240), {})[0] == first[0]


def test_filled_gaps_are_dashed() -> None:
    row = one_row((40, 30, 160, 110))
    edges = []
    for score in (0.9, 0.0):
        image = grey()
        draw_tracks(image, dataclasses.replace(row, score=np.array([score])), {3: ""}, 1.0)
        edges.append((image[60:110, 39:42] != 127).any(2).any(1).mean())
    assert edges[0] == 1 and 0.3 < edges[1] < 0.9


@pytest.mark.parametrize(
    ("text", "layers"),
    [
        ("solids", {"boxes", "solids"}),
        ("Ellipses, trails", {"boxes", "ellipses", "trails"}),
        ("boxes", {"boxes"}),
        ("on", {"boxes", "solids"}),  # the default layers
        ("True", {"boxes", "solids"}),
        ("none", set()),
        ("0", set()),
        (False, set()),
    ],
)
def test_layers_of_the_overlay(text: str, layers: set[str]) -> None:
    assert film_layers(text) == layers


@pytest.mark.parametrize("text", ["solid", "solids,trials", "none,solids", "sphere"])
def test_unknown_layers_are_refused(text: str) -> None:
    with pytest.raises(rt.ReobjError, match=r"expected boxes, solids, ellipses, trails .* mean"):
        film_layers(text)
    with pytest.raises(rt.ReobjError, match=r"output\.overlay"):
        rt.OutputConfig(overlay=text)


# ---- The overlay video ----


def decoded(path: Path) -> tuple[list[np.ndarray], float]:
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


def overlay_of(
    result: rt.Result, video: rt.Video, path: Path, layers: str = "solids"
) -> tuple[list[np.ndarray], float]:
    """Frames of the overlay without its legend, and its rate."""
    overlay = Overlay(result, path, video, layers)
    overlay.legend = []
    for frame in video:
        overlay.take(frame)
    overlay.close(True)
    return decoded(overlay.path)


@pytest.mark.parametrize("size", [(1601, 901), (321, 241)])
def test_videos_have_their_full_size_with_boxes(tmp_path: Path, size: tuple[int, int]) -> None:
    """Also if the working size is smaller than the frames; the sides are even."""
    box = tuple(np.array([0.2, 0.4, 0.6, 0.8]) * [*size, *size])
    tracks = one_row(box, frame=1)
    video = rt.Video(frames(tmp_path / "f", 2, size), rt.InputConfig(max_size=300))
    result = rt.Result(tracks, (), VideoInfo("f", *size, 30.0))
    (empty, drawn), fps = overlay_of(result, video, tmp_path / "o.mp4")
    height, width = drawn.shape[:2]
    assert (width, height) == (size[0] - 1, size[1] - 1) and fps == 2
    assert np.abs(empty.astype(int) - 127).max() < 8
    changed = np.abs(drawn.astype(int) - 127).max(2) > 60
    assert changed[int(0.6 * height)].any() and not changed[: int(0.3 * height)].any()
    columns = np.flatnonzero(changed[int(0.6 * height)])
    np.testing.assert_allclose(columns[[0, -1]] / width, [0.2, 0.6], atol=0.012)


def test_every_other_image_is_in_the_video(tmp_path: Path) -> None:
    video = rt.Video(frames(tmp_path / "f", 6, (64, 48)), rt.InputConfig(every=2))
    result = rt.Result(rt.Tracks.empty(), (), VideoInfo("f", 64, 48, 30.0))
    pictures, fps = overlay_of(result, video, tmp_path / "o.mp4")
    assert len(pictures) == 3 and fps == 2


def solid_pixels(
    result: rt.Result, folder: Path, count: int, layers: str = "solids"
) -> tuple[list[np.ndarray], rt.Result]:
    """Frames with the 3D shapes alone: boxes and labels are removed."""
    bare = dataclasses.replace(result, tracks=rt.Tracks.empty())
    video = rt.Video(frames(folder / "f", count, SIZE))
    return overlay_of(bare, video, folder / "o.mp4", layers)[0], bare


@pytest.mark.parametrize("layers", ["solids", "ellipses"])
def test_shapes_are_drawn_at_the_objects(chairs: rt.Result, tmp_path: Path, layers: str) -> None:
    """The first object is rejected: the others keep their positions and colours."""
    result = dataclasses.replace(chairs)
    result = dataclasses.replace(
        result,
        objects=[
            dataclasses.replace(chairs.objects[0], status="rejected"),
            *chairs.objects[1:],
        ],
    )
    pictures, _ = solid_pixels(result, tmp_path, 2, layers)
    poses = walk()
    kind = "box" if layers == "solids" else "ellipsoid"
    cams = poses.camera.K @ poses.cam_from_world[:2]
    truth = quadrics.solid_boxes(chair_solids(), kind, cams)  # (2, 3, 4)
    for picture, boxes in zip(pictures, truth, strict=True):
        changed = np.abs(picture.astype(int) - 127).max(2) > 40
        y, x = np.nonzero(changed)
        expected = [*boxes[1:, :2].min(0), *boxes[1:, 2:].max(0)]
        np.testing.assert_allclose([x.min(), y.min(), x.max(), y.max()], expected, atol=10)
        assert boxes[0, 0] < expected[0] - 30  # the rejected one would be visible
        for number in (2, 3):
            hue = picture[changed].astype(int) - object_color(number)
            assert (np.abs(hue).max(1) < 75).any(), number


def test_labels_and_lines_of_large_frames_can_be_read(tmp_path: Path) -> None:
    """Frames of 4K are shown shrunk."""
    heights = []
    for zoom in (1, 3):
        image = grey(1280 * zoom, 720 * zoom)
        draw_tracks(image, one_row((200, 300, 600, 500)), {3: "3 chair"}, float(zoom))
        label = (image[: 299 * zoom, 210 * zoom] != 127).any(1)
        heights.append(label.sum() / zoom)
    assert heights[0] > 10 and heights[1] == pytest.approx(heights[0], rel=0.1)


def test_ellipses_of_large_videos_have_their_place(chairs: rt.Result, tmp_path: Path) -> None:
    """The same walk with a camera of three times the pixels."""
    small = walk(1).camera
    large = rt.Camera("PINHOLE", 1920, 1440, tuple(3 * p for p in small.params))
    result = dataclasses.replace(chairs, poses=dataclasses.replace(chairs.poses, camera=large))
    result = dataclasses.replace(result, tracks=rt.Tracks.empty())
    video = rt.Video(frames(tmp_path / "f", 1, (1920, 1440)))
    (picture,), _ = overlay_of(result, video, tmp_path / "o.mp4", "ellipses")
    assert picture.shape == (1440, 1920, 3)
    dual_c, _ = quadrics.project(chairs.fits.ellipsoids.dual_quadrics(),
                                 small.K @ chairs.poses.cam_from_world[:1])  # fmt: skip
    expected = 3 * quadrics.boxes_from_dual_conics(dual_c)[0]  # (3, 4)
    y, x = np.nonzero(np.abs(picture.astype(int) - 127).max(2) > 40)
    bounds = [x.min(), y.min(), x.max(), y.max()]
    np.testing.assert_allclose(bounds, [*expected[:, :2].min(0), *expected[:, 2:].max(0)], atol=5)


def test_priors_are_drawn_only_with_a_detection(chairs: rt.Result, tmp_path: Path) -> None:
    result = dataclasses.replace(chairs)
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(o, status="prior_dominated") for o in chairs.objects]
    )
    pictures, bare = solid_pixels(result, tmp_path, 1)
    assert np.abs(pictures[0].astype(int) - 127).max() < 8
    seen = chairs.tracks[(chairs.tracks.frame == 0) & (chairs.tracks.track_id == 2)]
    bare = dataclasses.replace(bare, tracks=seen)
    video = rt.Video(tmp_path / "f")
    (picture,), _ = overlay_of(bare, video, tmp_path / "o.mp4")
    middle = chairs.tracks.xyxy[1].reshape(2, 2).mean(0)
    x, y = np.round(middle).astype(int)
    inside = picture[y - 40 : y + 40, x - 60 : x + 60].astype(int)
    assert np.abs(inside - 127).max() > 60  # the ellipse lies in its box


def test_a_loaded_result_is_drawn_identically(chairs: rt.Result, tmp_path: Path) -> None:
    dataclasses.replace(chairs).save(tmp_path / "out")
    pictures, _ = solid_pixels(rt.Result.load(tmp_path / "out"), tmp_path, 1)
    assert np.abs(pictures[0].astype(int) - 127).max() > 60


def test_frames_without_a_pose_have_boxes_only(tmp_path: Path) -> None:
    poses = walk(8)
    poses.cam_from_world[0] = np.nan
    result = fitted(tracks_of(poses), poses)
    pictures, _ = solid_pixels(result, tmp_path, 2)
    assert np.abs(pictures[0].astype(int) - 127).max() < 8
    assert np.abs(pictures[1].astype(int) - 127).max() > 60


def moving_rows(count: int, step: int = 6) -> rt.Tracks:
    """One object that moves to the right, in every frame."""
    left = 20 + step * np.arange(count)
    one = np.ones(count, np.int64)
    boxes = np.column_stack([left, one * 100, left + 20, one * 120]).astype(float)
    return rt.Tracks(np.arange(count), one, one, boxes, one * 0.9, one * 0, one * 0)


def test_trails_show_the_last_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reobj.results.overlay.film_fps", lambda _: 30.0)
    count, video = 45, rt.Video(frames(tmp_path / "f", 45, (320, 240)))
    result = rt.Result(moving_rows(count), (), VideoInfo("f", 320, 240, 30.0))
    plain, _ = overlay_of(result, video, tmp_path / "a.mp4", "boxes")
    trails, _ = overlay_of(result, video, tmp_path / "b.mp4", "boxes,trails")
    added = np.abs(trails[-1].astype(int) - plain[-1]).max(2) > 60
    y, x = np.nonzero(added)
    assert abs(y.mean() - 110) < 2  # through the middle of the boxes
    assert x.max() < 300 and x.min() == pytest.approx(30 + 6 * (44 - 30), abs=4)


def test_the_legend_is_shown_first(
    chairs: rt.Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate = 4.0
    monkeypatch.setattr("reobj.results.overlay.film_fps", lambda _: rate)
    video = rt.Video(frames(tmp_path / "f", 12, SIZE))
    overlay = Overlay(chairs, tmp_path / "o.mp4", video)
    for frame in video:
        overlay.take(frame)
    overlay.close(True)
    pictures, _ = decoded(overlay.path)
    panel = [picture[-60:-10, 8:20].astype(int).mean() < 90 for picture in pictures]
    shown = int(2 * rate)  # 2 s
    assert panel == [True] * shown + [False] * (12 - shown) and shown >= rate


def test_the_legend_lists_the_drawn_elements(chairs: rt.Result, tmp_path: Path) -> None:
    """And no others: no gaps, no 3D, no trails."""
    video = rt.Video(frames(tmp_path / "f", 1, SIZE))

    def kinds(result: rt.Result, layers: str) -> list[str]:
        overlay = Overlay(result, tmp_path / "o.mp4", video, layers)
        overlay.close(False)
        return [kind for kind, _ in overlay.legend]

    assert kinds(chairs, "solids") == ["box", "solid", "thin"]
    assert kinds(chairs, "boxes") == ["box"]
    flat = dataclasses.replace(chairs, poses=None, fits=None)
    flat = dataclasses.replace(
        flat, objects=[dataclasses.replace(o, status="tracked") for o in chairs.objects]
    )
    assert kinds(flat, "solids,trails") == ["box", "trail"]
    gap = dataclasses.replace(chairs.tracks, score=chairs.tracks.score * 0)
    assert kinds(dataclasses.replace(flat, tracks=gap), "boxes") == ["box", "dashed"]
    image = grey(400, 200)
    draw_legend(image, [("box", "a"), ("dashed", "b"), ("solid", "c"), ("thin", "d")])
    assert (image[-10:, 200:] == 127).all() and (image[:100] == 127).all()
    assert (image[110:190, 10:40].max(2) > 150).any()


# ---- Exact positions ----


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_edges_lie_on_two_adjacent_faces(kind: str) -> None:
    """And the centre is inside of all faces."""
    center = (0.2, 0.1, 4.0)
    frames, _ = one_solid(kind, center, (0.2, 0.5, 0.9))
    ends = frames.points[frames.edges]  # (E, 2, 3)
    planes = frames.planes[frames.faces]  # (E, 2, 4)
    off = np.einsum("efk,epk->efp", planes[..., :3], ends) - planes[..., 3:]
    np.testing.assert_allclose(off, 0, atol=1e-9)
    assert (frames.planes[:, :3] @ np.array(center) < frames.planes[:, 3]).all()
    assert len(np.unique(np.sort(frames.edges, 1), axis=0)) == len(frames.edges)
    assert (frames.faces[:, 0] != frames.faces[:, 1]).all()
    assert len(frames.edges) == {"box": 12, "cylinder": 144}[kind]
    assert frames.crease.sum() == {"box": 12, "cylinder": 96}[kind]


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_lines_are_centred_on_the_edges(scale: float) -> None:
    """To a tenth of a pixel, also in smaller pictures: the front face of a box straight ahead."""
    frames, _ = one_solid("box", (0.1, -0.05, 4.0), (0.3, 0.2, 0.5), np.eye(3))
    image = np.zeros((120, 200, 3), np.uint8)
    draw_wireframes(image, frames, PINHOLE, STILL, scale, [1], np.ones(1, bool), set())
    weight = image.astype(float).sum(2)
    left, right = (scale * (100 + 300 * (0.1 + side * 0.3) / 3.5) for side in (-1, 1))
    top, bottom = (scale * (60 + 300 * (-0.05 + side * 0.2) / 3.5) for side in (-1, 1))
    row, column = round(scale * (60 - 300 * 0.05 / 3.5)), round(scale * (100 + 300 * 0.1 / 3.5))
    for values, edges in ((weight[row], (left, right)), (weight[:, column], (top, bottom))):
        middle = len(values[values > 0]) and round(sum(edges) / 2)
        for part, edge in ((slice(None, middle), edges[0]), (slice(middle, None), edges[1])):
            at = np.arange(len(values))[part] + 0.5
            assert (at @ values[part]) / values[part].sum() == pytest.approx(edge, abs=0.1)


def test_no_edge_in_view_draws_nothing() -> None:
    """No solid with edges, one behind the camera, one that the camera is in the middle of."""
    solids = chair_solids()
    for kinds, pose in (
        ([None] * 3, STILL),
        (["box"] * 3, np.c_[np.diag([-1.0, 1, -1]), [0, 0, -9.0]]),
    ):
        image = grey()
        frames = wireframes(solids, kinds)
        draw_wireframes(image, frames, PINHOLE, pose, 1.0, [1, 2, 3], np.ones(3, bool), {1, 2, 3})
        assert (image == 127).all()
    empty = wireframes(solids[np.zeros(3, bool)], [])
    draw_wireframes(grey(), empty, PINHOLE, STILL, 1.0, [], np.ones(0, bool), set())


def test_thin_lines_are_thinner() -> None:
    """In the legend, and for boxes of objects with a drawn 3D shape."""

    def ink(image: np.ndarray) -> int:
        return int((np.abs(image.astype(int) - object_color(1)).max(2) < 90).sum())

    pictures = [grey(300, 60) for _ in range(4)]
    draw_legend(pictures[0], [("thin", "")])
    draw_legend(pictures[1], [("solid", "")])
    row = one_row((40, 10, 160, 50), 1)
    draw_tracks(pictures[2], row, {1: ""}, 1.0, thin=frozenset({1}))
    draw_tracks(pictures[3], row, {1: ""}, 1.0, thin=frozenset({2}))
    assert 0 < 1.4 * ink(pictures[0]) < ink(pictures[1])
    assert 0 < 1.4 * ink(pictures[2]) < ink(pictures[3])


def test_long_class_names_are_cut(chairs: rt.Result, tmp_path: Path) -> None:
    result = dataclasses.replace(chairs)
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(o, class_name="b" * 5000) for o in chairs.objects]
    )
    overlay = Overlay(result, tmp_path / "o.mp4", rt.Video(frames(tmp_path / "f", 1, SIZE)))
    overlay.close(False)
    assert overlay.labels[1] == f"1 {'b' * 21}..."
    image = grey()
    draw_tracks(image, one_row((60, 30, 90, 50), 1), overlay.labels, 1.0)
    x1, y1, x2, y2 = drawn_in(image, object_color(1))
    assert x1 >= 0 and y1 >= 0 and x2 <= 200 and y2 <= 120


def test_labels_are_beside_their_boxes() -> None:
    """Above, with the same left edge, where there is room; else at most four heights away."""
    box, size = np.array([[100, 80, 160, 140]]), np.array([[50, 17]])
    assert place_labels([1], size, box, (320, 240), {}) == [(100, 63)]
    at_top = np.array([[100, 5, 160, 140]])
    assert place_labels([1], size, at_top, (320, 240), {}) == [(100, 0)]
    crowd = place_labels(range(9), np.tile(size, (9, 1)), np.tile(box, (9, 1)), (320, 240), {})
    for x, y in (spot for spot in crowd if spot):
        assert 100 - 50 - 68 <= x <= 160 + 68 and 80 - 17 - 68 <= y <= 140 + 68


# ---- Changes since a map ----

MOVED, NEW, GONE, WAS = (CHANGE_COLORS[kind] for kind in ("moved", "new", "gone", "was"))


def changed(chairs: rt.Result, support: str = "box") -> rt.Result:
    """Chair 1 stayed, 2 moved, 3 is new; lamp 9 stood behind them and is gone."""
    lamp = Shape(support, np.array([0.2, 0.3, 0.5]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))
    one, two, three = (o.center for o in chairs.objects)
    changes = Changes(
        "flat.map", "tuesday",
        stayed=(Change(1, "chair", one, one, 0.0, 0.02),),
        moved=(Change(2, "chair", two + 0.4, two, 0.693, 0.02),),
        new=(Change(3, "chair", None, three),),
        gone=(Change(9, "lamp", np.array([0.2, 1.2, 0.5]), None, before_shape=lamp),
              Change(8, "cup", np.array([0.2, 1.2, 0.5]))),  # without a shape: not drawn
    )  # fmt: skip
    return dataclasses.replace(chairs, changes=changes)


def test_the_recording_that_made_the_map_has_no_new_objects(
    chairs: rt.Result, tmp_path: Path
) -> None:
    """All of them are: they keep the colours of their identities."""
    new = tuple(Change(o.id, "chair", None, o.center) for o in chairs.objects)
    result = dataclasses.replace(chairs, changes=Changes("flat.map", "monday", new=new))
    overlay = Overlay(result, tmp_path / "o.mp4", rt.Video(frames(tmp_path / "f", 1, SIZE)))
    overlay.close(False)
    assert overlay.labels == {1: "1 chair", 2: "2 chair", 3: "3 chair"} and overlay.marks == {}
    assert [kind for kind, _ in overlay.legend] == ["box", "solid", "thin"]


def near(image: np.ndarray, color: tuple[int, int, int], spread: int = 70) -> np.ndarray:
    """Pixels of about a colour: the video is compressed."""
    return (np.abs(image.astype(int) - color) <= spread).all(-1)


def test_labels_name_the_change(chairs: rt.Result, tmp_path: Path) -> None:
    video = rt.Video(frames(tmp_path / "f", 1, SIZE))
    result = changed(chairs)
    overlay = Overlay(result, tmp_path / "o.mp4", video)
    overlay.close(False)
    assert overlay.labels == {
        1: "1 chair", 2: "2 chair, moved 0.69 m", -2: "2 chair, was here", 3: "3 chair, new",
        -8: "8 cup, gone", -9: "9 lamp, gone",
    }  # fmt: skip
    assert overlay.marks == {2: MOVED, -2: WAS, 3: NEW, -8: GONE, -9: GONE}
    assert [kind for kind, _ in overlay.legend] == ["box", "solid", "thin", "moved", "new", "gone"]
    boxes = Overlay(result, tmp_path / "o.mp4", video, "boxes")
    boxes.close(False)
    assert [kind for kind, _ in boxes.legend] == ["box", "moved", "new"] and boxes.former == {}
    unscaled = dataclasses.replace(result.changes.moved[0], distance_m=None)
    assert change_label("moved", unscaled) == ", moved" and change_label("stayed", unscaled) == ""


def test_changed_objects_have_a_second_outline() -> None:
    """Around the box, in the colour of the change; the label has this colour too."""
    image = grey(300, 200)
    row = one_row((60, 60, 160, 150))
    draw_tracks(image, row, {3: "3 chair"}, 1.0, marks={3: MOVED})
    columns = np.flatnonzero(near(image[100], MOVED, 90))
    np.testing.assert_allclose(columns[[0, -1]], [56, 164], atol=1.5)
    columns = np.flatnonzero(near(image[100], object_color(3), 60))
    np.testing.assert_allclose(columns[[0, -1]], [60, 160], atol=1.5)
    assert near(image[40:60, 60:110], MOVED, 5).mean() > 0.4
    plain = grey(300, 200)
    draw_tracks(plain, row, {3: "3 chair"}, 1.0, marks={4: MOVED})
    assert not near(plain, MOVED, 5).any()


@pytest.mark.parametrize("support", ["box", "cylinder", "ellipsoid"])
def test_gone_objects_have_a_dashed_outline_with_a_label(
    chairs: rt.Result, tmp_path: Path, support: str
) -> None:
    """Its bounds are those of the projected solid; chairs are not drawn here."""
    result = changed(chairs, support)
    lamp = result.changes.gone[0]
    axes = Rotation.from_quat(lamp.before_shape.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    solid = quadrics.Ellipsoids(lamp.before[None], lamp.before_shape.half_axes[None], axes[None])
    poses = walk()
    true = quadrics.solid_boxes(solid, support, poses.camera.K @ poses.cam_from_world[:1])[0, 0]
    bare = dataclasses.replace(result, objects=[], fits=None, tracks=rt.Tracks.empty())
    overlay = Overlay(bare, tmp_path / "o.mp4", rt.Video(frames(tmp_path / "f", 1, SIZE)))
    overlay.close(False)
    image = grey(*SIZE)
    bounds = overlay._draw_former(image, 0)
    assert list(bounds) == [-9]
    found = drawn_in(image, GONE, 25)
    np.testing.assert_allclose(found, true, atol=2.5)
    np.testing.assert_allclose(bounds[-9], true, atol=1.5)
    gaps = np.abs(image[round(true[1]) : round(true[3])].astype(int) - 127).max(2) > 40
    assert 0.2 < gaps.any(1).mean()
    # dashes of 6 px with round ends of 1 px, and gaps of 6 px: two thirds of the outline
    hull = outline_of(poses.camera, poses.cam_from_world[0], _former_surface(lamp))
    solid_line = grey(*SIZE)
    cv2.polylines(solid_line, [hull.round().astype(np.int32)], True, GONE, 2, cv2.LINE_AA)
    share = (image != 127).any(2).sum() / (solid_line != 127).any(2).sum()
    assert 0.35 < share < 0.85
    draw_tracks(image, rt.Tracks.empty(), overlay.labels, 1.0, marks=overlay.marks, former=bounds)
    x1, y1, *_ = bounds[-9]
    assert near(image[y1 - 17 : y1, x1 : x1 + 60], GONE, 5).mean() > 0.5


def test_gone_objects_are_in_the_video(chairs: rt.Result, tmp_path: Path) -> None:
    """And not in one of a run without a map, nor in components that were not placed in it."""
    result = dataclasses.replace(changed(chairs), objects=[], fits=None)
    for name in "abc":
        (tmp_path / name).mkdir()
    with_gone, _ = solid_pixels(result, tmp_path / "a", 1)
    elsewhere = dataclasses.replace(result.changes, components=(1,))
    others = [
        solid_pixels(dataclasses.replace(result, changes=changes), tmp_path / name, 1)[0][0]
        for name, changes in (("b", None), ("c", elsewhere))
    ]
    assert near(with_gone[0], GONE, 40).sum() > 300  # with the label
    assert [near(picture, GONE, 40).sum() for picture in others] == [0, 0]


def test_marks_are_in_the_video(chairs: rt.Result, tmp_path: Path) -> None:
    video = rt.Video(frames(tmp_path / "f", 1, SIZE))
    (marked,), _ = overlay_of(changed(chairs), video, tmp_path / "a.mp4")
    (plain,), _ = overlay_of(chairs, video, tmp_path / "b.mp4")
    for color in (MOVED, NEW):
        assert near(marked, color, 40).sum() > 300 > 10 * near(plain, color, 40).sum()


def test_gone_objects_are_shifted_with_their_world(chairs: rt.Result, tmp_path: Path) -> None:
    """A world far from its origin: the outline is at the same pixels."""
    shift = np.array([5e5, 4e6, 100.0])
    near_origin = changed(chairs)
    cams = chairs.poses.cam_from_world.copy()
    cams[:, :, 3] -= cams[:, :, :3] @ shift
    (lamp, _) = near_origin.changes.gone
    moved_lamp = dataclasses.replace(lamp, before=lamp.before + shift)
    far = dataclasses.replace(
        near_origin,
        objects=[dataclasses.replace(o, center=o.center + shift) for o in chairs.objects],
        poses=dataclasses.replace(chairs.poses, cam_from_world=cams),
        changes=Changes("flat.map", "tuesday", gone=(moved_lamp,)),
        fits=None,
    )
    video = rt.Video(frames(tmp_path / "f", 1, SIZE))
    bounds = []
    for result in (near_origin, far):
        overlay = Overlay(result, tmp_path / "o.mp4", video)
        overlay.close(False)
        places, pose = overlay.former[0]
        assert np.abs(places.surface[9]).max() < 100
        bounds.append(places.outlines(pose)[9])
    np.testing.assert_allclose(bounds[1].max(0), bounds[0].max(0), atol=1e-3)
    np.testing.assert_allclose(bounds[1].min(0), bounds[0].min(0), atol=1e-3)


def test_moved_objects_have_an_outline_at_their_former_place(
    chairs: rt.Result, tmp_path: Path
) -> None:
    """Dashed, with a label, where that place is; not for an object that is not in the result."""
    result = changed(chairs)
    (move,) = result.changes.moved
    lamp = result.changes.gone[0].before_shape
    move = dataclasses.replace(move, before_shape=lamp)
    lost = dataclasses.replace(move, id=7)  # with the low-confidence objects, for example
    changes = dataclasses.replace(result.changes, moved=(move, lost), gone=())
    moved = dataclasses.replace(result, changes=changes)
    overlay = Overlay(moved, tmp_path / "o.mp4", rt.Video(frames(tmp_path / "f", 1, SIZE)))
    overlay.close(False)
    image = grey(*SIZE)
    assert list(overlay._draw_former(image, 0)) == [-2]
    axes = Rotation.from_quat(lamp.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    solid = quadrics.Ellipsoids(move.before[None], lamp.half_axes[None], axes[None])
    poses = walk()
    true = quadrics.solid_boxes(solid, "box", poses.camera.K @ poses.cam_from_world[:1])[0, 0]
    np.testing.assert_allclose(drawn_in(image, WAS, 25), true, atol=2.5)
    assert [kind for kind, _ in overlay.legend][-3:] == ["moved", "new", "was"]


@pytest.mark.parametrize(
    ("center", "half_axes", "shown"),
    [
        ((0.0, 0.0, 2.0), (0.5, 0.5, 0.5), False),  # between the camera and the place
        ((0.0, 0.0, 6.0), (0.5, 0.5, 0.5), True),  # behind it
        ((0.0, 0.0, 3.5), (0.7, 0.7, 0.7), True),  # around its centre
        ((0.6, 0.0, 2.0), (0.5, 0.5, 0.5), True),  # beside the ray
        ((0.6, 0.0, 2.0), (0.7, 0.2, 0.2), False),  # long in the direction of the ray
        ((0.0, 0.0, -2.0), (0.5, 0.5, 0.5), True),  # behind the camera
        ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), True),  # around the camera
    ],
)
def test_a_nearer_object_hides_a_former_place(
    center: tuple[float, ...], half_axes: tuple[float, ...], shown: bool
) -> None:
    place = np.array([0, 0, 4.0])
    cube = surface_points("box") * 0.3 + place
    turned = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    objects = quadrics.Ellipsoids(np.array([center]), np.array([half_axes]), turned[None])
    places = FormerPlaces({5: cube}, {5: place}, objects, PINHOLE)
    assert list(places.outlines(STILL)) == [5] * shown


def test_outlines_of_objects_out_of_view_are_not_drawn() -> None:
    points = surface_points("box") * 0.3
    assert outline_of(PINHOLE, STILL, points + np.array([0, 0, 4.0])) is not None
    for center in ([0, 0, -4.0], [0, 0, 0.1], [3.0, 0, 4.0]):
        assert outline_of(PINHOLE, STILL, points + center) is None, center


def test_the_legend_shows_the_colours_of_changes() -> None:
    image = grey(300, 100)
    draw_legend(image, [("moved", "a"), ("new", "b"), ("gone", "c"), ("was", "d")])
    rows = [image[10 + 20 * k : 30 + 20 * k, 8:40] for k in range(4)]
    for row, color in zip(rows, (MOVED, NEW, GONE, WAS), strict=True):
        assert [near(r, color, 30).any() for r in rows] == [r is row for r in rows]
