"""Results of a run, written and read back; every file is also read by an independent reader."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import CHAIR, CUP, chair_solids, fitted, tracks_of, walk, with_columns

import quadrics
import reobj_track as rt
from reobj.results.entries import decode
from reobj.results.ply import write_ply
from reobj.results.report import sides
from reobj.results.result import VideoInfo
from reobj.results.saving import validate_objects, write_mot
from reobj.results.stages import tracked_embeddings


def copy_of(result: rt.Result, **changes: object) -> rt.Result:
    return dataclasses.replace(result, **changes)  # type: ignore[arg-type]


@pytest.fixture
def saved(chairs: rt.Result, tmp_path: Path) -> Path:
    out = tmp_path / "out"
    copy_of(chairs).save(out)
    return out


# ---- Written, then read ----


def test_doubtful_objects_are_in_the_list_and_not_in_the_tracks(
    chairs: rt.Result, tmp_path: Path
) -> None:
    first, *rest = chairs.objects
    objects = [dataclasses.replace(first, status="doubtful", confidence=0.3), *rest]
    result = copy_of(chairs, objects=objects)
    for asked in (False, True):
        result.save(tmp_path, doubtful=asked)
        found = rt.Result.load(tmp_path)
        assert [o.id for o in found.objects] == [o.id for o in objects]
        assert (first.id in found.tracks.track_id) == asked
        assert set(found.tracks.track_id) >= {o.id for o in rest}


def test_implausible_objects_keep_their_tracks_and_are_not_counted(
    chairs: rt.Result, tmp_path: Path
) -> None:
    first, *rest = chairs.objects
    why = "size is 7.2 sigma from the usual one: another object?"
    odd = dataclasses.replace(first, status="implausible", reason=why)
    result = copy_of(chairs, objects=[odd, *rest], fits=None)
    result.save(tmp_path)
    assert validate_objects(tmp_path / "objects.json") == []
    found = rt.Result.load(tmp_path)
    assert [o.status for o in found.objects] == ["implausible", "ok", "ok"]
    assert first.id in found.tracks.track_id and [o.id for o in found.located] == [2, 3]
    lines = " ".join(found.summary().split())
    assert f"implausible, not counted: chair 1 ({why})" in lines
    assert "2 objects with a shape: 2 chair" in lines and "low confidence" not in lines
    assert not any(line.split()[:1] == ["1"] for line in found.summary().splitlines())
    data = json.loads((tmp_path / "objects.json").read_text())
    data["objects"][0]["center"] = None
    (tmp_path / "objects.json").write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match="object 1 is implausible without a shape"):
        rt.Result.load(tmp_path)


def test_save_then_load_gives_the_same(chairs: rt.Result, tmp_path: Path) -> None:
    poses = dataclasses.replace(chairs.poses, points=np.eye(3), colors=np.eye(3, dtype=np.uint8),
                                messages=("a gap",))  # fmt: skip
    links = (rt.LinkEvent("join", (1, 4), 0.5, 1.25, True),
             rt.LinkEvent("split", (3, 2), None, -0.75, False))  # fmt: skip
    scale = quadrics.Scale(0.5, 0.125, "priors")
    world = dataclasses.replace(chairs.world, links=links, scale=scale)
    rejected = rt.Object(4, "cup", 0.5, "rejected", "no reason", None, tracklet_ids=[7, 9],
                         visits=[[0, 3], [5, 5]])  # fmt: skip
    before = copy_of(chairs, poses=poses, world=world, warnings=["take care"])
    before = dataclasses.replace(before, objects=[*chairs.objects, rejected], fits=None)
    before = before.save(tmp_path)
    after = rt.Result.load(tmp_path)
    assert after.out == before.out == tmp_path
    assert len(after.objects) == 4
    for ours, theirs in zip(before.objects, after.objects, strict=True):
        for f in dataclasses.fields(rt.Object):
            a, b = getattr(ours, f.name), getattr(theirs, f.name)
            assert type(a) is type(b), f.name
            np.testing.assert_array_equal(a, b, f.name)
    for name in {f.name for f in dataclasses.fields(rt.World)} - {"parts"}:
        np.testing.assert_array_equal(getattr(before.world, name), getattr(after.world, name), name)
    assert after.world.to_json()["parts"] == before.world.to_json()["parts"]
    assert after.world.links == links and isinstance(after.world.scale, quadrics.Scale)
    assert after.video == before.video and after.warnings == ["take care"]
    for f in dataclasses.fields(rt.Poses):
        np.testing.assert_array_equal(getattr(poses, f.name), getattr(after.poses, f.name), f.name)
    np.testing.assert_array_equal(after.tracks.frame, before.tracks.frame)
    np.testing.assert_array_equal(after.tracks.track_id, before.tracks.track_id)
    np.testing.assert_allclose(after.tracks.xyxy, before.tracks.xyxy, atol=0.0101)
    np.testing.assert_allclose(after.tracks.score, before.tracks.score, atol=1e-4)
    assert {after.class_names[c] for c in after.tracks.class_id} == {"chair"}


def test_a_loaded_result_saves_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    rt.Result.load(saved).save(again)
    for name in ("tracks.txt", "objects.json", "poses.txt", "cache/last-poses.npz"):
        assert (again / name).read_bytes() == (saved / name).read_bytes(), name
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    a, b = (trimesh.load(out / "objects.ply") for out in (saved, again))
    np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-5)


def test_objects_are_typed(saved: Path) -> None:
    found = rt.Result.load(saved).objects[2]
    assert (found.id, found.class_name, found.status, found.located) == (3, "chair", "ok", True)
    assert found.center.shape == found.size_m.shape == (3,) and found.center.dtype == np.float64
    np.testing.assert_allclose(found.center, chair_solids().center_in_world[2], atol=0.03)


def test_ellipsoids_of_a_loaded_result_are_those_of_the_fit(chairs: rt.Result, saved: Path) -> None:
    ours, theirs = chairs.ellipsoids(), rt.Result.load(saved).ellipsoids()
    np.testing.assert_allclose(theirs.center_in_world, ours.center_in_world, atol=1e-5)
    np.testing.assert_allclose(theirs.half_axes, ours.half_axes, atol=1e-5)
    np.testing.assert_allclose(theirs.world_from_obj, ours.world_from_obj, atol=1e-5)


def test_ellipsoids_leave_rejected_objects_out(chairs: rt.Result) -> None:
    result = copy_of(chairs)
    first = dataclasses.replace(result.objects[0], status="rejected")
    result = dataclasses.replace(result, objects=[first, *result.objects[1:]])
    assert [o.id for o in result.located] == [2, 3]
    np.testing.assert_array_equal(
        result.ellipsoids().center_in_world, chairs.fits.ellipsoids.center_in_world[1:]
    )
    assert len(rt.Result(result.tracks, (), result.video).ellipsoids()) == 0


def test_rows_of_a_class_get_that_of_their_object(chairs: rt.Result, tmp_path: Path) -> None:
    """tracks.txt has no classes; a result without poses and objects loads completely."""
    tracks = chairs.tracks[chairs.tracks.track_id < 3]
    tracks = with_columns(tracks, class_id=np.where(tracks.track_id == 1, CHAIR, CUP))
    fitted(tracks, None).save(tmp_path)
    after = rt.Result.load(tmp_path)
    assert after.poses is None and after.world.scale is None and after.world.units is None
    assert [after.class_names[c] for c in after.tracks.class_id] == [
        rt.COCO_NAMES[c] for c in tracks.class_id
    ]
    assert not (tmp_path / "poses.txt").exists() and not (tmp_path / "objects.ply").exists()


def test_an_empty_result(tmp_path: Path) -> None:
    rt.Result(rt.Tracks.empty(), (), VideoInfo("a.mp4", 64, 48, 25.0)).save(tmp_path)
    after = rt.Result.load(tmp_path)
    assert len(after.tracks) == 0 == len(after.objects) and after.poses is None
    assert validate_objects(tmp_path / "objects.json") == []
    assert after.summary().startswith("objects: none")


def test_files_of_an_earlier_run_are_deleted(chairs: rt.Result, saved: Path) -> None:
    stale = ("poses.txt", "cameras.csv", "objects.ply", "overlay.mp4", "overlay.webm",
             "scene.html")  # fmt: skip
    for name in stale:
        (saved / name).write_text("old")
    (saved / "notes.txt").write_text("mine")
    fitted(chairs.tracks, None).save(saved)
    assert not [name for name in stale if (saved / name).exists()]
    assert (saved / "notes.txt").exists() and rt.Result.load(saved).poses is None


def test_a_full_disk_keeps_the_files_of_an_earlier_run(chairs: rt.Result, saved: Path) -> None:
    """Also if the last step fails: here a file added by the caller."""
    (saved / "scene.html").write_text("old page")
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}

    def full(folder: Path) -> None:
        (folder / "scene.html").write_text("ne")
        raise OSError(28, "No space left on device")

    with pytest.raises(rt.ReobjError, match="No space left"):
        fitted(chairs.tracks, None).save(saved, more=full)
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before


def test_evidence_is_rounded_to_four_digits() -> None:
    links = (rt.LinkEvent("join", (1, 2), 0.123456, -9.87654321, True),
             rt.LinkEvent("join", (1, 3), None, 0.00004, False))  # fmt: skip
    written = rt.World(links=links).to_json()["links"]
    assert [e["place_iou"] for e in written] == [0.1235, None]
    assert [e["appearance_log_odds"] for e in written] == [-9.8765, 0.0]
    again = decode(rt.World, json.loads(json.dumps({"links": written})))
    assert again.to_json()["links"] == written and again.links[0].tracklets == (1, 2)


# ---- The files, read by other tools ----


def test_tracks_are_motchallenge_rows(tmp_path: Path) -> None:
    tracks = tracks_of(walk(4), 0.0)
    write_mot(tmp_path / "t.txt", tracks)
    rows = np.loadtxt(tmp_path / "t.txt", delimiter=",")
    assert rows.shape == (12, 10) and (rows[:, 7:] == -1).all()
    np.testing.assert_array_equal(rows[:, 0], tracks.frame + 1)  # frames from 1
    np.testing.assert_array_equal(rows[:, 1], tracks.track_id)
    np.testing.assert_allclose(rows[:, 2:4], tracks.xyxy[:, :2], atol=0.006)
    np.testing.assert_allclose(rows[:, 2:4] + rows[:, 4:6], tracks.xyxy[:, 2:], atol=0.011)
    assert (rows[:, 6] == 0.9).all()


def test_cameras_are_tum_rows(saved: Path) -> None:
    tum, poses = np.loadtxt(saved / "poses.txt"), walk()
    np.testing.assert_allclose(tum[:, 0], poses.time_s, atol=1e-6)
    rotation = Rotation.from_quat(tum[:, 4:]).as_matrix()  # world_from_cam
    np.testing.assert_allclose(rotation, poses.cam_from_world[:, :, :3].transpose(0, 2, 1),
                               atol=1e-6)  # fmt: skip
    world = np.einsum("fij,fj->fi", poses.cam_from_world[:, :, :3], tum[:, 1:4])
    np.testing.assert_allclose(world, -poses.cam_from_world[:, :, 3], atol=1e-6)


def test_ply_is_a_closed_mesh_at_the_right_position(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    solids = chair_solids()
    write_ply(tmp_path / "o.ply", solids, [1, 2, 3])
    mesh = trimesh.load(tmp_path / "o.ply")
    assert mesh.is_watertight and mesh.is_winding_consistent
    volume = 4 / 3 * np.pi * solids.half_axes.prod(1).sum()
    assert mesh.volume == pytest.approx(volume, rel=0.05)  # > 0: the normals point outwards
    np.testing.assert_allclose(mesh.bounds[:, 2], [0, 0.82], atol=0.01)
    for part in mesh.split():
        row = np.linalg.norm(solids.center_in_world - part.centroid, axis=1).argmin()
        local = (part.vertices - solids.center_in_world[row]) @ solids.world_from_obj[row]
        radius = np.linalg.norm(local / solids.half_axes[row], axis=1)
        np.testing.assert_allclose(radius, 1, atol=1e-3)
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) == 3


def test_ply_has_the_located_objects_only(chairs: rt.Result, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    result = copy_of(chairs)
    middle = dataclasses.replace(result.objects[1], status="rejected", center=None)
    result = dataclasses.replace(result, objects=[result.objects[0], middle, result.objects[2]])
    result.save(tmp_path)
    x = sorted(part.centroid[0] for part in trimesh.load(tmp_path / "objects.ply").split())
    np.testing.assert_allclose(x, [-1.1, 1.1], atol=0.05)


def test_objects_json_is_self_describing(saved: Path) -> None:
    data = json.loads((saved / "objects.json").read_text())
    assert validate_objects(saved / "objects.json") == []
    assert data["reobj_track"] == rt.__version__ and data["video"]["tracked_frames"] == 40
    assert data["conventions"]["quaternion"] == "wxyz, world_from_obj"
    entry = data["objects"][0]
    assert entry["class"] == "chair" and entry["tracks"] == [1] and entry["frames"] == [[0, 39]]
    w, x, y, z = entry["quat_wxyz"]
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    corner = np.array(entry["center"]) + axes @ np.array(entry["size"]) / 2
    true = chair_solids()
    local = np.abs(true.world_from_obj[0].T @ (corner - true.center_in_world[0]))
    np.testing.assert_allclose(np.sort(local), np.sort(true.half_axes[0]), atol=0.06)


def test_the_summary_is_the_table_printed_by_run(chairs: rt.Result, saved: Path) -> None:
    result = copy_of(chairs, out=saved, seconds={"track": 1.25})
    result = dataclasses.replace(result, objects=[*chairs.objects[:2], dataclasses.replace(
        chairs.objects[2], status="rejected", reason="too far", size=None, size_m=None,
        size_rel_sigma=None)])  # fmt: skip
    text = result.summary()
    (w, d, h), size = (side for side, _ in sides(chairs.objects[0])), chairs.objects[0].size_m
    assert re.search(rf"1  chair +40 +{w} x {d} x {h} +\d+ %  measured$", text, re.M)
    assert size is not None and np.allclose([float(w), float(d), float(h)], size, atol=0.0051)
    assert re.search(r"3  chair +40 +- +-  none$", text, re.M)
    assert "\ntoo far: object 3\n" in text and "width x depth x height, m" in text
    assert text.startswith("2 objects with a shape: 2 chair; 1 without: 1 chair\nlook at: ")
    assert "cameras: 40 of 40 frames (user)" in text and "seconds: track 1.2" in text
    assert f"look at: {saved / 'objects.json'}" in text


def test_the_summary_counts_objects_without_a_shape_apart(chairs: rt.Result) -> None:
    """They come second, also in the table; without cameras there is one number."""
    first, *rest = chairs.objects
    person = rt.Object(1, "person", 0.9, "rejected", "objects of this class move")
    result = copy_of(chairs, objects=[person, *rest], fits=None)
    lines = result.summary().splitlines()
    assert lines[0] == "2 objects with a shape: 2 chair; 1 without: 1 person"
    assert "2 objects with a shape, 1 without" in repr(result)
    rows = [line.split()[0] for line in lines if line.endswith((" measured", " none"))]
    assert rows == ["2", "3", "1"]
    flat = [dataclasses.replace(o, status="tracked") for o in (person, first)]
    result = copy_of(chairs, objects=flat, poses=None, fits=None)
    assert result.summary().startswith("2 objects: 1 chair, 1 person")


def test_the_summary_says_where_the_time_went(chairs: rt.Result) -> None:
    """In one line: steps of a stage, unless the stage is its only step, and cached results."""
    result = copy_of(
        chairs,
        seconds={"detect": 0.04, "poses": 30.16, "track": 5.0, "objects": 2.0},
        step_seconds={"detect": {}, "poses": {"match": 20.0, "pnp": 10.04}, "track": {"track": 5}},
    )
    line = "seconds: detect 0.0 (from the cache), poses 30.2 (match 20.0, pnp 10.0), track 5.0, "
    assert f"{line}objects 2.0" in " ".join(result.summary().split())


def test_sizes_are_rounded_by_the_smallest_sigma(chairs: rt.Result) -> None:
    found = dataclasses.replace(
        chairs.objects[0], size=np.array([4.1234, 2.0, 1.0]), size_m=np.array([0.41234, 0.2, 0.1]),
        size_rel_sigma=np.array([0.1, 0.3, 0.6]),
    )  # fmt: skip
    assert sides(found) == [("0.41", "0.04"), ("0.20", "0.06"), ("0.10", "0.06")]
    units = dataclasses.replace(found, size_m=None)  # of arbitrary length
    assert sides(units) == [("4.1", "0.4"), ("2.0", "0.6"), ("1.0", "0.6")]
    assert sides(dataclasses.replace(units, size=None, size_rel_sigma=None)) == []


def test_the_summary_fits_the_terminal(chairs: rt.Result) -> None:
    """For many objects, with reasons, in components; each reason is printed once."""
    reason = "width and depth guessed from the category"
    result = copy_of(chairs, out=None)
    result = dataclasses.replace(result, objects=[
        dataclasses.replace(chairs.objects[0], id=i, class_name=f"dining table {i % 40}",
                            status="prior_dominated",
                            reason=reason if i < 120 else f"parallax of .3 deg; {reason}")
        for i in range(1, 121)
    ])  # fmt: skip
    lines = result.summary().splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) < 160
    assert sum(reason in line for line in lines) == 1
    first = next(k for k, line in enumerate(lines) if reason in line)
    assert lines[first].startswith(f"{reason}: objects 1, 2, 3,")
    assert any(line.endswith(" 119, 120") for line in lines[first:])
    assert "parallax of .3 deg: object 120" in lines


# ---- The schema ----


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("status", "fine"), ("center", [1, 2]), ("id", "one"), ("support", "sphere"),
        ("center", None), ("views", -1), ("cov", [[1.0] * 9] * 8), ("score", float("nan")),
    ],
)  # fmt: skip
def test_validate_names_file_and_path(saved: Path, name: str, value: object) -> None:
    """One line for each fault; also for a missing field."""
    data = json.loads((saved / "objects.json").read_text())
    data["objects"][0][name] = value
    del data["objects"][1]["id"]
    (saved / "objects.json").write_text(json.dumps(data))
    for path in (saved, saved / "objects.json"):
        first, second = validate_objects(path)
        assert first.startswith(f"{saved / 'objects.json'}: $.objects[0].{name}: ")
        assert second.startswith(f"{saved / 'objects.json'}: $.objects[1]: 'id'")


def test_validate_prints_no_control_characters_of_a_path(saved: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(saved, tmp_path / "\x1b[31mred")
    (folder / "objects.json").write_text("{}")
    assert all(line.isprintable() for line in validate_objects(folder))


def test_validate_refuses_invalid_json(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(rt.ReobjError, match="not valid JSON"):
        validate_objects(tmp_path / "x.json")


def test_validate_names_the_missing_package(
    saved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "jsonschema", None)
    assert rt.main(["objects", str(saved), "--validate"]) == 2
    advice = "jsonschema is not installed: pip install jsonschema"
    assert capsys.readouterr().err == f"error: {advice}\n"
    rt.Result.load(saved)  # needs no jsonschema


# ---- Damaged folders ----


def of_first(**values: Any) -> Callable[[dict[str, Any]], None]:
    """Change the first object of objects.json."""
    return lambda data: data["objects"][0].update(values)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (of_first(id=2), "two objects of one id"),
        (of_first(part=1), "object 1 is in component 1, which does not exist"),
        (of_first(center=None), "object 1 is ok without a shape"),
        (of_first(status="fine"), r"\$\.objects\[0\]\.status: .*ok|prior_dominated"),
        (of_first(quat_wxyz=[1, 1, 0, 0]), r"\$\.objects\[0\]: quat_wxyz is not of length 1"),
        (of_first(size=[1, 0, 1]), r"\$\.objects\[0\]: a size .* is not positive"),
        (of_first(center=["x"] * 3), r"\$\.objects\[0\]\.center: Expected 3 finite"),
        (of_first(cov=[[1.0] * 9] * 8), r"\[0\]\.cov: Expected 9 x 9"),
        (of_first(frames=[[1]]), r"\[0\]\.frames\[0\]: Expected array of length"),
        (of_first(views=True), r"\[0\]\.views: Expected int, got bool"),
        (of_first(classes={"a": "b"}), r"\[0\]\.classes.*: Expected float"),
        (lambda d: d["objects"][0].pop("class"), r"\$\.objects\[0\]: .*missing .* class"),
        (lambda d: d["video"].update(fps=float("nan")), r"\$\.video\.fps: Expected float > 0"),
        (
            lambda d: d["world"]["scale"].update(metres_per_unit=0),
            r"\$\.world\.scale\.metres_per_unit: Expected float > 0",
        ),
        (lambda d: d["world"].update(links=[0]), r"\$\.world\.links\[0\]: Expected object"),
        (lambda d: d.update(version=2), 'expected .*"version": 1'),
    ],
)
def test_inconsistent_files_are_not_loaded(saved: Path, change: Any, fault: str) -> None:
    data = json.loads((saved / "objects.json").read_text())
    change(data)
    (saved / "objects.json").write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match=rf"objects.json: .*{fault}.*; is damaged: run the"):
        rt.Result.load(saved)


# ---- Tracks and embeddings of the tracker ----


def embedded_result() -> rt.Result:
    """Three frames of chairs; some detections were embedded, one of them was never confirmed."""
    result = fitted(tracks_of(walk(3)), None)
    row = np.arange(6, dtype=np.float32).reshape(2, 3)
    embedded = [(np.array([2, 0]), row), (np.empty(0, np.int64), np.empty((0, 0), np.float32)),
                (np.array([1, 9]), row + 6)]  # fmt: skip
    embeddings, row = tracked_embeddings(result.tracks, [0, 1, 2], embedded, 2)
    return copy_of(result, embeddings=embeddings, embedding_row=row)


def test_embeddings_belong_to_their_rows() -> None:
    """Frame 0 has chairs 2 and 0, frame 2 chair 1; detection 9 is in no track."""
    result = embedded_result()
    rows = result.tracks[result.embedding_row]
    assert rows.frame.tolist() == [0, 0, 2] and rows.detection_index.tolist() == [2, 0, 1]
    np.testing.assert_array_equal(result.embeddings.foreground, [[0, 1], [3, 4], [6, 7]])
    np.testing.assert_array_equal(result.embeddings.background, [[2], [5], [8]])
    assert result.embeddings.foreground.dtype == np.float16


def test_without_a_width_rows_are_foreground() -> None:
    tracks = tracks_of(walk(2))
    embedded = [(np.array([1]), np.ones((1, 3), np.float32))]
    embeddings, _ = tracked_embeddings(tracks, [0], embedded, 0)
    assert embeddings.foreground.shape == (1, 3) and embeddings.background.shape == (1, 0)
    nothing = [(np.empty(0, np.int64), np.empty((0, 0), np.float32))] * 2
    embeddings, row = tracked_embeddings(tracks, [0, 1], nothing, 0)
    assert embeddings.foreground.shape == (0, 0) and len(row) == 0


def test_tracker_output_is_read_back(tmp_path: Path) -> None:
    before = embedded_result()
    before = dataclasses.replace(before, warnings=["dark"], identities_given=True)
    before.save_tracked(tmp_path / "a.npz")
    after = rt.Result.load_tracked(tmp_path / "a.npz")
    for f in dataclasses.fields(rt.Tracks):
        a, b = getattr(before.tracks, f.name), getattr(after.tracks, f.name)
        np.testing.assert_array_equal(a, b, f.name)
        assert a.dtype == b.dtype
    np.testing.assert_array_equal(after.embeddings.foreground, before.embeddings.foreground)
    np.testing.assert_array_equal(after.embeddings.background, before.embeddings.background)
    np.testing.assert_array_equal(after.embedding_row, before.embedding_row)
    assert after.class_names == rt.COCO_NAMES and after.video == before.video
    assert after.warnings == ["dark"] and after.identities_given and after.objects == []


# ---- Folders of version 0.1.0 ----


def old_objects(out: Path) -> None:
    """Turn objects.json into one of 0.1.0: links have `look`."""
    data = json.loads((out / "objects.json").read_text())
    link = {"kind": "join", "tracklets": [1, 2], "place_iou": 0.5, "look": 0.87, "kept": True}
    data["world"]["links"] = [link]
    (out / "objects.json").write_text(json.dumps(data | {"reobj_track": "0.1.0"}))


def old_poses(out: Path) -> None:
    """Write last-poses.npz as 0.1.0 did: facts beside the arrays, covariances, parts."""
    poses = walk()
    arrays = {k: getattr(poses, k) for k in ("frame", "time_s", "cam_from_world", "status")}
    facts = {"camera": {"model": "PINHOLE"}, "source": "user", "metric": True, "up": None}
    np.savez_compressed(out / "cache/last-poses.npz", **arrays, points=poses.points,
                        colors=poses.colors, cov=np.zeros((0, 6, 6)), parts=0,
                        facts=json.dumps(facts))  # fmt: skip


def old_tracks(out: Path) -> None:
    """Write last-tracks.npz as 0.1.0 did: object_id, look, no facts."""
    tracks = tracks_of(walk())
    columns = {f.name: getattr(tracks, f.name) for f in dataclasses.fields(rt.Tracks)}
    columns["object_id"] = columns.pop("track_id")
    np.savez_compressed(out / "cache/last-tracks.npz", **columns, fixed=False, split=0,
                        look=np.zeros((0, 0), np.float16), look_row=np.zeros(0, np.int64),
                        class_names=np.array(rt.COCO_NAMES), messages=np.array([]))  # fmt: skip


def test_objects_of_an_old_folder_load(saved: Path) -> None:
    old_objects(saved)
    (saved / "cache/last-poses.npz").unlink()
    (link,) = rt.Result.load(saved).world.links
    assert link == rt.LinkEvent("join", (1, 2), 0.5, 0.87, True)


COMMANDS: dict[str, Callable[[Path], tuple[object, ...]]] = {
    "export": lambda out: ("export", out, "--to", "cvat"),
    "eval": lambda out: ("eval", out, "--gt", out / "tracks.txt"),
    "objects": lambda out: ("objects", out),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_an_old_folder_is_refused_with_its_version(
    saved: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    old_objects(saved)
    old_poses(saved)
    old_tracks(saved)
    assert rt.main([str(a) for a in COMMANDS[command](saved)]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and error.startswith("error: ")
    assert "written by reobj_track 0.1.0" in error and f"this is {rt.__version__}" in error
    assert "run the video again" in error


@pytest.mark.parametrize("command", ["export", "eval"])
def test_objects_of_another_schema_are_refused_with_their_version(
    saved: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads((saved / "objects.json").read_text())
    for changed in (data | {"reobj_track": "9.9", "objects": [{"id": 1}]},
                    data | {"reobj_track": "9.9", "world": None},
                    [data]):  # fmt: skip
        (saved / "objects.json").write_text(json.dumps(changed))
        assert rt.main([str(a) for a in COMMANDS[command](saved)]) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1 and "written by reobj_track" in error
        assert ("9.9" in error) == isinstance(changed, dict)


def test_a_damaged_file_is_not_reported_as_another_version(saved: Path) -> None:
    np.savez(saved / "cache/last-poses.npz", frame=np.arange(3))
    with pytest.raises(rt.ReobjError, match=r"last-poses\.npz: is damaged: run the video again"):
        rt.Result.load(saved)
    (saved / "cache/last-poses.npz").write_bytes(b"PK")
    with pytest.raises(rt.ReobjError, match=r"last-poses\.npz: is damaged: run"):
        rt.Result.load(saved)


# ---- In Python and in a notebook ----


def test_reprs_are_one_line_without_arrays(chairs: rt.Result, saved: Path) -> None:
    video = rt.Video(Path(__file__).parents[1] / "examples/room/room.mp4")
    masks = np.zeros((1, 4, 6), bool)
    config = rt.Config(detect=rt.DetectConfig(classes="cup"), threads=2)
    named = dataclasses.replace(chairs.objects[1], class_name="a\nb", size_m=None, frames_seen=1)
    size = " x ".join(f"{side:.3g}" for side in chairs.objects[1].size)
    box = rt.Detections.from_array([[0, 0, 10, 20, 0.9, 56]])
    expected = {
        "Result('walk.mp4', 3 objects with a shape, 120 boxes, cameras: 40 of 40 frames (user))":
            chairs,
        "Result('walk.mp4', 0 objects, 0 boxes, out='o')":
            rt.Result(rt.Tracks.empty(), (), chairs.video, out=Path("o")),
        f"Object(2 chair, ok, {size} m, 40 frames)": chairs.objects[1],
        f"Object(2 a\\nb, ok, {size} units, 1 frame)": named,
        "Object(1 cup, tracked, 0 frames)": rt.Object(1, "cup", 0.5, "tracked", ""),
        "Tracks(120 boxes, 3 identities, frames 0 to 39)": chairs.tracks,
        "Tracks(0 boxes)": rt.Tracks.empty(),
        "Poses(cameras: 40 of 40 frames (user), 0 points, in metres)": chairs.poses,
        "Detections(1 box, 1 class, scores 0.90 to 0.90)": box,
        "Detections(0 boxes)": rt.Detections.empty(),
        "Detections(1 box, 1 class, scores 0.90 to 0.90, with masks)":
            dataclasses.replace(box, masks=masks),
        "Frame(3, 0.100 s, 6x4)": rt.Frame(3, 0.1, np.zeros((4, 6, 3), np.uint8)),
        "Config()": rt.Config(),
        "Config(detect.classes='cup', threads=2)": config,
        f"Video({video.source!r}, 640x480, 240 frames to read)": video,
    }  # fmt: skip
    assert {text: repr(value) for text, value in expected.items()} == {t: t for t in expected}
    assert video._clock is None  # the file was not decoded


def test_an_object_by_its_number(chairs: rt.Result) -> None:
    assert chairs.object(2) is chairs.objects[1]
    objects = [dataclasses.replace(chairs.objects[0], id=i) for i in (1, 9, 10, 14, 15, 30)]
    with pytest.raises(
        rt.ReobjError, match=r"no object 12; the nearest numbers are 9, 10, 14, 15$"
    ):
        copy_of(chairs, objects=objects).object(12)
    with pytest.raises(rt.ReobjError, match="no object 1; the result has no objects"):
        copy_of(chairs, objects=[]).object(1)


def test_the_table_for_pandas_is_that_of_the_csv(saved: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pip install pandas (extra `dev`)")
    result = rt.Result.load(saved)
    objects = [*result.objects, rt.Object(7, "=cup", 0.5, "rejected", "few views")]
    table = copy_of(result, objects=objects).to_pandas()
    written = pandas.read_csv(rt.export(saved, "csv"), index_col="id")
    assert list(table.columns) == list(written.columns) and table.index.tolist() == [1, 2, 3, 7]
    numbers = ["center_x", "size_m_z", "qw", "views", "part"]
    np.testing.assert_array_equal(table.loc[:3, numbers], written[numbers])
    assert table.center_x.dtype == np.float64 and np.isnan(table.center_x[7])
    assert table["class"][7] == "=cup" and table.reason[7] == "few views"


def test_pandas_is_needed_for_its_table_alone(
    chairs: rt.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(rt.ReobjError, match="to_pandas needs pandas: pip install pandas"):
        chairs.to_pandas()


class Shown(HTMLParser):
    """The elements of a page, their text, and the attributes of its iframe."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.text = ""
        self.frame: dict[str, str | None] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.frame |= dict(attrs) if tag == "iframe" else {}

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_notebook_shows_the_objects_and_the_viewer(chairs: rt.Result, saved: Path) -> None:
    """The viewer is made if the folder has none; scripts of its page cannot reach the notebook."""
    first, *rest = chairs.objects
    bad = dataclasses.replace(first, class_name='<b>&amp;"')
    result = copy_of(chairs, objects=[bad, *rest], fits=None)
    shown = Shown(result._repr_html_())
    assert shown.tags == {"pre", "iframe"} and shown.text == result.summary()
    assert '<b>&amp;"' in shown.text and shown.frame["sandbox"] == "allow-scripts allow-downloads"
    page = str(shown.frame["srcdoc"])
    assert page.startswith("<!doctype html>") and page.rstrip().endswith("</html>")
    assert '"title":"walk.mp4"' in page and "\\u003cb>&amp;" in page
    assert not list(saved.glob("scene.html"))
    (saved / "scene.html").write_text('<b title="&lt;">')
    assert Shown(rt.Result.load(saved)._repr_html_()).frame["srcdoc"] == '<b title="&lt;">'
    assert Shown(copy_of(chairs, poses=None)._repr_html_()).tags == {"pre"}


@pytest.mark.parametrize("missing", ["objects.json", "tracks.txt"])
def test_no_output_folder(saved: Path, missing: str) -> None:
    (saved / missing).unlink()
    with pytest.raises(rt.ReobjError, match="make them first with `run`"):
        rt.Result.load(saved)
