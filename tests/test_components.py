"""A trajectory in two unconnected components: each has its own frame, in every file."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from simulated import (
    BREAK,
    COMPONENTS,
    chair_solids,
    finished,
    into_component,
    tracks_in_two_components,
    tracks_of,
    two_components,
    unlinked,
    walk,
)

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.evaluation.objects import score_objects

CENTERS = chair_solids().center_in_world


# ---- Linked and fitted ----


def test_every_component_has_its_own_identities(broken_walk: rt.Result) -> None:
    """Tracks continue over the break, but their positions after it are unrelated."""
    assert [(o.id, o.part) for o in broken_walk.objects] == [
        (1, 0), (2, 0), (3, 0), (4, 1), (5, 1), (6, 1),
    ]  # fmt: skip
    tracks = broken_walk.tracks
    assert set(tracks.track_id[tracks.frame < BREAK]) == {1, 2, 3}
    assert set(tracks.track_id[tracks.frame >= BREAK]) == {4, 5, 6}
    np.testing.assert_array_equal(tracks.track_id % 3, (tracks.detection_index + 1) % 3)
    assert [o.visits for o in broken_walk.objects] == [[[0, 39]]] * 3 + [[[40, 63]]] * 3
    assert len({t for o in broken_walk.objects for t in o.tracklet_ids}) == 6


def test_embeddings_stay_with_their_boxes() -> None:
    """Half of the boxes were embedded, the first of them too; identities are linked again."""
    poses = walk(24)
    before = unlinked(poses, tracks_of(poses))
    row = np.arange(0, len(before.tracks), 2)
    name = before.tracks.xyxy[row, :1].astype(np.float16)
    after = finished(
        dataclasses.replace(before, embeddings=rt.Embeddings(name, -name), embedding_row=row)
    )
    for values, sign in ((after.embeddings.foreground, 1), (after.embeddings.background, -1)):
        found = after.tracks.xyxy[after.embedding_row, :1].astype(np.float16)
        np.testing.assert_array_equal(found, sign * values)
    assert len(found) == len(row)


def test_a_component_equals_the_result_of_a_separate_video(broken_walk: rt.Result) -> None:
    for component in (0, 1):
        poses = broken_walk.poses.of_part(component)
        tracks = tracks_in_two_components(broken_walk.poses)
        alone = finished(unlinked(poses, tracks[np.isin(tracks.frame, poses.frame)]))
        own = [o for o in broken_walk.objects if o.part == component]
        assert len(alone.objects) == len(own) == 3
        for a, b in zip(alone.objects, own, strict=True):
            a, b = a.to_json(), b.to_json()
            for key in ("id", "part", "tracks"):
                del a[key], b[key]
            assert a == b
        (facts,) = alone.world.to_json()["parts"]
        assert facts == broken_walk.world.to_json()["parts"][component]


def test_the_world_describes_its_components(broken_walk: rt.Result) -> None:
    world = broken_walk.world
    assert [(p.spans, p.frames, p.registered_frames) for p in world.parts] == [
        ([[0, 39]], 40, 38), ([[40, 63]], 24, 23),
    ]  # fmt: skip
    for component, (scale, turn, _) in zip(world.parts, COMPONENTS, strict=True):
        assert component.scale.source == "priors"
        np.testing.assert_allclose(component.scale.value, 1 / scale, rtol=0.2)
        up = into_component(COMPONENTS.index((scale, turn, _)), np.array([[0, 0, 1.0], [0, 0, 0]]))
        np.testing.assert_allclose(component.up_in_world, (up[0] - up[1]) / scale, atol=0.03)
    largest = world.parts[0]  # the fields that predate components
    assert world.registered_frames == 38 and world.frames == 64
    assert world.scale == largest.scale and world.up_source == largest.up_source
    np.testing.assert_array_equal(world.up_in_world, largest.up_in_world)


# ---- Files ----


def test_each_component_has_its_own_files(broken_walk_folder: Path) -> None:
    poses = two_components()
    for component, name in enumerate(("poses.txt", "poses_part1.txt")):
        own = poses.of_part(component)
        table = np.loadtxt(broken_walk_folder / name)
        np.testing.assert_allclose(table[:, 0], own.time_s[own.known], atol=1e-6)
        centers = invert_rigid(own.cam_from_world[own.known])[:, :, 3]
        np.testing.assert_allclose(table[:, 1:4], centers, atol=1e-6)
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    for component, name in enumerate(("objects.ply", "objects_part1.ply")):
        mesh = trimesh.load(broken_walk_folder / name)
        middle = into_component(component, CENTERS).mean(0)
        np.testing.assert_allclose(
            mesh.vertices.mean(0), middle, atol=0.02 * COMPONENTS[component][0]
        )


def test_the_summary_has_a_line_for_each_component(broken_walk: rt.Result) -> None:
    lines = broken_walk.summary().splitlines()
    cameras = "cameras: 61 of 64 frames (pycolmap) in 2 components"
    assert f"{cameras}, each with its own frame and scale" in lines
    first, second = (line for line in lines if re.match(r"component \d: ", line))
    objects = "3 objects with a shape; scale "
    assert first.startswith(f"component 0: frames 0-39; 38 of 40 frames; {objects}")
    assert second.startswith(f"component 1: frames 40-63; 23 of 24 frames; {objects}")
    groups = [k for k, line in enumerate(lines) if line in ("component 0", "component 1")]
    assert ["measured" in line for line in lines[groups[1] + 1 : groups[1] + 4]] == [True] * 3
    assert groups[1] - groups[0] == 4
    assert not [line for line in lines if line.startswith("scale")]
    mixed = dataclasses.replace(
        broken_walk, objects=sorted(broken_walk.objects, key=lambda o: o.id % 3)
    )
    lines = mixed.summary().splitlines()
    assert [k for k, line in enumerate(lines) if line in ("component 0", "component 1")] == groups


# ---- Exports and scores ----


def truth(tmp_path: Path, frames: int = 64) -> tuple[Path, Path]:
    """True solids 1 to 3, and true cameras of the first frames."""
    solids, eyes = chair_solids(), true_eyes()
    entries = [
        {"id": i + 1, "center": solids.center_in_world[i].tolist(),
         "size": (2 * solids.half_axes[i]).tolist(), "R": solids.world_from_obj[i].tolist()}
        for i in range(3)
    ]  # fmt: skip
    (tmp_path / "gt_objects.json").write_text(json.dumps({"objects": entries}))
    c2w = np.tile(np.eye(4), (frames, 1, 1))
    c2w[:, :3, 3] = eyes[:frames]
    np.savetxt(tmp_path / "poses_c2w.txt", c2w.reshape(-1, 16))
    return tmp_path / "gt_objects.json", tmp_path / "poses_c2w.txt"


def true_eyes() -> np.ndarray:
    return invert_rigid(walk(64, 200.0).cam_from_world)[:, :, 3]


def test_each_component_is_aligned_and_scored_separately(
    broken_walk: rt.Result, tmp_path: Path
) -> None:
    pairs: dict[int, int | None] = {1: 1, 2: 5, 3: 6}  # one of component 0, two of component 1
    found = score_objects(broken_walk, *truth(tmp_path), pairs)
    assert (found["true"], found["found"]) == (3, 3)
    assert found["o3d_all"] > 0.9 and found["center_error_median"] < 0.02
    errors = found["part_scale_errors"]
    assert found["scale_error"] == errors[0] and len(errors) == 2 and max(errors) < 0.2
    scales = [component.scale.value * scale for component, (scale, *_) in zip(
        broken_walk.world.parts, COMPONENTS, strict=True)]  # fmt: skip
    np.testing.assert_allclose(errors, np.abs(np.array(scales) - 1), atol=5e-3)


def test_objects_that_are_seen_through_are_less_probable() -> None:
    """Every camera observes points behind the first chair, on rays through its middle."""
    plain = finished(unlinked(walk(), tracks_of(walk()))).objects
    poses, chair = walk(), np.array(plain[0].center)
    camera = -np.einsum("fji,fj->fi", poses.cam_from_world[:, :, :3], poses.cam_from_world[:, :, 3])
    points = camera + 1.5 * (chair - camera)  # (F, 3)
    own = np.repeat(np.arange(len(points))[:, None], 2, 1)
    colors = np.zeros(points.shape, np.uint8)
    poses = dataclasses.replace(poses, points=points, colors=colors, visibility=own)
    seen = finished(unlinked(poses, tracks_of(poses))).objects
    assert [o.id for o in seen] == [o.id for o in plain]
    change = [a.confidence - b.confidence for a, b in zip(plain, seen, strict=True)]
    assert change[0] > 0.005 and np.allclose(change[1:], 0)


def test_a_scale_of_depth_maps_is_one_statement_with_a_sigma() -> None:
    """In the summary and in every size, in each component; a known size replaces it."""
    metric = dataclasses.replace(walk(), metric=True, scale=(1.0, 0.03), source="pycolmap")
    result = finished(unlinked(metric, tracks_of(metric)))
    (line,) = (line for line in result.summary().splitlines() if line.startswith("scale"))
    assert line == "scale: 1.00 m per unit, sigma 3 % (from depth maps)"
    supplied = finished(unlinked(dataclasses.replace(metric, scale=None), tracks_of(metric)))
    for ours, theirs in zip(result.objects, supplied.objects, strict=True):
        more = np.square(ours.size_rel_sigma) - np.square(theirs.size_rel_sigma)
        np.testing.assert_allclose(more, 0.03**2, rtol=0.05)
    components = finished(
        unlinked(dataclasses.replace(two_components(), metric=True, scale=(1.0, 0.03)))
    )
    assert [p.scale.source for p in components.world.parts] == ["depth_maps"] * 2
    known = finished(unlinked(metric, tracks_of(metric)), known_size="chair=.8m")
    assert known.world.scale.source == "known_size"
