"""Several frames at once for a network: the detections of each are those of one frame at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj.results.stages import detect_all
from reobj.results.workspace import Workspace
from reobj.sources import detectors
from reobj.sources.detectors import DetectionCache, as_source, open_detections
from reobj.types import Image

onnx = pytest.importorskip("onnx", reason="pip install onnx (extra `dev`)")
SHARED = Path(os.environ.get("REOBJ_SHARED", Path(__file__).resolve().parents[2] / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "models").is_dir(), reason="no weights: set REOBJ_SHARED"
)
GREYS = (40, 80, 120, 160, 200, 240)  # of the frames; the score of the only box depends on it


def grey_model(folder: Path, shape: Sequence[Any] = ("n", 3, 64, 64), each: bool = True) -> Path:
    """Write a YOLOv8 model whose box has the score .5 + .4 of the mean of the image (0 to 1).

    each: of each image; else of all images of the batch, in an output for one.
    """
    helper = onnx.helper
    side = shape[3] if isinstance(shape[3], int) else 640
    rows = np.zeros((1, 7, sum((side // stride) ** 2 for stride in (8, 16, 32))), np.float32)
    at = rows.copy()
    rows[0, :, 50] = [side / 2, side / 2, side / 4, side / 4, 0, 0, 0.5]
    at[0, 6, 50] = 0.4
    constants = {"rows": rows, "at": at, "one": np.array([-1, 1, 1])}
    axes = [1, 2, 3] if each else [0, 1, 2, 3]
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=axes, keepdims=0),
        helper.make_node("Reshape", ["mean", "one"], ["column"]),
        helper.make_node("Mul", ["column", "at"], ["added"]),
        helper.make_node("Add", ["added", "rows"], ["output0"]),
    ]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("images", 1, shape)],
        [helper.make_tensor_value_info("output0", 1, [shape[0], *rows.shape[1:]])],
        [onnx.numpy_helper.from_array(a, name) for name, a in constants.items()],
    )
    opset = onnx.helper.make_opsetid("", 17)
    made = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=8)
    onnx.helper.set_model_props(made, {"names": "{0: 'cup', 1: 'bowl', 2: 'tv'}"})
    onnx.save(made, folder / "m.onnx")
    return folder / "m.onnx"


class Spy:
    """An onnxruntime session that notes the sizes of its batches; the first runs are trials."""

    batches: ClassVar[list[int]] = []
    stop_after = -1  # runs; then Ctrl-C

    def __init__(self, *args: Any, make: Any = detectors.onnx_session) -> None:
        path, threads, *_ = args
        self.session = make(path, threads)
        Spy.batches = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)

    def run(self, names: Any, feeds: dict[str, Any]) -> Any:
        if len(Spy.batches) == Spy.stop_after:
            raise KeyboardInterrupt
        Spy.batches.append(len(feeds["images"]))
        return self.session.run(names, feeds)


@pytest.fixture
def spied(monkeypatch: pytest.MonkeyPatch) -> type[Spy]:
    monkeypatch.setattr(detectors, "onnx_session", Spy)
    monkeypatch.setattr(Spy, "stop_after", -1)
    return Spy


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Six grey images of 96 x 64."""
    (tmp_path / "im").mkdir()
    for index, grey in enumerate(GREYS):
        cv2.imwrite(str(tmp_path / f"im/{index}.png"), plain(grey))
    return tmp_path / "im"


def plain(grey: int, size: tuple[int, int] = (96, 64)) -> Image:
    return np.full((size[1], size[0], 3), grey, np.uint8)


def same(a: rt.Detections, b: rt.Detections) -> bool:
    """Test for equality to the bit, masks included."""
    masks = (a.masks is None) == (b.masks is None)
    columns = ("xyxy", "score", "class_id") + (("masks",) if masks and a.masks is not None else ())
    return masks and all(np.array_equal(getattr(a, c), getattr(b, c)) for c in columns)


# ---- The network ---------------------------------------------------------------------------------


def test_each_image_of_a_batch_gets_its_detections(tmp_path: Path, spied: type[Spy]) -> None:
    path = grey_model(tmp_path)
    images = [plain(grey) for grey in GREYS]
    one = rt.OnnxDetector(path)
    alone = [one(image) for image in images]
    assert one.batch == 1 and spied.batches == [1] * 7
    assert len({found.score[0] for found in alone}) == 6
    many = rt.OnnxDetector(path, rt.DetectConfig(batch=4))
    together = list(many.detect(images))
    assert many.batch == 4 and spied.batches == [1, 4, 2]
    assert all(map(same, together, alone))
    assert same(many(images[2]), alone[2]) and spied.batches[3:] == [1]
    assert list(many.detect([])) == [] and len(spied.batches) == 4


def test_a_fixed_batch_is_filled_up(tmp_path: Path, spied: type[Spy], caplog: Any) -> None:
    images = [plain(grey) for grey in GREYS[:5]]
    fixed = rt.OnnxDetector(grey_model(tmp_path, (3, 3, 64, 64)))
    found = list(fixed.detect(images))
    alone = fixed(images[4])
    assert fixed.batch == 3 and spied.batches == [3] * 4
    one = rt.OnnxDetector(grey_model(tmp_path))
    assert all(map(same, found, one.detect(images))) and same(found[4], alone)
    assert not caplog.text


def test_a_model_of_one_image_gets_one(tmp_path: Path, spied: type[Spy], caplog: Any) -> None:
    """The user is warned who asked for more."""
    path = grey_model(tmp_path, (1, 3, 64, 64))
    detector = rt.OnnxDetector(path, rt.DetectConfig(batch=4))
    found = list(detector.detect([plain(40), plain(200)]))
    assert detector.batch == 1 and spied.batches[-2:] == [1, 1]
    assert found[0].score < found[1].score
    assert "m.onnx: takes 1 images at once, not detect.batch=4" in caplog.text
    caplog.clear()
    assert rt.OnnxDetector(path, device="cuda").batch == 1 and not caplog.text


def test_a_model_whose_outputs_have_no_batch_axis_is_refused(tmp_path: Path) -> None:
    detector = rt.OnnxDetector(grey_model(tmp_path, each=False), rt.DetectConfig(batch=4))
    with pytest.raises(rt.ReobjError, match=r"2 images at once .detect.batch.: its outputs have"):
        list(detector.detect([plain(40), plain(200)]))


def test_images_of_different_input_sizes_are_not_joined(tmp_path: Path, spied: type[Spy]) -> None:
    """With a dynamic input size; with a fixed one they are, at their different scales."""
    wide = plain(80, (320, 160))
    high = plain(160, (160, 320))
    images = [wide, wide, high, wide]
    for shape, batches in ((("n", 3, "h", "w"), [1, 2, 1, 1]), (("n", 3, 64, 64), [1, 4])):
        path = grey_model(tmp_path, shape)
        found = list(rt.OnnxDetector(path, rt.DetectConfig(batch=4)).detect(images))
        assert spied.batches == batches
        one = rt.OnnxDetector(path)
        assert all(map(same, found, map(one, images)))
        assert not np.array_equal(found[2].xyxy, found[3].xyxy)


def test_masks_of_a_batch_are_not_held_together(tmp_path: Path, monkeypatch: Any) -> None:
    """Outputs are decoded one by one, as the detections are used."""
    detector = rt.OnnxDetector(grey_model(tmp_path), rt.DetectConfig(batch=4))
    decoded = []
    decode = detector._decoded
    monkeypatch.setattr(detector, "_decoded", lambda *a: decoded.append(1) or decode(*a))
    steps = as_source(detector).detect([rt.Frame(i, 0.0, plain(40)) for i in range(4)])
    for count in (1, 2, 3, 4):
        next(steps)
        assert len(decoded) == count


def test_a_batch_that_fails_names_its_size(tmp_path: Path, monkeypatch: Any) -> None:
    detector = rt.OnnxDetector(grey_model(tmp_path), rt.DetectConfig(batch=4))

    class Full:
        def run(self, *_: Any) -> None:
            raise RuntimeError("CUDA failure 2: out of memory\nat line 3")

    monkeypatch.setattr(detector, "_session", Full())
    frames = [rt.Frame(i, 0.0, plain(40)) for i in (7, 8)]
    with pytest.raises(rt.ReobjError) as caught:
        next(as_source(detector).detect(frames))
    text = "failed on 2 images at once (detect.batch): CUDA failure 2: out of memory"
    assert str(caught.value) == f"frame 7: {detector.path} {text}"


@needs_shared
@pytest.mark.parametrize("name", ["deimv2-femto", "deimv2-atto", "yolo11n-seg_dyn"])
def test_real_weights_in_batches(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of different sizes; the last batch is shorter. Scores may differ by rounding."""
    monkeypatch.setenv("REOBJ_MODELS", str(SHARED / "models"))
    folder = SHARED / "data/redkitchen_7scenes/images"
    images = [frame.image for frame in rt.Video(folder, rt.InputConfig(every=100))]
    images[1] = images[1][100:]
    alone = map(rt.OnnxDetector(name, rt.DetectConfig(min_score=0.3), threads=1), images)
    many = rt.OnnxDetector(name, rt.DetectConfig(min_score=0.3, batch=4), threads=1)
    assert len(images) == 5 and many.batch == 4
    for a, b in zip(alone, many.detect(images), strict=True):
        assert len(a) and a.class_id.tolist() == b.class_id.tolist()
        np.testing.assert_allclose(a.xyxy, b.xyxy, atol=0.01)
        np.testing.assert_allclose(a.score, b.score, atol=1e-4)
        if a.masks is not None and b.masks is not None:
            assert (a.masks != b.masks).mean() < 1e-4


# ---- The loops -----------------------------------------------------------------------------------


class Noted:
    """A source in batches of two; it notes them, and how many frames were read by then."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.read: list[int] = []
        self.source = rt.DetectionSource(self.several, batch=2)

    def one(self, frame: rt.Frame) -> rt.Detections:
        return rt.Detections.from_array([[9, 9, 50, 40 + frame.index, 0.9, 56]])

    def several(self, frames: Sequence[rt.Frame]) -> Iterator[rt.Detections]:
        self.batches.append([frame.index for frame in frames])
        self.read.append(Counted.read)
        return map(self.one, frames)


class Counted(rt.Video):
    """A video that counts the frames that were read."""

    read = 0

    def __iter__(self) -> Iterator[rt.Frame]:
        Counted.read = 0
        for frame in super().__iter__():
            Counted.read += 1
            yield frame


FIVE = rt.InputConfig(stop=5)  # frames: the last batch is shorter


def few_ahead(noted: Noted) -> bool:
    """Test that no more than the batch after the current one was read."""
    ends = np.cumsum([len(batch) for batch in noted.batches])
    return bool((np.array(noted.read) <= ends + 2).all())


def test_a_detection_of_all_frames_is_in_batches(clip: Path, tmp_path: Path) -> None:
    noted = Noted()
    _, rows = detect_all(noted.source, Counted(clip, FIVE), Workspace(tmp_path / "out"))
    assert noted.batches == [[0, 1], [2, 3], [4]] and few_ahead(noted)
    assert rows.frame.tolist() == list(range(5))
    assert rows.xyxy[:, 3].tolist() == [40 + i for i in range(5)]


@pytest.mark.parametrize("camera_motion", [True, False])
def test_tracking_is_in_batches(clip: Path, camera_motion: bool) -> None:
    """Each frame has the tracks of its detections, with and without motion estimated ahead."""
    noted = Noted()
    config = rt.TrackerConfig(camera_motion=camera_motion)
    steps = list(rt.track(Counted(clip, FIVE), noted.source, rt.Tracker(config)))
    assert noted.batches == [[0, 1], [2, 3], [4]] and few_ahead(noted)
    one_by_one = lambda frames: map(noted.one, frames)  # noqa: E731
    plain_steps = list(
        rt.track(rt.Video(clip, FIVE), rt.DetectionSource(one_by_one), rt.Tracker(config))
    )
    for (a, found), (b, expected) in zip(steps, plain_steps, strict=True):
        assert a.index == b.index and np.array_equal(found.xyxy, expected.xyxy)
        assert found.track_id.tolist() == expected.track_id.tolist()


def test_a_live_source_is_not_delayed(clip: Path) -> None:
    """Its frames are detected as they come."""
    noted = Noted()
    video = Counted(clip)
    video.is_live = True
    video.__dict__["_from_live"] = video._from_images
    for frame, _ in rt.track(video, noted.source, rt.Tracker()):
        assert noted.batches[-1] == [frame.index] and Counted.read == frame.index + 1
    assert len(noted.batches) == 6


def test_a_function_gets_one_image_at_a_time(clip: Path) -> None:
    shapes = []

    def find(image: Image) -> Any:
        shapes.append(image.shape)
        return [[9, 9, 50, 40, 0.9, 56]]

    for frame, _ in rt.track(rt.Video(clip), find, rt.Tracker()):
        assert shapes == [(64, 96, 3)] * (frame.index + 1)


def test_a_subclass_decides_what_a_call_returns(tmp_path: Path) -> None:
    class Two(rt.OnnxDetector):
        def __call__(self, image: Image) -> rt.Detections:
            return super().__call__(image)[[0, 0]]

    source = as_source(Two(grey_model(tmp_path), rt.DetectConfig(batch=4)))
    assert len(next(source.detect([rt.Frame(0, 0.0, plain(40))]))) == 2 and source.always_looks


def test_cached_frames_are_not_in_the_batch(tmp_path: Path) -> None:
    noted = Noted()
    cache = DetectionCache(tmp_path, (96, 64))
    source = rt.DetectionSource(noted.several, batch=4, cache=cache)
    frames = [rt.Frame(i, 0.0, plain(40)) for i in range(4)]
    assert next(source.detect(frames[2:3])).xyxy[0, 3] == 42
    steps = source.detect(frames)
    next(steps)
    assert noted.batches == [[2], [0, 1, 3]] and 0 in cache and 1 not in cache
    assert [found.xyxy[0, 3] for found in steps if found is not None] == [41, 42, 43]
    assert all(i in cache for i in range(4))


def test_an_interrupted_run_continues_with_another_batch(
    clip: Path, tmp_path: Path, spied: type[Spy]
) -> None:
    """Its detections are those of one frame at a time; the frames detected so far are kept."""
    path = grey_model(tmp_path)
    words = ["track", str(clip), "--detector", str(path), "--embed", "none",
             "--set", "output.overlay=none", "--set", "output.scene=0"]  # fmt: skip
    assert rt.main([*words, "-o", str(tmp_path / "one")]) == 0
    assert spied.batches == [1] * 7
    spied.stop_after = 2  # a trial, and a batch
    several = [*words, "-o", str(tmp_path / "several")]
    assert rt.main([*several, "--set", "detect.batch=4"]) == 130
    assert spied.batches == [1, 4]
    spied.stop_after = -1
    assert rt.main([*several, "--set", "detect.batch=2"]) == 0
    assert spied.batches == [1, 2]  # the last two frames
    written = [(tmp_path / out / "tracks.txt").read_text() for out in ("one", "several")]
    assert written[0] == written[1] and len(written[0].splitlines()) == 6


def test_the_cache_key_is_that_of_any_batch(clip: Path, tmp_path: Path) -> None:
    path = str(grey_model(tmp_path))
    video = rt.Video(clip)
    keys = {open_detections(video, rt.DetectConfig(path, batch=n)).key for n in (0, 2, 4)}
    assert len(keys) == 1 and "" not in keys
