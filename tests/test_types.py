"""Data types: boxes, detections, frames, tables of tracks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.types import (
    as_detections,
    as_frame,
    box_iou,
    class_shares,
    object_classes,
    one_line,
    without_secrets,
)


def step(*found: tuple[int, int, float]) -> rt.Tracks:
    """Tracks of a frame from (identity, tracklet, left) tuples; detections are numbered."""
    table = np.array(found, float).reshape(-1, 3)
    ids = table[:, :2].astype(np.int64)
    left, n = table[:, 2], len(table)
    xyxy = np.column_stack([left, 0 * left, left + 10, 0 * left + 20])
    zero = np.zeros(n, np.int64)
    return rt.Tracks(zero, ids[:, 0], ids[:, 1], xyxy, np.full(n, 0.9), zero, np.arange(n))


# ---- Boxes ----


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0, 0, 10, 10), (0, 0, 10, 10), 1.0),  # equal
        ((0, 0, 10, 10), (10, 0, 20, 10), 0.0),  # touching edges
        ((0, 0, 10, 10), (10, 10, 20, 20), 0.0),  # touching corners
        ((0, 0, 10, 10), (20, 20, 30, 30), 0.0),  # apart in both axes
        ((0, 0, 10, 10), (5, 0, 15, 10), 1 / 3),  # half over half
        ((0, 0, 10, 10), (2, 2, 4, 4), 0.04),  # one inside the other
        ((0, 0, 0, 0), (0, 0, 0, 0), 0.0),  # zero area
    ],
)
def test_box_iou(a: tuple[float, ...], b: tuple[float, ...], expected: float) -> None:
    iou = box_iou(np.array([a], float), np.array([b], float))
    assert iou[0, 0] == pytest.approx(expected)


# ---- Detections ----


ROWS = np.array([[10, 20, 110, 220, 0.9, 56], [300, 40, 400, 200, 0.7, 2.0]])
PARTS = (ROWS[:, :4], ROWS[:, 4], ROWS[:, 5])


class Tensor:
    """An array with the interface of torch: on a device, converted by `__array__` on the CPU."""

    def __init__(self, values: Any, where: str = "cuda:0") -> None:
        self.values, self.where = np.asarray(values), where

    def __len__(self) -> int:
        return len(self.values)

    def detach(self) -> Tensor:
        return Tensor(self.values, self.where)

    def cpu(self) -> Tensor:
        return Tensor(self.values, "cpu")

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        if self.where != "cpu":
            raise TypeError(f"can't convert {self.where} device type tensor to numpy")
        return self.values.astype(dtype or self.values.dtype)


def ultralytics(masks: Any = None, **other: Any) -> Any:
    """A Results: its boxes are attributes of another object."""
    xyxy, conf, cls = map(Tensor, PARTS)
    boxes = SimpleNamespace(xyxy=xyxy, conf=conf, cls=cls)
    return SimpleNamespace(**{"boxes": boxes, "masks": masks, "orig_shape": (480, 640)} | other)


def torchvision(**other: Any) -> dict[str, Any]:
    boxes, scores, labels = map(Tensor, PARTS)
    return {"boxes": boxes, "scores": scores, "labels": labels} | other


def supervision(**other: Any) -> Any:
    given = {"xyxy": PARTS[0], "confidence": PARTS[1], "class_id": PARTS[2], "mask": None}
    return SimpleNamespace(**given | other)


@pytest.mark.parametrize(
    "found",
    [
        ROWS,
        ROWS.tolist(),
        ROWS.astype(object),
        Tensor(ROWS),
        rt.Detections(*PARTS[:2], PARTS[2].astype(np.int64)),
        ultralytics(),
        ultralytics().boxes,
        [ultralytics()],  # output of a model: a batch of one
        torchvision(),
        [torchvision(masks=None)],
        supervision(),
    ],
)
def test_detections_of_common_libraries(found: Any) -> None:
    made = as_detections(found)
    np.testing.assert_allclose(made.xyxy, PARTS[0])
    np.testing.assert_allclose(made.score, PARTS[1])
    assert made.class_id.tolist() == [56, 2] and made.masks is None
    kinds = (made.xyxy.dtype, made.score.dtype, made.class_id.dtype)
    assert kinds == (np.float64, np.float64, np.int64)


@pytest.mark.parametrize("none", [[], np.empty((0, 6)), np.empty(0), supervision(
    xyxy=np.empty((0, 4)), confidence=None, class_id=None)])  # fmt: skip
def test_a_frame_without_detections(none: Any) -> None:
    assert as_detections(none).xyxy.shape == (0, 4) and len(as_detections(none)) == 0


def test_masks_of_a_padded_input_are_mapped_to_the_image() -> None:
    """640 x 480 in a square of 320: rows 40 to 280 are the image, at half its size."""
    data = np.zeros((2, 320, 320), np.float32)
    data[0, 40 + 10 : 40 + 110, 5:55] = 1
    data[1, :40] = 1  # in the padding: outside the image
    masks = as_detections(ultralytics(SimpleNamespace(data=Tensor(data)))).masks
    assert masks is not None and masks.shape == (2, 480, 640)
    expected = np.zeros((480, 640), bool)
    expected[20:220, 10:110] = True
    assert np.array_equal(masks[0], expected) and not masks[1].any()


def changed(row: int, column: int, value: float) -> np.ndarray:
    rows = ROWS.copy()
    rows[row, column] = value
    return rows


XYXY, SCORE, LABEL = PARTS
REFUSED = [
    (ROWS[:, :5], r"shape \(2, 5\); expected \(N, 6\) rows"),
    (np.ones((6, 7)), r"shape \(6, 7\); expected"),  # rows of trackers have an identity
    (np.ones(6), r"shape \(6,\); expected"),
    ([ROWS, ROWS], r"shape \(2, 2, 6\); expected"),  # of two frames
    (None, "are NoneType, no array of numbers; expected"),
    ("det.txt", "are str, no array"),
    (ROWS.astype(complex), "are complex128, no array"),
    ([[1, 2], [3]], "no array of numbers .*inhomogeneous"),
    (object(), "no array of numbers"),
    ({"boxes": XYXY}, "no score or confidence or scores or conf; expected"),
    (SimpleNamespace(xyxy=XYXY), "no score or confidence"),
    (SimpleNamespace(xyxy=XYXY, conf=SCORE), "no class_id or labels or cls"),
    (ultralytics(boxes=None), "Results without boxes"),
    (supervision(xyxy=XYXY[:, :3]), r"boxes are an array of shape \(2, 3\), expected \(2, 4\)"),
    (supervision(confidence=SCORE[:1]), r"scores are .* \(1,\), expected \(2,\)"),
    (torchvision(labels=LABEL[:, None]), r"classes are .* \(2, 1\), expected \(2,\)"),
    (supervision(mask=np.ones((1, 4, 4), bool)), r"masks are .* expected \(2, 4, 4\)"),
    (torchvision(masks=np.ones((2, 3, 4, 4))), r"masks are .* \(2, 3, 4, 4\), expected"),
    (changed(1, 0, np.nan), "detection 1: .*expected finite coordinates"),
    (changed(0, 3, 1.1e7), r"at most 1e\+07"),
    (changed(1, 2, 299), "detection 1: .*x1 <= x2 and y1 <= y2: corners, not x, y, width"),
    (changed(1, 4, 9), r"detection 1: 9.0, expected a confidence in \[0, 1\]"),
    (changed(0, 4, np.nan), "nan, expected a confidence"),
    (changed(0, 5, -1), "-1.0, expected a class number from 0"),
    (changed(0, 5, 2e9), "expected a class number from 0 to 32767"),  # gigabytes of class votes
    (changed(0, 5, 1.5), "1.5, expected a class number"),
    (np.repeat(ROWS, 1501, 0), "3002 detections in a frame, at most 3000"),
]


@pytest.mark.parametrize(("found", "message"), REFUSED)
def test_invalid_detections_are_refused_in_one_line(found: Any, message: str) -> None:
    with pytest.raises(rt.ReobjError, match=message) as caught:
        as_detections(found)
    assert "\n" not in str(caught.value)


# ---- Frames ----


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 6), np.uint8),  # gray
        np.zeros((4, 6, 1), np.uint8),
        np.zeros((4, 6, 4), np.uint8),  # with alpha
        np.zeros((3, 4, 6), np.uint8),  # channels first
        np.zeros((4, 6, 3)),
        np.zeros((4, 6, 3), bool),
        [[[0, 0, 0]]],
        "room.jpg",
    ],
)
def test_other_images_are_refused(image: Any) -> None:
    with pytest.raises(rt.ReobjError, match=r"expected a BGR image \(H, W, 3\) of uint8"):
        as_frame(image)


# ---- Tables of tracks ----


def test_concatenate_backfills_the_confirmed_identity() -> None:
    """Tracklet 2 is confirmed in the last frame, tracklet 3 never, tracklet 4 is a return of 1."""
    steps = [
        step((1, 1, 0), (0, 2, 50)),
        step((0, 3, 90), (0, 2, 52)),
        step(),
        step((2, 2, 54), (1, 4, 70)),
    ]
    table = rt.Tracks.concatenate([10, 12, 14, 16], steps, scale=0.5)
    assert table.frame.tolist() == [10, 10, 12, 16, 16]
    assert table.track_id.tolist() == [1, 2, 2, 2, 1]
    assert table.tracklet_id.tolist() == [1, 2, 2, 2, 4]
    assert table.detection_index.tolist() == [0, 1, 1, 0, 1]
    np.testing.assert_allclose(table.xyxy[:, 0], [0, 100, 104, 108, 140])
    np.testing.assert_allclose(table.xyxy[0], [0, 0, 20, 40])


def test_identities_are_numbered_by_first_appearance() -> None:
    table = step(*[(1, i, 10 * i) for i in range(6)])
    named = table.with_identities(np.array([7, 3, 7, -2, 3, 9]))
    assert named.track_id.tolist() == [1, 2, 1, 3, 2, 4]
    assert named.tracklet_id.tolist() == table.tracklet_id.tolist()
    assert table.track_id.tolist() == [1] * 6
    assert len(rt.Tracks.empty().with_identities(np.empty(0, np.int64))) == 0


def test_a_class_is_voted_by_the_sum_of_scores() -> None:
    """Two low scores vote for class 5, one high score for 7; the second object is always 5."""
    table = step((1, 1, 0), (1, 1, 0), (1, 1, 0), (2, 2, 0))
    score, kind = np.array([0.3, 0.3, 0.9, 0.2]), np.array([5, 5, 7, 5])
    table = rt.Tracks(*(table.frame, table.track_id, table.tracklet_id, table.xyxy), score, kind,
                      table.detection_index)  # fmt: skip
    assert object_classes(table) == {1: 7, 2: 5}
    shares = class_shares(table, table.track_id - 1, 3)
    np.testing.assert_allclose(shares[:, [5, 7]], [[0.4, 0.6], [1, 0], [0, 0]])


# ---- Messages ----


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rtsp://me:secret@10.0.0.7/stream", "rtsp://10.0.0.7/stream"),
        ("run http://token@a/b rtsp://u:p@c -o out", "run http://a/b rtsp://c -o out"),
        ("rtsp://me:se@cret@10.0.0.7:554/a/b", "rtsp://10.0.0.7:554/a/b"),
        ("rtsp://me:se/cret@10.0.0.7/stream", "rtsp://10.0.0.7/stream"),
        ("rtsp://me:1/2@3/4@cam/stream", "rtsp://cam/stream"),
        ("rtsp://me:s?c@cam/stream", "rtsp://..."),  # or a query with "@": ambiguous
        ("http://cam/v.mp4?user=me@x.org&pwd=secret", "http://..."),
        ("http://cam/v.mp4?user=me&pwd=secret", "http://cam/v.mp4"),
        ("http://cam/v.mp4#t=secret", "http://cam/v.mp4"),
        ("rtsp://cam:554/user=me_password=secret_channel=1", "rtsp://cam:554/user"),
        ("rtsp://me:s=c@cam/stream", "rtsp://..."),
        ("http://cam?pwd=a@secret", "http://..."),
        ("rtsp://cam/stream;key=secret", "rtsp://cam/stream"),
        ("RTSP://me:secret@cam/1 is gone", "RTSP://cam/1 is gone"),
        ("http:/me:secret@cam/1", "http:/cam/1"),  # as pathlib writes it
        ("--rtsp://me:secret@cam/1", "--rtsp://cam/1"),  # as argparse repeats it
        ("a" * 40 + "://me:secret@cam/1", "a" * 40 + "://cam/1"),
        ("C:/Users/me@work/a?b", "C:/Users/me@work/a?b"),  # no URL
        ("me@home.org and/or C:\\a", "me@home.org and/or C:\\a"),
        ("/data/room=1?/a@b.mp4", "/data/room=1?/a@b.mp4"),  # a file
    ],
)
def test_passwords_are_not_shown(text: str, expected: str) -> None:
    assert without_secrets(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "x" * 10**6,
        "\x1b" * 10**5,  # escaped, each is four characters
        "\U000e0001" * 10**5,
        "a-" * 10**6,  # not in quadratic time
        "a\nb\x00\x85\u2028\ud800\u202e",
        "rtsp://me:pa@ss/w0rd@host/cam?pwd=w0rd " * 50,
        "y" * 340 + "rtsp://me:w0rd@host/" + "z" * 500,  # where a message is cut
        "y" * 500 + "rtsp://me:w0rd@host/" + "z" * 222,
    ],
)
def test_messages_are_one_printable_short_line_without_secrets(text: str) -> None:
    for found in (one_line(text), str(rt.ReobjError(text))):
        assert found.isprintable() and 0 < len(found) <= 700 and "w0rd" not in found
