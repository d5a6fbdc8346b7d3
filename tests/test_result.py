"""Results of a run, written and read back; every file is also read by an independent reader."""

from __future__ import annotations

import dataclasses
import html
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import chair_solids, fitted, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.results.entries import validate_objects, write_mot
from reobj.results.ply import write_ply
from reobj.results.result import load_tracked, save_tracked, sides
from reobj.results.workspace import tracked_embeddings


def copy_of(result: rt.Result, **changes: object) -> rt.Result:
    return dataclasses.replace(result, **changes)  # type: ignore[arg-type]


@pytest.fixture
def saved(chairs: rt.Result, tmp_path: Path) -> Path:
    out = tmp_path / "out"
    copy_of(chairs).save(out)
    return out


# ---- Written, then read ----


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


# ---- The schema ----


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("status", "fine"), ("center", [1, 2]), ("views", -1), ("score", float("nan")),
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
        (lambda d: d["objects"][0].pop("class"), r"\$\.objects\[0\]: .*missing .* class"),
        (lambda d: d["video"].update(fps=float("nan")), r"\$\.video\.fps: Expected float > 0"),
        (lambda d: d.update(version=2), 'expected .*"version": 1'),
    ],
)
def test_inconsistent_files_are_not_loaded(saved: Path, change: Any, fault: str) -> None:
    data = json.loads((saved / "objects.json").read_text())
    change(data)
    (saved / "objects.json").write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match=rf"objects.json: .*{fault}.*; damaged, or not"):
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


def test_tracker_output_is_read_back(tmp_path: Path) -> None:
    before = embedded_result()
    before = dataclasses.replace(before, warnings=["dark"], identities_given=True)
    save_tracked(before, tmp_path / "a.npz")
    after = load_tracked(tmp_path / "a.npz")
    for f in dataclasses.fields(rt.Tracks):
        a, b = getattr(before.tracks, f.name), getattr(after.tracks, f.name)
        np.testing.assert_array_equal(a, b, f.name)
        assert a.dtype == b.dtype
    np.testing.assert_array_equal(after.embeddings.foreground, before.embeddings.foreground)
    np.testing.assert_array_equal(after.embeddings.background, before.embeddings.background)
    np.testing.assert_array_equal(after.embedding_row, before.embedding_row)
    assert after.class_names == rt.COCO_NAMES and after.video == before.video
    assert after.warnings == ["dark"] and after.identities_given and after.objects == []


# ---- In Python and in a notebook ----


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


def test_a_notebook_shows_the_objects_and_the_viewer(chairs: rt.Result, saved: Path) -> None:
    """The viewer is that of the folder; scripts of its page cannot reach the notebook."""
    first, *rest = chairs.objects
    bad = dataclasses.replace(first, class_name='<b>&amp;"')
    result = copy_of(chairs, objects=[bad, *rest], fits=None)
    text = result._repr_html_()
    assert html.unescape(text) == f"<pre>{result.summary()}</pre>" and "<b>" not in text
    page = '<b title="&lt;">'
    (saved / "scene.html").write_text(page)
    _, _, frame = rt.Result.load(saved)._repr_html_().partition("<iframe ")
    assert 'sandbox="allow-scripts allow-downloads"' in frame and frame.count("<") == 1
    assert f'srcdoc="{html.escape(page)}"' in frame
