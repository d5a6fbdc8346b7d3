"""Hostile input: it is either read or refused in one line with the reason.

`hypothesis` generates it; every defect found this way is kept as an example. The tests take
less than a minute; `pytest -n 0 tests/test_properties.py --hypothesis-profile long` tries more.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadrics
import reobj_track as rt
from reobj.config import read_config
from reobj.evaluation.objects import read_true_objects
from reobj.evaluation.truth import read_truth
from reobj.results.edits import apply_edits, read_edits
from reobj.results.workspace import Workspace
from reobj.sources.video import ImagelessVideo

hypothesis = pytest.importorskip("hypothesis", reason="pip install hypothesis (dev extra)")
from hypothesis import example, given  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.extra import numpy as npst  # noqa: E402

REFUSED = (rt.ReobjError, quadrics.QuadricsError)
SIZE = (640, 480)
LONGEST = 701  # characters of a message


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def video(folder: Path) -> Any:
    names = [f"{i}.png" for i in range(20)]
    return ImagelessVideo("room", SIZE, times_s=np.arange(20) / 10, names=names)


def accepted(read: Callable[[], Any]) -> Any:
    """Call a reader; None if it refuses in one printable line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            return read()
    except REFUSED as error:
        text = str(error)
        assert text.strip() and text.isprintable() and len(text) < LONGEST, repr(text)
        return None


# ---- Files ----

MOT = "".join(f"{f},-1,{10 + f},20,30.5,40,.9,57,-1,-1\n" for f in range(1, 6))
CSV = "frame,x1,y1,x2,y2,score,class\n" + "".join(f"{f},1,2,30,40,.9,chair\n" for f in range(5))
COCO = json.dumps([
    {"image_id": f, "category_id": 62, "bbox": [1.5, 2, 30, 40], "score": 0.9} for f in range(4)
])  # fmt: skip
TUM = "".join(f"{f / 10} {f / 5} 0 0 0 0 0 1\n" for f in range(20))
TRANSFORMS = json.dumps({
    "w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240,
    "applied_transform": np.eye(4)[:3].tolist(),
    "frames": [
        {"file_path": f"{f}.png", "transform_matrix": np.diag([1.0, -1, -1, 1]).tolist()}
        for f in range(20)
    ],
})  # fmt: skip
PRIORS = json.dumps({
    "aliases": {"sofa": "couch"},
    "couch": {"size_m": {"mean": [2, 0.9, 0.8], "log_std": [0.2, 0.2, 0.2], "corr": [0, 0, 0]}},
})  # fmt: skip
CVAT = (
    '<annotations><track id="0" label="chair">'
    + "".join(f'<box frame="{f}" xtl="1" ytl="2" xbr="30" ybr="40"/>' for f in range(4))
    + "</track></annotations>"
)


def boxes_make_sense(found: Any, video: Any) -> None:
    assert np.isfinite(found.xyxy).all() and (np.abs(found.xyxy) <= 1e7).all()
    assert ((found.score >= 0) & (found.score <= 1)).all()
    assert ((found.frame >= 0) & (found.frame < video.frame_count)).all()
    assert (found.class_id < len(found.class_names)).all() and len(found.class_names) < 40000
    assert not re.search("[\x00-\x1f\x7f-\x9f]", "".join(found.class_names))


def boxes_are_finite(found: Any) -> None:
    assert np.isfinite(found.xyxy).all() and (np.abs(found.xyxy) <= 2e7).all()


def poses_make_sense(poses: rt.Poses, video: Any) -> None:
    rotation = poses.cam_from_world[poses.known][:, :, :3]
    assert len(rotation) and (np.linalg.det(rotation) > 0).all()
    assert np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() < 1e-6
    assert np.isfinite(poses.camera.params).all() and (np.diag(poses.camera.K) > 0).all()
    assert (np.abs(poses.cam_from_world[poses.known]) < 1e9).all()


def tracks_make_sense(found: Any, video: Any) -> None:
    tracks = found[0]
    assert np.isfinite(tracks.xyxy).all() and (tracks.track_id >= 0).all()
    rows = np.column_stack([tracks.frame, tracks.track_id])
    assert len(np.unique(rows, axis=0)) == len(rows)


def priors_make_sense(priors: quadrics.Priors, video: Any) -> None:
    for values in (priors.log_mean, priors.log_cov, priors.ratio_mean, priors.ratio_cov):
        assert np.isfinite(values).all()
    assert not len(priors.names) or np.linalg.eigvalsh(priors.log_cov).min() > 0
    priors.index(["chair", "sofa", None])


EDITS = json.dumps({"format": "reobj-edits", "version": 1, "edits": [
    {"do": "merge", "object": {"id": 1, "frame": 0, "box": [1, 2, 30, 40]},
     "with": {"id": 2, "frame": 0, "box": [1, 2, 30, 40]}},
    {"do": "rename", "object": {"id": 3, "frame": 2, "box": [1, 2, 30, 40]}, "class": "cup"},
]})  # fmt: skip
TRUTH = json.dumps({"objects": [
    {"id": 1, "center": [0, 1, 2], "size": [1, 2, 3], "R": np.eye(3).tolist()},
    {"id": 2, "center": [0, 1, 2], "half_axes": [1, 2, 3], "world_from_obj": np.eye(3).tolist()},
]})  # fmt: skip
SOURCE = json.dumps({
    "source": "poses.txt", "content": "x", "input": {"every": 1, "start": 0, "stop": 0},
    "frames": {"size": [640, 480], "times_s": [0, 0.1, 0.2], "names": [], "count": 3},
})  # fmt: skip
TOML = "threads = 1\n[input]\nevery = 2\n[tracker]\nhigh_score = 0.4\nremember = true\n"
COLMAP = "1 1 0 0 0 0 0 0 1 0.png\n\n2 1 0 0 0 0.5 0 0 1 1.png\n\n"


def read_applied_edits(path: Path, video: Any) -> Any:
    """Read edits, and apply them to three objects."""
    count, none = 9, np.zeros(9, np.int64)
    ids, boxes = np.arange(count) % 3 + 1, np.tile([1.0, 2, 30, 40], (count, 1))
    tracks = rt.Tracks(np.arange(count) // 3, ids, ids, boxes, np.ones(count), none, none)
    return apply_edits(tracks, ("chair",), read_edits(path))


def read_bound(path: Path, video: Any) -> Any:
    """Read source.json where an output folder has it."""
    folder = path.parent / "bound" / "cache"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "source.json").write_bytes(path.read_bytes())
    return Workspace.open(folder.parent).video()


def read_colmap(path: Path, video: Any) -> rt.Poses:
    folder = path.parent / "model"
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (folder / "images.txt").write_bytes(path.read_bytes())
    return rt.read_poses(folder, video)


def frames_make_sense(found: Any, video: Any) -> None:
    if found.frame_count <= 1000:
        assert all(np.isfinite(frame.time_s) for frame in found)
    assert min(found.size) > 0 and np.isfinite(found.fps)


def truth_makes_sense(found: Any, video: Any) -> None:
    assert all(np.isfinite(getattr(found[1], name)).all() for name in found[1].__slots__)


def edits_make_sense(found: Any, video: Any) -> None:
    assert len(found.tracks) == 9 and "".join(found.class_names).isprintable()


EVERY_SCORE = rt.DetectConfig(min_score=0.0)
FILES: dict[str, tuple[str, Callable[..., Any], Callable[..., None]]] = {
    "det.txt": (MOT, lambda p, v: rt.read_detections(p, v, EVERY_SCORE), boxes_make_sense),
    "det.csv": (CSV, lambda p, v: rt.read_detections(p, v, EVERY_SCORE), boxes_make_sense),
    "coco.json": (COCO, lambda p, v: rt.read_detections(p, v, EVERY_SCORE), boxes_make_sense),
    "cvat.xml": (CVAT, rt.read_tracks, tracks_make_sense),
    "poses.txt": (TUM, lambda p, v: rt.read_poses(p, v, camera="500,500,320,240"),
                  poses_make_sense),
    "transforms.json": (TRANSFORMS, rt.read_poses, poses_make_sense),
    "priors.json": (PRIORS, lambda p, v: quadrics.load_priors(p), priors_make_sense),
    "images.txt": (COLMAP, read_colmap, poses_make_sense),
    "edits.json": (EDITS, read_applied_edits, edits_make_sense),
    "gt_objects.json": (TRUTH, lambda p, v: read_true_objects(p), truth_makes_sense),
    "source.json": (SOURCE, read_bound, frames_make_sense),
    "config.toml": (TOML, lambda p, v: read_config(rt.Config(), p), lambda found, v: None),
    "gt.txt": (MOT.replace(",-1,1", ",3,1"), lambda p, v: read_truth(p, ["chair"], 0.0),
               lambda found, v: boxes_are_finite(found)),
}  # fmt: skip
NASTY = [
    "nan", "inf", "-inf", "1e308", "1e400", "-1", "0", "1e-320", "1.5", "2147483648", "3.7", "1e30",
    "9" * 23, "", " ", "abc", "²", "٣", "--5", "null", "[]", "{}", "true", '"', "\\", "\x00",
    "\x1b[31m", "\n", "a" * 300, "[" * 2000, "x" * 140000, "=1+1", "\u202e", "\ud800",
]  # fmt: skip
edits = st.lists(st.tuples(st.floats(0, 1), st.sampled_from(NASTY), st.integers(0, 4)),
                 min_size=1, max_size=3)  # fmt: skip


def edited(text: str, changes: list[tuple[float, str, int]]) -> str:
    """Replace numbers and words with hostile text; truncate, repeat and reverse."""
    for at, nasty, kind in changes:
        spots = list(re.finditer(r"[-+]?[0-9][0-9.eE+-]*|[A-Za-z_]+", text))
        split = round(at * len(text))
        if kind < 3 and spots:
            spot = spots[min(int(at * len(spots)), len(spots) - 1)]
            text = text[: spot.start()] + nasty + text[spot.end() :]
        elif kind == 3:
            text = text[:split]
        else:
            text = text[:split] + nasty + text[split:] + text[:split]
    return text


@pytest.mark.parametrize("name", FILES)
@given(changes=edits)
@example(changes=[(0.0, "3.7", 0)])  # a fractional frame
@example(changes=[(0.0, "1e30", 0)])
@example(changes=[(0.99, '"', 4)])  # an unclosed quote
@example(changes=[(0.99, "x" * 140000, 0)])  # a field beyond the limit of csv
@example(changes=[(0.3, "[" * 2000, 4)])
@example(changes=[(0.45, "-1", 0)])
@example(changes=[(0.0, "\x1b[31m", 4)])
def test_files_are_read_or_refused(
    name: str, folder: Path, video: Any, changes: list[tuple[float, str, int]]
) -> None:
    text, read, check = FILES[name]
    path = folder / name
    path.write_bytes(edited(text, changes).encode("utf-8", "surrogatepass"))
    found = accepted(lambda: read(path, video))
    if found is not None:
        check(found, video)


@pytest.mark.parametrize("name", FILES)
def test_the_unmodified_files_are_valid(name: str, folder: Path, video: Any) -> None:
    """Otherwise only refusals would be tested."""
    text, read, check = FILES[name]
    (folder / name).write_text(text)
    check(read(folder / name, video), video)


# ---- Arrays ----


@given(
    rows=npst.arrays(
        st.sampled_from([np.float64, np.float32, np.int64]),
        npst.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=7),
        elements=st.sampled_from([0, 1, 2, 10, 63, -5, 1000]),
    ),
    value=st.sampled_from([0.5, np.nan, np.inf, -np.inf, 1e300, -1.0, 9.0]),
    at=st.integers(0, 50),
)
@example(rows=np.ones((6, 5)), value=0.5, at=0)  # once reshaped to garbage
@example(rows=np.ones((6, 7)), value=0.5, at=0)
@example(rows=np.array([[30.0, 30, 10, 10, 0.9, 1]]), value=0.9, at=4)  # upside down
@example(rows=np.array([[1.0, 1, 10, 10, 0.9, 1]]), value=1e300, at=2)
@example(rows=np.array([[1.0, 1, 10, 10, 0.9, 1]]), value=9.0, at=4)
def test_frames_of_a_tracker_are_accepted_or_refused(rows: Any, value: float, at: int) -> None:
    tracker = rt.Tracker()
    if rows.dtype.kind == "f" and rows.size:
        rows = rows.copy()
        with np.errstate(over="ignore"):  # float32
            rows.flat[at % rows.size] = value
    for _ in range(4):
        tracks = accepted(lambda: tracker.update(rows))
        if tracks is not None:
            assert (
                np.isfinite(tracks.xyxy).all() and ((tracks.score >= 0) & (tracks.score <= 1)).all()
            )
            assert (tracks.xyxy[:, 2:] >= tracks.xyxy[:, :2]).all()
