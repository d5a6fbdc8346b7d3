#!/usr/bin/env python3
"""Corrupt good recordings, reconstruct their cameras, and count undetected wrong reconstructions.

    python benchmarks/pose_breaks.py -o OUT [--data FOLDER] [--cases 216] [--jobs 2]
        [--only KIND...]
    python benchmarks/pose_breaks.py -o OUT mirrored_half-009      # these cases; images are kept

Writes OUT/results.jsonl, a line for every case; a second call resumes. Clips of the recordings, and
the poses of whole recordings without ground truth, are computed once and kept (--cache, default
OUT/cache). Uses public names only. Exit code 1 if a wrong reconstruction was not detected, or if a
good recording was refused or split.

Kinds of corruption, in clips of 24 to 40 images:
    mirrored_half    all images after a cut are mirrored left to right: two scenes that no rigid
                     motion aligns
    mirrored_middle  a stretch in the middle is mirrored
    left_out         images are removed where the view turns most
    permuted         images are shuffled: within blocks, or all; or blocks in another order
    two_rooms        two recordings one after the other, or interleaved (at one focal length)
    corridor         rendered rooms in a row that look the same: a revisited view is another room
    turn             rendered: the camera only rotates for a stretch
    zoomed           a stretch is zoomed: another focal length
    thin             a stretch is blurred or dark: its two sides have few common points
and besides
    good             unchanged recordings, with the defaults: they must still be registered

Verdict. Every frame has a true pose and a scene label. A component of the result is right if all
its frames show one scene and ONE similarity aligns their cameras (centres and orientations) with
the truth, at the same scale throughout; it is the similarity with the most inlier frames. A result
is
    whole     right, in one component with (nearly) every frame
    partly    right, in several components or with frames without a pose
    refused   without positions
    said      wrong, but messages list all wrong frames by number
    passed    wrong otherwise: some component contains wrong frames, without a message
A shuffled set that is reconstructed correctly is no failure, and neither is a detected corruption.
A component whose true cameras do not move is judged by its orientations alone. Interpolated frames,
which are marked, are not judged.
Components of which only directions are known (Poses.direction_sigma) do not enter this verdict: an
orientation is right within 3 deg after the best common rotation, and such a component is wrong if
half of its orientations are not.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rendering.camera import TURNS_FROM_TO, camera_matrix
from rendering.config import RoomConfig
from rendering.photograph import render_clip
from rendering.room import make_room
from tables import table
from truth import rotation_errors

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Images = npt.NDArray[np.uint8]
Rng = np.random.Generator

ROOT = Path(__file__).resolve().parent.parent
CLIP_PX = 480  # longer side of the pictures that are kept
SHORT = rt.PosesConfig(size_px=320)  # for 24-40 pictures, of which all are keyframes

# ---- Verdict ------------------------------------------------------------------------------------

# Error of a centre over the extent of its component's true path. Good recordings stay below .06
# (benchmarks/RESULTS.md: redkitchen against a Kinect), a wrong loop of the corridor is at .6.
MAX_CENTRE = 0.1
LEAST_EXTENT = 0.05  # of that path over all of its world's: below it a component hardly moved
# Local scale within a component over that of most of it. Half as much again bends a straight path
# by no more than .05 of its extent, which MAX_CENTRE lets pass.
MAX_SCALE_JUMP = 1.35
MAX_TURN_DEG = 10.0  # error of an orientation; good recordings stay below 3 in the median
MAX_DIRECTION_DEG = 3.0  # error of an orientation where only directions are known
STRAY_SHARE = 0.05  # of a component's frames, at least one, may be strays: counted, no break
WHOLE_SHARE = 0.9  # of the frames in one component: whole


def align(found: Array, truth: Array) -> tuple[Array, Array]:
    """Bring cameras to the truth by one similarity.

    Centres and orientations have equal weight, so that a straight path has no free roll.

    Args:
        found, truth: cam_from_world (n, 3, 4), n >= 1; a similarity of all of them is fitted.
    Returns:
        rotation (3, 3) times scale, and shift (3,).
    Ref: Umeyama, PAMI 1991, with the mean of the relative orientations added to the covariance.
    """
    (a, turn_a), (b, turn_b) = world_from_cam(found), world_from_cam(truth)
    a0, b0 = a - a.mean(0), b - b.mean(0)
    size = np.sqrt((a0**2).sum(1).mean() * (b0**2).sum(1).mean())
    relative = np.einsum("fij,fkj->ik", turn_b, turn_a) / len(a)  # b_from_a
    covariance = relative + (b0.T @ a0 / (len(a) * size) if size > 1e-12 else 0)
    u, _, vt = np.linalg.svd(covariance)
    rotation = u * [1, 1, np.sign(np.linalg.det(u @ vt))] @ vt
    scale = (b0 * (a0 @ rotation.T)).sum() / max((a0**2).sum(), 1e-24)
    scaled = max(float(scale), 1e-12) * rotation
    return scaled, b.mean(0) - scaled @ a.mean(0)


def world_from_cam(cam_from_world: Array) -> tuple[Array, Array]:
    """Centres (n, 3) and orientations (n, 3, 3)."""
    turn = np.swapaxes(cam_from_world[:, :, :3], 1, 2)
    return -(turn @ cam_from_world[:, :, 3:])[:, :, 0], turn


def extent_of(cam_from_world: Array) -> float:
    """Diagonal of the box around the centres of cameras (n, 3, 4)."""
    return float(np.linalg.norm(np.ptp(world_from_cam(cam_from_world)[0], axis=0)))


def misfit(
    found: Array, truth: Array, to_truth: tuple[Array, Array], extent: float
) -> tuple[Array, Array]:
    """Errors (n,) of centres, over an extent, and of orientations, degrees."""
    (a, turn_a), (b, turn_b) = world_from_cam(found), world_from_cam(truth)
    scaled, shift = to_truth
    error = np.linalg.norm(a @ scaled.T + shift - b, axis=1) / extent
    rotation = scaled / np.cbrt(np.linalg.det(scaled))
    cosine = (np.einsum("ij,fjk,fik->f", rotation, turn_a, turn_b) - 1) / 2
    return error, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def fit_component(found: Array, truth: Array, least_extent: float = 1e-9) -> tuple[Array, Array]:
    """Measure the cameras (n, 3, 4) of one component under the similarity on which most agree.

    Hypotheses are fitted to all, to halves, quarters and eighths of the path and to random samples.

    Args:
        least_extent: the smallest size of a path that errors are related to.
    Returns:
        as `misfit`.
    """
    rng, rows = np.random.default_rng(0), np.arange(len(found))
    extent = max(extent_of(truth), least_extent)
    subsets = [s for k in (1, 2, 4, 8) for s in np.array_split(rows, k) if len(s) >= 2] or [rows]
    subsets += [rng.choice(rows, min(5, len(rows)), replace=False) for _ in range(30)]
    best, most = misfit(found, truth, align(found, truth), extent), -1.0
    for subset in subsets:
        for _ in range(4):  # to those who agree
            error, turn = misfit(found, truth, align(found[subset], truth[subset]), extent)
            good = fits(error, turn)
            score = good.sum() - error[good].mean() if good.any() else 0.0
            if score > most:
                best, most = (error, turn), float(score)
            if good.sum() < 2:
                break
            subset = rows[good]
    return best


WINDOW_SHARE = 6  # a sixth of the frames on each side is the window of a local scale
LEAST_SPREAD = 0.1  # of the true centres in it over that of all; less is uninformative


def local_scale(found: Array, truth: Array, noise: float = 0.0) -> Array:
    """Measure by how much the path around each frame is larger or smaller than most of it is.

    Args:
        found, truth: cam_from_world (n, 3, 4) of a component, in order. noise: of the true centres.
    Returns:
        (n,) true over found spread of the centres in a window, over the value on which most frames
        agree; 1 where the camera hardly moved.
    """
    a, b = world_from_cam(found)[0], world_from_cam(truth)[0]
    if not len(a):
        return np.ones(0)
    half = max(3, len(a) // WINDOW_SHARE)
    windows = [slice(max(0, i - half), i + half + 1) for i in range(len(a))]
    spread = np.array([[np.sqrt(x[w].var(0).sum()) for x in (a, b)] for w in windows])  # (n, 2)
    moves = spread[:, 1] > max(LEAST_SPREAD * np.sqrt(b.var(0).sum()), noise, 1e-9)
    ratio = np.log(np.maximum(spread[:, 1], 1e-12) / np.maximum(spread[:, 0], 1e-12))
    if not moves.any():
        return np.ones(len(a))
    agree = np.abs(ratio[moves][:, None] - ratio[moves]) < np.log(MAX_SCALE_JUMP) / 2  # (m, m)
    most = np.median(ratio[moves][agree[agree.sum(1).argmax()]])
    return np.exp(np.where(moves, ratio - most, 0.0))


def fits(error: Array, turn_deg: Array) -> BoolArray:
    """(n,) True where a camera is where the truth has it."""
    return np.asarray((error <= MAX_CENTRE) & (turn_deg <= MAX_TURN_DEG), bool)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a result is worth against the truth.

    Attributes:
        outcome: whole, partly, refused, said or passed (head of this file).
        posed: fraction of the frames that have a pose, be it a direction. right: frames whose pose
        is right. components: number of those with positions. strays: frames off their component
        that are too few to be a break. wrong: numbers of frames that do not belong to it.
        centre, turn_deg: their median errors (of all frames, if none is wrong), centres over the
        extent of the component. look: what to look at. directions: frames of which only directions
        are known; directions_off: of them, those that are wrong; directions_deg: the largest median
        error of the orientations of such a component.
    """

    outcome: str
    posed: float
    right: int
    components: int
    strays: int
    wrong: tuple[int, ...]
    centre: float
    turn_deg: float
    look: str
    directions: int = 0
    directions_off: int = 0
    directions_deg: float = 0.0


def judge(poses: rt.Poses, truth: Array, world: IntArray, noise: float = 0.0) -> Verdict:
    """Compare poses with the truth by frame number.

    Args:
        truth: cam_from_world (N, 3, 4) of frame 0 .. N - 1, NaN where it is unknown. world: (N,)
            which world each frame shows; true poses of different worlds have nothing in common.
        noise: largest error of a true centre.
    """
    posed = poses.known & (poses.status != "interpolated")
    wrong, strays, looks, right = list[int](), 0, list[str](), [0]
    errors, bad_errors = list[Array](), list[Array]()
    directions = list[Array]()  # errors, degrees, by component
    for component in np.unique(poses.part[posed]):
        rows = np.flatnonzero(posed & (poses.part == component))
        rows = rows[np.isfinite(truth[poses.frame[rows]]).all((1, 2))]
        if not len(rows):
            continue
        frame = poses.frame[rows]
        at = np.unique(world[frame], return_counts=True)
        own = world[frame] == at[0][at[1].argmax()]
        error, turn = np.full(len(rows), np.inf), np.full(len(rows), 180.0)
        if poses.direction_sigma[component] > 0:
            turn[own] = rotation_errors(poses.cam_from_world[rows[own]], truth[frame[own]])
            directions.append(turn)
            continue
        pair, scale = (poses.cam_from_world[rows[own]], truth[frame[own]]), np.ones(len(rows))
        of_world = np.isfinite(truth).all((1, 2)) & (world == at[0][at[1].argmax()])
        least = max(LEAST_EXTENT * extent_of(truth[of_world]), noise / MAX_CENTRE, 1e-9)
        error[own], turn[own] = fit_component(*pair, least)
        good = fits(error, turn)
        scale[good] = local_scale(pair[0][good[own]], pair[1][good[own]], noise)
        good &= np.abs(np.log(scale)) <= np.log(MAX_SCALE_JUMP)
        errors.append(np.stack([error, turn]))
        right.append(int(good.sum()))
        if 0 < (~good).sum() <= max(1, round(STRAY_SHARE * len(rows))):
            strays += int((~good).sum())
        elif not good.all():
            wrong += frame[~good].tolist()
            bad_errors.append(errors[-1][:, ~good])
            looks.append(describe(int(component), frame, own, good, errors[-1]))
    known = np.isfinite(truth).all((1, 2)).sum()
    turns = np.concatenate([*directions, np.empty(0)])
    off = int((turns > MAX_DIRECTION_DEG).sum())
    worst = round(max((float(np.median(turn)) for turn in directions), default=0.0), 2)
    grade = (len(turns), off, worst)
    if not errors:
        look = "; ".join(poses.messages)[:200]
        return Verdict("refused", float(poses.known.mean()), 0, 0, 0, (), 0.0, 0.0, look, *grade)
    middle = np.median(np.concatenate(bad_errors or errors, 1), axis=1)
    outcome = "whole" if max(right) >= WHOLE_SHARE * known else "partly"
    if wrong:
        said = [text for text in poses.messages if "directions only" not in text]
        outcome = "said" if set(wrong) <= named_frames(said) else "passed"
        looks += [f"messages: {poses.messages}"]
    return Verdict(
        outcome, float(poses.known.mean()), sum(right), len(errors), strays, tuple(wrong),
        round(float(min(middle[0], 999)), 4), round(float(middle[1]), 2), "; ".join(looks),
        *grade,
    )  # fmt: skip


def describe(
    component: int,
    frame: IntArray,
    own: BoolArray,
    good: BoolArray,
    errors: Array,
) -> str:
    """Say which frames of a component are wrong, and how."""
    other = f", {(~own).sum()} of them of another world" if not own.all() else ""
    off, turn = np.median(errors[:, ~good], axis=1)
    far = f"{100 * off:.0f} % of the path" if np.isfinite(off) else "no place at all in it"
    text = f"component {component} of {len(frame)} frames: {(~good).sum()} wrong"
    return f"{text} ({spans(frame[~good])}){other}; in the median off by {far} and {turn:.0f} deg"


def spans(numbers: Iterable[int]) -> str:
    """Write ascending numbers as spans: 3-5, 9."""
    found: list[list[int]] = []
    for n in numbers:
        if found and n == found[-1][1] + 1:
            found[-1][1] = n
        else:
            found.append([n, n])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in found)


NUMBERS = re.compile(r"frames?\s+((?:\d+(?:\s*(?:-|to)\s*\d+)?(?:,\s*|\s+and\s+)?)+)", re.I)


def named_frames(messages: Sequence[str]) -> set[int]:
    """Frame numbers that messages name: `frames 78-113, 120`, `frame 51`.

    >>> sorted(named_frames(["frames 3-5, 9: off", "of 12 frames 2 are lost"]))
    [3, 4, 5, 9]
    """
    found: set[int] = set()
    for text in (t for m in messages for t in NUMBERS.findall(re.sub(r"\d+ of \d+ frames", "", m))):
        for first, last in re.findall(r"(\d+)(?:\s*(?:-|to)\s*(\d+))?", text):
            found |= set(range(int(first), int(last or first) + 1))
    return found


# ---- Clips --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Clip:
    """Pictures and the truth about their cameras.

    Attributes:
        images: (N, h, w, 3) BGR. truth: cam_from_world (N, 3, 4), NaN where unknown. world: (N,)
        which world each shows. focal: over the width. noise: largest error of a true centre.
    """

    images: Images
    truth: Array
    world: IntArray
    focal: float
    noise: float = 0.0

    def rows(self, rows: Any) -> Clip:
        """Return these pictures in this order."""
        images = np.asarray(self.images[rows])
        return replace(self, images=images, truth=self.truth[rows], world=self.world[rows])

    def changed(self, rows: IntArray, change: Callable[[Any], Any]) -> Clip:
        """Change some pictures."""
        images = self.images.copy()
        for row in rows:
            images[row] = change(images[row])
        return replace(self, images=images)


NO_IMAGES = np.empty((0, 0, 0, 3), np.uint8)
FLIP = np.diag([-1.0, 1.0, 1.0])


def mirrored(clip: Clip, rows: IntArray) -> Clip:
    """Mirror some pictures left to right: they show the mirrored world, seen from there.

    x_cam = R X + t becomes F x_cam = (F R F) (F X) + F t with F the flip of x.
    """
    truth = clip.truth.copy()
    world = clip.world.copy()
    truth[rows] = FLIP @ truth[rows]
    truth[rows, :, :3] = truth[rows, :, :3] @ FLIP
    world[rows] = -1 - world[rows]
    flipped = clip.changed(rows, lambda image: image[:, ::-1])
    return replace(flipped, truth=truth, world=world)


def zoomed(image: Any, factor: float, size: tuple[int, int]) -> Any:
    """Cut the middle out of a picture and enlarge it to (w, h), its shape kept."""
    height, width = image.shape[:2]
    cut = min(width / size[0], height / size[1]) / factor
    to_cut = np.array([[1 / cut, 0, 0], [0, 1 / cut, 0]])
    to_cut[:, 2] = np.array(size) / 2 - np.array([width, height]) / cut / 2 + 0.5 * (1 / cut - 1)
    flags = cv2.INTER_AREA if cut > 1 else cv2.INTER_LINEAR
    return cv2.warpAffine(image, to_cut, size, flags=flags)


def with_focal(clip: Clip, focal: float, size: tuple[int, int]) -> Clip:
    """Cut and resize the pictures so that their focal length is `focal` over the width or more."""
    height, width = clip.images.shape[1:3]
    used = min(width, height * size[0] / size[1]) / width  # of the width, by the shape alone
    factor = max(focal * used / clip.focal, 1.0)
    images = np.stack([zoomed(image, factor, size) for image in clip.images])
    return replace(clip, images=images, focal=clip.focal / used * factor)


def write_pictures(clip: Clip, folder: Path) -> None:
    """Write the pictures as an image folder, numbered."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for i, image in enumerate(clip.images):
        cv2.imwrite(str(folder / f"{i:04d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


# ---- Recordings ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording, or a clip to be rendered, and what the tool makes of it today.

    Attributes:
        source: file or folder below --data or examples/. every: of its pictures, for the clip.
        truth: file of true poses, "" without: the poses of the whole recording, found once at the
        defaults, take its place. focal: true one over the width (0: the one found).
        room: RoomConfig of a rendered one. today: frames with a right pose, in one component, at
        the defaults with `good_every`, at commit a196537; interpolated ones do not count. 0:
        broken.
        noise: largest error of a true centre, in its unit: smaller errors are not significant.
        plan: of a rendered room, "" without. Rooms of one plan are one scene in other colours, to
        15 cm, and are rightly joined.
    """

    source: str = ""
    every: int = 1
    truth: str = ""
    focal: float = 0.0
    room: RoomConfig | None = None
    good_every: int = 1
    today: int = 0
    noise: float = 0.0
    plan: str = ""


SMALL = RoomConfig(width=400, height=300, supersample=1, texels_per_m=200, light_rays=2)


def rendered(seed: int, path: str, frames: int, plan: str = "home", today: int = 0) -> Recording:
    """Describe a clip of benchmarks/render_room.py, small; a turn is one on the spot exactly."""
    shake_m = 0.0 if path == "turn" else SMALL.shake_m
    room = replace(SMALL, seed=seed, path=path, frames=frames, plan=plan, shake_m=shake_m)
    return Recording(room=room, today=today, plan="" if plan == "varied" else plan)


RECORDINGS = {
    "room": Recording("room/room.mp4", 2, "room/poses.txt", 0.77, today=240, plan="home"),
    "redkitchen": Recording(
        "redkitchen_7scenes/images", 4, "poses_c2w.txt", 0.828, good_every=4, today=125, noise=0.1
    ),  # a Kinect's tracker: from whole models it is off by 5 cm in the median, 10 cm at most
    "studio_room": Recording("studio_room/images", 1, "poses_c2w.txt", 0.4705, today=35),
    "office_loop": Recording("office_loop/images", 2, today=237),
    "hololens": Recording("hololens_kitchen/images", 1, "poses_c2w.txt", 0.9177),
    "bonsai": Recording("bonsai_mip360/images"),
    "livingroom13": Recording("livingroom13/images", today=13),
    "tum_fr3": Recording("tum_fr3_office/images17", 1, "poses17_c2w.txt", 0.8365, today=17),
    "apple": Recording("orbit_clips/apple.mp4", today=50),
    "teddybear": Recording("orbit_clips/teddybear.mp4", today=9),
    "walk": rendered(11, "walk", 72, today=72),
    "turn": rendered(11, "turn", 60),
    "corridor": rendered(11, "corridor", 66, "corridor"),
    "table": rendered(11, "table", 48),
    "orbit": rendered(12, "orbit", 48, today=48),
    "turn_b": rendered(12, "turn", 60),
    "corridor_b": rendered(12, "corridor", 60, "corridor"),
    "tour": rendered(21, "tour", 96, "varied", today=96),
}
WALKS = ("room", "redkitchen", "studio_room", "office_loop", "hololens", "bonsai", "walk", "orbit",
         "tour", "table")  # fmt: skip
GOOD = ("room", "redkitchen", "studio_room", "office_loop", "bonsai", "livingroom13", "tum_fr3",
        "apple", "teddybear", "walk", "orbit", "table", "tour")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Shelf:
    """Where recordings come from, and the clips made of them."""

    data: Path
    cache: Path

    def path(self, name: str) -> Path:
        """Where a recording lies; a rendered one is not on disk."""
        source = RECORDINGS[name].source
        inside = ROOT / "examples" / source
        return inside if source.startswith("room/") else self.data / source

    def has(self, name: str) -> bool:
        """Return True if the recording is on this machine, or can be rendered."""
        return RECORDINGS[name].room is not None or self.path(name).exists()

    def clip(self, name: str) -> Clip:
        """Return the clip of a recording; made at the first call."""
        folder = self.cache / name
        if not (folder / "truth.npz").exists():
            made = self._render(name) if RECORDINGS[name].room else self._read(name)
            folder.mkdir(parents=True, exist_ok=True)
            np.save(folder / "images.npy", made.images)
            np.savez(folder / "part.npz", truth=made.truth, world=made.world, focal=made.focal)
            (folder / "part.npz").replace(folder / "truth.npz")
        facts = np.load(folder / "truth.npz")
        images = np.load(folder / "images.npy", mmap_mode="r")
        noise = RECORDINGS[name].noise
        return Clip(images, facts["truth"], facts["world"], float(facts["focal"]), noise)

    def _render(self, name: str) -> Clip:
        config = RECORDINGS[name].room or SMALL
        frames = list(render_clip(make_room(config), config))
        truth = np.stack([f.cam_from_world for f in frames])
        focal = float(camera_matrix(config)[0, 0]) / config.width
        images = np.stack([f.image for f in frames])
        return Clip(images, truth, np.zeros(len(frames), np.int64), focal)

    def _read(self, name: str) -> Clip:
        recording = RECORDINGS[name]
        video = rt.Video(self.path(name), rt.InputConfig(every=recording.every, max_size=CLIP_PX))
        frames = list(video)
        truth, focal = self.truth(name)
        images = np.stack([f.image for f in frames])
        truth = truth[[f.index for f in frames]]
        return Clip(images, truth, np.zeros(len(frames), np.int64), recording.focal or focal)

    def truth(self, name: str) -> tuple[Array, float]:
        """Return cam_from_world (N, 3, 4) by frame of the source, and the focal length."""
        recording, path = RECORDINGS[name], self.path(name)
        if recording.room is not None:
            return self.clip(name).truth, self.clip(name).focal
        if recording.truth.startswith("room/"):
            width, height, focal = 640, 480, recording.focal * 640
            camera = f"{focal},{focal},{width / 2},{height / 2}"
            tum = ROOT / "examples" / recording.truth
            supplied = rt.read_poses(tum, rt.Video(path), camera=camera)
            return supplied.cam_from_world, recording.focal
        if recording.truth:
            world_from = np.loadtxt(path.parent / recording.truth).reshape(-1, 4, 4)
            return np.asarray(np.linalg.inv(world_from)[:, :3], np.float64), recording.focal
        saved = self.cache / f"{name}_reference.npz"
        if not saved.exists():
            self._reconstruct_whole(path, saved)
        return np.load(saved)["truth"], float(np.load(saved)["focal"])

    def _reconstruct_whole(self, path: Path, saved: Path) -> None:
        """Write the poses of a whole recording at the defaults, and its focal length.

        Raises: ReobjError if they cannot serve as the truth: frames are missing.
        """
        self.cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.cache) as work:
            poses = rt.estimate_poses(rt.Video(path), rt.PosesConfig(), Path(work))
            kept = poses.known & (poses.part == 0) & (poses.status != "interpolated")
            if kept.mean() < WHOLE_SHARE:
                raise rt.ReobjError(
                    f"{path}: {kept.sum()} of {len(kept)} frames got a pose: no reference for the "
                    f"bench. Give one that an earlier version made (--cache). {poses.messages}"
                )
            cams = np.full((int(poses.frame.max()) + 1, 3, 4), np.nan)
            cams[poses.frame[kept]] = poses.cam_from_world[kept]
            np.savez(
                Path(work) / "truth.npz",
                truth=cams,
                focal=poses.camera.K[0, 0] / poses.camera.width,
            )
            (Path(work) / "truth.npz").replace(saved)


# ---- Breaks: (clip, rng) -> broken clip, what was done to it -------------------------------------

Broken = tuple[Clip, str]


def stretch(shelf: Shelf, names: Sequence[str], rng: Rng, least: int = 24) -> Broken:
    """Cut 24 to 40 pictures, or all if there are fewer, out of one of the recordings."""
    name = str(rng.choice(list(names)))
    clip = shelf.clip(name)
    count = min(int(rng.integers(least, 41)), len(clip.images))
    stride = int(rng.integers(1, min(2, max(1, len(clip.images) // count)) + 1))
    start = int(rng.integers(0, len(clip.images) - stride * (count - 1)))
    rows = start + stride * np.arange(count)
    if rng.random() < 0.25:
        rows = rows[::-1]
    return clip.rows(rows), f"{name} {rows[0]}..{rows[-1]} by {stride}"


def unbroken(clip: Clip, rng: Rng) -> Broken:
    """Leave the clip as it is: it is difficult by itself."""
    return clip, ""


def mirror_half(clip: Clip, rng: Rng) -> Broken:
    """Mirror all pictures after a cut."""
    cut = round(len(clip.images) * rng.uniform(0.35, 0.65))
    return mirrored(clip, np.arange(cut, len(clip.images))), f", mirrored from {cut} on"


def mirror_middle(clip: Clip, rng: Rng) -> Broken:
    """Mirror the pictures of a stretch in the middle."""
    rows = middle(len(clip.images), rng, 0.25, 0.5)
    return mirrored(clip, rows), f", {rows[0]}-{rows[-1]} mirrored"


def middle(count: int, rng: Rng, least: float, most: float) -> IntArray:
    """Rows of a stretch that leaves a quarter of the pictures on each side, where it can."""
    length = round(count * rng.uniform(least, most))
    first = int(rng.integers(count // 4, max(count // 4, count - length - count // 4) + 1))
    return np.arange(first, first + length)


def leave_out(clip: Clip, rng: Rng) -> Broken:
    """Leave out the interval, a fraction of the clip, over which the view turns most."""
    count, gap = len(clip.images), round(len(clip.images) * rng.uniform(0.3, 0.55))
    starts = np.arange(count // 5, max(count // 5 + 1, count - gap - count // 5))
    axis = clip.truth[:, 2, :3]  # viewing directions
    cosine = np.nan_to_num((axis[starts - 1] * axis[starts + gap]).sum(1), nan=1.0)
    first = int(rng.choice(starts[np.argsort(cosine)][:3]))
    rows = np.r_[0:first, first + gap : count]
    return clip.rows(rows), f", {first}-{first + gap - 1} left out"


def permute(clip: Clip, rng: Rng) -> Broken:
    """Shuffle: all pictures, those of blocks, or blocks of them."""
    way = str(rng.choice(["all", "in blocks", "blocks"]))
    size = len(clip.images) if way == "all" else int(rng.integers(4, 9))
    blocks = np.split(np.arange(len(clip.images)), np.arange(size, len(clip.images), size))
    if way == "blocks":
        blocks = [blocks[i] for i in rng.permutation(len(blocks))]
    else:
        blocks = [rng.permutation(block) for block in blocks]
    return clip.rows(np.concatenate(blocks)), f", shuffled: {way} of {size}"


def zoom_stretch(clip: Clip, rng: Rng) -> Broken:
    """Zoom a stretch in the middle or the rest."""
    count = len(clip.images)
    rows = middle(count, rng, 0.3, 0.5) if rng.random() < 0.5 else np.arange(count // 2, count)
    factor = float(rng.uniform(1.25, 1.5))
    size = (clip.images.shape[2], clip.images.shape[1])
    broken = clip.changed(rows, lambda image: zoomed(image, factor, size))
    return broken, f", {rows[0]}-{rows[-1]} zoomed by {factor:.2f}"


def thin_out(clip: Clip, rng: Rng) -> Broken:
    """Blur or darken a stretch in the middle, by far too much or nearly."""
    rows = middle(len(clip.images), rng, 0.2, 0.4)
    what = f", {rows[0]}-{rows[-1]}"
    if rng.random() < 0.5:
        sigma = float(rng.uniform(2, 6)) * clip.images.shape[2] / 400
        broken = clip.changed(rows, lambda image: cv2.GaussianBlur(image, (0, 0), sigma))
        return broken, f"{what} blurred by {sigma:.1f}"
    light = float(rng.uniform(0.02, 0.1))
    broken = clip.changed(
        rows, lambda image: (image * light + rng.normal(0, 1.5, image.shape)).clip(0, 255).round()
    )
    return broken, f"{what} at {light:.2f} of the light"


def two_rooms(shelf: Shelf, names: Sequence[str], rng: Rng) -> Broken:
    """Put recordings of two scenes into one file, one after the other or by turns."""
    first = str(rng.choice(list(names)))
    plan = RECORDINGS[first].plan
    others = [n for n in names if n != first and not (plan and RECORDINGS[n].plan == plan)]
    second = str(rng.choice(others))
    pair = [stretch(shelf, [name], rng) for name in (first, second)]
    clips = [clip.rows(np.arange(min(len(clip.images), 24))) for clip, _ in pair]
    size = (clips[0].images.shape[2], clips[0].images.shape[1])
    for _ in range(2):  # the second time to what the first has reached by cutting
        focal = max(clip.focal for clip in clips)
        clips = [with_focal(clip, focal, size) for clip in clips]
    turns = int(rng.choice([1, 1, 2, 3]))
    splits = [np.array_split(np.arange(len(clip.images)), turns) for clip in clips]
    worlds = [replace(clip, world=clip.world + i) for i, clip in enumerate(clips)]
    pieces = [worlds[i].rows(splits[i][k]) for k in range(turns) for i in (0, 1)]
    images, truth, world = (
        np.concatenate([getattr(p, k) for p in pieces]) for k in ("images", "truth", "world")
    )
    joined = Clip(images, truth, world, clips[0].focal, max(clip.noise for clip in clips))
    return joined, f"{pair[0][1]} and {pair[1][1]} in {2 * turns} pieces"


def turn(shelf: Shelf, names: Sequence[str], rng: Rng) -> Broken:
    """Walk, turn on the spot in wider or smaller steps, walk on."""
    name = str(rng.choice(["turn", "turn_b"]))
    clip, every = shelf.clip(name), int(rng.integers(1, 5))
    count = len(clip.images)
    first, last = (round(fraction * count) for fraction in TURNS_FROM_TO)
    before, after = rng.integers(8, first + 1), rng.integers(8, count - last + 1)
    rows = np.r_[first - before : first, first:last:every, last : last + after]
    if rng.random() < 0.25:
        rows = rows[::-1]
    return clip.rows(rows), f"{name} {rows[0]}..{rows[-1]}, every {every} of the turn"


@dataclass(frozen=True, slots=True)
class OneClip:
    """How one clip is broken.

    Attributes:
        least: number of its pictures. names: recordings instead of the walks. not_of: recordings
            that are left out.
    """

    damage: Callable[[Clip, Rng], Broken]
    least: int = 24
    names: Sequence[str] = ()
    not_of: Sequence[str] = ()

    def __call__(self, shelf: Shelf, names: Sequence[str], rng: Rng) -> Broken:
        kept = [name for name in self.names or names if name not in self.not_of]
        clip, what = stretch(shelf, kept, rng, self.least)
        broken, done = self.damage(clip, rng)
        return broken, what + done


KINDS: dict[str, Callable[[Shelf, Sequence[str], Rng], Broken]] = {
    "mirrored_half": OneClip(mirror_half),
    "mirrored_middle": OneClip(mirror_middle),
    "left_out": OneClip(leave_out, 36, not_of=["table"]),
    "permuted": OneClip(permute),
    "two_rooms": two_rooms,
    "corridor": OneClip(unbroken, 36, names=["corridor", "corridor_b"]),
    "turn": turn,
    "zoomed": OneClip(zoom_stretch),
    "thin": OneClip(thin_out, 30),
}
KNOWN_CAMERA = 0.25  # fraction of the cases with given intrinsics


# ---- Running ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Job:
    """One case and all that its process needs."""

    name: str
    shelf: Shelf
    names: tuple[str, ...]
    seed: int
    work: Path
    keep: bool


def run_case(job: Job) -> dict[str, Any]:
    """Make a case, reconstruct it, judge it; return its line of the results."""
    cv2.setNumThreads(1)
    kind, _, tail = job.name.partition("-")
    started, cpu = time.monotonic(), cpu_s()
    folder = job.work / job.name
    shutil.rmtree(folder, ignore_errors=True)
    line: dict[str, Any] = {"case": job.name, "kind": kind}
    try:
        video, clip, config, what = prepare(job, kind, tail, folder)
        started, cpu = time.monotonic(), cpu_s()
        (folder / "sfm").mkdir(parents=True)
        poses = rt.estimate_poses(video, config, folder / "sfm")
        found = judge(poses, clip.truth, clip.world, clip.noise)
        ratio = poses.camera.K[0, 0] / poses.camera.width / clip.focal
        line |= {"what": what, "frames": len(poses.frame), "known": int(poses.known.sum())}
        line |= {"focal_ratio": round(float(ratio), 4), "messages": list(poses.messages)}
        line |= dataclasses.asdict(found)
    except Exception as error:  # a bench goes on: the summary counts it
        line |= {"outcome": "crashed", "look": f"{type(error).__name__}: {error}"}
    line |= {"wall_s": round(time.monotonic() - started, 1), "cpu_s": round(cpu_s() - cpu, 1)}
    if not job.keep:
        shutil.rmtree(folder, ignore_errors=True)
    return line


def cpu_s() -> float:
    """Seconds of processors used by this process and its children that ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def prepare(
    job: Job, kind: str, tail: str, folder: Path
) -> tuple[rt.Video, Clip, rt.PosesConfig, str]:
    """Make the pictures of a case; returns its video, the truth, options and what was done."""
    recording = RECORDINGS[tail] if kind == "good" else Recording()
    if recording.source:  # as it is, all of it
        video = rt.Video(job.shelf.path(tail), rt.InputConfig(every=recording.good_every))
        truth, focal = job.shelf.truth(tail)
        kept = np.arange(len(truth)) % recording.good_every == 0
        truth = np.where(kept[:, None, None], truth, np.nan)
        clip = Clip(NO_IMAGES, truth, np.zeros(len(truth), np.int64), focal, recording.noise)
        return video, clip, rt.PosesConfig(), "as it is"
    if kind == "good":
        clip = job.shelf.clip(tail)
        what = "as it is"
        config = rt.PosesConfig()
    else:
        rng = np.random.default_rng([job.seed, list(KINDS).index(kind), int(tail)])
        clip, what = KINDS[kind](job.shelf, job.names, rng)
        config = SHORT
        height, width = clip.images.shape[1:3]
        if rng.random() < KNOWN_CAMERA:
            focal = clip.focal * width
            config = replace(config, camera=f"{focal:.3f},{focal:.3f},{width / 2},{height / 2}")
            what += ", camera given"
    write_pictures(clip, folder / "images")
    return rt.Video(folder / "images"), clip, config, what


def planned(args: argparse.Namespace, shelf: Shelf) -> list[str]:
    """Name the cases to run, good recordings first."""
    here = [name for name in RECORDINGS if shelf.has(name)]
    whole = [f"good-{name}" for name in GOOD if name in here]
    kinds = list(KINDS)
    short = [f"{kinds[i % len(kinds)]}-{i // len(kinds):03d}" for i in range(args.cases)]
    names = short if args.quick else whole + short
    return args.names or [n for n in names if not args.only or n.partition("-")[0] in args.only]


QUICK_CASES = 12
QUICK_WALKS = ("room", "walk", "tour")  # needs nothing but this repository
OUTCOMES = ("whole", "partly", "refused", "said", "passed", "crashed")


def main() -> int:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="only these cases, e.g. turn-003; keep files")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--cache", type=Path, help="clips and references (default OUT/cache)")
    parser.add_argument("--cases", type=int, default=216, help="corrupted cases (default 216)")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once (default 2)")
    parser.add_argument("--only", nargs="*", default=[], choices=[*KINDS, "good"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_CASES} cases, own data only")
    args = parser.parse_args()
    args.cases = QUICK_CASES if args.quick else args.cases
    shelf = Shelf(args.data, args.cache or args.out / "cache")
    args.out.mkdir(parents=True, exist_ok=True)
    walks = tuple(n for n in (QUICK_WALKS if args.quick else WALKS) if shelf.has(n))
    results = args.out / "results.jsonl"
    done = read_results(results)
    names = planned(args, shelf)
    todo = [n for n in names if n not in done or args.names]
    jobs = [Job(n, shelf, walks, args.seed, args.out / "work", bool(args.names)) for n in todo]
    if jobs:
        make_clips(shelf, walks, names, args.jobs)
    started = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(args.jobs) as pool, open(results, "a") as file:
        for count, line in enumerate(pool.imap_unordered(run_case, jobs), 1):
            file.write(json.dumps(line) + "\n")
            file.flush()
            done[line["case"]] = line
            left = (time.monotonic() - started) / count * (len(jobs) - count) / 60
            print(f"{count}/{len(jobs)} {line['case']}: {line['outcome']} {line['cpu_s']} s, "
                  f"{left:.0f} min left", file=sys.stderr, flush=True)  # fmt: skip
    lines = [done[name] for name in names if name in done]
    print(summary(lines))
    return int(any(failed(line) for line in lines))


def make_clips(shelf: Shelf, walks: Sequence[str], names: Sequence[str], jobs: int) -> None:
    """Render and read what the cases need, before they do at the same time."""
    kinds = {name.partition("-")[0] for name in names}
    needed = {n for n in walks if kinds & (set(KINDS) - {"corridor", "turn"})}
    needed |= {n for n in RECORDINGS if f"good-{n}" in names}
    needed |= {n for n in ("corridor", "corridor_b") if "corridor" in kinds}
    needed |= {n for n in ("turn", "turn_b") if "turn" in kinds}
    missing = sorted(n for n in needed if not (shelf.cache / n / "truth.npz").exists())
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for name in pool.imap_unordered(functools.partial(make_clip, shelf), missing):
            print(f"clip {name}", file=sys.stderr, flush=True)


def make_clip(shelf: Shelf, name: str) -> str:
    """Make a clip in another process."""
    cv2.setNumThreads(1)
    shelf.clip(name)
    return name


def read_results(path: Path) -> dict[str, dict[str, Any]]:
    """Read the lines of earlier calls by case; the last one of a case counts."""
    lines = path.read_text().splitlines() if path.exists() else []
    found = [json.loads(line) for line in lines if line.endswith("}")]
    return {line["case"]: line for line in found}


def failed(line: dict[str, Any]) -> bool:
    """Return True for what must not be: wrong and passed, or a good recording lost."""
    if line["outcome"] in ("passed", "crashed"):
        return True
    today = RECORDINGS[line["case"].partition("-")[2]].today if line["kind"] == "good" else 0
    if not today:
        return False
    torn = line["outcome"] == "said" or line["components"] != 1
    return bool(torn or line["right"] < WHOLE_SHARE * today)


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """Format the summary: a row a kind, good recordings, failing cases."""
    broken = [line for line in lines if line["kind"] != "good"]
    rows = []
    for kind in [*dict.fromkeys(line["kind"] for line in broken), "all"]:
        own = [line for line in broken if kind in (line["kind"], "all")]
        counts = [sum(line["outcome"] == o for line in own) for o in OUTCOMES]
        strays = sum(line.get("strays", 0) for line in own)
        seconds = np.mean([line["cpu_s"] for line in own]) if own else 0.0
        rows.append([kind, len(own), *counts, strays, f"{seconds:.1f}"])
    text = [table(["kind", "cases", *OUTCOMES, "stray frames", "s a case"], rows)]
    good = [line for line in lines if line["kind"] == "good"]
    if good:
        keys = ("known", "frames", "right", "components", "outcome", "centre", "turn_deg")
        rows = []
        for g in good:
            name = g["case"][5:]
            today = RECORDINGS[name].today
            rows.append([name, *map(g.get, keys), g.get("focal_ratio"), today])
        titles = ("with pose", "of", "right", "components", "outcome", "centre", "turn, deg")
        head = ["recording", *titles, "focal / true", "right at a196537"]
        text += ["", table(head, rows)]
    lost = sum(failed(g) for g in good)
    passed = sum(line["outcome"] == "passed" for line in broken)
    text += ["", f"passed as good though wrong: {passed} of {len(broken)}; good recordings refused "
             f"or torn: {lost} of {len(good)}"]  # fmt: skip
    text.append(grades(lines))
    for line in (line for line in lines if failed(line)):
        text.append(f"- {line['case']}: {line.get('what', '')}: {line['outcome']}: {line['look']}")
    return "\n".join(text)


def grades(lines: Sequence[dict[str, Any]]) -> str:
    """Say how many cases have frames of each grade, and how many of them are wrong."""
    judged = [line for line in lines if line["outcome"] != "crashed"]
    positions = [line for line in judged if line["components"]]
    wrong = sum(bool(line["wrong"]) for line in positions)
    turned = [line for line in judged if line["directions"]]
    off = [line["case"] for line in turned if line["directions_deg"] > MAX_DIRECTION_DEG]
    frames = [sum(line[key] for line in turned) for key in ("directions_off", "directions")]
    return (
        f"cases with positions: {len(positions)}, wrong {wrong}; with directions: {len(turned)}, "
        f"wrong {len(off)} {off}, {frames[0]} of their {frames[1]} frames by more than "
        f"{MAX_DIRECTION_DEG:.0f} deg"
    )


if __name__ == "__main__":
    sys.exit(main())
