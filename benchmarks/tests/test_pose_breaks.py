"""The benchmark of broken reconstructions: its verdicts on known cases."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pose_breaks as pb
import pytest
from pose_worlds import motion
from scipy.spatial.transform import Rotation

import reobj_track as rt

COUNT = 40
HALF = np.arange(COUNT) >= COUNT // 2
ONE_WORLD = np.zeros(COUNT, np.int64)
CAMERA = rt.Camera("PINHOLE", 320, 240, (250.0, 250.0, 160.0, 120.0))


def moved(cams: np.ndarray, seed: int, scale: float = 1.0) -> np.ndarray:
    """The same cameras (n, 3, 4) in another world: x' = scale Q x + c."""
    rng = np.random.default_rng(seed)
    q, c = Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 3, 3)
    turn = cams[:, :, :3] @ q.T
    shift = scale * cams[:, :, 3] - turn @ c
    return np.concatenate([turn, shift[:, :, None]], 2)


def poses(cams: np.ndarray, part=None, messages=(), status="keyframe") -> rt.Poses:
    count = len(cams)
    known = np.isfinite(cams).all((1, 2))
    return rt.Poses(
        CAMERA, np.arange(count), np.arange(count) / 30.0, cams,
        np.where(known, status, "none").astype("U12"), "pycolmap",
        part=np.zeros(count, np.int64) if part is None else np.asarray(part, np.int64),
        messages=tuple(messages),
    )  # fmt: skip


def torn(truth: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Move the second half by a separate similarity."""
    return np.where(HALF[:, None, None], moved(truth, 8, scale), moved(truth, 7, 3.0))


@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward"])
def test_right_poses_are_whole_in_any_world_and_scale(kind: str) -> None:
    truth = motion(kind, COUNT)
    verdict = pb.judge(poses(moved(truth, 1, 7.5)), truth, ONE_WORLD)
    assert verdict.outcome == "whole" and verdict.wrong == () and verdict.centre < 1e-6


@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward"])
def test_a_torn_component_passes_unless_messages_name_its_frames(kind: str) -> None:
    truth = motion(kind, COUNT)
    verdict = pb.judge(poses(torn(truth)), truth, ONE_WORLD)
    assert verdict.outcome == "passed"
    assert set(verdict.wrong) in (set(np.flatnonzero(HALF)), set(np.flatnonzero(~HALF)))
    named = pb.spans(verdict.wrong)
    said = pb.judge(poses(torn(truth), messages=[f"off: frames {named}"]), truth, ONE_WORLD)
    assert said.outcome == "said"
    other = pb.judge(poses(torn(truth), messages=["sizes are rough"]), truth, ONE_WORLD)
    assert other.outcome == "passed"


def test_the_same_halves_as_two_components_are_right() -> None:
    truth = motion("orbit", COUNT)
    verdict = pb.judge(poses(torn(truth), part=HALF), truth, ONE_WORLD)
    assert (verdict.outcome, verdict.parts) == ("partly", 2)


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_a_jump_of_scale_alone_is_detected(scale: float) -> None:
    truth = motion("walk", COUNT)
    centre, turn = pb.world_from_cam(truth)
    seam = centre[COUNT // 2]
    centre = np.where(HALF[:, None], seam + scale * (centre - seam), centre)
    shift = -(np.swapaxes(turn, 1, 2) @ centre[:, :, None])
    verdict = pb.judge(poses(np.concatenate([truth[:, :, :3], shift], 2)), truth, ONE_WORLD)
    assert verdict.outcome == "passed"


def test_two_scenes_in_one_component_are_wrong() -> None:
    truth = motion("orbit", COUNT)
    verdict = pb.judge(poses(truth), truth, HALF.astype(np.int64))
    assert verdict.outcome == "passed" and len(verdict.wrong) == COUNT // 2
    assert pb.judge(poses(truth, part=HALF), truth, HALF.astype(np.int64)).outcome == "partly"


def test_frames_without_pose_and_refusals_are_no_failures() -> None:
    truth = motion("orbit", COUNT)
    some, none = truth.copy(), np.full_like(truth, np.nan)
    some[HALF] = np.nan
    assert pb.judge(poses(some), truth, ONE_WORLD).outcome == "partly"
    assert pb.judge(poses(none), truth, ONE_WORLD).outcome == "refused"


def test_single_wrong_poses_are_counted_and_many_are_a_break() -> None:
    truth = motion("orbit", COUNT)
    one, many = truth.copy(), truth.copy()
    one[11, :, 3] += 500
    many[11:16, :, 3] += 500
    verdict = pb.judge(poses(one), truth, ONE_WORLD)
    assert (verdict.outcome, verdict.strays) == ("whole", 1)
    verdict = pb.judge(poses(many), truth, ONE_WORLD)
    assert (verdict.outcome, verdict.wrong) == ("passed", (11, 12, 13, 14, 15))


def test_a_wrong_rotation_at_the_right_centre_is_detected() -> None:
    truth = motion("walk", COUNT)
    centre, turn = pb.world_from_cam(truth)
    rolled = np.where(
        HALF[:, None, None], turn @ Rotation.from_rotvec([0, 0, 0.5]).as_matrix(), turn
    )
    back = np.swapaxes(rolled, 1, 2)
    found = np.concatenate([back, -(back @ centre[:, :, None])], 2)
    assert pb.judge(poses(found), truth, ONE_WORLD).outcome == "passed"


def test_interpolated_frames_and_frames_without_truth_are_not_scored() -> None:
    truth = motion("orbit", COUNT)
    unknown = np.where(HALF[:, None, None], np.nan, truth)
    assert pb.judge(poses(torn(truth)), unknown, ONE_WORLD).outcome == "whole"
    marked = poses(torn(truth))
    marked.status[HALF] = "interpolated"
    assert pb.judge(marked, truth, ONE_WORLD).wrong == ()


def test_messages_name_frames() -> None:
    text = ["frames 3-5, 9: off", "of 12 frames 2 are lost", "frame 40 and 41", "7 of 90 frames 3"]
    assert pb.named_frames(text) >= {3, 4, 5, 9, 40, 41}
    assert pb.named_frames(["240 of 240 frames", "sizes are rough"]) == set()


# ---- Breaks ----


class FakeShelf:
    """Clips on an orbit whose images encode their number."""

    def clip(self, name: str) -> pb.Clip:
        count = 60
        images = np.zeros((count, 24, 32, 3), np.uint8)
        images[..., 0], images[:, :, :16, 1] = np.arange(count)[:, None, None], 200
        return pb.Clip(images, motion("orbit", count), np.zeros(count, np.int64), 0.8)


@pytest.mark.parametrize("kind", sorted(pb.KINDS))
def test_breaks_keep_images_and_truth_aligned(kind: str) -> None:
    changed, original = set(), motion("orbit", 60)
    for seed in range(6):
        clip, what = pb.KINDS[kind](FakeShelf(), ["room", "tour"], np.random.default_rng(seed))
        again, _ = pb.KINDS[kind](FakeShelf(), ["room", "tour"], np.random.default_rng(seed))
        np.testing.assert_array_equal(clip.images, again.images)
        changed.add(what)
        assert len(clip.images) == len(clip.truth) == len(clip.world) >= 16
        if kind in ("thin", "zoomed", "two_rooms"):
            continue
        number = clip.images[:, 0, 0, 0]
        flipped = clip.images[:, 0, 0, 1] == 0
        np.testing.assert_array_equal(clip.truth[~flipped], original[number[~flipped]])
        np.testing.assert_array_equal(flipped, clip.world < 0)
        assert flipped.any() == kind.startswith("mirrored")
    assert len(changed) == 6


def test_two_rooms_are_two_scenes() -> None:
    for seed in range(20):
        names = ["room", "walk", "orbit", "tour"]
        _, what = pb.two_rooms(FakeShelf(), names, np.random.default_rng(seed))
        assert "tour" in what  # the others have one plan, in other colours


def test_mirrored_cameras_see_the_mirrored_world() -> None:
    clip = FakeShelf().clip("")
    flipped = pb.mirrored(clip, np.arange(30, 60))
    x = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for i in (3, 40):
        before = x @ clip.truth[i, :, :3].T + clip.truth[i, :, 3]
        seen = x * [-1, 1, 1] if i >= 30 else x
        after = seen @ flipped.truth[i, :, :3].T + flipped.truth[i, :, 3]
        np.testing.assert_allclose(after, before * ([-1, 1, 1] if i >= 30 else 1), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(flipped.truth[:, :, :3]), 1)
    np.testing.assert_array_equal(flipped.images[40], clip.images[40][:, ::-1])


def test_zoom_keeps_the_middle_and_moves_the_rest_outwards() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    cv2.circle(image, (50, 30), 3, (255, 255, 255), -1)
    wide = pb.zoomed(image, 1.5, (80, 60)).astype(float).sum(2)
    center = (wide.sum(0) * (np.arange(80) + 0.5)).sum() / wide.sum()
    assert center - 40 == pytest.approx(1.5 * (50.5 - 40), abs=0.3)
    np.testing.assert_array_equal(pb.zoomed(image, 1.0, (80, 60)), image)


def test_two_recordings_get_one_focal_length() -> None:
    images = np.zeros((2, 90, 160, 3), np.uint8)
    clip = pb.Clip(images, motion("walk", 2), np.zeros(2, np.int64), 0.5)
    cut = pb.with_focal(clip, 0.8, (80, 60))
    assert cut.focal == pytest.approx(0.8) and cut.images.shape == (2, 60, 80, 3)
    square = pb.with_focal(clip, 0.1, (80, 60))  # 160x90 to 4:3 leaves 120 of the width
    assert square.focal == pytest.approx(0.5 * 160 / 120)


# ---- The run ----


def test_table_counts_and_names_what_failed() -> None:
    line = {"case": "turn-001", "kind": "turn", "outcome": "passed", "look": "part 0", "cpu_s": 2.0}
    text = pb.table([line, line | {"case": "turn-002", "outcome": "refused"}])
    assert "| turn | 2 | 0 | 0 | 1 | 0 | 1 | 0 |" in text and "1 of 2" in text
    assert "- turn-001" in text and "- turn-002" not in text
    good = {"case": "good-room", "kind": "good", "outcome": "whole", "look": "", "cpu_s": 1.0}
    good |= {"parts": 1, "right": pb.RECORDINGS["room"].today}
    assert not pb.failed(good)
    changes = {"right": 100}, {"parts": 2}, {"outcome": "said"}, {"outcome": "passed"}
    assert all(pb.failed(good | change) for change in changes)


def test_results_of_a_call_that_was_killed_are_read(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({"case": "turn-000"}) + "\n" + '{"case": "turn-0')
    assert list(pb.read_results(path)) == ["turn-000"]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> pb.Clip:
    shelf = pb.Shelf(Path("nowhere"), tmp_path_factory.mktemp("cache"))
    return shelf.clip("room").rows(slice(0, 60, 2))


def verdict_of(clip: pb.Clip, folder: Path) -> pb.Verdict:
    pb.write_pictures(clip, folder / "images")
    (folder / "sfm").mkdir()
    found = rt.estimate_poses(rt.Video(folder / "images"), pb.SHORT, folder / "sfm")
    return pb.judge(found, clip.truth, clip.world)


def test_a_good_interval_is_reconstructed_completely(room: pb.Clip, tmp_path: Path) -> None:
    verdict = verdict_of(room, tmp_path)
    assert verdict.outcome == "whole" and verdict.centre < 0.02 and verdict.turn_deg < 2


def test_a_mirrored_half_does_not_pass(room: pb.Clip, tmp_path: Path) -> None:
    broken = pb.mirrored(room, np.arange(15, 30))
    assert verdict_of(broken, tmp_path).outcome in ("partly", "refused", "said")
