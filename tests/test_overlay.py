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


def test_filled_gaps_are_dashed() -> None:
    row = one_row((40, 30, 160, 110))
    edges = []
    for score in (0.9, 0.0):
        image = grey()
        draw_tracks(image, dataclasses.replace(row, score=np.array([score])), {3: ""}, 1.0, {})
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
    draw_tracks(image, row, {3: "3 chair"}, 1.0, {}, marks={3: MOVED})
    columns = np.flatnonzero(near(image[100], MOVED, 90))
    np.testing.assert_allclose(columns[[0, -1]], [56, 164], atol=1.5)
    columns = np.flatnonzero(near(image[100], object_color(3), 60))
    np.testing.assert_allclose(columns[[0, -1]], [60, 160], atol=1.5)
    assert near(image[40:60, 60:110], MOVED, 5).mean() > 0.4
    plain = grey(300, 200)
    draw_tracks(plain, row, {3: "3 chair"}, 1.0, {}, marks={4: MOVED})
    assert not near(plain, MOVED, 5).any()


def former_of(result: rt.Result, folder: Path) -> tuple[np.ndarray, dict[int, np.ndarray], Overlay]:
    """A grey image with the outlines of former places in frame 0, and their bounds."""
    overlay = Overlay(result, folder / "o.mp4", rt.Video(frames(folder / "f", 1, SIZE)))
    overlay.close(False)
    image = grey(*SIZE)
    return image, overlay._draw_outlines(image, *overlay.cameras[0], set()), overlay


def box_of(place: np.ndarray, shape: Shape) -> np.ndarray:
    """The box of a shape in frame 0 of the walk."""
    axes = Rotation.from_quat(shape.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    solid = quadrics.Ellipsoids(place[None], shape.half_axes[None], axes[None])
    cams = walk().camera.K @ walk().cam_from_world[:1]
    return quadrics.solid_boxes(solid, shape.support, cams)[0, 0]


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
