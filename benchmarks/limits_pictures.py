#!/usr/bin/env python3
"""Draw the pictures of docs/limits.md from the example clip, which has ground truth.

    python benchmarks/limits_pictures.py -o docs/img        # needs matplotlib; about a minute

limits_views.png   a table and its chairs from above, from 6, 24 and all frames, and the truth
limits_hidden.jpg  a chair that is always occluded by the table: truth, detection, fitted shape
limits_turn.jpg    a camera that turns on the spot

It also prints the figures that the page quotes, the result for a chair that is carried away while
out of view, and the message for a camera that only rotates.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
CAMERA = "492.756788421,492.756788421,320,240"
K = np.array([[492.756788421, 0, 320], [0, 492.756788421, 240], [0, 0, 1]])
Entry = dict[str, Any]
Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2


def true_objects() -> list[Entry]:
    """Entries of gt_objects.json: center, size_m, world_from_obj; z is up, metres."""
    entries: list[Entry] = json.loads((ROOM / "gt_objects.json").read_text())["objects"]
    return entries


def run(folder: Path, detections: Path, **options: int) -> Entry:
    """objects.json of the clip with its true cameras."""
    output = rt.OutputConfig(overlay=False, scene=False)
    poses = rt.PosesConfig(mode=str(ROOM / "poses.txt"), camera=CAMERA)
    config = rt.Config(input=rt.InputConfig(**options), poses=poses, output=output)
    rt.run(ROOM / "room.mp4", folder, config, detections=detections)
    data: Entry = json.loads((folder / "objects.json").read_text())
    return data


def fitted(data: Entry, near: Array, reach: float) -> list[Entry]:
    """Fitted chairs and tables around a position, with their rotation as a matrix."""
    kept = [o for o in data["objects"] if o["center"] and o["class"] in ("chair", "dining table")]
    for o in kept:
        o["world_from_obj"] = Rotation.from_quat(np.roll(o["quat_wxyz"], -1)).as_matrix()
    return [o for o in kept if np.hypot(*(np.array(o["center"][:2]) - near)) < reach]


def footprint(o: Entry, size: str) -> Array:
    """(5, 2) outline of a solid from above."""
    turn = np.array(o["world_from_obj"])
    flat = np.column_stack([CORNERS, np.zeros(5)]) * np.array(o[size])
    outline: Array = (flat @ turn.T + np.array(o["center"]))[:, :2]
    return outline


def draw_views(path: Path, work: Path) -> None:
    """The same table and chairs from ever more frames; blobs are 95 % regions of the centres."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    true = [o for o in true_objects() if o["class"] in ("chair", "dining table")]
    table = np.array(true[0]["center"][:2])
    true = [o for o in true if np.hypot(*(np.array(o["center"][:2]) - table)) < 1.5]
    poses = np.loadtxt(ROOM / "poses.txt")
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.3), sharex=True, sharey=True)
    for ax, stop in zip(axes, (6, 24, 240), strict=True):
        found = fitted(run(work / f"views{stop}", ROOM / "detections.npz", stop=stop), table, 2.2)
        for o in true:
            ax.plot(*footprint(o, "size_m").T, color="0.6", lw=3)
        angle = np.linspace(0, 2 * np.pi, 60)
        for o in found:
            colour = "tab:green" if o["status"] == "ok" else "tab:orange"
            ax.plot(*footprint(o, "size_m").T, color=colour, lw=1.2)
            spread = np.linalg.cholesky(np.array(o["cov"])[:2, :2]) * np.sqrt(5.991)
            blob = spread @ [np.cos(angle), np.sin(angle)] + np.array(o["center"][:2])[:, None]
            ax.fill(*blob, color=colour, alpha=0.25, lw=0)
        ax.plot(*poses[:stop, 1:3].T, color="tab:blue", lw=1.5)
        error = [min(np.linalg.norm(np.subtract(o["center"], t["center"])) for t in true)
                 for o in found]  # fmt: skip
        parallax = np.median([o["parallax_deg"] for o in found])
        print(
            f"views: {stop} frames, parallax {parallax:.1f} deg (median), centres off by "
            f"{100 * np.median(error):.1f} cm (median), {100 * max(error):.0f} cm (worst)"
        )
        ax.set_title(f"{stop} frames, parallax {parallax:.0f}°", fontsize=10)
        ax.set_aspect("equal")
        ax.set_xlim(table[0] - 1.8, table[0] + 3.4)
        ax.set_ylim(table[1] - 1.6, table[1] + 2.6)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def project(points: Array, index: int) -> Array:
    """(N, 2) pixels of world points (N, 3) in a frame."""
    row = np.loadtxt(ROOM / "poses.txt")[index]
    turn = Rotation.from_quat(row[4:]).as_matrix()
    camera = (points - row[1:4]) @ turn @ K.T
    pixels: Array = camera[:, :2] / camera[:, 2:]
    return pixels


def outline(o: Entry, size: str, index: int) -> Array:
    """Convex outline in a frame of a box-shaped solid."""
    half = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T / 2 * np.array(o[size])
    corners = half @ np.array(o["world_from_obj"]).T + np.array(o["center"])
    return np.asarray(cv2.convexHull(project(corners, index).astype(np.float32))[:, 0], np.float64)


def image_of(index: int) -> Image:
    """A frame of the clip."""
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(start=index, stop=index + 1))
    return next(iter(video)).image


def box_iou(box: Array, others: Array) -> Array:
    """Overlap (N,) of a box (4,) with others (N, 4), xyxy."""
    corner = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    inter = corner.clip(0).prod(1)
    areas = np.prod(box[2:] - box[:2]) + (others[:, 2:] - others[:, :2]).prod(1)
    return np.asarray(inter / (areas - inter), np.float64)


def most_hidden(work: Path) -> tuple[int, Entry, Array]:
    """Frame, true chair and detected box where least of a chair's true outline is in its box."""
    truth = np.loadtxt(ROOM / "gt_mot.txt", delimiter=",")
    true = {o["id"]: o for o in true_objects() if o["class"] == "chair"}
    found = np.loadtxt(work / "views240" / "tracks.txt", delimiter=",")
    best: tuple[float, Any] = (1.0, None)
    for row in truth[np.isin(truth[:, 1], list(true))]:
        there = found[found[:, 0] == row[0]]
        corners = np.hstack([there[:, 2:4], there[:, 2:4] + there[:, 4:6]])
        iou = box_iou(np.hstack([row[2:4], row[2:4] + row[4:6]]), corners)
        whole = outline(true[int(row[1])], "size_m", int(row[0]) - 1)
        inside = whole.min() > 5 and (whole.max(0) < [635, 475]).all()
        if inside and iou.max(initial=0) > 0.6:
            box = corners[iou.argmax()]
            visible = np.prod(box[2:] - box[:2]) / np.prod(np.ptp(whole, axis=0))
            if visible < best[0]:
                best = (float(visible), (int(row[0]) - 1, true[int(row[1])], box))
    index, chair, box = best[1]
    return index, chair, box


def draw_hidden(path: Path, work: Path) -> None:
    """White the true outline, yellow the detection, green the solid fitted from 17 such frames."""
    index, chair, box = most_hidden(work)
    window = {"start": max(index - 8, 0), "stop": index + 9}
    data = run(work / "hidden", ROOM / "detections.npz", **window)
    near = fitted(data, np.array(chair["center"][:2]), 2.0)
    fit = min(near, key=lambda o: np.ptp([box, around(outline(o, "size_m", index))], 0).max())
    image = image_of(index)
    for o, colour in ((chair, (255, 255, 255)), (fit, (80, 220, 80))):
        line = outline(o, "size_m", index).round().astype(np.int32)
        cv2.polylines(image, [line], True, colour, 2, cv2.LINE_AA)
    x1, y1, x2, y2 = (round(v) for v in box)
    cv2.rectangle(image, (x1, y1), (x2, y2), (0, 220, 255), 2)
    off = np.linalg.norm(np.subtract(fit["center"], chair["center"]))
    print(
        f"hidden: frame {index}; size {fit['size_m']} +- {fit['size_rel_sigma']} instead of "
        f"{chair['size_m']}, centre off by {100 * off:.0f} cm, {fit['status']}: {fit['reason']}"
    )
    cx, cy = np.mean([around(outline(chair, "size_m", index))[[0, 2]].mean(), (x1 + x2) / 2]), y1
    left, top = round(np.clip(cx - 160, 0, 320)), round(np.clip(cy - 40, 0, 240))
    cv2.imwrite(str(path), image[top : top + 240, left : left + 320])


def around(points: Array) -> Array:
    """(4,) box around points (N, 2)."""
    return np.hstack([points.min(0), points.max(0)])


def carry_away(work: Path) -> None:
    """Move a chair by a metre in the second half, by changing its boxes, and print the result."""
    video = rt.Video(ROOM / "room.mp4")
    rows = np.loadtxt(ROOM / "gt_mot.txt", delimiter=",")
    chair = next(o for o in true_objects() if o["class"] == "chair")
    mine = rows[rows[:, 1] == chair["id"]]
    moved = chair | {"center": np.add(chair["center"], [1.0, 0.3, 0])}
    lines = ["frame,x1,y1,x2,y2,score,class"]
    for frame, _, left, top, width, height in mine[:, :6]:
        box = np.array([left, top, left + width, top + height])
        if frame > video.frame_count / 2:
            box = around(outline(moved, "size_m", int(frame) - 1)).clip(0, [640, 480, 640, 480])
        if (box[2:] - box[:2]).min() > 10:
            lines.append(f"{int(frame) - 1},{','.join(f'{v:.1f}' for v in box)},0.9,chair")
    (work / "carried.csv").write_text("\n".join(lines) + "\n")
    data = run(work / "carried", work / "carried.csv")
    for o in data["objects"]:
        print("carried:", o["id"], o["status"], o["center"], o["size_m"], o["frames"], o["reason"],
              "dropped", o["dropped_boxes"], "of", o["views"])  # fmt: skip


def turn(path: Path, work: Path) -> None:
    """A camera that only turns: one frame, warped as the turn would show it."""
    folder, image, size = work / "turned", image_of(20), (400, 300)
    folder.mkdir()
    small = K.copy()
    small[:2, 2] = (200, 150)
    pictures = []
    for i, angle in enumerate(np.linspace(-9, 9, 40)):
        rotation = Rotation.from_euler("yx", [angle, angle / 4], degrees=True).as_matrix()
        warp = small @ rotation @ np.linalg.inv(K)
        pictures.append(cv2.warpPerspective(image, warp, size))
        cv2.imwrite(str(folder / f"{i:03d}.png"), pictures[-1])
    (work / "none.csv").write_text("frame,x1,y1,x2,y2,score,class\n0,10,10,90,90,0.9,chair\n")
    output = rt.OutputConfig(overlay=False, scene=False)
    result = rt.run(folder, work / "turn", rt.Config(output=output), detections=work / "none.csv")
    print("turn:", *result.warnings, sep="\n  ")
    strip = cv2.hconcat([cv2.resize(pictures[i], (200, 150)) for i in (0, 13, 26, 39)])
    cv2.imwrite(str(path), strip, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main(argv: Sequence[str] | None = None) -> int:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the pictures")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        draw_views(args.out / "limits_views.png", Path(name))
        draw_hidden(args.out / "limits_hidden.jpg", Path(name))
        turn(args.out / "limits_turn.jpg", Path(name))
        carry_away(Path(name))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
