"""The example clip, and the comparison of an output folder with its ground truth.

Inputs are the files of a user; results are compared with the ground truth by
benchmarks/truth.py, which reads the public files only.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import truth as scores
from scipy.spatial.transform import Rotation

import reobj_track as rt

if TYPE_CHECKING:  # also run where pytest is not installed
    from pytest import CaptureFixture

ROOT = Path(__file__).resolve().parent.parent.parent
ROOM = ROOT / "examples" / "room"
CAMERA = "492.756788421,492.756788421,320,240"  # of examples/room/camera.txt
SMALL = ("--set", "poses.size_px=320")  # images that points and own cameras are made of: quick
FEW = ("--every", 3, "--stop", 120, *SMALL)  # frames of the clip that are enough for most
# The shortest clip on which `assert_right` holds: for tests of how a file is read
SHORTEST = ("--every", 4, "--stop", 64, "--set", "poses.size_px=160")
SHORTEST_FRAMES = range(0, 64, 4)
DETECTIONS = ("--detections", ROOM / "detections.npz")
POSES = ("--poses", ROOM / "poses.txt", "--camera", CAMERA)


def cli(*args: object) -> int:
    """Run a command in this process, as the installed program does."""
    return rt.main([str(a) for a in args])


def refusal(capsys: CaptureFixture[str], *command: object) -> str:
    """The line of a command that ends with exit code 2."""
    capsys.readouterr()
    assert cli(*command) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1
    return said.err


def readme_command() -> list[str]:
    """Return the words of README's first command, from `run` on."""
    line = re.search(
        r"^    pip install -r requirements.txt -e \. && python reobj_track.py (.*)$",
        (ROOT / "README.md").read_text(),
        re.M,
    )
    assert line, "README.md: the first command is no longer there"
    return shlex.split(line[1])


def info(out: Path) -> dict[str, Any]:
    """Read objects.json."""
    data: dict[str, Any] = json.loads((out / "objects.json").read_text())
    return data


@cache
def true_objects() -> list[dict[str, Any]]:
    """Return the true solids of the clip: class, center, size_m, world_from_obj, ..."""
    objects: list[dict[str, Any]] = json.loads((ROOM / "gt_objects.json").read_text())["objects"]
    return objects


@cache
def true_boxes(min_visible: float = 0.0) -> scores.Truth:
    """Return the true boxes of the clip; less visible ones are not `clear`."""
    names = {o["class_id"]: o["class"] for o in true_objects()}
    return scores.read_mot_truth(ROOM / "gt_mot.txt", names, min_visible=min_visible)


@cache
def true_centres() -> scores.Array:
    """Return the true camera centres (240, 3), m."""
    return scores.read_centres(ROOM / "poses.txt")


def true_cameras(frames: range) -> scores.Array:
    """Return the true cam_from_world (F, 3, 4) of some frames."""
    rows = np.loadtxt(ROOM / "poses.txt")[list(frames)]
    turn = Rotation.from_quat(rows[:, 4:]).inv().as_matrix()
    return np.concatenate([turn, -turn @ rows[:, 1:4, None]], 2)


def overlay_frames(out: Path) -> int:
    """Count the decodable frames of the overlay video in OUT."""
    (path,) = out.glob("overlay.*")
    video = cv2.VideoCapture(str(path))
    count = 0
    while video.read()[0]:
        count += 1
    return count


def assert_right(
    out: Path,
    frames: range = range(0, 120, 3),
    *,
    idf1: float = 0.97,
    own_cameras: bool = False,
    centre_m: float = 0.03,
    size: float = 0.1,
    hit_rate: float = 0.9,
    warning: str = "",
) -> None:
    """Compare an output folder with the truth of the clip.

    Args:
        frames: that were read. centre_m, size: bounds of the median errors of centres, and of the
            sizes (relative). hit_rate: minimum fraction of the true objects that are
            located; 0: no 3D shapes are expected. warning: start of the only expected warning.
    """
    output = scores.Output.read(out)
    said = output.data["warnings"]
    assert len(said) == bool(warning) and all(text.startswith(warning) for text in said), said
    assert 0.95 * len(frames) <= output.data["video"]["tracked_frames"] <= len(frames)
    found = scores.score_2d(true_boxes().of_frames(frames), output)
    assert found.idf1 >= idf1, found
    assert found.found >= found.true - 1 and found.false <= 1, found
    if not hit_rate:
        return
    assert sorted(output.centres) == list(frames)
    cameras = scores.score_cameras(output, dict(enumerate(true_centres())), own_cameras)
    assert cameras is not None
    assert cameras.median <= (0.003 * cameras.extent if own_cameras else 1e-6), cameras
    seen = set(true_boxes().of_frames(frames).identity.tolist())
    true = [o for o in true_objects() if o["id"] in seen]
    solids = scores.score_solids(true, output, cameras.truth_from_ours)
    assert solids.found >= hit_rate * len(true), solids
    assert solids.centre_m <= centre_m and solids.size <= size, solids


def assert_example_right(out: Path) -> None:
    """Compare the output folder of README's first command with the truth."""
    assert_right(out, range(240), own_cameras=True, idf1=0.98, centre_m=0.04, hit_rate=0.94)
    assert overlay_frames(out) == 240


if __name__ == "__main__":
    assert_example_right(Path(sys.argv[1]))
    print(f"{sys.argv[1]}: right")
