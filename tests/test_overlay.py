"""The overlay video: position, scale and identity of everything drawn."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import SIZE, chair_solids, walk

import quadrics
import reobj_track as rt
from reobj.results.changes import Change, Changes, Shape
from reobj.types import box_iou, object_color
from reobj.viewer.overlay import (
    CHANGE_COLORS,
    Overlay,
    draw_legend,
    draw_tracks,
    draw_wireframes,
    outline_of,
    place_labels,
    surface_points,
    wireframes,
)


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


# ---- Shapes in 3D ----

CAMERA = np.array([[300.0, 0, 100], [0, 300, 60], [0, 0, 1]]) @ np.eye(3, 4)
TILTED = Rotation.from_euler("zyx", [50, 30, 10], degrees=True).as_matrix()


def one_solid(kind: str, center: tuple[float, ...], half: tuple[float, ...], turn=TILTED):
    """A solid, its bounds by the geometry's own projection, and its edges."""
    solid = quadrics.Ellipsoids(np.array([center]), np.array([half]), np.array([turn]))
    bounds = quadrics.solid_boxes(solid, kind, CAMERA[None])[0, 0]
    return wireframes(solid, [kind]), bounds


PINHOLE = rt.Camera("PINHOLE", 200, 120, (300.0, 300.0, 100.0, 60.0))
STILL = np.eye(3, 4)


@pytest.mark.parametrize("kind", ["box", "cylinder", "ellipsoid"])
@pytest.mark.parametrize("turn", [TILTED, np.eye(3), TILTED.T])
def test_edges_and_outlines_span_the_projection(kind: str, turn: np.ndarray) -> None:
    place, half = np.array([0.2, 0.1, 4.0]), np.array([0.2, 0.5, 0.9])
    frames, bounds = one_solid(kind, tuple(place), tuple(half), turn)
    outline = outline_of(PINHOLE, STILL, surface_points(place, half, turn, kind))
    for pixels in (outline, PINHOLE.project(frames.segments(STILL)[0]).reshape(-1, 2)):
        if len(pixels):
            found = [*pixels.min(0), *pixels.max(0)]
            np.testing.assert_allclose(found, bounds, atol=1e-4 if kind == "box" else 0.5)
    assert len(frames.ends) == {"box": 12, "cylinder": 144, "ellipsoid": 0}[kind]
    assert frames.crease.sum() == {"box": 12, "cylinder": 96, "ellipsoid": 0}[kind]
    assert outline_of(PINHOLE, STILL, surface_points(-place, half, turn, kind)) is None


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
    whole = frames.ends[edge]
    across = np.cross(ends[:, :1] - whole[:, :1], whole[:, 1:] - whole[:, :1])
    np.testing.assert_allclose(across, 0, atol=1e-9)
    behind, _ = one_solid("box", (0.0, 0.0, -4.0), (0.5, 0.5, 0.5))
    assert len(behind.segments(STILL)[0]) == 0


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
    beside, _ = one_solid("box", (0.6, 0.0, 0.3), (0.5, 0.5, 0.5), np.eye(3))
    assert (drawn(beside, {1}) == 127).all()  # its outline would run through the whole picture


def test_edges_beyond_the_fold_of_the_lens_are_not_drawn() -> None:
    """A plank from the image to far beside it: its lines end where the lens shows no more, to 1/8.

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
    ends = frames.ends
    line = ends.mean(1, keepdims=True) + steps[:, None] * np.diff(ends, axis=1) / 2
    shown = lens.project(line).reshape(-1, 2)
    shown = shown[np.isfinite(shown).all(1)] - 0.5
    gap = np.linalg.norm(np.c_[x, y][:, None] - shown[::7], axis=2).min(1)
    assert gap.max() < 3
    assert x.max() > 100 and x.min() < 60


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


# ---- Labels, legend ----


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


def test_labels_never_cover_small_objects() -> None:
    """Cups side by side: labels lie around the group, with lines to their cups."""
    boxes = np.array([[x, y, x + 24, y + 24] for y in (90, 118) for x in (100, 128, 156)])
    sizes = np.array([[60, 17]] * 6)
    spots = place_labels(range(6), sizes, boxes, (320, 240), {})
    labels = np.array([(x, y, x + 60, y + 17) for x, y in filter(None, spots)], float)
    assert len(labels) == 6 and box_iou(labels, boxes.astype(float)).max() == 0
    gap = np.maximum(boxes[:, :2] - labels[:, 2:], labels[:, :2] - boxes[:, 2:]).max(1)
    (away,) = np.nonzero(gap > 2)
    assert len(away)


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


def overlay_of(result: rt.Result, video: rt.Video, path: Path) -> tuple[list[np.ndarray], float]:
    """Frames of the overlay without its legend, and its rate."""
    overlay = Overlay(result, path, video)
    overlay.legend = []
    for frame in video:
        overlay.take(frame)
    overlay.close(True)
    return decoded(path)


def solid_pixels(result: rt.Result, folder: Path, count: int) -> tuple[list[np.ndarray], rt.Result]:
    """Frames with the 3D shapes alone: boxes and labels are removed."""
    bare = dataclasses.replace(result, tracks=rt.Tracks.empty())
    video = rt.Video(frames(folder / "f", count, SIZE))
    return overlay_of(bare, video, folder / "o.mp4")[0], bare


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_shapes_are_drawn_at_the_objects(chairs: rt.Result, tmp_path: Path, kind: str) -> None:
    """The first object is rejected: the others keep their positions and colours."""
    objects = [dataclasses.replace(o, support=kind) for o in chairs.objects]
    objects[0] = dataclasses.replace(objects[0], status="rejected")
    result = dataclasses.replace(chairs, objects=objects)
    pictures, _ = solid_pixels(result, tmp_path, 2)
    poses = walk()
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


def test_the_legend_lists_the_drawn_elements(chairs: rt.Result, tmp_path: Path) -> None:
    video = rt.Video(frames(tmp_path / "f", 1, SIZE))

    def kinds(result: rt.Result) -> list[str]:
        overlay = Overlay(result, tmp_path / "o.mp4", video)
        overlay.close(False)
        return [kind for kind, _ in overlay.legend]

    assert kinds(chairs) == ["box", "solid", "thin"]
    flat = dataclasses.replace(chairs, poses=None, fits=None, objects=[])
    gap = dataclasses.replace(chairs.tracks, score=chairs.tracks.score * 0)
    assert kinds(dataclasses.replace(flat, tracks=gap)) == ["box", "dashed"]
    new = tuple(Change(o.id, "chair", None, o.center) for o in chairs.objects)
    made = dataclasses.replace(chairs, changes=Changes("flat.map", "monday", new=new))
    assert kinds(made) == ["box", "solid", "thin"]  # in the map that it made all are new
    image = grey(400, 200)
    draw_legend(image, [("box", "a"), ("new", "b"), ("gone", "c"), ("thin", "d")])
    assert (image[-10:, 200:] == 127).all() and (image[:100] == 127).all()
    rows = [image[110 + 20 * k : 130 + 20 * k, 8:40] for k in range(4)]
    assert [near(row, NEW, 30).any() for row in rows] == [False, True, False, False]
    assert [near(row, GONE, 30).any() for row in rows] == [False, False, True, False]


# ---- Exact positions ----


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
        -8: "8 cup, gone", -9: "9 lamp, gone", -3: "3 chair, was here",
    }  # fmt: skip
    assert {2: MOVED, -2: WAS, 3: NEW, -8: GONE, -9: GONE}.items() <= overlay.marks.items()
    assert [kind for kind, _ in overlay.legend] == ["box", "solid", "thin", "moved", "new", "gone"]


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


def former_of(result: rt.Result, folder: Path) -> tuple[np.ndarray, dict[int, np.ndarray], Overlay]:
    """A grey image with the outlines of former places in frame 0, and their bounds."""
    overlay = Overlay(result, folder / "o.mp4", rt.Video(frames(folder / "f", 1, SIZE)))
    overlay.close(False)
    image = grey(*SIZE)
    return image, overlay._draw_former(image, *overlay.cameras[0]), overlay


def box_of(place: np.ndarray, shape: Shape) -> np.ndarray:
    """The box of a shape in frame 0 of the walk."""
    axes = Rotation.from_quat(shape.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    solid = quadrics.Ellipsoids(place[None], shape.half_axes[None], axes[None])
    cams = walk().camera.K @ walk().cam_from_world[:1]
    return quadrics.solid_boxes(solid, shape.support, cams)[0, 0]


@pytest.mark.parametrize("support", ["box", "cylinder", "ellipsoid"])
def test_gone_objects_have_a_dashed_outline_with_a_label(
    chairs: rt.Result, tmp_path: Path, support: str
) -> None:
    """Its bounds are those of the projected solid; chairs are not drawn here."""
    result = changed(chairs, support)
    lamp = result.changes.gone[0]
    true = box_of(lamp.before, lamp.before_shape)
    image, bounds, overlay = former_of(result, tmp_path)
    assert list(bounds) == [-9]
    np.testing.assert_allclose(drawn_in(image, GONE, 25), true, atol=2.5)
    np.testing.assert_allclose(bounds[-9], true, atol=1.5)
    x1, y1, *_ = bounds[-9]
    component, pose = overlay.cameras[0]
    outline = outline_of(component.poses.camera, pose, component.former[9])  # (n, 2)
    whole = grey(*SIZE)
    cv2.polylines(whole, [outline.round().astype(np.int32)], True, GONE, 2, cv2.LINE_AA)
    share = (image != 127).any(2).sum() / (whole != 127).any(2).sum()
    assert 0.35 < share < 0.85  # dashes of 6 px with round ends, and gaps of 6 px
    draw_tracks(image, rt.Tracks.empty(), overlay.labels, 1.0, marks=overlay.marks, former=bounds)
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
    bounds = []
    for k, result in enumerate((near_origin, far)):
        (tmp_path / str(k)).mkdir()
        _, found, overlay = former_of(result, tmp_path / str(k))
        assert np.abs(overlay.cameras[0][0].former[9]).max() < 100
        bounds.append(found[-9])
    np.testing.assert_array_equal(*bounds)


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
    image, bounds, overlay = former_of(moved, tmp_path)
    assert list(bounds) == [-2]
    np.testing.assert_allclose(drawn_in(image, WAS, 25), box_of(move.before, lamp), atol=2.5)
    assert [kind for kind, _ in overlay.legend][-3:] == ["moved", "new", "was"]
