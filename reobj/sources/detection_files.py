"""Recorded detections and tracks of other tools: one registry of readers, one validation.

Start at `read_detections` and `read_tracks`. Every reader of DETECTIONS returns a
`RecordedDetections`, which is then validated: invalid content raises an error with the line number;
unusable rows are dropped and counted in a message.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reobj.cameras import Poses
from reobj.files import did_you_mean, last_name, shortened
from reobj.formats import AUTO, Format, Probe, Registry
from reobj.sources import coco, label_folders, tables
from reobj.sources.class_names import check_length, load_class_names
from reobj.sources.recorded import (
    NORMALISED_MAX,
    RecordedDetections,
    Source,
    detector_ran_message,
    infer_detector_ran,
    other_form,
    read_npz,
)
from reobj.sources.video import ImagelessVideo, Video
from reobj.types import (
    COORDINATE_MAX,
    DETECTIONS_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    Tracks,
    box_iou,
    option,
    rows_by,
)
from reobj.words import meant

# ---- Formats -------------------------------------------------------------------------------------

Reader = Callable[[Source], RecordedDetections]


def _has(keys: str, listed: bool) -> Callable[[Probe], bool]:
    """Test for keys in a JSON object, or, if it is `listed`, in the first object of a list."""
    return lambda probe: listed == isinstance(probe.json, list) and probe.keys() >= {*keys.split()}


def _table(name: str) -> Callable[[Probe], bool]:
    return lambda probe: name in tables.forms(probe)


FROM_1 = "from 1; from 0 if there is a 0"
NAMED = "by image name, else by the number in it"


def _labels(name: str, title: str, numbers: int) -> Format[Reader]:
    """Make the format of folders of labels that may have a form of `label_folders.forms`."""

    def recognise(probe: Probe) -> bool:
        with contextlib.suppress(ReobjError):
            return probe.is_dir and numbers in label_folders.forms(probe.path)
        return not numbers

    return Format(
        name, f"a folder of YOLO labels, boxes {title}", recognise,
        lambda source: label_folders.read_label_folder(source, numbers),
        f"{NAMED}; VIDEO_N.txt from 1", "fractions", "keypoints" * (numbers > 0), kind="folder",
    )  # fmt: skip


DETECTIONS: Registry[Reader] = Registry("detections", "--detections-format", [
    Format("mot", "MOTChallenge, CVAT's MOT 1.1, trackers: rows of 6 to 10 numbers",
           _table("mot"), tables.read_mot, FROM_1, "px", "column 9; x, y, z in ten columns",
           kind="text"),
    Format("boxmot", "boxmot: nine columns that end in 1, class from 0, score", _table("boxmot"),
           tables.read_boxmot, FROM_1, "px", kind="text"),
    Format("visdrone", "VisDrone: ten columns that end in class, truncation, occlusion",
           _table("visdrone"), tables.read_visdrone, FROM_1, "px", "truncation, occlusion",
           kind="text"),
    Format("kitti", "KITTI tracking: 17 or 18 columns", _table("kitti"), tables.read_kitti,
           "from 0", "px", "everything in 3D", kind="text"),
    Format("csv", "tables with a header: supervision's CSVSink, pandas, Boxer's 2D boxes, "
           "Roboflow's CSV", _table("csv"), tables.read_csv,
           "from 0 (bb_left: from 1), image names, or times", "px", "other columns", kind="text"),
    Format("boxer-3d", "Boxer, WildDet3D: boxes in the world of --poses", _table("boxer-3d"),
           tables.read_source_3d, "by time", "world", "instance, sem_id", kind="text"),
    Format("records", "supervision's JSONSink: a JSON list of flat objects",
           lambda probe: isinstance(probe.json, list)
           and not probe.keys().isdisjoint(tables.ALIASES["x1"].split()),
           tables.read_records, "from 0", "px", "other keys", kind="JSON"),
    Format("coco-results", "COCO results, ultralytics' predictions.json",
           lambda probe: probe.json == [] or _has("image_id bbox", listed=True)(probe),
           coco.read_coco_results, f"{NAMED}, else image_id from 0", "px", kind="JSON"),
    Format("coco", "COCO, COCO-VID and TAO datasets, CVAT's and Roboflow's COCO",
           _has("images", listed=False), coco.read_coco, f"frame_id from 0; else {NAMED}", "px",
           "keypoints", kind="JSON"),
    Format("oa-slam", "OA-SLAM, VOOM", _has("file_name detections", listed=True),
           coco.read_oa_slam, NAMED, "px", kind="JSON"),
    _labels("yolo", "or polygons", 0), _labels("yolo-pose", "with keypoints", 3),
    _labels("yolo-pose-2d", "with keypoints without visibility", 2),
    Format("cvat", "CVAT for video 1.1 and for images 1.1, XML or zip",
           lambda probe: "annotations.xml" in probe.names
           or getattr(probe.root, "tag", "") == "annotations", coco.read_cvat,
           f"from 0; images {NAMED}", "px", "skeletons, cuboids", kind="XML"),
    Format("npz", "`rt.write_detections_npz`", lambda probe: probe.suffix == ".npz",
           lambda source: read_npz(source.path, source.video.size, source.video.working_size),
           "from 0", "px"),
])  # fmt: skip


# ---- Options -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DetectConfig:
    """Detector, and filter of detections, recorded ones included."""

    model: str = option(
        "deimv2-femto",
        "detector: a name of `models`, fast (deimv2-atto), a .onnx file, a model of an installed "
        "library (FILE.pt or ultralytics:MODEL, rfdetr:MODEL, torchvision:MODEL, hf:MODEL), or "
        "module:function of a BGR image",
        "--detector",
    )
    words: str = option(
        "",
        "comma-separated objects to look for, in free text, by a detector that takes text "
        "(ultralytics' YOLO-World and YOLOE, hf: Grounding DINO and OWLv2)",
        "--words",
    )
    min_score: float = option(0.1, "drop detections of a lower score (ByteTrack: .1)")
    classes: str = option("", "comma-separated class names to keep (default: all)", "--classes")
    class_names: str = option(
        "", "file of class names that are not COCO's: text, one a line, or a data.yaml"
    )
    format: str = option(
        AUTO, "format of the file of detections or identities: auto, or a name of the table in "
        "docs/input_formats.md", "--detections-format",
    )  # fmt: skip
    first_frame: str = option(
        "", "number of the first frame in a file of detections, 0 or 1 (default: as the format "
        "says); order: the images that a COCO dataset lists are the frames, in this order",
    )  # fmt: skip
    image_size: str = option(
        "", "WIDTHxHEIGHT of the frames that a file of detections was made for, if it does not "
        "say so; boxes are scaled",
    )  # fmt: skip
    score_max: float = option(1.0, "largest possible score in a file of detections")
    max_detections: int = option(
        0, "most detections per frame, by score (0: 100 of a model, all of a file)"
    )
    batch: int = option(
        0,
        "frames that a network gets at once (0: 8 on cuda and tensorrt, else 1; a live source: 1); "
        "lower: less memory of the device",
    )
    layout: str = option(
        "",
        "layout of the ONNX model's outputs, as docs/input_formats.md lists them (default: the one "
        "that agrees with its shapes, class names and task)",
        "--detector-layout",
    )


def unnamed_class(class_id: int, count: int) -> str:
    """Return the message about a class id without a class name."""
    return (f"class {class_id}, but there are only {count} class names: give a file of names with "
            "--set detect.class_names=FILE")  # fmt: skip


def class_filter(wanted: str, names: Sequence[str], present: IntArray | None = None) -> IntArray:
    """Return the ids of comma-separated class names, or of their synonyms (`words.meant`).

    Args:
        present: ids of the classes that occur, if known: synonyms among them go before a name that
            does not occur.
    Raises:
        ReobjError: a name that is not among `names`.
    """
    words = [word.strip() for word in wanted.split(",") if word.strip()]
    here = [name if present is None or i in present else "" for i, name in enumerate(names)]
    chosen = list[int]()
    for word in words:
        if not (ids := meant(word, here) or meant(word, names)):
            close = did_you_mean(word, names) or f" among {', '.join(names)}"
            raise ReobjError(f"--classes: no class {word}{close}")
        chosen += ids
    return np.array(chosen, np.int64)


# ---- Reading -------------------------------------------------------------------------------------


def read_detections(
    path: str | Path,
    video: Video,
    config: DetectConfig | None = None,
    poses: Poses | None = None,
) -> RecordedDetections:
    """Read recorded detections of a video, in any of the formats.

    Args:
        path: the file, or a folder of YOLO labels; boxes in px and frame numbers of the source.
        config: all options but the detector's apply.
        poses: cameras that project boxes in 3D (Boxer's CSV).
    Raises:
        ReobjError: the file, the line and what was expected.
    """
    path = Path(path)
    config = config or DetectConfig()
    recorded = _read(path, video, config, poses)
    listed = recorded.detector_ran is not None
    if recorded.detector_ran is None:
        recorded.detector_ran = infer_detector_ran(recorded.frame, video.frame_count)
    elif not 0 < len(recorded.detector_ran) < (video.frame_count or sys.maxsize):
        recorded.detector_ran = None
    if recorded.detector_ran is not None:
        recorded.messages.append(detector_ran_message(recorded.detector_ran, listed))
    _check_scores(recorded, config.score_max, path)
    _check(recorded, path, config, video.frame_count)
    return recorded


def _read(
    path: Path, video: Video, config: DetectConfig, poses: Poses | None = None
) -> RecordedDetections:
    """Read a file of any format without validation."""
    if config.first_frame not in ("", "0", "1", "order"):
        raise ReobjError(f"detect.first_frame {config.first_frame}: expected 0, 1 or order")
    source = Source(path, video, class_names(config), config.first_frame, poses)
    return read_source(source, DETECTIONS.find(path, config.format).read)


def class_names(config: DetectConfig) -> Sequence[str]:
    """Read the class names that the user gives; (): none."""
    return load_class_names(config.class_names) if config.class_names else ()


def read_source(source: Source, read: Reader) -> RecordedDetections:
    """Read a file in its format."""
    try:
        return read(source)
    except ReobjError:
        raise
    except Exception as error:  # zip, zlib and expat have their own exceptions for damaged files
        text = f"damaged, or not as its format says ({error!r:.200})"
        raise ReobjError(f"{source.path}: {text}") from error


def described_images(
    path: Path, config: DetectConfig
) -> tuple[tuple[int, int] | None, list[str], Array | None]:
    """Return what a file of detections, or a dataset beside it, says about its images.

    Returns:
        their common (w, h), None: not stated or they differ; their names; their times in s,
        ascending, None: frames are not found by times.
    """
    video = ImagelessVideo(path, (0, 0))
    source = Source(path, video, class_names(config), config.first_frame, describes=True)
    size = read_source(source, DETECTIONS.find(path, config.format).read).size
    sizes = {size, *source.image_sizes} - {(0, 0)}
    stated = sizes.pop() if len(sizes) == 1 else (0, 0)
    times_s = None if source.times_s is None else np.unique(source.times_s)
    return None if 0 in stated else stated, list(dict.fromkeys(source.image_names)), times_s


def _check(
    recorded: RecordedDetections, path: Path, config: DetectConfig, frame_count: int
) -> None:
    """Validate and filter detections of any format; sort them by frame and score.

    Invalid content is an error; dropped rows are counted in a message.
    """
    check_rows(recorded, path)
    say = recorded.messages.append
    if ignored := int(recorded.ignored.sum()):
        say(f"{ignored} ignored regions of the file left out")
        recorded.select(np.flatnonzero(~recorded.ignored))
    if stated := config.image_size:
        if not (match := re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", stated)):
            raise ReobjError(f"detect.image_size {stated}: expected WIDTHxHEIGHT, such as 640x480")
        ratio = np.divide(recorded.size, [int(side) for side in match.groups()])
        recorded.xyxy = recorded.xyxy * np.tile(ratio, 2)
    keep = _usable(recorded, path, frame_count, not stated)
    count = len(recorded)
    low = keep & (recorded.score < config.min_score)
    if low.any():
        say(f"{low.sum()} of {count} boxes have a score below {config.min_score:g} "
            "(detect.min_score): left out")  # fmt: skip
    keep &= ~low
    if config.classes:
        present = np.unique(recorded.class_id)
        chosen = class_filter(config.classes, recorded.class_names, present)
        keep &= np.isin(recorded.class_id, chosen)
    if not keep.any():
        kinds = f" and class {config.classes}" * bool(config.classes)
        say(f"none of {count} boxes is left: those of score {config.min_score:g} or more "
            f"(detect.min_score){kinds} are used" if count else "no detections in this file"
            )  # fmt: skip
    rows = np.flatnonzero(keep)
    rows = rows[np.lexsort((rows, -recorded.score[rows], recorded.frame[rows]))]  # best first
    frame = recorded.frame[rows]
    rank = np.arange(len(rows)) - np.searchsorted(frame, frame)  # within its frame
    most = config.max_detections or len(rows)
    if (rank >= most).any():
        say(f"{(rank >= most).sum()} boxes beyond the best {most} of a frame left out "
            "(detect.max_detections)")  # fmt: skip
    elif len(rows) and rank.max() >= DETECTIONS_MAX:
        raise ReobjError(
            f"{path}: {rank.max() + 1} boxes in frame {frame[rank.argmax()]} (0-based), at most "
            f"{DETECTIONS_MAX} are allowed; raise detect.min_score, or keep the best with --set "
            "detect.max_detections=N"
        )
    recorded.select(rows[rank < most])
    recorded.messages[:] = [f"{last_name(path)}: {text}" for text in recorded.messages]


def check_rows(recorded: RecordedDetections, path: Path) -> None:
    """Refuse invalid values and masks; the error names the first such row."""
    names = recorded.class_names
    for name in names:
        check_length(name, str(path))
    rows = np.column_stack([recorded.xyxy, recorded.score])  # (N, 5)
    kinds = recorded.class_id
    finite: BoolArray = np.all(np.abs(rows) <= COORDINATE_MAX, axis=1)  # (N,), NaN is not
    named = (kinds >= 0) & (kinds < len(names))
    pixels = np.array([runs.sum() for runs in recorded.runs], np.int64)
    fits = np.isin(pixels, (0, math.prod(recorded.size)))
    for row in np.flatnonzero(~(finite & named & fits))[:1].tolist():
        text = f"mask of {pixels[row]} pixels in a video of {recorded.size}"
        text = text if named[row] else unnamed_class(kinds[row], len(names))
        text = text if finite[row] else f"{rows[row]}: NaN, infinite or beyond 1e7 pixels"
        raise ReobjError(f"{path}, {recorded.unit} {recorded.line[row]}: {text}")


def _check_scores(recorded: RecordedDetections, most: float, path: Path) -> None:
    """Convert scores of up to `most` to [0, 1]: -1 for all is no score; below 0 is 0."""
    score = recorded.score
    if len(score) and (score == -1).all():
        recorded.messages.append("scores are all -1: taken as 1")
        recorded.score = -score
        return
    if (high := score.max(initial=0)) > most * 1.01 or not most:  # rounded
        raise ReobjError(f"{path}: scores up to {high:g}, expected 0 to {most:g}; name the largest "
                         "with --set detect.score_max=N, e.g. 100 for percent")  # fmt: skip
    if (low := score < 0).any():
        recorded.messages.append(f"{low.sum()} scores below 0, from {score.min():g}, count as 0")
    recorded.score = np.clip(score / most, 0, 1)


def _usable(
    recorded: RecordedDetections, path: Path, frame_count: int, checks_size: bool
) -> BoolArray:
    """Test which boxes (N,) have an area, overlap the image and belong to a frame of the video."""
    count = len(recorded)
    if not count:
        return np.zeros(0, bool)
    xyxy = recorded.xyxy
    frame = recorded.frame
    size = recorded.size
    low, high = xyxy[:, :2], xyxy[:, 2:]
    empty: BoolArray = np.any(high <= low, axis=1)  # (N,)
    outside: BoolArray = ~empty & np.any((high <= 0) | (low >= size), axis=1)
    missing: BoolArray = (frame < 0) | (frame >= (frame_count or sys.maxsize))
    numbers = shortened(np.unique(frame[missing]).tolist())
    absent = f"of frames that the video lacks (0-based: {numbers}; it has {frame_count or 'some'})"
    larger = outside.sum() > max(10, 0.05 * count) and not (high <= 0).any()
    for fault in (
        f"no coordinate above {NORMALISED_MAX}: normalised to 0..1? Multiply them by the image size"
        * bool(xyxy.max() <= NORMALISED_MAX),
        other_form(xyxy, recorded.form, size, frame, recorded.identity),
        _other_size(xyxy[~empty], size) * checks_size,
        f"{empty.sum()} of {count} boxes have no area and {outside.sum()} lie outside the image of "
        f"{size}: frames of another size (--set detect.image_size=WIDTHxHEIGHT), not turned "
        "upright, or another video?" * bool(larger or 2 * (empty | outside).sum() > count),
        f"all detections are {absent}: detections of another video?" * bool(missing.all()),
    ):
        if fault:
            raise ReobjError(f"{path}: {fault}")
    for bad, why in ((empty, "without area"), (outside, "wholly outside the image"),
                     (missing, absent)):  # fmt: skip
        if bad.any():
            first = f"{recorded.unit} {recorded.line[bad][0]}"
            recorded.messages.append(f"{bad.sum()} boxes {why} dropped, the first at {first}")
    return np.logical_not(empty | outside | missing)


def _other_size(xyxy: Array, size: tuple[int, int]) -> str:
    """Describe the frames of another size that boxes (N, 4) were made for; "" if there are none.

    Boxes of a detector begin at 0 and end at the borders of its frame: several have the largest x2
    (y2), and differ in x1 (y1). If these borders are not those of the image, the frames had another
    size. One border is enough if boxes reach the same share of the image in the other direction.
    """
    most = xyxy[:, 2:].max(0, initial=1)  # (2,)
    share = most / size
    begins = xyxy[:, :2].min(0, initial=np.inf) <= 0.02 * most  # of the largest corner
    cut = [xyxy[xyxy[:, k + 2] >= most[k] - 1, k] // (0.02 * most[k]) for k in (0, 1)]
    ends = np.array([len(np.unique(starts)) >= 4 for starts in cut])  # 3 may be of one object
    moved = np.abs(share - 1) > 0.02
    similar = np.ptp(share) <= 0.02
    if not ((moved & begins).any() and ends.sum() + similar >= 2):
        return ""
    return (f"boxes are cut off at x = {most[0]:.0f}, y = {most[1]:.0f}, and the image is "
            f"{size[0]}x{size[1]}: boxes of frames of another size? Name it with --set "
            "detect.image_size=WIDTHxHEIGHT")  # fmt: skip


def read_tracks(
    path: str | Path,
    video: Video,
    config: DetectConfig | None = None,
    known: Tracks | None = None,
    known_names: Sequence[str] = (),
) -> tuple[Tracks, tuple[str, ...], list[str]]:
    """Read identities of another tool or of manual corrections.

    Args:
        path: any file of `read_detections` with identities: CVAT for video 1.1 (XML or zip), COCO
            (track_id or instance_id, also in CVAT's attributes), MOT, KITTI, CSV, YOLO labels;
            frames excluded by the video's options are not used.
        known, known_names: earlier tracks of the video and their class names; their scores are
            copied to unmoved boxes, their classes to files without classes.
    Returns:
        tracks, their class names, and messages for the user.
    """
    path = Path(path)
    config = dataclasses.replace(config or DetectConfig(), min_score=0.0, max_detections=0)
    recorded = _read(path, video, config)
    recorded.score = np.clip(np.where(recorded.score == -1, 1, recorded.score), 0, 1)
    _check(recorded, path, config, video.frame_count)
    name = last_name(path)
    identified = recorded.identity >= 0
    if len(recorded) and not identified.any():
        raise ReobjError(f"{path}: no box has an identity; expected a file of tracks")
    if not identified.all():
        recorded.messages.append(f"{name}: {(~identified).sum()} of {len(recorded)} boxes without "
                                 "an identity left out")  # fmt: skip
        recorded.select(np.flatnonzero(identified))
    if recorded.identity.min(initial=1) == 0:
        recorded.messages.append(f"{name}: identities count from 0: 1 is added to all of them")
        recorded.identity = recorded.identity + 1
    recorded.select(np.flatnonzero(video.config.selects(recorded.frame)))
    pairs = np.column_stack([recorded.frame, recorded.identity])  # (N, 2)
    unique, rows, count = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        frame, identity = unique[count.argmax()]
        raise ReobjError(f"{path}: identity {identity} has {count.max()} boxes in frame {frame} "
                         "(0-based); an object is in one place at a time")  # fmt: skip
    recorded.select(rows)
    ids = recorded.identity
    tracks = Tracks(recorded.frame, ids, ids, recorded.xyxy, recorded.score, recorded.class_id,
                    np.full(len(rows), -1, np.int64))  # fmt: skip
    names = recorded.class_names
    if known is not None:
        unnamed = names == ("object",)
        tracks = _with_known(tracks, known, unnamed)
        if unnamed:
            names = tuple(known_names)
            without = (tracks.class_id < 0).sum()
            recorded.messages.append(
                f"{name}: no classes: {len(tracks) - without} boxes get the class of the earlier "
                f"object that they show, {without} are `object`"
            )
    return tracks, names, recorded.messages


def _with_known(tracks: Tracks, known: Tracks, unnamed: bool) -> Tracks:
    """Copy scores of earlier tracks to unmoved boxes, and classes to unnamed objects.

    The class has the largest sum of IoU over the frames of an object; -1: no overlap.
    """
    class_id = tracks.class_id.copy()
    score = tracks.score.copy()
    overlap = np.zeros(len(tracks))
    known_class = np.full(len(tracks), -1, np.int64)
    for rows in rows_by(tracks.frame):
        same_frame = known[known.frame == tracks.frame[rows[0]]]
        if not len(same_frame):
            continue
        iou = box_iou(tracks.xyxy[rows], same_frame.xyxy)  # (n, m)
        best = iou.argmax(1)
        overlap[rows] = iou.max(1)
        unmoved = overlap[rows] > 0.95  # counts as the tracker's own box
        score[rows] = np.where(unmoved, same_frame.score[best], score[rows])
        same_object = overlap[rows] >= 0.5  # as in PASCAL VOC
        known_class[rows] = np.where(same_object, same_frame.class_id[best], -1)
    for rows in rows_by(tracks.track_id) if unnamed else ():
        voters = rows[known_class[rows] >= 0]
        votes = np.bincount(known_class[voters], overlap[voters])
        class_id[rows] = int(votes.argmax()) if len(voters) else -1
    return dataclasses.replace(tracks, class_id=class_id, score=score)
