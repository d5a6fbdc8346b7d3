"""The formats of detections and tracks: how each is recognised, and its reader."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable

from reobj.formats import Format, Probe, Registry
from reobj.sources import boxes_3d, coco, cvat, label_folders, tables
from reobj.sources.recorded import RecordedDetections, Source, read_npz
from reobj.types import ReobjError

Reader = Callable[[Source], RecordedDetections]


def _read_npz(source: Source) -> RecordedDetections:
    return read_npz(source.path, source.video.size, source.video.working_size)[0]


def _has(*choices: str, listed: bool | None = None) -> Callable[[Probe], bool]:
    """Test for all keys of a choice in a JSON object, or in the first object of a list.

    listed: whether it must be a list; None: either.
    """
    return lambda probe: (
        listed in (None, isinstance(probe.json, list))
        and any(probe.keys() >= {*keys.split()} for keys in choices)
    )


def _table(name: str) -> Callable[[Probe], bool]:
    return lambda probe: name in tables.forms(probe)


def _root(tag: str) -> Callable[[Probe], bool]:
    return lambda probe: probe.root is not None and probe.root.tag == tag


@functools.lru_cache(maxsize=1)
def _sample(probe: Probe) -> Probe:
    """Return the deepest JSON or XML file in a folder without labels; else the same path."""
    with contextlib.suppress(ReobjError):
        if not probe.is_dir or label_folders.label_files(probe.path):
            return probe
    files = sorted(path for path in probe.path.rglob("*") if path.suffix in (".json", ".xml"))
    if not files:
        return probe
    sample = Probe(max(files, key=lambda path: len(path.parts)))
    probe.found = f", which has no label files, but {sample.path.name}{sample.found}"
    return sample


def _is_via(probe: Probe) -> bool:
    """Test for a JSON object whose values have regions."""
    data = probe.json
    values = list(data.values())[:1] if isinstance(data, dict) else []
    regions = any(isinstance(value, dict) and "regions" in value for value in values)
    return regions or _has("_via_img_metadata")(probe)


def _is_cvat(probe: Probe) -> bool:
    return _root("annotations")(probe) or "annotations.xml" in probe.names


def _labels(form: int) -> Callable[[Probe], bool]:
    """Test for a folder of labels that may have a form of `label_folders.forms`."""

    def recognise(probe: Probe) -> bool:
        if not probe.is_dir or _sample(probe) is not probe:
            return False
        with contextlib.suppress(ReobjError):
            return form in label_folders.forms(probe.path)
        return not form

    return recognise


def _label_reader(pose: int) -> Reader:
    return lambda source: label_folders.read_label_folder(source, pose)


FROM_1 = "from 1; from 0 if there is a 0"
NAMED = "by image name, else by the number in it"
COCO, YOLO = "as COCO JSON", "as a folder of YOLO labels"

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
           boxes_3d.read_source_3d, "by time", "world", "instance, sem_id", kind="text"),
    Format("records", "supervision's JSONSink: a JSON list of flat objects",
           _has(*tables.ALIASES["x1"].split(), listed=True), tables.read_records, "from 0", "px",
           "other keys", kind="JSON"),
    Format("coco-results", "COCO results, ultralytics' predictions.json",
           lambda probe: probe.json == [] or _has("image_id bbox", listed=True)(probe),
           coco.read_coco_results, f"{NAMED}, else image_id from 0", "px", kind="JSON"),
    Format("coco", "COCO, COCO-VID and TAO datasets, CVAT's and Roboflow's COCO",
           _has("images", listed=False), coco.read_coco, f"frame_id from 0; else {NAMED}", "px",
           "keypoints", kind="JSON"),
    Format("oa-slam", "OA-SLAM, VOOM", _has("file_name detections", listed=True),
           coco.read_oa_slam, NAMED, "px", kind="JSON"),
    *(Format(name, f"a folder of YOLO labels, boxes {title}", _labels(numbers),
             _label_reader(numbers),
             f"{NAMED}; VIDEO_N.txt from 1", "fractions", "keypoints" * (numbers > 0),
             kind="folder")
      for name, title, numbers in (
        ("yolo", "or polygons", 0), ("yolo-pose", "with keypoints", 3),
        ("yolo-pose-2d", "with keypoints without visibility", 2),
      )),
    Format("cvat", "CVAT for video 1.1 and for images 1.1, XML or zip", _is_cvat, cvat.read_cvat,
           f"from 0; images {NAMED}", "px", "skeletons, cuboids", kind="XML"),
    Format("npz", "`rt.write_detections_npz`", lambda probe: probe.suffix == ".npz", _read_npz,
           "from 0", "px"),
    *(Format(name, title, lambda probe, test=recognise: test(_sample(probe)), None,  # type: ignore[misc]
             advice=f"export it {advice}")
      for name, title, recognise, advice in (
        ("label-studio", "Label Studio's JSON",
         _has("data annotations", "data predictions", "data completions",
              "annotation_id annotator", listed=True), COCO),
        ("fiftyone", "FiftyOne's JSON", _has("classes labels", "samples", listed=False), COCO),
        ("youtube-vis", "YouTube-VIS' JSON", lambda probe: _has("videos annotations")(probe)
         and "images" not in probe.keys(), "as COCO-VID, with images that have frame_id"),
        ("scalabel", "Scalabel's or BDD100K's JSON", _has("labels name", "frames config"), COCO),
        ("voc", "Pascal VOC's XML", _root("annotation"), YOLO),
        ("detrac", "UA-DETRAC's XML", _root("sequence"), "as MOTChallenge rows"),
        ("datumaro", "Datumaro's JSON", _has("items categories"), COCO),
        ("labelme", "labelme's JSON", _has("shapes imagePath"), COCO),
        ("via", "VGG Image Annotator's JSON", _is_via, COCO),
        ("createml", "Create ML's JSON", _has("image annotations", listed=True), COCO),
        ("supervisely", "Supervisely's JSON", _has("objects size"), COCO),
        ("darwin", "V7's Darwin JSON", _has("item annotations"), COCO),
        ("detectron2", "detectron2's dicts", _has("file_name annotations", listed=True), COCO),
        ("ultralytics", "ultralytics' `to_json`", _has("box confidence", listed=True),
         "with save_txt=True"),
        ("boxes-json", "a JSON list whose objects have a list bbox and no image_id",
         lambda probe: _has("bbox", listed=True)(probe) and "image_id" not in probe.keys(),
         "as CSV with the columns frame,x1,y1,x2,y2,score,class"),
      )),
])  # fmt: skip
