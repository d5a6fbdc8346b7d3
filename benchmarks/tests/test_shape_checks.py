"""Checks of shapes without ground truth, on simulated chairs and on known objects."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import shape_checks as sc
from scipy.spatial.transform import Rotation
from simulated import chair_solids, tracks_of, unlinked, walk

import reobj_track as rt
from reobj.results.result import Object
from reobj.results.workspace import Workspace

NO_PAIRS = np.empty((0, 2), np.int64)


def chairs() -> rt.Result:
    """Three chairs before linking; eight sparse points near the centre of each, seen everywhere."""
    poses = walk()
    around = np.stack(np.meshgrid(*[(-0.05, 0.05)] * 3), -1).reshape(-1, 3)
    points = (chair_solids().center_in_world[:, None] + around).reshape(-1, 3)
    seen = np.stack(np.meshgrid(np.arange(len(poses.frame)), np.arange(len(points))), -1)
    poses = dataclasses.replace(
        poses, points=points, colors=np.zeros_like(points, np.uint8), visibility=seen.reshape(-1, 2)
    )
    return unlinked(poses, tracks_of(poses))


def checked(tmp_path: Path, result: rt.Result) -> dict[str, dict]:
    """Figures of an output folder with these tracks and cameras, from the command line."""
    Workspace(tmp_path / "chairs").save_last(result, result.poses)
    assert sc.main([str(tmp_path / "chairs"), "--json", str(tmp_path / "figures.json")]) == 0
    return json.loads((tmp_path / "figures.json").read_text())


def test_good_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = checked(tmp_path, chairs())
    found = figures["chairs"]
    assert figures["all"] == found  # one recording
    assert found["objects"] == 3
    assert found["runaway"] == found["absurd"] == found["implausible"] == 0
    assert found["depth"] == pytest.approx([1, 1, 1], abs=0.05)
    for kind in ("halves", "noise"):
        row = found[kind]
        assert (row["a"], row["b"], row["both"], row["one_only"]) == (3, 3, 3, 0)
        assert row["centres"] >= 2 / 3 and row["sizes"] >= 2 / 3 and 1 <= row["sides"] < 1.15
    last = [line.split()[0] for line in capsys.readouterr().out.splitlines()[-2:]]
    assert last == ["chairs", "all"]


def test_shapes_far_behind_their_points(tmp_path: Path) -> None:
    result = chairs()
    poses = result.poses
    assert poses is not None
    eyes = -np.einsum("fji,fj->fi", poses.cam_from_world[..., :3], poses.cam_from_world[..., 3])
    near = eyes[:, None] + 0.3 * (poses.points - eyes[:, None])  # (F, P, 3)
    points = near[::8].reshape(-1, 3)
    colors = np.zeros_like(points, np.uint8)
    moved = dataclasses.replace(poses, points=points, colors=colors, visibility=NO_PAIRS)
    found = checked(tmp_path, dataclasses.replace(result, poses=moved))["all"]
    assert found["runaway"] == 3 and found["depth"][0] > 2


def test_a_chair_of_the_other_half_only(tmp_path: Path) -> None:
    result = chairs()
    left_out = (result.tracks.track_id == 2) & (result.tracks.frame % 2 == 1)
    result = dataclasses.replace(result, tracks=result.tracks[~left_out])
    halves = checked(tmp_path, result)["all"]["halves"]
    assert (halves["a"], halves["b"], halves["both"], halves["one_only"]) == (3, 2, 2, 1)


def test_a_folder_of_something_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert sc.main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def solid(center: tuple[float, ...], half: tuple[float, ...], axes: np.ndarray) -> Object:
    """A shape with a standard deviation of .1 in all parameters."""
    wxyz = np.roll(Rotation.from_matrix(axes).as_quat(), 1)
    numbers = {"center": np.array(center), "half_axes": np.array(half), "quat_wxyz": wxyz}
    return Object(1, "chair", 0.9, "ok", "", "box", **numbers, cov=0.01 * np.eye(9))


def test_differences_in_units_of_their_covariance() -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # the first axis of one is the second
    first = solid((0, 0, 0), (0.2, 0.5, 1.0), np.eye(3))
    second = solid((0.3, 0, 0), (0.5, 0.2, 1.0 * np.exp(0.2)), turn)
    centre, size, sides = sc.differences(first, second)
    assert (centre, size, sides) == pytest.approx((0.09 / 0.02, 0.04 / 0.02, np.exp(0.2)))


def test_pairs_by_tracks() -> None:
    """Both fits list two objects of the same tracks, in another order; one of another component."""
    objects = [solid((0, 0, 0), (1, 1, 1), np.eye(3)) for _ in range(3)]
    elsewhere = [*objects[:2], dataclasses.replace(objects[2], part=1)]
    a = np.array([[0, 9, 0, 0], [0, 0, 5, 0], [0, 0, 0, 4]])
    b = np.array([[0, 1, 6, 0], [0, 8, 0, 0], [0, 0, 0, 4]])
    assert sc.matched(objects, elsewhere, a, b) == [(0, 1), (1, 0)]
    few = np.array([[0, 1, 0, 5]])  # mostly of another track
    assert sc.matched(objects[:1], objects[:1], a[:1], few) == []


def test_rows_of_a_half() -> None:
    result = chairs()
    row = np.arange(0, len(result.tracks), 5)
    embedded = rt.Embeddings(row[:, None].astype(np.float16), np.zeros((len(row), 0), np.float16))
    result = dataclasses.replace(result, embeddings=embedded, embedding_row=row)
    half = sc.only_in(result, np.arange(1, 40, 2))
    assert set(half.tracks.frame.tolist()) == set(range(1, 40, 2))
    kept = half.embeddings.foreground[:, 0].astype(np.int64)
    assert len(kept) and (kept % 5 == 0).all()
    for before, after in zip(kept, half.embedding_row, strict=True):
        assert (result.tracks.xyxy[before] == half.tracks.xyxy[after]).all()
