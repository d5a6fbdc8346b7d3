"""Gallery and calibrated similarity: against formulas and examples defined here."""

from __future__ import annotations

import numpy as np
import pytest

from reobj.appearance.reid import (
    Gallery,
    SimilarityCalibration,
    match_probability,
    part_cosines,
)

UNKNOWN = np.full((1, 3), np.nan)


def unit(rng: np.random.Generator, n: int, dim: int = 64) -> np.ndarray:
    vectors = rng.normal(size=(n, dim))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def at_degrees(*angles: float) -> np.ndarray:
    """Unit rows (n, 2) in these directions."""
    a = np.radians(angles)
    return np.stack([np.cos(a), np.sin(a)], 1).astype(np.float32)


def one(value: int = 0) -> np.ndarray:
    return np.array([value])


# ---- Gallery ----


def filled(angles: tuple[float, ...], **options) -> Gallery:
    """A gallery updated with views of identity 0 in these directions, one after the other."""
    gallery = Gallery(**options)
    gallery.foreground_width = 2
    for row in at_degrees(*angles):
        gallery.add(one(), row[None], UNKNOWN)
    return gallery


def kept(gallery: Gallery) -> list[int]:
    rows = gallery.rows[0, : gallery.count[0]]
    return np.degrees(np.arctan2(rows[:, 1], rows[:, 0])).round().astype(int).tolist()


@pytest.mark.parametrize(
    ("angles", "options", "expected"),
    [
        ((0, 30), {}, [0, 30]),  # cosine .87: a new view
        ((0, 18), {}, [2]),  # cosine .951: blended, nine parts to one
        ((0, 90, 100), {}, [0, 91]),  # blended into the nearest view
        ((0, 30, 150, 270), {"views": 3}, [270, 30, 150]),  # replaces one of the two most similar
        ((0, 150, 180, 90), {"views": 3}, [0, 90, 180]),
    ],
)
def test_kept_views(angles, options, expected) -> None:
    gallery = filled(angles, **options)
    assert [k % 360 for k in kept(gallery)] == expected
    assert gallery.rows.shape[1] == options.get("views", 12)
    lengths = np.linalg.norm(gallery.rows[0, : len(expected)], axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


def test_gallery_parts_come_from_the_most_similar_view() -> None:
    gallery = Gallery()
    gallery.foreground_width = 2
    views = np.array([[1, 0, 1, 0], [0, 1, 0, 1.0]], np.float32) / np.sqrt(2)
    ahead, left = np.array([[[0, 0, 1.0]], [[-1, 0, 0]]])
    for view, ray in zip(views, (ahead, left), strict=True):
        gallery.add(one(), view[None], ray)
    fore, back, angle = gallery.parts(views[1:], one(), ahead)
    assert (fore, back, angle) == (pytest.approx(1), pytest.approx(1), pytest.approx(90))
    gallery.add(one(), views[1:], ahead)  # nothing new: the kept view's ray stays
    assert gallery.parts(views[1:], one(), left)[2] == pytest.approx(0)
    assert np.isnan(gallery.parts(views[1:], one(), UNKNOWN)[2])
    mixed = np.array([[0.6, 0.8, 0, 1.0]], np.float32) / np.sqrt(2)  # nearer to the second
    fore, back, _ = gallery.parts(mixed, one(), ahead)
    assert (fore, back) == (pytest.approx(0.8), pytest.approx(1))


# ---- Cosines ----


def test_part_cosines_of_fused_rows() -> None:
    rng = np.random.default_rng(0)
    fore, back = unit(rng, 4, 6), unit(rng, 4, 3)
    fused = np.concatenate([np.sqrt(0.7) * fore, np.sqrt(0.3) * back], 1)
    got = part_cosines(fused, fused[:2], 6)
    np.testing.assert_allclose(got[0], fore @ fore[:2].T)
    np.testing.assert_allclose(got[1], back @ back[:2].T)
    assert np.isnan(part_cosines(fused[:, :6], fused[:, :6], 6)[1]).all()
    blank = np.concatenate([fused[:1], 0 * fused[:1]])
    assert np.isnan(part_cosines(blank, fused, 6)[0]).all(1).tolist() == [False, True]


# ---- Calibrated similarity ----


def reference_logit(pairs, weight, foreground, background, angle_deg=45.0) -> float:
    """The documented formula, from all pairs; the default ones are samples of their mean and
    spread. pairs: {same: (n, 2) cosines}, NaN where unknown.
    """
    total = 0.0
    a = np.radians(angle_deg)
    facing = ((1 + np.cos(a)) / 2, max(np.cos(a), 0))
    for k, (cosine, factor) in enumerate(zip((foreground, background), (0.55, 0.5), strict=True)):
        if np.isnan(cosine):
            continue
        samples = []
        for same, usual in ((False, (1.3, 0.65)), (True, (1.8, 1.2))):
            shown = np.asarray(pairs.get(same, np.empty((0, 2))))[:, k]
            shown = -np.log(1.03 - shown[~np.isnan(shown)])
            stand_in = np.repeat([usual[k] - 0.45, usual[k] + 0.45], weight // 2)
            samples.append(np.concatenate([stand_in, shown]))
        different, same_mean = samples[0].mean(), samples[1].mean()
        std = np.sqrt((samples[0].var() + samples[1].var()) / 2)
        separation = max((same_mean - different) / std, 0)
        middle = (different + same_mean) / 2
        total += factor * facing[k] * (-np.log(1.03 - cosine) - middle) / std * (1 + separation)
    odds = np.exp(total)
    return float(np.log((odds + 1e-3) / (1 + 1e-3 * odds)))


SHOWN = {
    False: np.array([[0.6, 0.1], [0.7, 0.35], [0.2, np.nan], [0.5, 0.5]]),
    True: np.array([[0.95, 0.9], [0.8, 0.6], [0.9, np.nan]]),
}


@pytest.mark.parametrize("shown", [{}, SHOWN], ids=["usual", "after a video"])
@pytest.mark.parametrize("weight", [10, 4])
@pytest.mark.parametrize(
    ("foreground", "background", "angle"),
    [(0.9, 0.8, 45.0), (0.3, 0.9, 0.0), (0.9, np.nan, 70.0), (0.8, 0.2, 120.0), (1.0, 1.0, 0.0)],
)
def test_log_odds_follow_the_documented_formula(
    shown, weight, foreground, background, angle
) -> None:
    calibration = SimilarityCalibration(weight)
    for same, pairs in shown.items():
        calibration.add(pairs[:, 0], pairs[:, 1], same)
    expected = reference_logit(shown, weight, foreground, background, angle)
    assert calibration.logit(foreground, background, angle) == pytest.approx(expected, abs=1e-9)
    unknown = reference_logit(shown, weight, foreground, background)
    assert calibration.logit(foreground, background) == pytest.approx(unknown, abs=1e-9)


def test_probability_adapts_to_the_video() -> None:
    """If all objects are similar, a cosine is weaker evidence; unknown parts do not calibrate."""
    plain = SimilarityCalibration()
    similar = SimilarityCalibration()
    similar.add(np.full(200, 0.95), np.full(200, np.nan), False)
    assert similar.logit(0.92, 0.92) < plain.logit(0.92, 0.92)
    np.testing.assert_array_equal(similar.moments[:, :, 1], plain.moments[:, :, 1])
    similar.add(np.full(200, 0.99), np.full(200, 0.99), True)
    assert similar.logit(0.99, 0.99) > 0 > similar.logit(0.93, 0.9)


def test_match_probability_equals_brute_force() -> None:
    """o / (1 + o + the largest other o of the row or the column), one pair after the other."""
    logit = np.random.default_rng(4).normal(0, 2, (4, 5))
    logit[1, 2] = -np.inf
    for prior in (1.0, 1.8):
        odds = prior * np.exp(logit)
        expected = np.empty((4, 5))
        for i, j in np.ndindex(4, 5):
            others = np.concatenate([np.delete(odds[i], j), np.delete(odds[:, j], i)])
            expected[i, j] = odds[i, j] / (odds[i, j] + 1 + others.max())
        np.testing.assert_allclose(match_probability(logit, prior), expected)
    np.testing.assert_array_equal(match_probability(logit), match_probability(logit, 1.8))
