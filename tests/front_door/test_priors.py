"""Size priors of categories through the public API: a wrong one must not override the boxes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_quadrics as syn
from simulated import tracks_of, unlinked, walk

import quadrics as q
from reobj.objects.config import ObjectsConfig
from reobj.objects.fit import link_and_fit
from reobj.results.edits import read_edits
from reobj.sources.detection_files import class_filter
from reobj.words import canonical, check_known_size, load_size_priors, unused_sizes

UP = (0.0, 0.0, 1.0)
PRIORS = q.load_priors()


def scene(
    category: str, scale: float, views: int, arc: float, on_side: bool = False, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, q.Ellipsoids]:
    """Boxes (V, 4, 1 noise %) of four boxes `scale` times the usual size, cameras, truth."""
    rng = np.random.default_rng(seed)
    half = np.tile(0.5 * scale * np.exp(PRIORS.log_mean[PRIORS.index([category])]), (4, 1))
    turn = syn.random_yaw(4, rng)
    if on_side:
        turn = turn @ np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    truth = q.Ellipsoids(np.zeros((4, 3)), half, turn)
    cams = syn.arc_cameras(views, arc, rng)
    cams[:, :, 3] *= 6.4 * half.max() / 2.5  # as far away as the object is large
    boxes = syn.noisy(q.solid_boxes(truth, "box", cams), 0.01, rng)
    return boxes, cams, truth


def overlap(fits: q.ObjectFits, truth: q.Ellipsoids) -> float:
    return float(syn.box_overlap(fits.ellipsoids, truth).mean())


@pytest.mark.parametrize("scale", [0.4, 1.0, 2.5])
@pytest.mark.parametrize("on_side", [False, True])
@pytest.mark.parametrize("category", ["chair", "book"])
def test_a_wrong_size_does_not_override_the_boxes(
    category: str, on_side: bool, scale: float
) -> None:
    for views, arc in ((8, 90.0), (20, 180.0)):
        boxes, cams, truth = scene(category, scale, views, arc, on_side)
        with_it = q.fit_objects(boxes, cams, syn.IMAGE, [category] * 4, PRIORS, up=UP)
        without = q.fit_objects(boxes, cams, syn.IMAGE, up=UP)
        assert overlap(with_it, truth) > overlap(without, truth) - 0.03
        if scale != 1.0 and views == 20 and category == "chair" and not on_side:
            assert overlap(with_it, truth) > 0.9
            assert all(f"category overruled: size is {scale} times the usual" in r
                       for r in with_it.reason)  # fmt: skip
        if scale == 1.0 and not on_side:
            assert not any("overruled" in reason for reason in with_it.reason)


def test_the_right_category_helps_where_views_are_few() -> None:
    gain = []
    for seed in range(6):
        boxes, cams, truth = scene("chair", 1.0, 3, 15.0, seed=seed)
        with_it = q.fit_objects(boxes, cams, syn.IMAGE, ["chair"] * 4, PRIORS, up=UP)
        gain.append(overlap(with_it, truth) - overlap(q.fit_objects(boxes, cams, syn.IMAGE, up=UP),
                                                      truth))  # fmt: skip
    assert np.mean(gain) > 0.03


def test_one_wrong_class_does_not_corrupt_the_scale() -> None:
    boxes, cams, _, names = syn.furnished_room(np.random.default_rng(3))
    boxes, names = boxes[:, :8], names[:8]
    right = q.fit_objects(boxes, cams, syn.IMAGE, names, PRIORS, up=UP, metric=False)
    names[4] = "cup"  # a refrigerator
    wrong = q.fit_objects(boxes, cams, syn.IMAGE, names, PRIORS, up=UP, metric=False)
    assert abs(np.log(wrong.scale.value / right.scale.value)) < wrong.scale.rel_sigma < 0.25


def test_millimetre_precision_far_from_the_origin() -> None:
    boxes, cams, _ = scene("chair", 1.0, 12, 120.0)
    shift = np.array([4.0e5, 5.4e6, 120.0])
    away = cams.copy()
    away[:, :, 3] -= cams[:, :, :3] @ shift
    near, far = (
        q.fit_objects(boxes, c, syn.IMAGE, ["chair"] * 4, PRIORS, up=UP) for c in (cams, away)
    )
    moved = far.ellipsoids.center_in_world - shift - near.ellipsoids.center_in_world
    assert np.abs(moved).max() < 1e-3
    assert np.abs(far.size - near.size).max() < 1e-3


def test_synonyms_are_one_category() -> None:
    check_known_size("sofa=80cm", PRIORS, ["chair", "couch"])  # raises where there is none
    with pytest.raises(ValueError, match="no such class"):
        check_known_size("sofa=80cm", PRIORS, ["chair", "cup"])
    assert unused_sizes("sofa=80cm", PRIORS, []) != []
    words = ["Sofa", "fridge", "table", "phone", "plant", "television", "toaster"]
    usual = ["couch", "refrigerator", "dining table", "cell phone", "potted plant", "tv", "toaster"]
    assert PRIORS.canonical(words) == usual
    table = json.loads(Path(q.__file__).with_name("priors.json").read_text())
    assert set(table["aliases"].values()) <= set(PRIORS.names)


def test_one_table_of_synonyms() -> None:
    """ "monitor" means what "tv" means, but has its own size; a class of that name goes first."""
    assert [canonical(w) for w in ("sofa", "Couch", "mobile_phone", "screen", "vcr")] == [
        "couch", "couch", "cell phone", "tv", "vcr"
    ]  # fmt: skip
    row = PRIORS.index(["monitor", "tv", "screen", "television"]).tolist()
    assert row[0] == row[2] != row[1] == row[3]
    assert class_filter("monitor,sofa", ["tv", "couch", "chair"]).tolist() == [0, 1]
    assert class_filter("monitor", ["tv", "monitor"]).tolist() == [1]


def test_a_word_like_no_category_is_named() -> None:
    """Not the file of the priors, which is valid."""
    with pytest.raises(q.QuadricsError, match=r"^nonsense: no such category"):
        q.load_priors(more={"mixer": "nonsense"})


def test_a_file_of_priors_takes_the_synonyms_of_its_words(tmp_path: Path) -> None:
    """Its "sofa" is the prior of "couch" too; a word of the user replaces it."""
    path = tmp_path / "p.json"
    size = {"mean": [2.0, 1.0, 0.8], "log_std": [0.2] * 3}
    path.write_text(json.dumps({"sofa": {"size_m": size}, "aliases": {"settee": "sofa"}}))
    priors = load_size_priors(str(path))
    assert priors.index(["couch", "Sofa", "settee", "chair"]).tolist() == [0, 0, 0, -1]
    priors = load_size_priors(str(path), "couch=1x1x1m")
    assert np.exp(priors.log_mean[priors.index(["sofa"])]).tolist() == [[1, 1, 1]]


@pytest.mark.parametrize(("label", "same"), [("my favourite seat", True), ("cup", False)])
def test_a_label_without_a_prior_keeps_the_category(tmp_path: Path, label: str, same: bool) -> None:
    """Three frames hardly constrain the size: it is that of the category."""
    poses = walk()
    tracks = tracks_of(poses)
    tracks = tracks[tracks.frame < 3]
    box = tracks.xyxy[tracks.track_id == 2][0].tolist()
    entry = {"do": "rename", "object": {"id": 2, "frame": 0, "box": box}, "class": label}
    path = tmp_path / "e.json"
    path.write_text(json.dumps({"format": "reobj-edits", "version": 1, "edits": [entry]}))
    sizes = []
    for edits in (None, read_edits(path)):
        result = unlinked(poses, tracks)
        result = dataclasses.replace(result, edits=edits)
        result = link_and_fit(result, ObjectsConfig(link=False))
        found = {o.id: o for o in result.objects}[2]
        sizes.append(np.array(found.size))
    assert found.class_name == label
    assert np.allclose(*sizes) == same


def test_a_name_that_is_no_unicode_is_a_class_name() -> None:
    assert len({canonical("\ud800"), canonical("chair")}) == 2
