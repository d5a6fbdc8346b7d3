"""A detector that was not run on every frame: unprocessed frames are no misses."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from simulated import unlinked, walk

import reobj_track as rt
from reobj.objects.fit import link_and_fit
from reobj.sources.recorded import infer_detector_ran

TABLE, CHAIR = 60, 56
FRAMES = 60


def scene(frame: int) -> list[list[float]]:
    """A table, and from frame 10 on a chair beside it."""
    table = [300 + 0.2 * frame, 200, 500 + 0.2 * frame, 350, 0.8, TABLE]
    chair = [40 + 0.2 * frame, 100, 110 + 0.2 * frame, 220, 0.8, CHAIR]
    return [table, chair] if frame >= 10 else [table]


def irregular(count: int = 300) -> set[int]:
    return set(np.flatnonzero(np.random.default_rng(1).random(count) < 0.3).tolist())


WHEN = {f"every {n}": set(range(0, 300, n)) for n in (2, 10)}
WHEN |= {"late start": set(range(7, 300, 5)), "irregular": irregular()}


@pytest.mark.parametrize("name", WHEN)
@pytest.mark.parametrize("unseen", [None, []])
def test_a_new_track_is_confirmed_at_its_third_detection(name: str, unseen: object) -> None:
    """Also if unprocessed frames of regular intervals are given as frames without detections."""
    if name == "irregular" and unseen is not None:
        return
    tracker, chair = rt.Tracker(), []
    for frame in range(300):
        detector_ran = frame in WHEN[name]
        found = tracker.update(scene(frame) if detector_ran else unseen)
        if detector_ran and frame >= 10:
            chair.append(dict(zip(found.class_id.tolist(), found.track_id.tolist(), strict=True)))
        if not detector_ran:
            assert len(found) == 0 and len(tracker.latest) == 0
    assert [ids.get(CHAIR) for ids in chair[2:]] == [2] * (len(chair) - 2)
    assert {ids[TABLE] for ids in chair} == {1}


def test_a_track_missed_in_processed_frames_ends() -> None:
    """`coast_frames` and the limit of tentative tracks count processed frames."""
    tracker = rt.Tracker(rt.TrackerConfig(coast_frames=4))
    for frame in range(30):
        tracker.update(scene(frame) if frame % 3 == 0 else None)
    for _ in range(50):
        tracker.update(None)
    assert len(tracker.state.tracks.identity) == 2 and not tracker.looked
    assert tracker.predicted().track_id.tolist() == [1, 2]
    for k in range(5):
        assert len(tracker.state.tracks.identity) == 2, k
        tracker.update([], looked=True)
    assert len(tracker.state.tracks.identity) == 0


@pytest.mark.parametrize(
    ("frames", "boxes", "detector_ran"),
    [
        (range(60), 3, None),  # dense
        ([f for f in range(60) if f % 7], 3, None),  # some are empty
        ([*range(10), *range(50, 60)], 3, None),  # a wall for most of the time
        (range(0, 60, 3), 1, range(0, 60, 3)),
        ([0, 6, 9, 21, 24, 30, 51], 1, range(0, 60, 3)),  # nothing found in many of them
        (range(7, 50, 5), 2, range(2, 60, 5)),
        ([3, 4, 9, 12, 20, 22, 31, 40, 47, 51], 3, None),  # irregular: the file must list them
        ([5, 40], 3, None),  # two frames are no interval
        ([], 1, None),
    ],
)
def test_processed_frames_are_inferred(frames: object, boxes: int, detector_ran: object) -> None:
    found = infer_detector_ran(np.repeat(np.array(frames, np.int64), boxes), 60)
    assert (None if found is None else found.tolist()) == (detector_ran and list(detector_ran))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sparse") / "images"
    folder.mkdir()
    for frame in range(FRAMES):
        image = np.full((480, 640, 3), 90, np.uint8)
        for x1, y1, x2, y2, *_ in scene(frame):
            cv2.rectangle(image, (int(x1), int(y1)), (int(x2), int(y2)), (200, 60, 20), -1)
        cv2.imwrite(str(folder / f"{frame:04d}.png"), image)
    return folder


def mot(path: Path, frames: range, truth: bool = False) -> Path:
    lines = [
        f"{frame + 1},{k if truth else -1},{x1},{y1},{x2 - x1},{y2 - y1},{1 if truth else score}"
        for frame in frames
        for k, (x1, y1, x2, y2, score, _) in enumerate(scene(frame), 1)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def track(images: Path, boxes: Path, out: Path, *more: str) -> list[str]:
    """Run `track` on the command line; returns the warnings that it keeps."""
    off = ("--set", "output.overlay=none", "--set", "output.scene=false", "--embed", "none")
    args = ("track", images, "--detections", boxes, "-o", out, *off, *more)
    assert rt.main([str(a) for a in args]) == 0
    return list(json.loads((out / "objects.json").read_text())["warnings"])


@pytest.mark.parametrize("n", [3, 10])
def test_both_objects_are_tracked(images: Path, tmp_path: Path, n: int) -> None:
    warnings = track(images, mot(tmp_path / "det.txt", range(0, FRAMES, n)), tmp_path / "out")
    (said,) = warnings
    assert f"1 frame in {n} (0, {n}, {2 * n}, " in said and "not run on the others" in said
    rows = np.loadtxt(tmp_path / "out/tracks.txt", delimiter=",")
    last = (FRAMES - 1) // n * n + 1  # from 1
    first = -(-10 // n) * n + 1
    assert rows[rows[:, 1] == 1, 0].tolist() == list(range(1, last + 1, n))
    assert rows[rows[:, 1] == 2, 0].tolist() == list(range(first, last + 1, n))
    assert (rows[:, 6] > 0).all()
    whole = rt.evaluate(tmp_path / "out", mot(tmp_path / "gt.txt", range(FRAMES), truth=True))
    assert whole["tracks"]["all"]["HOTA"] == 1 and whole["tracks"]["all"]["IDF1"] == 1
    assert "the detector was not run" in whole["messages"][-1]


def test_lists_of_images_define_the_processed_frames(images: Path, tmp_path: Path) -> None:
    """COCO's `images` and npz's `done`: also frames without a box, whatever their intervals."""
    seen, clip = [0, 1, 7, 30, 31, 50], rt.Video(images)
    boxes = {f: scene(f) if f in (0, 30, 31) else [] for f in seen}
    entries = [
        {"id": 2 * f + k, "image_id": f + 7, "category_id": int(c), "score": s,
         "bbox": [x1, y1, x2 - x1, y2 - y1]}
        for f, found in boxes.items() for k, (x1, y1, x2, y2, s, c) in enumerate(found)
    ]  # fmt: skip
    data = {"images": [{"id": f + 7, "file_name": f"{f:04d}.png"} for f in seen],
            "categories": [{"id": k, "name": rt.COCO_NAMES[k]} for k in (TABLE, CHAIR)],
            "annotations": entries}  # fmt: skip
    (tmp_path / "coco.json").write_text(json.dumps(data))
    arrays = [(f, rt.Detections.from_array(found)) for f, found in boxes.items()]
    rt.write_detections_npz(tmp_path / "d.npz", arrays, rt.COCO_NAMES, (640, 480))
    for name in ("coco.json", "d.npz"):
        source = rt.open_detections(clip, rt.DetectConfig(), tmp_path / name)
        answers = {f: len(a) for f, a in enumerate(source.detect(list(clip))) if a is not None}
        assert answers == {f: len(found) for f, found in boxes.items()}


def test_none_from_a_function_means_not_processed(images: Path, tmp_path: Path) -> None:
    calls = list[int]()

    def detector(image: np.ndarray) -> object:
        calls.append(len(calls))
        return scene(calls[-1]) if calls[-1] % 4 == 0 else None

    online = [tracks.track_id.tolist() for _, tracks in rt.track(images, detector, rt.Tracker())]
    assert online[20] == [1, 2] and online[21] == [] and len(calls) == FRAMES
    calls.clear()
    config = rt.Config(
        embed=rt.EmbedConfig(model="none"), output=rt.OutputConfig(overlay="none", scene=False),
        poses=rt.PosesConfig(mode="none"),
    )  # fmt: skip
    result = rt.run(images, tmp_path / "out", config, detections=detector)
    assert len(calls) == FRAMES and result.looked is not None
    assert [o.class_name for o in result.objects] == ["dining table", "chair"]
    assert result.looked.tolist() == list(range(0, FRAMES, 4))
    nothing = rt.run(images, tmp_path / "none", config, detections=lambda image: None)
    assert "in the 0 frames that the detector was run on" in nothing.warnings[-1]


def test_unprocessed_frames_do_not_lower_the_confidence() -> None:
    """The confidence of chairs whose boxes are those of every fourth frame."""
    given = unlinked(walk())
    given = dataclasses.replace(given, tracks=given.tracks[given.tracks.frame % 4 == 0])
    given.tracks.score[:] = 0.35
    confidences = []
    for detector_ran in (np.arange(0, 40, 4), None):
        found = link_and_fit(
            dataclasses.replace(given, looked=detector_ran), rt.ObjectsConfig()
        ).objects
        confidences.append([o.confidence or 0.0 for o in found])
    assert len(confidences[0]) == 3
    assert min(confidences[0]) > max(confidences[1] or [0.0]) + 0.1
