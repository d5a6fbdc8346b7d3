"""The output folder: ownership, cached results, separation of videos."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from simulated import fitted, tracks_of, walk

import reobj_track as rt
from reobj.results.entries import copy_models, replaced
from reobj.results.workspace import Workspace

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def video(tmp_path: Path) -> rt.Video:
    return rt.Video(frames(tmp_path / "frames", 90))


def frames(folder: Path, grey: int) -> Path:
    """A folder of two frames."""
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((48, 64, 3), grey, np.uint8))
    return folder


# ---- Ownership of the folder ----


def test_a_foreign_folder_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(rt.ReobjError, match=r"not made by reobj_track.*--overwrite"):
        Workspace(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    Workspace(tmp_path, overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "precious"
    Workspace(tmp_path)  # it belongs to the tool now


# ---- One video a folder ----


def test_results_of_two_videos_are_never_mixed(video: rt.Video, tmp_path: Path) -> None:
    """Another video requires --overwrite, which deletes all results of the first."""
    space = Workspace(tmp_path / "out")
    space.bind(video)
    poses = walk(2)
    result = fitted(tracks_of(poses), poses)
    space.save_last(result, poses)
    result.save(space.out)
    (space.out / "overlay.mp4").write_text("of the first video")
    other = rt.Video(frames(tmp_path / "other", 10))
    with pytest.raises(rt.ReobjError, match=r"frames, not of .*other.*--overwrite"):
        space.bind(other)
    assert space.last_tracks is not None and space.source[0] == str(tmp_path / "frames")
    space.bind(other, overwrite=True)
    assert space.source[0] == str(tmp_path / "other") and space.last_tracks is None
    left = sorted(str(p.relative_to(space.out)) for p in space.out.rglob("*"))
    assert left == ["cache", "cache/source.json"]


def test_a_run_that_failed_does_not_claim_the_folder(video: rt.Video, tmp_path: Path) -> None:
    """It has no results that could mix with those of another video."""
    Workspace(tmp_path / "out").bind(video)
    other = rt.Video(frames(tmp_path / "other", 10))
    Workspace(tmp_path / "out").bind(other)
    assert Workspace(tmp_path / "out").source[0] == str(tmp_path / "other")
    (tmp_path / "out/tracks.txt").write_text("")
    with pytest.raises(rt.ReobjError, match=r"results of .*other, not of .*frames"):
        Workspace(tmp_path / "out").bind(video)


HOLD = """
import os, sys, time
from reobj.results.entries import copy_models, replaced
from reobj.results.workspace import Workspace
with Workspace(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_one_run_at_a_time_writes_into_a_folder(tmp_path: Path) -> None:
    """The lock ends with its process, also by kill -9, and needs no cleanup."""
    out = tmp_path / "out"
    command = [sys.executable, "-c", HOLD, str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(rt.ReobjError, match="out: another run is writing into this folder"):
            with Workspace(out):
                pass
        Workspace(out)  # reading needs no lock
        other.kill()
        other.wait()
    for _ in range(2):
        with Workspace(out):
            pass


def test_the_same_video_with_other_options_is_the_same_video(
    video: rt.Video, tmp_path: Path
) -> None:
    space = Workspace(tmp_path / "out")
    space.bind(video)
    space.save_last(fitted(tracks_of(walk(2)), None), None)
    config = rt.InputConfig(every=2, start=1, max_size=32)
    space.bind(rt.Video(tmp_path / "frames", config))
    assert space.source == (str(tmp_path / "frames"), config)
    assert space.last_tracks is not None


# ---- The cache ----


def published(out: Path, models: list[Path] | None) -> dict[str, list[str]]:
    """Names of the files in each folder sparse* after models of these folders were published."""
    with replaced(out, () if models is None else ("sparse",)) as new:
        copy_models(models or (), new)
    found = {p.name: sorted(f.name for f in p.iterdir()) for p in out.glob("sparse*")}
    assert not list(out.glob(".part*"))
    return found


def test_every_component_has_its_model(tmp_path: Path) -> None:
    """Copies; models of components that no longer exist are deleted, other folders are kept."""
    out, models = tmp_path / "out", [tmp_path / name for name in "abc"]
    for model in models:
        model.mkdir()
        (model / model.name).write_text(model.name)
    (out / "sparse_participants").mkdir(parents=True)
    kept: dict[str, list[str]] = {"sparse_participants": []}
    three = kept | {"sparse": ["a"], "sparse_part1": ["b"], "sparse_part2": ["c"]}
    assert published(out, models) == three
    assert published(out, None) == three
    assert published(out, models[1:]) == kept | {"sparse": ["b"], "sparse_part1": ["c"]}
    shutil.rmtree(models[1])
    assert (out / "sparse/b").read_text() == "b"
    assert published(out, models[:2]) == kept | {"sparse": ["a"]}  # a failed one has none
    assert published(out, []) == kept
