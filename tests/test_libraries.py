"""Detectors of other libraries and of the user's module, from `--detector` to detections.

The models have random weights and are made from configurations: shapes, classes and coordinates are
what is tested. `pip install -e '.[detectors]'` to run all tests.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from torchvision_operators import declare_nms

import reobj_track as rt
from reobj.sources import detectors
from reobj.sources.detectors import DetectionSource, open_detections
from reobj.types import Detections

INSTALL = "pip install -e '.[detectors]'"
WORDS = ("espresso machine", "red toolbox")


@pytest.fixture(scope="module", autouse=True)
def torchvision_can_be_imported() -> None:
    declare_nms()


@pytest.fixture
def video(tmp_path: Path) -> rt.Video:
    """One photo of noise, 320 x 240."""
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "0.png"), image)
    return rt.Video(tmp_path)


def detect(video: rt.Video, model: str, **config: Any) -> tuple[Detections, DetectionSource]:
    """Detections of the photo, checked as those of any detector."""
    source = open_detections(video, rt.DetectConfig(model=model, **config))
    (frame,) = list(video)
    (found,) = source.detect([frame])
    assert found is not None
    assert np.isfinite(found.xyxy).all() and (found.xyxy >= 0).all()
    assert (found.xyxy <= (320, 240, 320, 240)).all()
    assert (found.xyxy[:, 2:] > found.xyxy[:, :2]).all()
    assert (np.diff(found.score) <= 0).all()
    assert (found.class_id < len(source.class_names)).all()
    return found, source


def test_transformers_with_words(video: rt.Video, tmp_path: Path) -> None:
    tf = pytest.importorskip("transformers", reason=INSTALL)
    pytest.importorskip("torch", reason=INSTALL).manual_seed(0)
    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    tokens = [*letters, *(c + "</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {token: i for i, token in enumerate(tokens)}
    last = len(tokens) - 1
    small = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1,
             "num_attention_heads": 2}  # fmt: skip
    config = tf.Owlv2Config(
        text_config=small | {"vocab_size": last + 1, "bos_token_id": last - 1,
                             "eos_token_id": last, "pad_token_id": last,
                             "max_position_embeddings": 32},
        vision_config=small | {"image_size": 64, "patch_size": 16}, projection_dim=32,
    )  # fmt: skip
    folder = str(tmp_path / "model")
    tf.Owlv2ForObjectDetection(config).save_pretrained(folder)
    images = tf.Owlv2ImageProcessor(size={"height": 64, "width": 64})
    tokenizer = tf.CLIPTokenizer(vocab=vocabulary, merges=[])
    tf.Owlv2Processor(images, tokenizer).save_pretrained(folder)
    found, source = detect(video, f"hf:{folder}", min_score=0.0, words=", ".join(WORDS))
    assert tuple(source.class_names) == WORDS and len(found) > 0


# ---- What needs no library ---------------------------------------------------------------------


def test_phrases_get_the_word_that_shares_most_tokens() -> None:
    phrases = ["machine", "red espresso machine", "toolbox red", "", "lamp"]
    image = {"boxes": np.arange(20.0).reshape(5, 4), "scores": np.arange(5.0),
             "text_labels": phrases}  # fmt: skip
    found = detectors._with_words(image, list(WORDS))
    assert found["labels"].tolist() == [0, 0, 1]
    np.testing.assert_array_equal(found["scores"], [0, 1, 2])
    none = detectors._with_words(image | {"boxes": np.empty((0, 4)), "scores": np.empty(0),
                                          "text_labels": []}, list(WORDS))  # fmt: skip
    assert len(none["labels"]) == 0


def test_a_missing_library_is_one_line_with_the_command(
    video: rt.Video, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(rt.ReobjError, match=r"--detector mine\.pt: .* pip install ultralytics"):
        detect(video, "mine.pt")


def test_words_need_a_detector_of_free_text(video: rt.Video) -> None:
    with pytest.raises(rt.ReobjError, match="--words: rfdetr:nano has fixed classes"):
        detect(video, "rfdetr:nano", words="toolbox")


def test_a_function_of_the_users_module(
    video: rt.Video, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_boxes.py").write_text(
        "def find(image):\n"
        "    return [[-5, 10, 400, 200, .9, 2], [10, 10, 60, 60, .95, 1], [0, 0, 9, 9, .05, 1]]\n"
        "find.names = {1: 'lamp', 2: 'plant'}\n"
        "number = 3\n"
    )
    monkeypatch.chdir(tmp_path)
    found, source = detect(video, "my_boxes:find")
    assert [source.class_names[k] for k in found.class_id] == ["lamp", "plant"]
    np.testing.assert_array_equal(found.xyxy[1], [0, 10, 320, 200])  # clipped; low scores left out
    assert not source.key  # what the function depends on is unknown: nothing is cached
    plants, _ = detect(video, "my_boxes:find", classes="plant")
    assert len(plants) == 1
    for wrong, text in (("my_boxes:no", "no attribute"), ("my_boxes:number", "no function"),
                        ("no_module:find", "No module named")):  # fmt: skip
        with pytest.raises(rt.ReobjError, match=f"--detector {wrong}: .*{text}"):
            detect(video, wrong)


def test_a_library_gets_batches(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Each answer is checked and filtered as that of its frame; a failure names the batch."""
    calls: list[int] = []

    def run(images: list[Any]) -> Any:
        calls.append(len(images))
        if len(calls) == fails_at:
            raise RuntimeError("CUDA out of memory.")
        return [[[-5, 5, 20 + image[0, 0, 0], 40, 0.9, 0]] for image in images]

    stub = detectors.Library(lambda *_: (run, ("cup",)), "")
    monkeypatch.setitem(detectors.LIBRARIES, "ultralytics", stub)
    monkeypatch.setattr(detectors.importlib.metadata, "version", lambda name: "1")
    images = tmp_path / "five"
    images.mkdir()
    for i in range(5):
        cv2.imwrite(str(images / f"{i}.png"), np.full((48, 64, 3), i, np.uint8))
    words = ["track", str(images), "-o", str(tmp_path / "out"), "--detector", "ultralytics:m"]
    words += ["--embed", "none", "--set", "detect.batch=2", "--set", "output.overlay=none"]
    fails_at = 2
    assert rt.main(words) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    text = "ultralytics:m failed on 2 images at once (detect.batch): CUDA out of memory."
    assert line == f"error: frame 2: --detector {text}"
    fails_at = 0
    assert rt.main(words) == 0
    assert calls == [2, 2, 2, 1]  # the first two frames are in the cache
    rows = (tmp_path / "out/tracks.txt").read_text().splitlines()
    assert len(rows) == 5 and all(row.split(",")[2] == "0.00" for row in rows)
