"""Results of any kind are written, drawn and exported, or refused in one line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from simulated import SIZE, fitted, tracks_of, walk

import reobj_track as rt
from reobj.results.export import EXPORTS
from reobj.results.result import VideoInfo
from reobj.results.scene import write_pictures

FRAMES = 6


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> rt.Video:
    """A folder of grey images, of the walk's size."""
    folder = tmp_path_factory.mktemp("source") / "frames"
    folder.mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((*SIZE[::-1], 3), 127, np.uint8))
    return rt.Video(folder)


@pytest.fixture(scope="module")
def plain() -> rt.Result:
    """Three chairs in six frames, one box, one cylinder, one ellipsoid; copy before changes."""
    poses = walk(FRAMES)
    result = fitted(tracks_of(poses), poses)
    kinds = zip(result.objects, ("box", "cylinder", "ellipsoid"), strict=True)
    result.objects = [dataclasses.replace(o, support=kind) for o, kind in kinds]
    return result


def nothing(result: rt.Result) -> rt.Result:
    return rt.Result(rt.Tracks.empty(), (), result.video)


def cameras_alone(result: rt.Result) -> rt.Result:
    world = dataclasses.replace(result.world, links=())
    return rt.Result(rt.Tracks.empty(), (), result.video, poses=result.poses, world=world)


def no_cameras(result: rt.Result) -> rt.Result:
    return fitted(result.tracks, None)


def with_poses(result: rt.Result, cams: np.ndarray, **changes: Any) -> rt.Result:
    assert result.poses is not None
    poses = dataclasses.replace(result.poses, cam_from_world=cams, **changes)
    return dataclasses.replace(result, poses=poses)


def cameras_nan(result: rt.Result) -> rt.Result:
    return with_poses(result, np.full_like(result.poses.cam_from_world, np.nan))


def some_cameras_nan(result: rt.Result) -> rt.Result:
    cams = result.poses.cam_from_world.copy()
    cams[::2] = np.nan
    return with_poses(result, cams)


def behind(result: rt.Result) -> rt.Result:
    return with_poses(result, np.diag([-1.0, 1, -1]) @ result.poses.cam_from_world)


def in_an_object(result: rt.Result) -> rt.Result:
    cams = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    cams[:, :, 3] = -result.objects[0].center
    return with_poses(result, cams)


def far_away(result: rt.Result) -> rt.Result:
    """In the coordinates of a map projection."""
    away = np.array([450000.0, 5400000, 160])
    cams = result.poses.cam_from_world.copy()
    cams[:, :, 3] -= cams[:, :, :3] @ away
    moved = dataclasses.replace(with_poses(result, cams), fits=None)
    moved.objects = [dataclasses.replace(o, center=o.center + away) for o in result.objects]
    return moved


def fisheye(result: rt.Result) -> rt.Result:
    camera = rt.Camera("OPENCV_FISHEYE", *SIZE, (300.0, 300, 320, 240, 0.01, 0, 0, 0))
    return dataclasses.replace(result, poses=dataclasses.replace(result.poses, camera=camera))


def with_objects(result: rt.Result, **changes: Any) -> rt.Result:
    objects = [dataclasses.replace(o, **changes) for o in result.objects]
    return dataclasses.replace(result, objects=objects, fits=None)


NO_SOLID = dict.fromkeys(("support", "center", "half_axes", "quat_wxyz", "size", "size_m",
                          "size_rel_sigma", "cov"))  # fmt: skip


def all_rejected(result: rt.Result) -> rt.Result:
    return with_objects(result, status="rejected", reason="no", **NO_SOLID)


def all_doubtful(result: rt.Result) -> rt.Result:
    return with_objects(result, status="doubtful")


def no_support(result: rt.Result) -> rt.Result:
    return with_objects(result, support=None, cov=None, size_rel_sigma=None, size_m=None)


def ellipsoids(result: rt.Result) -> rt.Result:
    return with_objects(result, support="ellipsoid")


def huge(result: rt.Result) -> rt.Result:
    return with_objects(result, half_axes=np.full(3, 1e6), size=np.full(3, 2e6))


def tiny(result: rt.Result) -> rt.Result:
    return with_objects(result, half_axes=np.full(3, 1e-9), size=np.full(3, 2e-9))


def one_object(result: rt.Result) -> rt.Result:
    rows = result.tracks[result.tracks.track_id == 2]
    return dataclasses.replace(result, objects=result.objects[1:2], tracks=rows, fits=None)


def one_frame(result: rt.Result) -> rt.Result:
    rows = result.tracks[result.tracks.frame == 3]
    return dataclasses.replace(result, tracks=rows, poses=result.poses.of_part(0))


def one_camera(result: rt.Result) -> rt.Result:
    cams = result.poses.cam_from_world.copy()
    cams[1:] = np.nan
    return with_poses(result, cams)


def boxes_outside(result: rt.Result) -> rt.Result:
    boxes = result.tracks.xyxy.copy()
    boxes[::3] += 1e6
    boxes[1::3, 2:] = boxes[1::3, :2]  # without area
    boxes[2::3] -= 1e6
    return dataclasses.replace(result, tracks=dataclasses.replace(result.tracks, xyxy=boxes))


def odd_names(result: rt.Result) -> rt.Result:
    names = ("</script>&\"'=1+1", "stůl 桌子", "x" * 500)
    objects = [
        dataclasses.replace(o, class_name=name)
        for o, name in zip(result.objects, names, strict=True)
    ]
    rows = dataclasses.replace(result.tracks, class_id=result.tracks.track_id - 1)
    return dataclasses.replace(result, objects=objects, class_names=names, tracks=rows)


def objects_without_boxes(result: rt.Result) -> rt.Result:
    return dataclasses.replace(result, tracks=rt.Tracks.empty())


KINDS = [
    objects_without_boxes,
    dataclasses.replace, nothing, cameras_alone, no_cameras, cameras_nan, some_cameras_nan, behind,
    in_an_object, far_away, fisheye, all_rejected, all_doubtful, no_support, ellipsoids, huge, tiny,
    one_object, one_frame, one_camera, boxes_outside, odd_names,
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_kind_of_result_is_written_drawn_and_exported(
    plain: rt.Result, source: rt.Video, tmp_path: Path, kind: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    result, out = kind(plain), tmp_path / "out"
    result.video = VideoInfo(str(source.source), *SIZE, 30.0)
    result.save(out)
    for doubtful in (False, True):
        assert write_pictures(result, out, source, "solids,ellipses,trails", True, doubtful) == []
    film = cv2.VideoCapture(str(next(out.glob("overlay.*"))))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    json.loads((out / "objects.json").read_text(), parse_constant=pytest.fail)
    (out / "cache").mkdir(exist_ok=True)
    facts = {"source": str(source.source), "input": dataclasses.asdict(source.config)}
    (out / "cache/source.json").write_text(json.dumps(facts))
    assert "objects" in rt.Result.load(out).summary()
    for name, (default, _) in EXPORTS.items():
        capsys.readouterr()
        code, error = rt.main(["export", str(out), "--to", name]), capsys.readouterr().err
        assert code in (0, 2), error
        made = (out / default).exists()
        assert made == (code == 0), error
        if code:
            assert error.startswith("error: ") and error.count("\n") == 1
            assert name != "nerfstudio" or not (out / name).exists()
    assert not list(out.rglob(".part*"))
