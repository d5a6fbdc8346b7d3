#!/usr/bin/env python3
"""Run every kind of `--detector` on one real recording and write commands and output as a page.

    python benchmarks/detector_lines.py DATA -o docs/transcripts/detectors.md [--only NAME...]
        [--pt yolo11n-seg.pt] [--onnx yolo11n-seg.onnx]

DATA has the folder redkitchen_7scenes (images, poses_c2w.txt, detections_yolov8s.csv,
objects_gt.json); every 32nd image is read. The libraries come with `pip install -e ".[detectors]"`.
Models that cannot be had without a download are made of a configuration with random weights: boxes
of such a model mean nothing, but they come from the library. A command that fails stays in the page
with its message.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
CAMERA = "530,530,322,238"  # fx, fy, cx, cy of redkitchen_7scenes
STEP = 32  # of the images
BOXER = (
    "time_ns,tx_world_object,ty_world_object,tz_world_object,qw_world_object,qx_world_object,"
    "qy_world_object,qz_world_object,scale_x,scale_y,scale_z,name,instance,sem_id,prob"
)
MOST_LINES = 30  # of the output of a command
RANDOM = "Random weights: the boxes mean nothing."
LOW = "--set detect.min_score=0.001"  # scores of random weights are low
LOWEST = "--set detect.min_score=0.000001"
FUNCTION = '''\
import cv2
import numpy as np

def red(image):
    """Red regions of a BGR image: rows x1, y1, x2, y2, score, class."""
    hue, saturation, value = cv2.split(cv2.cvtColor(image, cv2.COLOR_BGR2HSV))
    mask = ((hue < 8) | (hue > 172)) & (saturation > 120) & (value > 60)
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    x, y, w, h, area = stats[1:].T
    rows = np.stack([x, y, x + w, y + h, np.full(len(x), 0.9), np.zeros(len(x))], 1)
    return rows[area > 150]

red.names = {0: "red region"}
'''


@dataclass(frozen=True)
class Line:
    """A kind of detector.

    Attributes:
        name: title of its section. words: of the command. note: what its weights are.
        make: writes what it needs into the current folder.
    """

    name: str
    words: str
    note: str
    make: Callable[[], object] = lambda: None


def make_function() -> None:
    """Write the module of a user."""
    Path("my_boxes.py").write_text(FUNCTION)


def make_rt_detr() -> None:
    """Write RT-DETRv2 with ResNet-18 and random weights."""
    import torch
    import transformers as tf

    torch.manual_seed(0)
    config = tf.RTDetrV2Config(
        backbone_config=tf.RTDetrResNetConfig(
            depths=[2, 2, 2, 2],
            hidden_sizes=[64, 128, 256, 512],
            layer_type="basic",
            out_features=["stage2", "stage3", "stage4"],
        ),
        encoder_in_channels=[128, 256, 512],
        decoder_layers=3,
        id2label={0: "chair", 1: "cup", 2: "tv"},
    )
    tf.RTDetrV2ForObjectDetection(config).save_pretrained("rt_detr")
    tf.RTDetrImageProcessor().save_pretrained("rt_detr")


def make_owl() -> None:
    """Write a small OWLv2, a detector of free text, whose tokens are letters."""
    import torch
    import transformers as tf

    torch.manual_seed(0)
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    tokens = [*letters, *(f"{c}</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    last = len(tokens) - 1
    size = {
        "hidden_size": 64,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    text = {
        "vocab_size": last + 1,
        "bos_token_id": last - 1,
        "eos_token_id": last,
        "pad_token_id": last,
        "max_position_embeddings": 32,
    }
    config = tf.Owlv2Config(
        text_config=size | text,
        vision_config=size | {"image_size": 128, "patch_size": 16},
        projection_dim=64,
    )
    tf.Owlv2ForObjectDetection(config).save_pretrained("owlv2")
    images = tf.Owlv2ImageProcessor(size={"height": 128, "width": 128})
    vocabulary = {token: i for i, token in enumerate(tokens)}
    tokenizer = tf.CLIPTokenizer(vocab=vocabulary, merges=[])
    tf.Owlv2Processor(images, tokenizer).save_pretrained("owlv2")


def make_boxer() -> None:
    """Write the annotated boxes of the kitchen as Boxer does, where their centres are in view."""
    from scipy.spatial.transform import Rotation

    world_from_cam = np.loadtxt("poses.txt").reshape(-1, 4, 4)
    truth = json.loads((Path("kitchen").resolve().parent / "objects_gt.json").read_text())
    fx, fy, cx, cy = map(float, CAMERA.split(","))
    rows = [BOXER]
    for frame in range(0, len(world_from_cam), STEP):
        cam_from_world = np.linalg.inv(world_from_cam[frame])
        for found in truth["objects"]:
            x, y, z = cam_from_world[:3, :3] @ found["center"] + cam_from_world[:3, 3]
            if z < 0.3 or abs(fx * x / z) > cx or abs(fy * y / z) > cy:
                continue
            quat = np.roll(Rotation.from_matrix(found["R"]).as_quat(), 1)  # wxyz
            numbers = [round(frame * 1e9 / 30), *found["center"], *quat, *found["size"]]
            end = [found["coco"] or found["name"], found["id"], -1, 0.9]
            rows.append(",".join(map(str, numbers + end)))
    Path("boxer.csv").write_text("\n".join(rows) + "\n")


def lines(onnx: str, pt: str) -> list[Line]:
    """Return all kinds of detectors, in the order of the table in docs/input_formats.md."""
    return [
        Line("deimv2-femto", "--detector deimv2-femto", "The default. Trained weights."),
        Line("fast", "--detector fast", "Trained weights."),
        Line("deimv2-n", "--detector deimv2-n", "Its weights are a download."),
        Line("FILE.onnx", f"--detector {onnx}", "Trained weights, with masks."),
        Line("FILE.pt", f"--detector {pt}", "ultralytics, trained weights, with masks."),
        Line("ultralytics:MODEL", f"--detector ultralytics:yolo11n-seg.yaml {LOWEST}", RANDOM),
        Line("rfdetr:MODEL", f"--detector rfdetr:nano= {LOW}", RANDOM),
        Line(
            "torchvision:MODEL",
            f"--detector torchvision:ssdlite320_mobilenet_v3_large= {LOW}",
            RANDOM,
        ),
        Line("hf:FOLDER", f"--detector hf:rt_detr {LOW}", f"RT-DETRv2. {RANDOM}", make_rt_detr),
        Line(
            "hf:FOLDER with words",
            f'--detector hf:owlv2 --words "red box, cup" {LOW}',
            f"A small OWLv2. {RANDOM}",
            make_owl,
        ),
        Line(
            "ultralytics:MODEL with words",
            '--detector ultralytics:yolov8s-worldv2.yaml --words "red box, cup"',
            "YOLO-World: the network that reads the words is a download, as that of YOLOE.",
        ),
        Line(
            "module:function",
            "--detector my_boxes:red",
            f"A detector of red regions:\n\n```py\n{FUNCTION}```",
            make_function,
        ),
        Line(
            "a file of boxes",
            "--detections boxes.csv",
            "Boxes of YOLOv8s, recorded on a GPU: `frame,x1,y1,x2,y2,score,class`.",
        ),
        Line(
            "3D boxes of Boxer",
            "--detections boxer.csv",
            "Boxer was not run: the annotated boxes of this recording, in its format.",
            make_boxer,
        ),
    ]


def count(out: Path) -> str:
    """Count the detections; those of a function are not cached, so the tracked ones."""
    for path in out.glob("cache/boxes-*.npz"):
        return f"{len(np.load(path)['frame'])} detections"
    return f"{len((out / 'tracks.txt').read_text().splitlines())} boxes in tracks.txt"


def result(line: Line, folder: Path) -> str:
    """Run a command; return its section."""
    out = re.sub(r"\W+", "_", line.name).strip("_")
    command = (
        f"python reobj_track.py run kitchen -o {out} --every {STEP} --poses poses.txt "
        f"--camera {CAMERA} {line.words}"
    )
    tool = str(ROOT / "reobj_track.py")
    quiet = " --set output.overlay=0 --set output.scene=0"
    shell = command.replace("python reobj_track.py", f'"{sys.executable}" "{tool}"') + quiet
    done = subprocess.run(shell, shell=True, cwd=folder, capture_output=True, text=True)
    errors = [row for row in done.stderr.splitlines() if row.startswith(("error:", "warning:"))]
    text = done.stdout.strip().partition("\nsigma:")[0].splitlines() + errors
    for path, name in (
        (str(folder), "."),
        (os.environ.get("REOBJ_MODELS", str(folder)), "$REOBJ_MODELS"),
        (str(Path.home()), "~"),
    ):
        text = [row.replace(path, name) for row in text]
    text = [re.sub(r"\x1b\[\d*m", "", row) for row in text]
    text = [row for row in text if not row.startswith("look at:")]
    if len(text) > MOST_LINES:
        text[MOST_LINES // 2 : -MOST_LINES // 2] = ["..."]
    end = f"{count(folder / out)}." if done.returncode == 0 else f"Exit code {done.returncode}."
    shown = "\n".join([f"$ {command}", *text])
    print(line.name, done.returncode, end, flush=True)
    return f"## {line.name}\n\n{line.note}\n\n```text\n{shown}\n```\n\n{end}\n"


def main() -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of the recordings")
    parser.add_argument("-o", type=Path, required=True, dest="page", help="page to write")
    parser.add_argument("--only", nargs="*", default=[], help="titles of sections")
    parser.add_argument("--onnx", type=Path, default=Path("yolo11n-seg.onnx"))
    parser.add_argument("--pt", type=Path, default=Path("yolo11n-seg.pt"))
    args = parser.parse_args()
    recording = (args.data / "redkitchen_7scenes").resolve()
    args.page.parent.mkdir(parents=True, exist_ok=True)
    page = args.page.resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        os.chdir(folder)
        links = {
            "kitchen": recording / "images",
            "poses.txt": recording / "poses_c2w.txt",
            "boxes.csv": recording / "detections_yolov8s.csv",
            "yolo11n-seg.onnx": args.onnx.resolve(),
            "yolo11n-seg.pt": args.pt.resolve(),
        }
        for link, target in links.items():
            Path(link).symlink_to(target)
        sections = []
        for line in lines("yolo11n-seg.onnx", "yolo11n-seg.pt"):
            if args.only and line.name not in args.only:
                continue
            line.make()
            sections.append(result(line, folder))
        os.chdir(ROOT)
    names = ("ultralytics", "rfdetr", "torchvision", "transformers", "torch", "onnxruntime")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    page.write_text("\n".join([HEAD.format(versions=versions), *sections]))
    return 0


HEAD = (
    "# Every detector, run\n\n"
    "Written by `benchmarks/detector_lines.py`, which runs each kind of\n"
    "[`--detector`](../input_formats.md#detectors---detector) on 16 images of a kitchen\n"
    "(7-Scenes, every 32nd of 500, supplied poses). Where trained weights could not be had, a\n"
    "model with random weights shows that the library is called and answers; tests compare its\n"
    "boxes with those of the library's own call. Versions: {versions}.\n"
)

if __name__ == "__main__":
    sys.exit(main())
