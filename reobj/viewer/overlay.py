"""Overlay video: boxes, identities and projected solids drawn over every frame.

`write_pictures` in scene.py reads the video and passes each frame to `Overlay`, which draws it;
`FilmWriter` encodes it.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Camera, Poses
from reobj.export.source import centred
from reobj.files import cut
from reobj.results.changes import Change
from reobj.results.ply import unit_mesh
from reobj.results.result import Result
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video
from reobj.types import Array, BoolArray, Frame, Image, IntArray, Tracks, object_color

Color = tuple[int, int, int]

# ---- Boxes and labels --------------------------------------------------------------------------

SHIFT = 4  # sub-pixel bits of OpenCV's lines
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
    positions: dict[int, int],
    thin: Collection[int] = (),
    marks: Mapping[int, Color] = MappingProxyType({}),
    former: Mapping[int, IntArray] = MappingProxyType({}),
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
    texts = [labels.get(obj, str(obj)) for obj in ids]
    sizes = np.array([_text_size(image, text) for text in texts], int).reshape(-1, 2)
    spots = place_labels(ids, sizes, boxes, (image.shape[1], image.shape[0]), positions)
    for obj, text, spot, size, box in zip(ids, texts, spots, sizes.tolist(), boxes, strict=True):
        if spot is not None:
            color = marks.get(obj, object_color(obj))
            right, bottom = (spot[0] + size[0], spot[1] + size[1])
            _draw_leader(image, np.array([*spot, right, bottom]), box, color)
            cv2.rectangle(image, spot, (right - 1, bottom - 1), color, -1)
            ink = (0,) * 3 if sum(color) > 380 else (255,) * 3  # black on light colours
            _draw_text(image, text, spot[0] + 2 * _width_of(image), bottom, ink)


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
    """Return the width and height of a label; its text is readable in a frame of 640 px."""
    width = _width_of(image)
    (wide, high), base = cv2.getTextSize(text, FONT, 0.45 * width, width)
    return wide + 4 * width, high + base + 2 * width


def _draw_text(image: Image, text: str, left: int, bottom: int, color: Color) -> None:
    width = _width_of(image)
    base = cv2.getTextSize(text, FONT, 0.45 * width, width)[1]
    cv2.putText(image, text, (left, bottom - base), FONT, 0.45 * width, color, width, cv2.LINE_AA)


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


# ---- Shapes in 3D ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Wireframes:
    """Edges of boxes and cylinders in world: E edges.

    Attributes:
        ends: (E, 2, 3). planes: (E, 2, 4) of the two faces that meet: n . x - d > 0 outside.
        crease: (E,) False between facets of a curved side: visible only on the outline.
        solid: (E,) number of the solid. min_depth: (E,) least depth at which it is drawn.
    """

    ends: Array
    planes: Array
    crease: BoolArray
    solid: IntArray
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
        facing = self.planes[..., :3] @ eye - self.planes[..., 3] > 0  # (E, 2)
        wanted = self.crease | (facing[:, 0] != facing[:, 1])  # (E,)
        ends = self.ends @ turn.T + shift  # (E, 2, 3)
        wanted &= (ends[:, :, 2] > self.min_depth[:, None]).any(1)
        edge = np.flatnonzero(wanted)
        ends = ends[edge]
        least = self.min_depth[edge]
        for a, b in ((0, 1), (1, 0)):  # move an end of too little depth along its edge
            missing = (least - ends[:, a, 2]).clip(0)  # (n,)
            length = np.maximum(np.maximum(missing, ends[:, b, 2] - ends[:, a, 2]), 1e-12)
            ends[:, a] += (missing / length)[:, None] * (ends[:, b] - ends[:, a])
        return ends, edge, np.asarray(facing[edge].any(1), bool)


def wireframes(ellipsoids: quadrics.Ellipsoids, shapes: Sequence[str | None]) -> Wireframes:
    """Make the edges of the solids in which ellipsoids are inscribed.

    Args:
        shapes: (S,) "box" or "cylinder"; other shapes have no edges.
    """
    columns = [(np.empty((0, 2, 3)), np.empty((0, 2, 4)), np.empty(0, bool), np.empty(0, int),
                np.empty(0))]  # fmt: skip
    rows = zip(ellipsoids.half_axes, ellipsoids.world_from_obj, ellipsoids.center_in_world,
               shapes, strict=True)  # fmt: skip
    for k, (half, turn, center, shape) in enumerate(rows):
        if shape not in EDGED:
            continue
        ends, planes, crease = _unit_edges(shape)
        normal = (planes[..., :3] / half) @ turn.T  # x = c + R (h u)
        world_planes = np.concatenate([normal, planes[..., 3:] + (normal @ center)[..., None]], 2)
        solid = np.full(len(ends), k)
        # nearer edges are not drawn
        min_depth = np.full(len(ends), 0.05 * half.max())
        columns.append((ends * half @ turn.T + center, world_planes, crease, solid, min_depth))
    return Wireframes(*(np.concatenate(column) for column in zip(*columns, strict=True)))


EDGED = ("box", "cylinder")


def _unit_edges(shape: str) -> tuple[Array, Array, BoolArray]:
    """Return the edges of a unit solid: ends (E, 2, 3), planes (E, 2, 4) and crease (E,)."""
    points, triangles = unit_mesh(shape)
    a, b, c = points[triangles.T]  # (T, 3) each
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    planes = np.column_stack([normal, (normal * a).sum(1)])  # (T, 4)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], 2).reshape(-1, 2)  # (3 T, 2)
    edges, edge_of = np.unique(sides, axis=0, return_inverse=True)
    faces = np.argsort(edge_of.ravel(), kind="stable").reshape(-1, 2) // 3  # two triangles each
    cosine = normal[faces].prod(1).sum(1)
    bent = cosine < 1 - 1e-9  # no diagonal of a flat face
    return points[edges[bent]], planes[faces[bent]], cosine[bent] < 0.5


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
    pieces = 1 if camera.model == "PINHOLE" else 8  # segments of an edge: 8 look smooth
    fraction = np.linspace(0, 1, pieces + 1)[:, None]  # (B + 1, 1)
    line = ends[:, :1] + fraction * (ends[:, 1:] - ends[:, :1])  # (n, B + 1, 3)
    pixels = scale * camera.project(line) - 0.5  # OpenCV draws with the pixel's centre at 0
    within = np.asarray(np.isfinite(pixels).all(2), bool)  # (n, B + 1) up to the fold of the lens
    solid = frames.solid[edge]  # (n,)
    wanted = [k for k in np.unique(solid).tolist() if drawn[k]]
    for k in sorted(wanted, key=lambda k: -ends[solid == k, :, 2].mean()):  # nearest last
        rows = (solid == k) & (within.sum(1) > 1)
        found = [line[shown] for line, shown in zip(pixels[rows], within[rows], strict=True)]
        if not (found and _fits(straight[solid == k], image) and _fits(np.vstack(found), image)):
            continue
        obj = object_id[k]
        lines = [np.round(line * (1 << SHIFT)).astype(np.int32) for line in found]
        front_lines = list(itertools.compress(lines, front[rows]))
        color = object_color(obj)
        dim = tuple(int(0.6 * c) for c in color)
        width = _width_of(image)
        if obj in seen:
            occluded_lines = list(itertools.compress(lines, ~front[rows]))
            cv2.polylines(image, occluded_lines, False, dim, width, cv2.LINE_AA, SHIFT)
        width *= 2 if obj in seen else 1
        cv2.polylines(image, front_lines, False, color, width, cv2.LINE_AA, SHIFT)


def _fits(pixels: Array, image: Image) -> bool:
    """Test whether an outline (n, B, 2) is finite and not too large (object beside the camera)."""
    flat = pixels.reshape(-1, 2)
    return bool(np.isfinite(flat).all() and np.ptp(flat, 0).max() < 4 * max(image.shape))


def surface_points(
    center: Array, half_axes: Array, world_from_obj: Array, shape: str | None
) -> Array:
    """Return points (P, 3) of a solid whose projections have its outline as convex hull."""
    if shape in EDGED:  # lens distortion bends edges: 8 segments look smooth
        ends = _unit_edges(shape)[0]
        fraction = np.linspace(0, 1, 9)[:, None, None]
        unit = (ends[:, 0] + fraction * (ends[:, 1] - ends[:, 0])).reshape(-1, 3)
    else:
        unit = unit_mesh(shape, 4)[0]
    return np.asarray(unit * half_axes @ world_from_obj.T + center)


def outline_of(camera: Camera, cam_from_world: Array, points: Array) -> Array | None:
    """Return the closed outline (n, 2), native pixels, of points (P, 3) of a convex solid.

    None where the solid is not entirely in front of the camera.
    """
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    least = 0.05 * np.linalg.norm(np.ptp(in_cam, axis=0))  # as for edges: nearer is not drawn
    pixels = camera.project(in_cam)
    pixels = pixels[np.isfinite(pixels).all(1)]
    if not len(pixels) or in_cam[:, 2].min() <= least:
        return None
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
    return np.concatenate([hull, hull[:1]]).astype(np.float64)


# ---- Changes since a map -----------------------------------------------------------------------

# BGR. Colours of identities have a saturation of at most .78 (`object_color`): these are purer or
# grey, and no two of them have the same lightness. Black text is readable on each. "was": former
# places of moved objects: light, as video codecs keep less of colour than of brightness.
CHANGE_COLORS: dict[str, Color] = {
    "moved": (255, 0, 255), "new": (40, 255, 90), "gone": (225, 225, 225), "was": (255, 150, 255),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Component:
    """What is drawn in the frames of a component, in a world with a near origin.

    Attributes:
        ids: (O,) of the located objects. solids: edges of boxes and cylinders among them.
        outlined: points (P, 3) of the other solids by identity, and of former places of moved and
            gone objects by their numbers, negative.
    """

    poses: Poses
    ids: list[int]
    solids: Wireframes
    outlined: dict[int, Array]


def _component(result: Result, number: int, component: Result) -> _Component | None:
    """Collect what is drawn in a component; None: it has no cameras."""
    shifted, origin = centred(component)
    poses = shifted.poses
    if poses is None:
        return None
    solids = shifted.ellipsoids()
    shapes = [o.support for o in component.located]
    ids = [o.id for o in component.located]
    outlined = {
        i: surface_points(solids.center_in_world[k], solids.half_axes[k], solids.world_from_obj[k],
                          shape)
        for k, (i, shape) in enumerate(zip(ids, shapes, strict=True)) if shape not in EDGED
    }  # fmt: skip
    changes = result.changes
    if changes is not None and number in changes.components:
        here = {o.id for o in component.objects}
        for change in (*(c for c in changes.moved if c.id in here), *changes.gone):
            if (shape := change.before_shape) is not None and change.before is not None:
                turn = Rotation.from_quat(shape.quat_wxyz[[1, 2, 3, 0]]).as_matrix()
                place = change.before - origin
                outlined[-change.id] = surface_points(place, shape.half_axes, turn, shape.support)
    return _Component(poses, ids, wireframes(solids, shapes), outlined)


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
        size: (w, h) of its frames. scale: their pixels per native pixel.
    """

    def __init__(self, result: Result, path: Path, video: Video) -> None:
        """Open the video."""
        self.fps = film_fps(video)
        self.writer = FilmWriter(path, self.fps, video.size)
        self.size = self.writer.size
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
                distance = "" if change.distance_m is None else f" {change.distance_m:.2f} m"
                self.labels |= {-i: f"{name}, was here", key: f"{name}, {kind}{distance}"}
                self.marks |= {-i: CHANGE_COLORS["was"], key: CHANGE_COLORS[kind]}
        self.label_positions: dict[int, int] = {}
        found = [_component(result, k, part) for k, part in enumerate(result.parts())]
        components = [c for c in found if c is not None]
        self.cameras = {
            frame: (component, pose)
            for component in components
            for frame, pose in zip(component.poses.frame.tolist(), component.poses.cam_from_world,
                                   strict=True)
            if np.isfinite(pose).all()
        }  # fmt: skip
        self.legend = _legend(result, components)

    def take(self, frame: Frame) -> None:
        """Draw and append one frame."""
        low, high = np.searchsorted(self.tracks.frame, [frame.index, frame.index + 1])
        rows = self.tracks[slice(low, high)]
        small = cv2.resize(frame.image, self.size, interpolation=cv2.INTER_AREA)
        image = np.asarray(small, np.uint8)
        seen = set(rows.track_id.tolist())
        thin = set[int]()
        former: dict[int, IntArray] = {}
        if frame.index in self.cameras:
            component, pose = self.cameras[frame.index]
            ids = component.ids
            drawn = np.array([i in seen or i in self.measured for i in ids], bool)
            camera = component.poses.camera
            draw_wireframes(image, component.solids, camera, pose, self.scale, ids, drawn, seen)
            former = self._draw_outlines(image, component, pose, seen)
            thin = seen.intersection(ids)
        draw_tracks(
            image, rows, self.labels, self.scale, self.label_positions, thin, self.marks, former
        )
        if self.legend and self.writer.count < 2 * self.fps:  # 2 s are enough to read it
            draw_legend(image, self.legend)
        self.writer.write(image)

    def _draw_outlines(
        self, image: Image, component: _Component, pose: Array, seen: set[int]
    ) -> dict[int, IntArray]:
        """Draw the outlines of round solids, and of former places whose centre is in the image.

        Returns:
            bounds (4,) of the former places, pixels of the image, by number, negative.
        """
        bounds: dict[int, IntArray] = {}
        camera = component.poses.camera
        for i, points in component.outlined.items():
            outline = outline_of(camera, pose, points)
            if outline is None or not _fits(self.scale * outline, image):
                continue
            line = self.scale * outline - 0.5  # OpenCV's pixels
            if i < 0:
                middle = camera.project(pose[:, :3] @ points.mean(0) + pose[:, 3])
                if ((middle > 0) & (middle < (camera.width, camera.height))).all():
                    _draw_dashes(image, line, self.marks[i], 2)
                    bounds[i] = np.array([line.min(0), line.max(0)]).round().astype(int).ravel()
            elif i in seen or i in self.measured:
                width = _width_of(image) * (2 if i in seen else 1)
                lines = [np.round(line * (1 << SHIFT)).astype(np.int32)]
                cv2.polylines(image, lines, False, object_color(i), width, cv2.LINE_AA, SHIFT)
        return bounds

    def close(self, complete: bool) -> None:
        """Finish the video; the file appears only if it is complete."""
        self.writer.close(complete)


def _changes_of(result: Result) -> dict[int, tuple[str, Change]]:
    """Map the number of each object to its change since the map; {} without a map."""
    changes = result.changes
    return {} if changes is None or changes.made_the_map else changes.of_objects()


# ---- Legend ------------------------------------------------------------------------------------


def _legend(result: Result, components: Sequence[_Component]) -> list[tuple[str, str]]:
    """List the kinds of lines in this video and their meaning."""
    kinds = {kind for kind, _ in _changes_of(result).values()}
    former = {kind for i, (kind, _) in _changes_of(result).items()
              if any(-i in component.outlined for component in components)}  # fmt: skip
    has_solids = any(component.ids for component in components)
    lines = (
        ("box", "detected; number = identity", True),
        ("dashed", "not detected: filled in", (result.tracks.score == 0).any()),
        ("solid", "its 3D shape, projected", has_solids),
        ("thin", "shape of an object not detected here", has_solids),
        ("moved", "moved since the map", "moved" in kinds),
        ("new", "not in the map", "new" in kinds),
        ("was", "was here, moved", "moved" in former),
        ("gone", "was here, gone now", "gone" in former),
    )
    return [(kind, text) for kind, text, is_shown in lines if is_shown]


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
        if kind in ("solid", "thin"):
            middle = y + line_px // 2
            thickness = px if kind == "thin" else 2 * px
            cv2.line(image, (x, middle), (right, middle), color, thickness, cv2.LINE_AA)
        else:
            wide = 2 if kind in CHANGE_COLORS or len(lines) == 1 else 1
            dashed = kind in ("dashed", "was", "gone")
            _draw_box(image, box, CHANGE_COLORS.get(kind, color), wide, dashed)
        if kind in ("moved", "new"):
            _draw_box(image, box + 3 * px * np.array([1, 1, -1, -1]), color, 1, dashed=False)
        _draw_text(image, text, x + sample_px, y + line_px, (255, 255, 255))


# ---- Encoding ----------------------------------------------------------------------------------


class FilmWriter:
    """Write a video for browsers atomically: H.264 in MP4, by PyAV.

    Attributes:
        path: of the file, which appears only when it is complete. count: frames so far.
        size: (w, h) of the frames, even, as the codec requires.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Open a video of frames of (w, h) `size`, of which odd sides lose a pixel."""
        import av

        self.path = path
        # absolute: FFmpeg reads a folder 12:30/ as a protocol
        self._part = path.with_name(f".part-{path.name}").absolute()
        width, height = (max(side // 2 * 2, 2) for side in size)
        self.size = (width, height)
        self.count = 0
        self._av: Any = av
        # faststart: the index comes first, so that a browser plays the file while loading it
        options = {"movflags": "+faststart"}
        self._file: Any = av.open(str(self._part), "w", format="mp4", options=options)
        # x264's default quality; "superfast" needs half the time of "veryfast" and 1.3 times the
        # bytes. Without lookahead: with it, the same frames give different bytes every few runs
        # (PyAV 18.1, one thread, no B-frames). Other encoders of H.264 ignore these options.
        options = {
            "preset": "superfast",
            "crf": "23",
            "x264-params": "bframes=0:threads=1:rc-lookahead=0:mbtree=0",
        }
        rate = Fraction(fps).limit_denominator(1001)  # such as 30000/1001
        self._stream: Any = self._file.add_stream("h264", rate=rate, options=options)
        self._stream.width, self._stream.height = self.size
        self._stream.pix_fmt = "yuv420p"  # the only format that all browsers decode
        self._stream.gop_size = max(1, round(2 * fps))  # a player can seek every 2 s
        self._encoder = ThreadPoolExecutor(1)  # encodes a frame while the next one is drawn
        self._pending: Future[None] | None = None

    def write(self, image: Image) -> None:
        """Append one BGR frame of (w, h) `size`; the caller must not change it afterwards."""
        self._wait()
        self._pending = self._encoder.submit(self._encode, image)
        self.count += 1

    def _encode(self, image: Image) -> None:
        # Converted by OpenCV: FFmpeg's result depends on the memory alignment of the image
        planes = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420)
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self._file.mux(self._stream.encode(frame))

    def _wait(self) -> None:
        """Wait for the frame that is being encoded."""
        if self._pending is not None:
            self._pending.result()

    def close(self, complete: bool) -> None:
        """Finish the file; keep it only if complete."""
        ignored = () if complete else (OSError, self._av.FFmpegError)
        try:
            with contextlib.suppress(*ignored):
                try:
                    self._wait()
                    self._file.mux(self._stream.encode())
                finally:
                    self._encoder.shutdown()
                    self._file.close()
            if complete:
                self._part.replace(self.path)
        finally:
            self._part.unlink(missing_ok=True)
