"""Hostile input: it is either read or refused in one line with the reason.

`hypothesis` generates it; every defect found this way is kept as an example. The tests take
less than a minute; `pytest -n 0 tests/test_properties.py --hypothesis-profile long` tries more.
"""

from __future__ import annotations

import copy
import json
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import chair_solids, fitted, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.cameras import load_poses, save_poses
from reobj.config import read_config, with_option
from reobj.files import load_cached
from reobj.poses.intrinsics import parse_camera
from reobj.results.edits import apply_edits, read_edits
from reobj.results.evaluation_3d import read_true_objects
from reobj.results.truth import read_truth
from reobj.results.workspace import Workspace
from reobj.sources.imageless import ImagelessVideo
from reobj.sources.recorded import read_npz
from reobj.words import parse_known_size, parse_up

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


NODES = [
    None, [], {}, "", "x", True, -1, 0, 1.5, 1e308, -1e308, 10**30, 2**63, float("nan"),
    float("inf"), [[]], [0, 0, 0], [float("nan")] * 4, {"a": 1}, "\ud800", "a\x00b\x1b[2J", "gone",
]  # fmt: skip


def value_paths(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of the values in a JSON value."""
    if path:
        yield path
    for key in data if isinstance(data, dict) else range(len(data) if type(data) is list else 0):
        yield from value_paths(data[key], (*path, key))


def replaced(data: Any, path: tuple[Any, ...], value: Any) -> None:
    """Set the value at a path, or delete it ("gone")."""
    for key in path[:-1]:
        data = data[key]
    if value == "gone":
        del data[path[-1]]
    else:
        data[path[-1]] = copy.deepcopy(value)


@pytest.fixture(scope="module")
def chairs_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """An output folder of three chairs; its objects.json."""
    out = tmp_path_factory.mktemp("hostile_out")
    poses = walk(4)
    fitted(tracks_of(poses), poses).save(out)
    return out, (out / "objects.json").read_text()


EXPORTED = ("csv", "cvat", "coco-vid", "ply")  # those that need neither video nor other packages
FIRST = ("objects", 0)


@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1), st.sampled_from(NODES)), min_size=1, max_size=2
    ),
    path=st.none(),
)  # fmt: skip
@example(changes=[(0.0, [0, 0, 0])], path=(*FIRST, "half_axes"))  # each was a traceback once
@example(changes=[(0.0, [0, 0, 0])], path=(*FIRST, "quat_wxyz"))
@example(changes=[(0.0, None)], path=(*FIRST, "quat_wxyz"))
@example(changes=[(0.0, "a\x00b\x1b[2J")], path=(*FIRST, "class"))
@example(changes=[(0.0, "\ud800")], path=(*FIRST, "class"))
@example(changes=[(0.0, 2)], path=(*FIRST, "id"))  # two of one number
@example(changes=[(0.0, 7)], path=(*FIRST, "part"))
@example(changes=[(0.0, "x")], path=("world", "scale"))
@example(changes=[(0.0, "gone")], path=("world",))
def test_an_output_folder_is_read_or_refused(
    chairs_folder: tuple[Path, str], changes: list[tuple[float, Any]], path: tuple[Any, ...] | None
) -> None:
    """Every field of objects.json with values of every type."""
    out, text = chairs_folder
    data = json.loads(text)
    for at, value in changes:
        known = [path] if path else list(value_paths(data))
        if known:
            replaced(data, known[min(int(at * len(known)), len(known) - 1)], value)
    (out / "objects.json").write_bytes(json.dumps(data).encode("utf-8", "surrogatepass"))
    for name in EXPORTED:
        made = accepted(lambda n=name: rt.export(out, n, out / "made"))
        assert made is None or made.stat().st_size
    result = accepted(lambda: rt.Result.load(out))
    if result is not None:
        assert all(c.isprintable() or c == "\n" for c in result.summary())
        ellipsoids = result.ellipsoids()
        assert np.isfinite(ellipsoids.center_in_world).all() and (ellipsoids.half_axes > 0).all()


def with_applied(matrix: Any) -> str:
    return json.dumps(json.loads(TRANSFORMS) | {"applied_transform": matrix})


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (with_applied(np.diag([-1.0, 1, 1, 1])[:3].tolist()), "mirrored"),
        (with_applied([[float("nan"), 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "4x4 finite numbers"),
        (
            TRANSFORMS.replace('"fl_x": 500', '"fl_x": 0'),
            r"frames\[0\]: a number is not finite, or",
        ),
        (TRANSFORMS.replace('"fl_x": 500, "fl_y": 500', '"camera_angle_x": 0'), "angle_x 0"),
    ],
)
def test_invalid_cameras(folder: Path, video: Any, text: str, what: str) -> None:
    path = folder / "transforms.json"
    path.write_text(text)
    with pytest.raises(rt.ReobjError, match=what):
        rt.read_poses(path, video)


# ---- Options ----


def options_make_sense(text: str) -> None:
    name, _, value = text.partition("=")
    config = with_option(rt.Config(), name, value)
    for section in ("tracker", "objects", "input", "detect", "poses"):
        own = getattr(config, section)
        values = [getattr(own, name) for name in own.__dataclass_fields__]
        assert all(v >= 0 and np.isfinite(v) for v in values if isinstance(v, int | float))


def sizes_make_sense(text: str) -> None:
    assert all(np.isfinite(v) and v > 0 for _, v in parse_known_size(text).values())


def camera_makes_sense(text: str) -> None:
    camera = parse_camera(text, SIZE)
    assert camera is None or np.isfinite(camera.params).all()


ARGUMENTS: dict[str, tuple[str, Callable[[str], None]]] = {
    "camera": ("492.7,492.7,320,240,0.1,0,0,0", camera_makes_sense),
    "known-size": ("chair=0.82m,door=2.0m", sizes_make_sense),
    "up": ("0,0,1", lambda text: None if np.isfinite(parse_up(text)).all() else pytest.fail(text)),
    "set": ("tracker.coast_frames=30", options_make_sense),
    "set float": ("tracker.return_probability=.5", options_make_sense),
}


@pytest.mark.parametrize("name", ARGUMENTS)
@given(changes=edits)
@example(changes=[(0.99, "nan", 0)])
@example(changes=[(0.99, "-1", 0)])
@example(changes=[(0.99, "\n", 4)])
@example(changes=[(0.3, "1.2.3", 0)])
@example(changes=[(0.5, "1e300", 0)])  # its square is infinite
@example(changes=[(0.3, "9" * 23, 0)])
@example(changes=[(0.99, "x" * 140000, 4)])  # messages quote a part of it only
def test_arguments_are_accepted_or_refused(
    name: str, changes: list[tuple[float, str, int]]
) -> None:
    text, check = ARGUMENTS[name]
    changed = edited(text, changes)
    if "\x00" not in changed:  # impossible in a command-line argument
        accepted(lambda: check(changed))


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


@given(
    seed=st.integers(0, 2**32 - 1),
    value=st.sampled_from([np.nan, np.inf, 0.0, 1e300, -1e12, 1e-300]),
    fraction=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    cameras=st.booleans(),
)
@example(seed=5, value=1e300, fraction=0.05, cameras=False)
@example(seed=5, value=np.inf, fraction=1.0, cameras=True)
def test_fits_are_finite_or_none(seed: int, value: float, fraction: float, cameras: bool) -> None:
    """Objects are located with finite numbers or not at all; the same for factorisations."""
    rng, poses = np.random.default_rng(seed), walk(5)
    img_from_world = poses.camera.K @ poses.cam_from_world
    boxes = quadrics.solid_boxes(chair_solids(), "box", img_from_world)
    boxes = np.concatenate([boxes, boxes + rng.normal(0, 2, boxes.shape)], 1)  # (5, 6, 4)
    target = img_from_world if cameras else boxes
    target[rng.random(target.shape) < fraction] = value
    categories = ["chair"] * boxes.shape[1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # squares of 1e300
        try:
            fits = quadrics.fit_objects(boxes, img_from_world, SIZE, categories)
            for name in ("center_in_world", "half_axes"):
                values = getattr(fits.ellipsoids, name)
                assert (np.isfinite(values).all(1) | np.isnan(values).any(1)).all()
            quadrics.fit_psfmo(boxes, quadrics.load_priors(), categories)
        except REFUSED as error:
            assert str(error).isprintable() and str(error)


# ---- Caches ----


def cached_poses(path: Path) -> Any:
    save_poses(path, walk(2))
    return load_poses, lambda poses: poses.cam_from_world


def cached_tracks(path: Path) -> Any:
    fitted(tracks_of(walk(2)), None).save_tracked(path)
    return rt.Result.load_tracked, lambda result: result.tracks.xyxy


def cached_tracker(path: Path) -> Any:
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1))
    tracker.update([[1, 1, 30, 40, 0.9, 1]])
    tracker.save(path)
    return rt.Tracker.load, lambda loaded: loaded.update([[2, 1, 31, 40, 0.9, 1]]).xyxy


def cached_detections(path: Path) -> Any:
    rt.write_detections_npz(path, [(0, rt.Detections.from_array([[1, 1, 30, 40, 0.9, 1]]))],
                            ["chair", "cup"], SIZE)  # fmt: skip
    return lambda p: read_npz(p, SIZE, SIZE, sealed=True), lambda found: found[0].xyxy


CACHES = {f.__name__: f for f in (cached_poses, cached_tracks, cached_tracker, cached_detections)}


@pytest.mark.parametrize("kind", CACHES)
@given(at=st.lists(st.floats(0, 1), min_size=1, max_size=4), value=st.integers(0, 255),
       cut=st.booleans())  # fmt: skip
@example(at=[0.0], value=0, cut=True)  # an empty file
@example(at=[0.999], value=7, cut=False)
def test_a_damaged_cache_is_computed_again(
    kind: str, folder: Path, at: list[float], value: int, cut: bool
) -> None:
    """Without a traceback, and with the original content."""
    path = folder / f"{kind}.npz"
    read, content_of = CACHES[kind](path)
    written, data = content_of(read(path)), bytearray(path.read_bytes())
    for position in at:
        data[round(position * (len(data) - 1))] = value
    path.write_bytes(data[: round(at[0] * len(data))] if cut else data)
    found = load_cached(path, read)
    if found is None:
        assert not path.exists()
    else:
        np.testing.assert_array_equal(content_of(found), written)
