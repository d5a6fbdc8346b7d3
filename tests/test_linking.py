"""Linking of tracklets to objects: joins and splits by appearance and by 3D position."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import CHAIR, CUP, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.objects.component import associate_component
from reobj.objects.config import make_fit
from reobj.tracking.linking import FRAGMENT_GAP, cut_at_gaps, link

NAMES = rt.COCO_NAMES
PERSON = 0
BICYCLE = 1
FRAMES = 120


def views_of(table: rt.Tracks, chair: np.ndarray, cosine: float) -> np.ndarray:
    """Noisy embeddings (N, 12) of the true chairs (N,), with this cosine between chairs 0 and 1."""
    own = np.eye(3, 12)
    own[1] = cosine * own[0] + np.sqrt(1 - cosine**2) * own[1]
    rows = own[chair] + np.random.default_rng(1).normal(0, 0.03, (len(table), 12))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


@pytest.mark.parametrize("every", [1, 8])
def test_fragments_end_at_long_gaps_of_frames_that_were_read(every: int) -> None:
    frame = np.array([0, 1, 2, 2 + FRAGMENT_GAP, 3 + 2 * FRAGMENT_GAP, 4 + 2 * FRAGMENT_GAP])
    one, none = np.ones(6, np.int64), np.zeros((6, 4))
    table = rt.Tracks(frame * every, one, one, none, none[:, 0], one, one)
    assert cut_at_gaps(table).tolist() == [0, 0, 0, 0, 1, 1]


def linked(
    table: rt.Tracks,
    poses: rt.Poses | None,
    views: np.ndarray | None = None,
    moving: tuple[str, ...] = (),
) -> tuple[rt.Tracks, list[rt.LinkEvent]]:
    """Associate and link as a run does; views: (N, E) embeddings of all rows, default none."""
    seen = (rt.Embeddings.empty(), np.empty(0, np.int64))
    if views is not None:
        seen = (rt.Embeddings(views, np.empty((len(table), 0))), np.arange(len(table)))
    if poses is None:
        return link(table, NAMES, *seen, None, moving=moving)
    fit, priors = make_fit(rt.ObjectsConfig(), poses, NAMES), quadrics.load_priors()
    found = associate_component(table, NAMES, poses, fit, priors, moving)
    return link(table, NAMES, *seen, poses, moving=moving, label=found.label, iou=found.iou)


def kinds(events: list[rt.LinkEvent], kept: bool = True) -> set[str]:
    return {e.kind for e in events if e.kept == kept}


def objects_of(table: rt.Tracks, truth: np.ndarray) -> list[list[int]]:
    """The true objects in each estimated object, by identity."""
    return [np.unique(truth[table.track_id == i]).tolist() for i in np.unique(table.track_id)]


# ---- By 3D position ----


def test_a_chair_that_came_back_under_a_new_identity_is_joined() -> None:
    """Each chair's track is cut in two with a gap; the halves are joined, identical chairs stay
    separate.
    """
    poses = walk(FRAMES)
    table = tracks_of(poses)
    table = table[(table.frame < 40) | (table.frame >= 80)]
    ids = table.track_id + 3 * (table.frame >= 80)
    found, events = linked(dataclasses.replace(table, track_id=ids, tracklet_id=ids), poses)
    assert objects_of(found, table.detection_index) == [[0], [1], [2]]
    assert kinds(events) == {"join"} and kinds(events, kept=False) == set()
    assert sorted(e.tracklets for e in events) == [(1, 4), (2, 5), (3, 6)]
    assert all(e.place_iou is not None and e.place_iou > 0.5 for e in events)


def test_a_wrong_return_is_split_by_its_position() -> None:
    """The tracker re-identified the third chair as the first one: two positions."""
    poses = walk(FRAMES)
    table, chair = tracks_of(poses), tracks_of(poses).detection_index
    table = table[((chair == 0) & (table.frame < 50)) | ((chair == 2) & (table.frame > 70))]
    one = np.ones(len(table), np.int64)
    found, events = linked(dataclasses.replace(table, track_id=one), poses)
    assert objects_of(found, table.detection_index) == [[0], [2]]
    assert [(e.kind, e.tracklets) for e in events] == [("split", (3,))]


@pytest.mark.parametrize("slips", [[60], [40, 80], []])
def test_a_tracklet_with_an_identity_switch_is_cut_by_position(slips: list[int]) -> None:
    """The tracklet switches to another chair without a missed frame; nothing else is cut."""
    poses = walk(FRAMES)
    table = tracks_of(poses)
    table = table[table.detection_index == np.searchsorted(slips, table.frame, "right")]
    one = np.ones(len(table), np.int64)
    found, events = linked(dataclasses.replace(table, track_id=one, tracklet_id=one), poses)
    truth = np.searchsorted(slips, table.frame, "right") + 1
    assert len(np.unique(found.track_id)) == len(slips) + 1
    assert (found.track_id == truth).mean() > 0.9
    assert ("split" in kinds(events)) == bool(slips)


@pytest.mark.parametrize(("gap", "cut"), [(7, True), (4, False)])
def test_a_tracklet_may_be_another_object_after_a_gap(gap: int, cut: bool) -> None:
    """Its last five frames, too few to be localised, show another chair."""
    poses = walk(FRAMES)
    table, last = tracks_of(poses), 70 + gap
    first = (table.detection_index == 0) & (table.frame < 70)
    after = (table.detection_index == 2) & (table.frame >= last) & (table.frame < last + 5)
    table = table[first | after]
    one = np.ones(len(table), np.int64)
    found, _ = linked(dataclasses.replace(table, track_id=one, tracklet_id=one), poses)
    assert (objects_of(found, table.detection_index) == [[0], [2]]) == cut


def test_objects_seen_together_are_never_joined() -> None:
    """Two tracks of one chair in the same frames (duplicate detections) stay separate by the
    evidence of position and of appearance.
    """
    poses = walk(FRAMES)
    table = tracks_of(poses)
    half = table[table.detection_index == 0]
    order = np.argsort(np.tile(half.frame, 2), kind="stable")
    ids = np.repeat([1, 2], len(half))[order]
    double = dataclasses.replace(half[order % len(half)], track_id=ids, tracklet_id=ids)
    same = views_of(double, 0 * ids, 0.5)
    for known in ((poses, None), (None, same), (poses, same)):
        found, events = linked(double, *known)
        assert np.unique(found.track_id).tolist() == [1, 2] and kinds(events) == set()


def test_moving_classes_keep_the_identities_of_the_tracker() -> None:
    """The same rows as chairs are joined by position and by appearance; as persons they are not.

    Static and moving classes are not joined either.
    """
    poses = walk(FRAMES)
    table = tracks_of(poses)
    table = table[(table.detection_index == 0) & ((table.frame < 40) | (table.frame >= 80))]
    ids = 1 + (table.frame >= 80)
    for known in ((poses, None), (None, views_of(table, 0 * ids, 0.5))):
        for early, late, objects in ((CHAIR, CHAIR, 1), (PERSON, PERSON, 2), (BICYCLE, PERSON, 2)):
            kind = np.where(ids == 1, early, late)
            rows = dataclasses.replace(table, track_id=ids, tracklet_id=ids, class_id=kind)
            found, _ = linked(rows, *known, moving=("person", "dog"))
            assert len(np.unique(found.track_id)) == objects


def test_moving_objects_do_not_take_identities_of_equal_number() -> None:
    """Two chairs that move, and later a person that looks like the first: its tracklet has the
    number of the identity of that chair, and its class is number 0.
    """
    table = tracks_of(walk(FRAMES))
    table = table[(table.detection_index == 1) | ((table.detection_index == 0) & (
        (table.frame < 40) | (table.frame >= 80)))]  # fmt: skip
    piece = np.where(table.detection_index == 1, 1, 2 * (table.frame >= 80))
    rows = dataclasses.replace(
        table, track_id=piece + 1, tracklet_id=np.array([4, 2, 1])[piece],
        class_id=np.array([CHAIR, CHAIR, PERSON])[piece],
    )  # fmt: skip
    found, _ = linked(rows, None, views_of(table, table.detection_index, 0.5), moving=("chair",))
    assert objects_of(found, piece) == [[0], [1], [2]]


def test_a_moving_tracklet_keeps_two_identities() -> None:
    table = tracks_of(walk(FRAMES))
    table = table[table.detection_index == 0]
    ids = 1 + (table.frame >= 60)
    kind = np.full(len(table), PERSON)
    rows = dataclasses.replace(table, track_id=ids, tracklet_id=0 * ids + 1, class_id=kind)
    found, _ = linked(rows, None, views_of(table, 0 * ids, 0.5), moving=("person",))
    assert objects_of(found, ids) == [[1], [2]]


def test_labels_are_propagated_within_fragments() -> None:
    """From the nearest labelled row of the fragment, unless that frame has the object already."""
    frame = np.array([0, 0, 1, 1, 2, 2, 3, 12, 13])
    piece = np.array([1, 2, 1, 2, 1, 2, 1, 1, 3])
    label = np.array([5, 6, -1, 5, -1, -1, 7, -1, -1])
    one = np.full(9, CHAIR)
    box = np.arange(36.0).reshape(9, 4)
    table = rt.Tracks(frame, piece, piece, box, np.ones(9), one, piece)
    nothing = (rt.Embeddings.empty(), np.empty(0, np.int64))
    found, _ = link(table, NAMES, *nothing, label=label)
    # row 2 is nearest to object 5, which frame 1 has; rows 7 and 8 are fragments without labels
    assert found.track_id.tolist() == [1, 2, 3, 1, 4, 1, 4, 3, 5]
    empty, events = link(rt.Tracks.empty(), NAMES, *nothing)
    assert len(empty) == 0 and events == []


# ---- By appearance ----


@pytest.mark.parametrize(
    ("tracker", "cosine", "objects", "expected"),
    [
        ([1, 2, 3, 4, 5, 6], 0.5, 3, {"join"}),  # all came back under new identities
        ([1, 2, 3, 2, 1, 3], 0.5, 3, {"join", "split"}),  # two were swapped
        ([1, 2, 3, 1, 2, 3], 0.5, 3, set()),  # already right
        ([1, 2, 3, 4, 5, 3], 0.999, 5, set()),  # indistinguishable instances stay separate
    ],
)
def test_appearance_alone_decides_without_poses(
    tracker: list[int], cosine: float, objects: int, expected: set[str]
) -> None:
    """Three chairs, each seen before frame 40 and after frame 80; identities of the tracker."""
    table = tracks_of(walk(FRAMES))
    table = table[(table.frame < 40) | (table.frame >= 80)]
    chair = table.detection_index
    piece = chair + 3 * (table.frame >= 80)
    ids = np.array(tracker)[piece]
    table = dataclasses.replace(table, track_id=ids, tracklet_id=piece + 1)
    found, events = linked(table, None, views_of(table, chair, cosine))
    assert len(np.unique(found.track_id)) == objects
    assert kinds(events) == expected
    assert all(e.place_iou is None and e.kept for e in events)
    assert all(len(true) == 1 for true in objects_of(found, chair))


# Frames of tracklets 0, 1, 2: all apart, or two of them at once; then also where.
APART, LAST_TWO, FIRST_LAST = ((0, 40, 80), (0, 40, 40), (0, 40, 0))


@pytest.mark.parametrize(
    ("first", "cosine", "beside", "group"),
    [
        (APART, {(0, 1): 0.99}, 200, [1, 1, 2]),  # similar
        (APART, {(0, 1): 0.4}, 200, [1, 2, 3]),  # rather dissimilar
        ((0, 0, 80), {(0, 1): 0.99}, 200, [1, 2, 3]),  # seen together
        (APART, {(0, 1): 0.99, (1, 2): 0.99, (0, 2): 0.98}, 200, [1, 1, 1]),
        (APART, {(0, 1): 0.93, (1, 2): 0.9, (0, 2): 0.7}, 200, [1, 1, 1]),  # through a third
        (LAST_TWO, {(0, 1): 0.99, (0, 2): 0.6, (1, 2): 0.6}, 200, [1, 1, 2]),  # the better of two
        (LAST_TWO, {(0, 1): 0.985, (0, 2): 0.984, (1, 2): 0.98}, 200, [1, 2, 3]),  # equal rivals
        (LAST_TWO, {(0, 1): 0.985, (0, 2): 0.984, (1, 2): 0.98}, 5, [1, 1, 2]),  # two boxes on one
        (FIRST_LAST, {(0, 1): 0.985, (1, 2): 0.984, (0, 2): 0.98}, 200, [1, 3, 2]),
    ],
)
def test_the_most_similar_are_joined_first_against_their_rivals(
    first: tuple[int, ...], cosine: dict[tuple[int, int], float], beside: int, group: list[int]
) -> None:
    """Three tracklets of ten frames; simultaneous ones are this many pixels apart."""
    gram = np.eye(3)
    for (i, j), value in cosine.items():
        gram[i, j] = gram[j, i] = value
    values, vectors = np.linalg.eigh(gram)
    own = np.pad(vectors * np.sqrt(values.clip(0)), ((0, 0), (0, 3)))  # unit rows of these cosines
    frame = np.concatenate([np.arange(10) + f for f in first])
    piece = np.repeat(np.arange(3), 10)
    left = 100.0 + beside * piece
    xyxy = np.column_stack([left, 0 * left, left + 100, 0 * left + 100])
    order = np.argsort(frame, kind="stable")
    kind = np.full(30, CHAIR)
    table = rt.Tracks(frame, piece + 1, piece + 1, xyxy, np.full(30, 0.9), kind, piece)[order]
    found, _ = linked(table, None, own[piece[order]])
    names = [int(found.track_id[table.detection_index == i][0]) for i in range(3)]
    assert names == group


@pytest.mark.parametrize(
    ("common", "kinds", "objects"),
    [(0.0, [CHAIR] * 3, 3), (0.9, [CHAIR] * 3, 6), (0.0, [CHAIR, CUP, PERSON], 6)],
)
def test_similarity_is_calibrated_on_the_video(
    common: float, kinds: list[int], objects: int
) -> None:
    """The returns have a cosine of .8: enough if simultaneous chairs are dissimilar, too little if
    their cosine is .7 or they have different classes, which do not calibrate.
    """
    table = tracks_of(walk(FRAMES))
    table = table[(table.frame < 40) | (table.frame >= 80)]
    chair = table.detection_index
    ids = 1 + chair + 3 * (table.frame >= 80)
    kind = np.array(kinds)[chair]
    table = dataclasses.replace(table, track_id=ids, tracklet_id=ids, class_id=kind)
    own = np.sqrt(common) * np.eye(1, 40) + np.sqrt(1 - common) * np.eye(3, 40, 1)[chair]
    visit = np.eye(6, 40, 10)[ids - 1]  # change until the return
    views = np.sqrt(0.8) * own + np.sqrt(0.2) * visit
    views += np.random.default_rng(2).normal(0, 0.03, views.shape)
    found, _ = linked(table, None, views / np.linalg.norm(views, axis=1, keepdims=True))
    assert len(np.unique(found.track_id)) == objects
