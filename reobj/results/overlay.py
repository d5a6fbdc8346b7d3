"""Overlay video: boxes, identities and projected solids drawn over every frame.

`write_pictures` in scene.py reads the video and passes each frame to `Overlay`; `film` encodes the
drawn frames.
"""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Camera
from reobj.files import cut
from reobj.results.changes import Change
from reobj.results.export_source import centred
from reobj.results.film import FilmWriter
from reobj.results.ply import CYLINDER_SIDES as SIDES
from reobj.results.result import Result
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video
from reobj.types import Array, BoolArray, Frame, Image, IntArray, ReobjError, Tracks, object_color

Color = tuple[int, int, int]


def film_layers(text: str) -> frozenset[str]:
    """Parse the layers of the overlay video; empty: no video.

    >>> sorted(film_layers("solids, trails"))
    ['boxes', 'solids', 'trails']
    """
    layers = ("boxes", "solids", "ellipses", "trails")
    words = {word.strip().lower() for word in str(text).split(",")}
    if len(words) == 1 and words <= {"none", "false", "no", "off", "0", ""}:
        return frozenset()
    words = {"solids" if word in ("true", "yes", "on", "1") else word for word in words}
    if unknown := sorted(words - set(layers)):
        close = difflib.get_close_matches(unknown[0], (*layers, "none"), 1, 0)[0]
        expected = f"{', '.join(layers)} (several with commas) or none; did you mean {close}?"
        raise ReobjError(f"--set output.overlay={text}: expected {expected}")
    return frozenset(words | {"boxes"})


# ---- Boxes and labels --------------------------------------------------------------------------

FONT = cv2.FONT_HERSHEY_SIMPLEX
SMALL_AREA = 4  # relative to that of a label: a label would cover a quarter of the box or more
DIRECTIONS = np.array([[0, -1], [0, 1], [1, 0], [-1, 0], [1, -1], [-1, -1], [1, 1], [-1, 1]])


def _width_of(image: Image) -> int:
    """Return the width of a thin line, px: large frames are shown shrunk to some 1280 px."""
    return max(1, int(max(image.shape)) // 1280)


def draw_tracks(
    image: Image,
    tracks: Tracks,
    labels: dict[int, str],
    scale: float,
    positions: dict[int, int] | None = None,
    thin: frozenset[int] = frozenset(),
    marks: Mapping[int, Color] | None = None,
    former: Mapping[int, IntArray] | None = None,
) -> None:
    """Draw the boxes and identities of one frame's rows, in place; interpolated boxes are dashed.

    Labels overlap neither each other nor small boxes; one without free space at its box gets a
    line to it, one without any is left out.

    Args:
        labels: text of each identity; scale: image pixels per pixel of the tracks.
        positions: index of the position of each identity's label in the previous frame, updated
            here, so that labels jump less.
        thin: identities whose solid is drawn too.
        marks: colours of the labels of changed objects, and of a second outline of their boxes.
        former: bounds (4,) of the outlines of former places, pixels of the image, by the number of
            the object, negative: they get the label and the colour of this number.
    """
    marks = marks or {}
    former = former or {}
    boxes = (tracks.xyxy * scale).round().astype(int)  # (N, 4)
    ids = tracks.track_id.tolist()
    scores = tracks.score.tolist()
    for obj, box, score in zip(ids, boxes, scores, strict=True):
        _draw_box(image, box, object_color(obj), 1 if obj in thin else 2, dashed=score == 0)
        if obj in marks:  # 1 px between both outlines
            margin = 4 * _width_of(image) * np.array([-1, -1, 1, 1])
            _draw_box(image, box + margin, marks[obj], 2, dashed=False)
    ids = [*ids, *former]
    boxes = np.array([*boxes, *former.values()], int).reshape(-1, 4)
    positions = {} if positions is None else positions
    texts = [labels.get(obj, str(obj)) for obj in ids]
    sizes = np.array([_text_size(image, text) for text in texts], int).reshape(-1, 2)
    spots = place_labels(ids, sizes, boxes, (image.shape[1], image.shape[0]), positions)
    for obj, text, spot, size, box in zip(ids, texts, spots, sizes, boxes, strict=True):
        if spot is not None:
            color = marks.get(obj, object_color(obj))
            _draw_leader(image, np.array([*spot, *(spot + size)]), box, color)
            _draw_label(image, text, spot, color)


def _draw_box(image: Image, box: IntArray, color: Color, thickness: int, dashed: bool) -> None:
    x1, y1, x2, y2 = box.tolist()
    if not dashed:
        width = thickness * _width_of(image)
        cv2.rectangle(image, (x1, y1), (x2, y2), color, width, cv2.LINE_AA)
        return
    corners = np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])
    for side in itertools.pairwise(corners):
        _draw_dashes(image, np.array(side), color, thickness)


def _draw_dashes(image: Image, line: Array | IntArray, color: Color, thickness: int) -> None:
    """Draw a polyline (n, 2), pixels, with dashes and gaps of 6 px (small frames)."""
    length = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], length.cumsum()])  # (n,)
    width = _width_of(image)
    steps = max(1, int(along[-1] / (6 * width)))
    at = np.linspace(0, along[-1], steps + 1)
    points = np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])
    points = points.round().astype(np.int32)  # (steps + 1, 2)
    dashes = [points[i : i + 2] for i in range(0, steps, 2)]
    cv2.polylines(image, dashes, False, color, thickness * width, cv2.LINE_AA)


def _text_size(image: Image, text: str) -> tuple[int, int]:
    """Return the width and height of a label."""
    width = _width_of(image)
    (wide, high), base = cv2.getTextSize(text, FONT, 0.45 * width, width)
    return wide + 4 * width, high + base + 2 * width


def _draw_text(image: Image, text: str, left: int, bottom: int, color: Color) -> None:
    width = _width_of(image)
    scale = 0.45 * width  # readable in a frame of 640 px
    base = cv2.getTextSize(text, FONT, scale, width)[1]
    cv2.putText(image, text, (left, bottom - base), FONT, scale, color, width, cv2.LINE_AA)


def _draw_label(image: Image, text: str, spot: tuple[int, int], color: Color) -> None:
    """Draw text on a filled rectangle with its top-left corner at `spot`."""
    x, y = spot
    width, height = _text_size(image, text)
    cv2.rectangle(image, (x, y), (x + width - 1, y + height - 1), color, -1)
    ink = (0,) * 3 if sum(color) > 380 else (255,) * 3  # black on light colours
    _draw_text(image, text, x + 2 * _width_of(image), y + height, ink)


def place_labels(
    ids: Sequence[int],
    sizes: IntArray,
    boxes: IntArray,
    image_size: tuple[int, int],
    positions: dict[int, int],
) -> list[tuple[int, int] | None]:
    """Choose a position for each label near its box, inside the image.

    It is free of other labels and of small boxes: those of less than SMALL_AREA times its area.

    Args:
        sizes: (N, 2) of the labels, boxes: (N, 4), both pixels.
        positions: index of the last position of each identity's label; updated here.
    Returns:
        top-left corner of each label, None where no position is free.
    """
    taken = np.empty((0, 4), int)
    spots: list[tuple[int, int] | None] = []
    limit = np.array(image_size)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    for obj, size, box in zip(ids, sizes, boxes, strict=True):
        corners = _label_corners(box, size).clip(0, np.maximum(limit - size, 0))  # (P, 2)
        others = np.concatenate([taken, boxes[areas < SMALL_AREA * size.prod()]])
        free = (  # left of, above, right of or below all others
            (corners[:, None] >= others[:, 2:]) | (corners[:, None] + size <= others[:, :2])
        ).any(2).all(1)  # fmt: skip
        order = [positions.get(obj, 0), *range(len(corners))]
        position = next((k for k in order if free[k]), None)
        spots.append(None)
        if position is not None:
            positions[obj] = position
            x, y = corners[position].tolist()
            taken = np.concatenate([taken, [[x, y, *(corners[position] + size)]]])
            spots[-1] = (x, y)
    return spots


def _label_corners(box: IntArray, size: IntArray) -> IntArray:
    """List the top-left corners (38, 2) of a label at a box, and away from it, best first."""
    x1, y1, x2, y2 = box.tolist()
    w, h = size.tolist()
    xs = (x1, x2 - w, (x1 + x2 - w) // 2)
    beside = ((x1 - w, y1), (x2, y1))
    rows = [(x, y) for y in (y1 - h, y1 + 2, y2 - h - 1, y2) for x in xs]
    near = np.array([*rows[:6], *beside, *rows[6:]])
    middle = np.array([x1 + x2 - w, y1 + y2 - h]) / 2
    reach = np.array([x2 - x1 + w, y2 - y1 + h]) / 2  # from there on it does not cover the box
    away = [middle + DIRECTIONS * (reach + gap * h) for gap in (1, 2, 4)]
    return np.concatenate([near, np.concatenate(away).round().astype(int)])


def _draw_leader(image: Image, label: IntArray, box: IntArray, color: Color) -> None:
    """Draw a line from a label (4,) to its box (4,) if they do not touch."""
    nearest = box.reshape(2, 2).mean(0).clip(label[:2], label[2:])  # of the label
    end = nearest.clip(box[:2], box[2:])
    if np.abs(nearest - end).max() > 2:
        start, stop = (tuple(p.round().astype(int).tolist()) for p in (nearest, end))
        cv2.line(image, start, stop, color, _width_of(image), cv2.LINE_AA)


# ---- Ellipses ----------------------------------------------------------------------------------


def draw_ellipses(
    image: Image, dual_c: Array, drawn: BoolArray, object_id: Sequence[int], seen: set[int]
) -> None:
    """Draw the outlines of projected ellipsoids, in place.

    Args:
        dual_c: (O, 3, 3) dual conics in pixels of `image`. drawn: (O,) which ones to draw.
        object_id: (O,). seen: identities with a box in this frame; the others are drawn thin.
    """
    for conic, wanted, obj in zip(dual_c, drawn, object_id, strict=True):
        shape = ellipse_of_dual_conic(conic) if wanted else None
        if shape is not None and max(shape[1]) < _max_outline(image):
            width = _width_of(image) * (2 if obj in seen else 1)
            cv2.ellipse(image, shape, object_color(obj), width, cv2.LINE_AA)


def _max_outline(image: Image) -> int:
    """Return the extent from which outlines, of objects beside the camera, are not drawn, px."""
    return int(4 * max(image.shape))


def ellipse_of_dual_conic(
    dual_c: Array,
) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    """Convert a dual conic C* (3, 3) to an ellipse for cv2.ellipse; None for other conics.

    C* = [S - m m', -m; -m', -1] up to scale: m is the centre, the eigenvalues of S are the squared
    half axes.

    Returns:
        centre in OpenCV's pixels, full axes, angle of the first axis from x towards y, deg.
    """
    conic = dual_c / -dual_c[2, 2]
    center = -conic[:2, 2]
    values, vectors = np.linalg.eigh(conic[:2, :2] + np.outer(center, center))
    if not (np.isfinite(values).all() and values.min() > 0):
        return None
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    minor, major = 2 * np.sqrt(values)
    x, y = (center - 0.5).tolist()  # OpenCV draws with the pixel's centre at 0
    return (x, y), (float(major), float(minor)), angle


# ---- Boxes and cylinders in 3D -----------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Wireframes:
    """Edges of boxes and cylinders in world: S solids, P points, E edges, N faces.

    Attributes:
        points: (P, 3). edges: (E, 2) points. faces: (E, 2) the two faces that meet in each edge.
        crease: (E,) False between facets of a curved side: visible only on the outline.
        solid: (E,) number of the solid. planes: (N, 4) of the faces: n . x - d > 0 outside.
        min_depth: (E,) least depth at which it is drawn.
    """

    points: Array
    edges: IntArray
    faces: IntArray
    crease: BoolArray
    solid: IntArray
    planes: Array
    min_depth: Array

    def segments(self, cam_from_world: Array) -> tuple[Array, IntArray, BoolArray]:
        """Clip the edges to the front of one camera (3, 4).

        Returns:
            ends (n, 2, 3) in camera coordinates; their edges (n,); front (n,): False where the
            solid occludes its own edge.
        """
        turn = cam_from_world[:, :3]
        shift = cam_from_world[:, 3]
        eye = -turn.T @ shift
        outside = self.planes[:, :3] @ eye - self.planes[:, 3] > 0  # (N,) faces the camera
        facing = outside[self.faces]  # (E, 2)
        wanted = self.crease | (facing[:, 0] != facing[:, 1])  # (E,)
        ends = (self.points @ turn.T + shift)[self.edges]  # (E, 2, 3)
        wanted &= (ends[:, :, 2] > self.min_depth[:, None]).any(1)
        edge = np.flatnonzero(wanted)
        ends = ends[edge]
        least = self.min_depth[edge]
        for a, b in ((0, 1), (1, 0)):  # move an end of too little depth along its edge
            missing = (least - ends[:, a, 2]).clip(0)  # (n,)
            length = np.maximum(np.maximum(missing, ends[:, b, 2] - ends[:, a, 2]), 1e-12)
            ends[:, a] += (missing / length)[:, None] * (ends[:, b] - ends[:, a])
        return ends, edge, np.asarray(facing[edge].any(1), bool)


def wireframes(ellipsoids: quadrics.Ellipsoids, support: Sequence[str | None]) -> Wireframes:
    """Make the edges of the solids in which ellipsoids are inscribed.

    Args:
        support: (S,) "box" or "cylinder"; other shapes have no edges.
    """
    columns: list[list[Any]] = [[] for _ in range(7)]
    points = faces = 0
    for k, shape in enumerate(support):
        if shape not in ("box", "cylinder"):
            continue
        mesh = _unit_box() if shape == "box" else _unit_cylinder()
        half = ellipsoids.half_axes[k]
        turn = ellipsoids.world_from_obj[k]
        center = ellipsoids.center_in_world[k]
        count = len(mesh[1])
        normal = (mesh[4][:, :3] / half) @ turn.T  # (N, 3) x = c + R (h u)
        values = (
            mesh[0] * half @ turn.T + center, mesh[1] + points, mesh[2] + faces, mesh[3],
            np.full(count, k), np.c_[normal, mesh[4][:, 3] + normal @ center],
            np.full(count, 0.05 * half.max()),  # nearer edges are not drawn
        )  # fmt: skip
        for column, array in zip(columns, values, strict=True):
            column.append(array)
        points = points + len(mesh[0])
        faces = faces + len(mesh[4])
    empty = (
        np.empty((0, 3)), np.empty((0, 2), int), np.empty((0, 2), int), np.empty(0, bool),
        np.empty(0, int), np.empty((0, 4)), np.empty(0),
    )  # fmt: skip
    joined = [np.concatenate([e, *c]) for e, c in zip(empty, columns, strict=True)]
    return Wireframes(*joined)


Mesh = tuple[Array, IntArray, IntArray, BoolArray, Array]  # points, edges, faces, crease, planes


def _unit_box() -> Mesh:
    """Make the cube of half side 1; face 2 k + (1 if positive) is normal to axis k."""
    points = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, 8).T
    edges = []
    faces = []
    for a in range(8):
        for axis in range(3):
            if points[a, axis] < 0:
                step = points[a] * 1
                step[axis] = 1
                edges.append((a, int(np.flatnonzero((points == step).all(1))[0])))
                faces.append([2 * k + int(points[a, k] > 0) for k in range(3) if k != axis])
    normals = np.repeat(np.eye(3), 2, 0) * np.tile([-1, 1], 3)[:, None]
    planes = np.c_[normals, np.ones(6)]
    return points.astype(float), np.array(edges), np.array(faces), np.ones(12, bool), planes


def _unit_cylinder() -> Mesh:
    """Make a prism for the upright cylinder of radius and half height 1; caps are last."""
    number = np.arange(SIDES)
    angle = 2 * np.pi * number / SIDES
    following = (number + 1) % SIDES
    ring = np.c_[np.cos(angle), np.sin(angle)]
    points = np.r_[np.c_[ring, -np.ones(SIDES)], np.c_[ring, np.ones(SIDES)]]
    low = np.c_[number, following]
    high = np.c_[number, following] + SIDES
    edges = np.r_[low, high, np.c_[number, number + SIDES]]
    caps = (np.full(SIDES, SIDES), np.full(SIDES, SIDES + 1))
    faces = np.r_[np.c_[number, caps[0]], np.c_[number, caps[1]], np.c_[number, number - 1]]
    faces[faces < 0] = SIDES - 1  # the side before the first
    middle = angle + np.pi / SIDES
    side = np.c_[np.cos(middle), np.sin(middle), 0 * middle, 0 * middle + np.cos(np.pi / SIDES)]
    planes = np.r_[side, [[0, 0, -1, 1], [0, 0, 1, 1]]]
    return points, edges, faces, np.repeat([True, True, False], SIDES), planes


def draw_wireframes(
    image: Image,
    frames: Wireframes,
    camera: Camera,
    cam_from_world: Array,
    scale: float,
    object_id: Sequence[int],
    drawn: BoolArray,
    seen: set[int],
) -> None:
    """Draw solids in place, farthest first; self-occluded edges are thin and dim.

    Args:
        scale: image pixels per pixel of the camera. object_id, drawn: (S,) identities of the
            solids, and which ones to draw.
        seen: identities with a box in this frame; other solids are thin, without occluded edges.
    """
    ends, edge, front = frames.segments(cam_from_world)
    straight = scale * (ends @ camera.K.T)[..., :2] / ends[..., 2:]  # (n, 2, 2) undistorted
    clipped = camera.clip_segments(ends)
    within = np.asarray(np.isfinite(clipped).all((1, 2)), bool)  # (n,)
    pieces = 1 if camera.model == "PINHOLE" else 8  # segments of an edge: 8 look smooth
    fraction = np.linspace(0, 1, pieces + 1)[:, None]  # (B + 1, 1)
    line = clipped[:, :1] + fraction * (clipped[:, 1:] - clipped[:, :1])  # (n, B + 1, 3)
    pixels = scale * camera.project(line) - 0.5  # OpenCV draws with the pixel's centre at 0
    shift = 4  # sub-pixel bits of OpenCV's lines
    solids, first = np.unique(frames.solid[edge], return_index=True)  # their edges are consecutive
    stop = np.append(first, len(edge))[1:]  # (S,)
    edges_of = {k: slice(a, b) for k, a, b in zip(solids.tolist(), first, stop, strict=True)}
    for k in sorted(edges_of, key=lambda k: -ends[edges_of[k], :, 2].mean()):  # nearest last
        rows = edges_of[k]
        obj = object_id[k]
        found = pixels[rows][within[rows]]
        if not (drawn[k] and len(found) and _fits(straight[rows], image) and _fits(found, image)):
            continue
        lines = np.round(found * (1 << shift)).astype(np.int32)
        shown = front[rows][within[rows]]
        color = object_color(obj)
        dim = tuple(int(0.6 * c) for c in color)
        width = _width_of(image)
        if obj in seen:
            cv2.polylines(image, list(lines[~shown]), False, dim, width, cv2.LINE_AA, shift)
        width *= 2 if obj in seen else 1
        cv2.polylines(image, list(lines[shown]), False, color, width, cv2.LINE_AA, shift)


def _fits(pixels: Array, image: Image) -> bool:
    """Test whether an outline (n, B, 2) is finite and not too large (object beside the camera)."""
    flat = pixels.reshape(-1, 2)
    return bool(np.isfinite(flat).all() and np.ptp(flat, 0).max() < _max_outline(image))


# ---- Changes since a map -----------------------------------------------------------------------

# BGR. Colours of identities have a saturation of at most .78 (`object_color`): these are purer or
# grey, and no two of them have the same lightness. Black text is readable on each. "was": former
# places of moved objects: light, as video codecs keep less of colour than of brightness.
CHANGE_COLORS: dict[str, Color] = {
    "moved": (255, 0, 255), "new": (40, 255, 90), "gone": (225, 225, 225), "was": (255, 150, 255),
}  # fmt: skip


def change_label(kind: str, change: Change) -> str:
    """Describe the change of a moved, new or gone object for its label; "" for other kinds.

    >>> change_label("moved", Change(6, "chair", distance_m=0.564))
    ', moved 0.56 m'
    """
    if kind not in CHANGE_COLORS:
        return ""
    known = kind == "moved" and change.distance_m is not None
    return f", {kind} {change.distance_m:.2f} m" if known else f", {kind}"


def surface_points(support: str) -> Array:
    """Return points (P, 3) of a unit solid whose projections have its outline as convex hull.

    Args:
        support: "box" (half sides 1), "cylinder" (radius and half height 1) or "ellipsoid".
    """
    if support == "box":
        corners, edges, *_ = _unit_box()
        # lens distortion bends edges: 8 segments look smooth
        fraction = np.linspace(0, 1, 9)[:, None, None]
        ends = corners[edges]  # (12, 2, 3)
        points = ends[:, 0] + fraction * (ends[:, 1] - ends[:, 0])
        return np.asarray(points.reshape(-1, 3))
    if support == "cylinder":
        return _unit_cylinder()[0]
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    height = np.cos(np.linspace(0, np.pi, SIDES // 2 + 1))[:, None]  # (L, 1)
    radius = np.sqrt(1 - height**2)
    rings = (radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle)
    return np.stack(rings, -1).reshape(-1, 3)


def outline_of(camera: Camera, cam_from_world: Array, points: Array) -> Array | None:
    """Return the closed outline (n, 2), native pixels, of points (P, 3) of a convex solid.

    None where the solid is not entirely in front of the camera, or its centre is not in the image.
    """
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    least = 0.05 * np.linalg.norm(np.ptp(in_cam, axis=0))  # as for edges: nearer is not drawn
    if not (in_cam[:, 2] > least).all():
        return None
    middle = camera.project(in_cam.mean(0))
    if not ((middle > 0) & (middle < (camera.width, camera.height))).all():
        return None
    pixels = camera.project(in_cam)
    pixels = pixels[np.isfinite(pixels).all(1)]
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
    return np.concatenate([hull, hull[:1]]).astype(np.float64)


def _former_surface(change: Change) -> Array:
    """Return surface points (P, 3) of an object at its former place, world of the map."""
    shape = change.before_shape
    assert shape is not None and change.before is not None
    turn = Rotation.from_quat(shape.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    points = surface_points(shape.support) * shape.half_axes @ turn.T + change.before
    return np.asarray(points, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class FormerPlaces:
    """Former places of moved and gone objects, and what occludes them, in one component.

    Attributes:
        surface: points (P, 3) of each by the number of the object. center: (3,) of each.
        present: ellipsoids of the objects that are there now. camera: of the component.
    """

    surface: dict[int, Array]
    center: dict[int, Array]
    present: quadrics.Ellipsoids
    camera: Camera

    def outlines(self, cam_from_world: Array) -> dict[int, Array]:
        """Return the outlines (n, 2), native pixels, of the places in view by their numbers.

        A place is out of view if a present ellipsoid lies between its centre and the camera. One
        that contains the centre does not.
        """
        eye = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
        outlines = {}
        for number, points in self.surface.items():
            outline = outline_of(self.camera, cam_from_world, points)
            if outline is not None and not _passes_through(eye, self.center[number], self.present):
                outlines[number] = outline
        return outlines


def _passes_through(start: Array, end: Array, ellipsoids: quadrics.Ellipsoids) -> bool:
    """Test whether a segment between points (3,) enters an ellipsoid and leaves it again."""
    axes = ellipsoids.world_from_obj
    scaled = axes / ellipsoids.half_axes[:, None]  # (O, 3, 3): each ellipsoid is the unit sphere
    from_center = np.einsum("ojk,oj->ok", scaled, start - ellipsoids.center_in_world)
    way = np.einsum("ojk,j->ok", scaled, end - start)  # (O, 3)
    a = (way**2).sum(1)  # |from_center + t way|^2 = 1 is a t^2 + 2 b t + c = 0
    b = (from_center * way).sum(1)
    c = (from_center**2).sum(1) - 1
    root = np.sqrt((b**2 - a * c).clip(0))  # 0: the line passes the ellipsoid or touches it
    entered = -b - root > 0
    left = -b + root < a
    return bool((entered & left & (root > 0)).any())


def _former_places(result: Result) -> dict[int, tuple[FormerPlaces, Array]]:
    """Map frames to the former places of moved and gone objects of the component, and the pose.

    Only components placed in the map are included. Moved objects are those of the component.
    """
    places: dict[int, tuple[FormerPlaces, Array]] = {}
    changes = result.changes
    if changes is None or not any(c.before_shape for c in (*changes.moved, *changes.gone)):
        return places
    for k, component in enumerate(result.parts()):
        shifted, origin = centred(component)
        poses = shifted.poses
        if poses is None or k not in changes.components:
            continue
        here = {o.id for o in component.objects}
        shown = [c for c in changes.moved if c.before_shape and c.id in here]
        shown += [c for c in changes.gone if c.before_shape]
        former = FormerPlaces(
            {c.id: _former_surface(c) - origin for c in shown},
            {c.id: np.asarray(c.before) - origin for c in shown},
            shifted.ellipsoids(),
            poses.camera,
        )
        known = poses.known
        for frame, pose in zip(poses.frame[known].tolist(), poses.cam_from_world[known],
                               strict=True):  # fmt: skip
            places[frame] = (former, pose)
    return places


# ---- The video ---------------------------------------------------------------------------------


def film_fps(video: Video) -> float:
    """Return the frame rate of the overlay video: that of the source.

    Images without times: so that it lasts 20 s, with 2 to 10 a second, which all encoders keep.
    """
    if video.files and not video.times_are_known:
        return min(max(video.expected / 20, 2.0), 10.0)
    return (video.fps or IMAGE_FPS) / video.config.every


class Overlay:
    """Draw the overlay video frame by frame.

    Solids that rest on a prior are drawn only while their object is detected.

    Attributes:
        path: of the video. size: (w, h) of its frames. scale: their pixels per native pixel.
    """

    def __init__(self, result: Result, path: Path, video: Video, layers: str = "solids") -> None:
        """Open the video."""
        self.fps = film_fps(video)
        self.writer = FilmWriter(path, self.fps, video.size)
        self.path = self.writer.path
        self.size = self.writer.size
        self.layers = film_layers(layers)
        self.scale = self.size[0] / video.size[0]
        self.tracks = result.tracks
        self.measured = {o.id for o in result.located if o.status == "ok"}
        # 24 characters are 200 px
        self.labels = {o.id: f"{o.id} {cut(o.class_name, 24)}" for o in result.objects}
        self.marks: dict[int, Color] = {}
        for i, (kind, change) in _changes_of(result).items():
            if kind in CHANGE_COLORS:
                name = self.labels.get(i, f"{i} {cut(change.class_name, 24)}")
                key = -i if kind == "gone" else i  # negative: the label of its former place
                self.labels[key] = name + change_label(kind, change)
                self.marks[key] = CHANGE_COLORS[kind]
                if kind == "moved":
                    self.labels[-i] = f"{name}, was here"
                    self.marks[-i] = CHANGE_COLORS["was"]
        self.former = _former_places(result) if self.layers & {"solids", "ellipses"} else {}
        self.outlines = _project_all(result, self.scale, self.layers)
        self.label_positions: dict[int, int] = {}
        self.cameras = _cameras(result) if "solids" in self.layers else {}
        outlined = {i for places, _ in self.former.values() for i in places.surface}
        self.legend = _legend(result, self.layers, outlined)
        self.trails: dict[int, list[tuple[int, Array]]] = {}  # by identity: frame, position

    def take(self, frame: Frame) -> None:
        """Draw and append one frame."""
        low, high = np.searchsorted(self.tracks.frame, [frame.index, frame.index + 1])
        rows = self.tracks[slice(low, high)]
        small = cv2.resize(frame.image, self.size, interpolation=cv2.INTER_AREA)
        image = np.asarray(small, np.uint8)
        seen = set(rows.track_id.tolist())
        if "trails" in self.layers:
            self._draw_trails(image, rows)
        thin = self._draw_solids(image, frame.index, seen)
        former = self._draw_former(image, frame.index)
        draw_tracks(
            image, rows, self.labels, self.scale, self.label_positions, thin, self.marks, former
        )
        if self.legend and self.writer.count < 2 * self.fps:  # 2 s are enough to read it
            draw_legend(image, self.legend)
        self.writer.write(image)

    def _draw_solids(self, image: Image, frame: int, seen: set[int]) -> frozenset[int]:
        """Draw the solids of a frame.

        Returns:
            identities in `seen` whose solid was drawn.
        """
        shown: set[int] = set()
        if frame in self.cameras:
            solids, ids, camera, cam_from_world = self.cameras[frame]
            drawn = np.array([i in seen or i in self.measured for i in ids], bool)
            draw_wireframes(image, solids, camera, cam_from_world, self.scale, ids, drawn, seen)
            shown |= set(np.array(ids)[np.unique(solids.solid)].tolist())
        if frame in self.outlines:
            ids, dual_c, visible = self.outlines[frame]
            drawn = visible & np.array([i in seen or i in self.measured for i in ids], bool)
            draw_ellipses(image, dual_c, drawn, ids, seen)
            shown |= set(ids)
        return frozenset(shown & seen)

    def _draw_former(self, image: Image, frame: int) -> dict[int, IntArray]:
        """Draw the outlines of moved and gone objects at their former places in view.

        Returns:
            bounds (4,) of each outline, pixels of the image, by the number of the object, negative.
        """
        bounds: dict[int, IntArray] = {}
        if frame not in self.former:
            return bounds
        places, cam_from_world = self.former[frame]
        for number, outline in places.outlines(cam_from_world).items():
            if _fits(self.scale * outline, image):
                line = self.scale * outline - 0.5  # OpenCV draws with the pixel's centre at 0
                _draw_dashes(image, line, self.marks[-number], 2)
                bounds[-number] = np.array([line.min(0), line.max(0)]).round().astype(int).ravel()
        return bounds

    def _draw_trails(self, image: Image, rows: Tracks) -> None:
        """Draw the path of the centre of each box in the last second."""
        now = self.writer.count
        for obj, box in zip(rows.track_id.tolist(), rows.xyxy * self.scale, strict=True):
            trail = self.trails.setdefault(obj, [])
            trail.append((now, box.reshape(2, 2).mean(0)))
            trail[:] = [step for step in trail if step[0] >= now - self.fps]
            line = np.array([center for _, center in trail]).round().astype(np.int32)  # (n, 2)
            width = 2 * _width_of(image)
            cv2.polylines(image, [line], False, object_color(obj), width, cv2.LINE_AA)

    def close(self, complete: bool) -> None:
        """Finish the video; the file appears only if it is complete."""
        self.writer.close(complete)


def _changes_of(result: Result) -> dict[int, tuple[str, Change]]:
    """Map the number of each object to its change since the map; {} without a map."""
    changes = result.changes
    return {} if changes is None or changes.made_the_map else changes.of_objects()


def _located_by_part(result: Result) -> list[tuple[Result, list[int]]]:
    """List the components with cameras and solids, and the identities of the solids.

    Worlds far from their origin are shifted: dual quadrics contain squares of coordinates.
    """
    parts = [(centred(part)[0], [o.id for o in part.located]) for part in result.parts()]
    return [(p, ids) for p, ids in parts if p.poses is not None and ids and p.poses.known.any()]


def _cameras(result: Result) -> dict[int, tuple[Wireframes, list[int], Camera, Array]]:
    """Map frame numbers to the solids and identities of the component, the camera and the pose."""
    cameras = {}
    for part, ids in _located_by_part(result):
        poses = part.poses
        assert poses is not None
        solids = wireframes(part.ellipsoids(), [o.support for o in part.located])
        for frame, pose in zip(poses.frame[poses.known].tolist(), poses.cam_from_world[poses.known],
                               strict=True):  # fmt: skip
            cameras[frame] = (solids, ids, poses.camera, pose)
    return cameras


def _project_all(
    result: Result, scale: float, layers: frozenset[str]
) -> dict[int, tuple[list[int], Array, BoolArray]]:
    """Project the ellipsoids into the frames with a pose in their component.

    With the layer ellipses: all located objects; with solids: those whose shape has no edges.

    Returns:
        by frame number: identities (O), dual conics (O, 3, 3) in scaled pixels, and visible (O,).
    """
    outlines: dict[int, tuple[list[int], Array, BoolArray]] = {}
    scaled = np.diag([scale, scale, 1.0])
    for part, ids in _located_by_part(result):
        poses = part.poses
        assert poses is not None
        no_edges = np.array([o.support not in ("box", "cylinder") for o in part.located])
        chosen = np.full(len(ids), "ellipses" in layers) | (no_edges & ("solids" in layers))
        if not chosen.any():
            continue
        img_from_world = scaled @ poses.camera.K @ poses.cam_from_world[poses.known]  # (F, 3, 4)
        projected = quadrics.project(part.ellipsoids()[chosen].dual_quadrics(), img_from_world)
        kept = np.array(ids)[chosen].tolist()
        for frame, dual_c, visible in zip(
            poses.frame[poses.known].tolist(), *projected, strict=True
        ):
            outlines[frame] = (kept, dual_c, visible)
    return outlines


# ---- Legend ------------------------------------------------------------------------------------


def _legend(result: Result, layers: frozenset[str], former: set[int]) -> list[tuple[str, str]]:
    """List the kinds of lines in this video and their meaning.

    Args:
        former: numbers of the objects whose former places are outlined.
    """
    lines = [("box", "detected; number = identity")]
    if (result.tracks.score == 0).any():
        lines.append(("dashed", "not detected: filled in"))
    if _located_by_part(result) and layers & {"solids", "ellipses"}:
        name = "shape" if "solids" in layers else "ellipsoid"
        lines.append(("solid", f"its 3D {name}, projected"))
        lines.append(("thin", f"{name} of an object not detected here"))
    if "trails" in layers:
        lines.append(("trail", "its path in the last 1 s"))
    kinds = {kind for kind, _ in _changes_of(result).values()}
    meanings = {"moved": "moved since the map", "new": "not in the map"}
    lines += [(kind, text) for kind, text in meanings.items() if kind in kinds]
    outlined = {kind for i, (kind, _) in _changes_of(result).items() if i in former}
    lines += [("was", "was here, moved")] if "moved" in outlined else []
    lines += [("gone", "was here, gone now")] if "gone" in outlined else []
    return lines


def draw_legend(image: Image, lines: Sequence[tuple[str, str]]) -> None:
    """Draw a legend on a dark panel at the bottom left, in place."""
    px = _width_of(image)
    line_px = 20 * px  # height of a line
    sample_px = 30 * px  # width of the sample beside its text
    color = object_color(1)
    width = sample_px + 16 * px + max(_text_size(image, text)[0] for _, text in lines)
    height = line_px * len(lines) + 8 * px
    top = max(0, image.shape[0] - height - 6 * px)
    panel = image[top : top + height, 6 * px : 6 * px + width]
    panel[:] = panel // 4
    for k, (kind, text) in enumerate(lines):
        x = 12 * px
        y = top + 4 * px + line_px * k
        right = x + sample_px - 8 * px
        box = np.array([x, y + 4 * px, right, y + line_px - 5 * px])
        if kind in ("box", "dashed"):
            _draw_box(image, box, color, 1 + (len(lines) == 1), kind == "dashed")
        elif kind in ("moved", "new"):
            _draw_box(image, box + 3 * px * np.array([1, 1, -1, -1]), color, 1, dashed=False)
            _draw_box(image, box, CHANGE_COLORS[kind], 2, dashed=False)
        elif kind in ("was", "gone"):
            _draw_box(image, box, CHANGE_COLORS[kind], 2, dashed=True)
        else:
            middle = y + line_px // 2
            thickness = px if kind == "thin" else 2 * px
            cv2.line(image, (x, middle), (right, middle), color, thickness, cv2.LINE_AA)
        _draw_text(image, text, x + sample_px, y + line_px, (255, 255, 255))
