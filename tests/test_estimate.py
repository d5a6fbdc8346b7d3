"""The whole chain from a video to the pose of every frame, and its options."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import shutil
import struct

import cv2
import numpy as np
import pytest
from pose_worlds import FakeVideo, ate_percent, blank, textured_room

import reobj_track as rt
from reobj.poses import estimate, sfm
from reobj.poses.estimate import KeyframeStore, rows_around_breaks
from reobj.poses.keyframes import Keyframe, ResizedVideo, pick_keyframes
from reobj.poses.localize import Located
from reobj.poses.redundancy import RedundancyOptions, find_repeated
from reobj.poses.sfm import Mapped
from reobj.poses.windows import map_keyframes

pycolmap = pytest.importorskip("pycolmap")


def config(**changes):
    return dataclasses.replace(rt.PosesConfig(), **changes)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    images, truth = textured_room(30, 0.12, -0.8, size=(320, 240))
    folder = tmp_path_factory.mktemp("walk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)
        patch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
        poses = rt.estimate_poses(FakeVideo(images), config(), folder)
    return FakeVideo(images), truth, folder, poses


def test_a_walk_gets_a_pose_for_every_frame(walk):
    video, truth, folder, poses = walk
    assert poses.known.all() and poses.source == "pycolmap" and not poses.metric
    assert set(poses.status) == {"keyframe", "pnp"} and not poses.messages
    assert poses.frame.tolist() == list(range(30))
    np.testing.assert_allclose(poses.time_s, np.arange(30) / 30)
    assert ate_percent(poses.cam_from_world, truth) < 1.0
    assert len(poses.points) > 300 and poses.colors.any() and len(poses.colors) == len(poses.points)
    assert (poses.camera.width, poses.camera.height) == video.size
    assert sorted(p.name for p in folder.iterdir()) == ["mapping.lock", "pycolmap.log", "sparse"]


def test_the_sparse_model_holds_the_keyframes(walk):
    video, _, folder, poses = walk
    back = rt.read_poses(folder / "sparse", video)
    keys = poses.status == "keyframe"
    np.testing.assert_array_equal(back.known, keys)
    np.testing.assert_allclose(back.cam_from_world[keys], poses.cam_from_world[keys], atol=1e-9)
    np.testing.assert_allclose(back.camera.params, poses.camera.params)


# ---- Options -------------------------------------------------------------------------------------


def seen_job(monkeypatch, video, folder, **changes):
    """Input of the reconstruction from `estimate_poses`."""
    seen = {}

    def record(images, ids, frames, names, boxes, size, **options):
        assert len(ids) == len(frames) == len(names) == len(images)
        seen.update(images=list(images), ids=ids, names=names, boxes=boxes, size=size, **options)
        return Mapped([], ["stopped here"])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", record)
    boxes = changes.pop("boxes", None)
    poses = rt.estimate_poses(video, config(**changes), folder, boxes_to_mask=boxes)
    assert poses.messages == ("stopped here",)
    return seen


def test_options_reach_the_reconstruction(walk, tmp_path, monkeypatch):
    video = walk[0]
    seen = seen_job(monkeypatch, video, tmp_path)
    assert seen["images"][0].shape == (240, 320, 3) and seen["size"] == (320, 240)
    assert (seen["camera"], seen["focal_guess"], seen["seed"]) == (None, 0.8, 0)
    assert len(seen["images"]) == 30  # of up to 40 pictures all are taken
    assert all(boxes.shape == (0, 4) for boxes in seen["boxes"])
    mask = lambda frame: np.full((2, 4), float(frame))  # noqa: E731
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 8)
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 8)
    changed = seen_job(monkeypatch, video, tmp_path, size_px=160, seed=3,
                       camera="288,288,160,120", boxes=mask)  # fmt: skip
    assert changed["images"][0].shape == (120, 160, 3) and len(changed["images"]) <= 8
    assert changed["camera"].params[0] == 288 and changed["seed"] == 3
    numbers = [int(name.removesuffix(".jpg").split("_")[1]) for name in changed["names"]]
    assert [boxes[0, 0] for boxes in changed["boxes"]] == numbers
    assert changed["ids"] == [number + 1 for number in numbers]


@pytest.fixture
def reconstructed(walk, monkeypatch):
    """Replaces the reconstruction of the keyframes by that of `walk`."""

    def copy(*args, work_dir, **options):
        shutil.copytree(walk[2] / "sparse", work_dir / "sparse", dirs_exist_ok=True)
        (work_dir / "mapping").mkdir(exist_ok=True)
        return Mapped([work_dir / "sparse"], [])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", copy)
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)  # those of the walk
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
    return walk


def test_the_seed_reaches_pnp(reconstructed, tmp_path, monkeypatch):
    seeds = []

    def note(model, key_rows, unmapped, video, seed, line, before):
        seeds.append(seed)
        count = len(video.frames)
        lost = np.full((count, 3, 4), np.nan)
        return Located(model, key_rows, key_rows, lost, np.full(count, "none"))

    monkeypatch.setattr("reobj.poses.estimate.locate_between", note)
    poses = rt.estimate_poses(reconstructed[0], config(seed=4), tmp_path)
    assert set(seeds) == {4} and not poses.known.any()


@pytest.mark.parametrize("max_gap, filled", [(2, True), (1, False)])
def test_gaps_are_filled_up_to_max_gap(reconstructed, tmp_path, monkeypatch, max_gap, filled):
    """Where the error is small enough; frames without a camera are named."""
    monkeypatch.setattr("reobj.poses.estimate.MAX_GAP", max_gap)
    monkeypatch.setattr("reobj.poses.localize.INLIER_PX", 1000.0)  # camera shake
    video, _, _, poses = reconstructed
    video = FakeVideo(video.images, [f"{k:03d}.jpg" for k in range(30)])
    cams, status = poses.cam_from_world.copy(), poses.status.copy()
    cams[11:13], status[11:13] = np.nan, "none"
    monkeypatch.setattr("reobj.poses.estimate._frame_name", lambda _, k: f"frame_{k:06d}.jpg")
    monkeypatch.setattr(
        "reobj.poses.estimate.locate_between",
        lambda model, rows, *_: Located(model, rows, rows, cams, status),
    )
    found = rt.estimate_poses(video, config(), tmp_path)
    assert found.known.all() == filled and (found.status[11] == "interpolated") == filled
    assert ("2 interpolated" in found.cameras_text) == filled and found.measured.sum() == 28
    assert bool(found.messages) != filled
    if not filled:
        assert "2 of 30 frames have no camera: frames 11-12 (2: 011.jpg, 012" in found.messages[0]
        assert "show too few points" in found.messages[0] and "are next to" not in found.messages[0]


# ---- Failures ------------------------------------------------------------------------------------


def test_a_smaller_step_is_advised_first(tmp_path):
    """Of every sixth frame some do not connect: two rooms."""
    video = FakeVideo(textured_room(5, 3.0)[0] + textured_room(4, 3.0, seed=5)[0])
    video.config = rt.InputConfig(every=6)
    first, *others = rt.estimate_poses(video, config(), tmp_path).messages
    assert "--every 6" in first and "--every 3" in first and others
    assert not any("--every" in text for text in others)


@pytest.mark.parametrize(
    "images, message",
    [
        (textured_room(1, 0)[0], "only 1 different view"),
        ([np.zeros((240, 320, 3), np.uint8)] * 45, "no image has texture"),  # black
        (textured_room(1, 0)[0] * 45, "only 2 different views"),  # still
    ],
)
def test_failures_are_reported_with_a_remedy(tmp_path, images, message):
    poses = rt.estimate_poses(FakeVideo(images), config(), tmp_path)
    assert not poses.known.any() and poses.source == "none" and set(poses.status) == {"none"}
    assert len(poses.frame) == len(images) and poses.cam_from_world.shape == (len(images), 3, 4)
    assert message in poses.messages[0] and "--poses" in poses.messages[0]
    assert "--every" not in " ".join(poses.messages)
    assert poses.camera.K[0, 0] == pytest.approx(0.8 * images[0].shape[1])


def test_empty_video_and_live_camera_are_refused(tmp_path):
    with pytest.raises(rt.ReobjError, match="no readable frame"):
        rt.estimate_poses(FakeVideo([]), config(), tmp_path)
    video = blank(3)
    video.is_live = True
    with pytest.raises(rt.ReobjError, match="live"):
        rt.estimate_poses(video, config(), tmp_path)


# ---- Breaks --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parts, rows",
    [
        ([[0, 10, 20, 30, 40, 50]], []),  # nothing broke
        ([[0, 10, 20], [30, 40, 50]], [*range(11, 40)]),  # the step between, and one on each side
        ([[0, 10, 20, 40, 50]], [*range(11, 50)]),  # a keyframe in no component
        ([[10, 20, 30, 40, 50]], [*range(1, 20)]),  # the first
        ([[0, 10, 20, 30, 40]], [*range(31, 50)]),  # the last
    ],
)
def test_more_keyframes_around_breaks(parts, rows, monkeypatch):
    keys, parts = [0, 10, 20, 30, 40, 50], [np.array(part) for part in parts]
    monkeypatch.setattr("reobj.poses.estimate.MAX_EXTRA", 9)
    assert rows_around_breaks(keys, parts) == [row for row in rows if row % 10]
    monkeypatch.setattr("reobj.poses.estimate.MAX_EXTRA", 1)
    assert rows_around_breaks(keys, parts) == [row for row in rows if row % 10 == 5]


def test_no_keyframes_between_adjacent_rows():
    parts = [np.array([0, 1, 2]), np.array([3, 4])]
    assert rows_around_breaks([0, 1, 2, 3, 4], parts) == []
    assert rows_around_breaks([0, 1, 2, 5, 6], [np.array([0, 1, 2]), np.array([5, 6])]) == [3, 4]


def test_a_broken_reconstruction_is_repeated_with_more_keyframes(walk, tmp_path, monkeypatch):
    """Once, including the earlier keyframes; ids are frame numbers."""
    calls = []

    def broken(images, ids, names, *args, work_dir, **options):
        calls.append(list(ids))
        source = pycolmap.Reconstruction(str(walk[2] / "sparse"))
        models = []
        keys = sorted(source.reg_image_ids())
        for number, own in enumerate((keys[:6], keys[6:])):
            made = pycolmap.Reconstruction(source)
            for image_id in set(keys) - set(own):
                made.deregister_frame(made.image(image_id).frame_id)
            models.append(work_dir / (f"sparse_part{number}" if number else "sparse"))
            shutil.rmtree(models[-1], ignore_errors=True)
            models[-1].mkdir()
            made.write(str(models[-1]))
        return Mapped(models, [])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", broken)
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
    poses = rt.estimate_poses(walk[0], config(), tmp_path)
    assert len(calls) == 2 and set(calls[0]) < set(calls[1])
    keys = [row + 1 for row in np.flatnonzero(walk[3].status == "keyframe")]
    assert calls[0] == keys and calls[1] == sorted(calls[1])
    assert poses.part_count == 2 and poses.known[walk[3].status == "keyframe"].all()
    assert (np.diff(poses.part) >= 0).all() or set(poses.part) == {0, 1}
    assert poses.visibility[:, 1].max() < len(poses.points)
    seen = poses.part[poses.visibility[:, 0]]  # (M,) rows of points of component 0 come first
    assert poses.visibility[seen == 0, 1].max() < poses.visibility[seen == 1, 1].min()
    assert "broke between frames 22 and 23" in poses.messages[0]


# ---- Interrupted runs ----------------------------------------------------------------------------


class Interrupted:
    """A run of `estimate_poses` that ends when the keyframes are mapped.

    Attributes:
        seen: ids and images of the keyframes of the last run. picked: how often some were chosen.
    """

    def __init__(self, folder, monkeypatch):
        self.folder = folder
        self.seen = None
        self.picked = 0
        self.images, _ = textured_room(50, 0.1, -0.8, size=(160, 120))
        monkeypatch.setattr(estimate, "mapping_child", lambda _: contextlib.nullcontext())
        monkeypatch.setattr(estimate, "MIN_KEYFRAMES", 20)
        monkeypatch.setattr(estimate, "reconstruct", self.interrupt)
        monkeypatch.setattr(estimate, "pick_keyframes", self.pick)

    def interrupt(self, images, ids, *_, **__):
        self.seen = list(ids), np.array(list(images))
        raise KeyboardInterrupt

    def pick(self, *args):
        self.picked += 1
        return pick_keyframes(*args)

    def run(self, fingerprint="one", **changes):
        video = FakeVideo(self.images)
        video.fingerprint = fingerprint
        self.picked = 0
        with contextlib.suppress(KeyboardInterrupt):
            rt.estimate_poses(video, config(**changes), self.folder)
        return self.seen


@pytest.fixture
def interrupted(tmp_path, monkeypatch):
    made = Interrupted(tmp_path, monkeypatch)
    made.run()
    return made


def test_keyframes_of_an_interrupted_run_are_not_chosen_again(interrupted):
    ids, images = interrupted.seen
    assert interrupted.picked > 1 and 10 < len(ids) < 50  # the steps were halved: some are spare
    again_ids, again = interrupted.run()
    assert interrupted.picked == 0 and again_ids == ids
    np.testing.assert_array_equal(again, images)
    np.testing.assert_array_equal(again, np.array(interrupted.images)[np.array(ids) - 1])


@pytest.mark.parametrize("change", [{"fingerprint": "other"}, {"size_px": 80}])
def test_keyframes_of_another_video_or_size_are_chosen_anew(interrupted, change):
    interrupted.run(**change)
    assert interrupted.picked > 0
    interrupted.run(**change)
    assert interrupted.picked == 0


def damaged_text(table, raw):
    table.write_text(table.read_text()[:-20])


def damaged_list(table, raw):
    table.write_text("[1, 2]")


def missing_image(table, raw):
    os.truncate(raw, raw.stat().st_size - 57600)


@pytest.mark.parametrize("damage", [damaged_text, damaged_list, missing_image])
def test_damaged_files_of_an_interrupted_run_are_ignored(interrupted, damage):
    ids, images = interrupted.seen
    damage(interrupted.folder / "keyframes.json", interrupted.folder / "keyframes.raw")
    again_ids, again = interrupted.run()
    assert interrupted.picked > 0 and again_ids == ids
    np.testing.assert_array_equal(again, images)


def test_files_of_keyframes_are_gone_after_success(interrupted, monkeypatch):
    assert {"keyframes.json", "keyframes.raw"} <= {p.name for p in interrupted.folder.iterdir()}
    monkeypatch.setattr(estimate, "reconstruct", lambda *_, **__: Mapped([], ["stopped"]))
    interrupted.run()
    assert not list(interrupted.folder.iterdir())


def test_images_added_after_an_interruption_are_their_own(tmp_path):
    """The interrupted run may have written some more images, the last one incompletely."""
    images = np.random.default_rng(0).integers(0, 255, (6, 12, 16, 3)).astype(np.uint8)
    video = ResizedVideo(FakeVideo(images), 16)
    frames = list(video)
    video.frames = list(range(6))
    video.times_s = [0.1 * k for k in range(6)]
    store = KeyframeStore(tmp_path, "key")
    store.save(video, [store.keep(frames[row]) for row in (0, 3)])
    store.keep(frames[1])
    with open(tmp_path / "keyframes.raw", "ab") as file:
        file.write(b"begun")
    again = KeyframeStore(tmp_path, "key")
    empty = ResizedVideo(FakeVideo(images), 16)
    keys = again.load(empty)
    assert keys == [Keyframe(0, 0), Keyframe(3, 3)]
    assert (empty.frames, empty.times_s) == (video.frames, video.times_s)
    keys += [again.keep(frames[row]) for row in (3, 5, 2)]
    np.testing.assert_array_equal(list(again.images_of(keys)), images[[0, 3, 3, 5, 2]])


def test_a_table_does_not_outlive_the_images_it_lists(tmp_path):
    """A second run with other options began to write its own images and was interrupted too."""
    images = np.random.default_rng(0).integers(0, 255, (3, 12, 16, 3)).astype(np.uint8)
    video = ResizedVideo(FakeVideo(images), 16)
    frames = list(video)
    first = KeyframeStore(tmp_path, "first")
    first.save(video, [first.keep(frames[0])])
    second = KeyframeStore(tmp_path, "second")
    assert second.load(video) is None
    second.keep(frames[1])
    assert KeyframeStore(tmp_path, "first").load(video) is None


# ---- Repeated views ------------------------------------------------------------------------------


def test_a_video_that_goes_back_and_forth_is_mapped_once(tmp_path, monkeypatch):
    """Keyframes of the way back are registered without being mapped; all frames have a pose."""
    images, truth = textured_room(48, 0.075, -0.5, size=(240, 180))
    rows = [*range(0, 48, 2), *range(47, 0, -2)]  # back between the places of the way forth
    mapped = []

    class Here:
        """Does the job in this process."""

        def run(self, progress):
            sfm._do_job(tmp_path / "mapping")
            return ""

    def note(search):
        mapped.append(list(search.frames.values()))
        return map_keyframes(search)

    few = functools.partial(find_repeated, options=RedundancyOptions(map_all_of=8, block=4))
    monkeypatch.setattr(sfm, "find_repeated", few)
    monkeypatch.setattr(sfm, "map_keyframes", note)
    monkeypatch.setattr(estimate, "mapping_child", lambda _: contextlib.nullcontext(Here()))
    monkeypatch.setattr(estimate, "MAX_KEYFRAMES", 16)
    monkeypatch.setattr(estimate, "MIN_KEYFRAMES", 8)
    options = config(camera="216,216,120,90")
    poses = rt.estimate_poses(FakeVideo([images[row] for row in rows]), options, tmp_path)
    assert poses.known.all() and poses.messages == () and set(poses.status) == {"keyframe", "pnp"}
    assert ate_percent(poses.cam_from_world, truth[rows]) < 1.0
    keys = np.flatnonzero(poses.status == "keyframe")
    registered = set(keys.tolist()) - set(mapped[0])
    assert len(mapped) == 1 and sum(row >= 24 for row in registered) > 2  # of the way back
    kept = rt.read_poses(tmp_path / "sparse", FakeVideo(images))
    np.testing.assert_array_equal(np.flatnonzero(kept.known), keys)


# ---- EXIF ----------------------------------------------------------------------------------------


def photo_with_exif(path, image, focal_35mm):
    """Write a JPEG whose EXIF says FocalLengthIn35mmFilm."""
    number = struct.pack("<H", 1)
    tiff = b"II*\0\x08\0\0\0" + number + struct.pack("<HHII", 0x8769, 4, 1, 26) + bytes(4)
    tiff += number + struct.pack("<HHIHH", 0xA405, 3, 1, focal_35mm, 0) + bytes(4)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    head = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(head) + 2) + head + data[2:])


@pytest.mark.parametrize("focal_35mm", [48, 0])
def test_the_exif_focal_length_replaces_the_default_guess(tmp_path, monkeypatch, focal_35mm):
    """COLMAP: 48 mm of a film whose diagonal is 43.27 mm."""
    images = textured_room(3, 0.5)[0]
    (tmp_path / "photos").mkdir()
    for i, image in enumerate(images):
        photo_with_exif(tmp_path / "photos" / f"{i}.jpg", image, focal_35mm)
    video = rt.Video(tmp_path / "photos")
    guess = seen_job(monkeypatch, video, tmp_path / "work")["focal_guess"]
    exif = 48 / np.hypot(36, 24) * np.hypot(480, 360) / 480
    assert guess == (pytest.approx(exif, rel=1e-3) if focal_35mm else 0.8)
