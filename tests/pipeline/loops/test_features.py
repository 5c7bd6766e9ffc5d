# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.pipeline.loops.feature_alignment import FeatureAligner
from ggwarp.pipeline.loops.features import FeatureExtractor, match_features
from ggwarp.pipeline.loops.recognition import VisualIndex

OFFICE = SyntheticOffice(scale=0.35)


@pytest.fixture(scope="module")
def extractor():
    return FeatureExtractor(OFFICE.camera, OFFICE.camera)


@pytest.fixture(scope="module")
def frames():
    return {i: OFFICE[i] for i in (0, 4, 8, 40, 44, 80, 84, 100, 104)}


def test_two_views_of_a_place_give_their_motion(extractor, frames):
    one, other = extractor.extract(frames[0]), extractor.extract(frames[4])
    matches = match_features(one, other)
    found = FeatureAligner(OFFICE.camera, lambda z: 0.001 + 0.0 * z).align(
        one.pixels[matches[:, 0]], one.points[matches[:, 0]], other.points[matches[:, 1]], seed=(0, 4)
    )
    assert found is not None and found.count > 30
    error = se3.se3_log(se3.inverse(se3.inverse(frames[0].T_wc) @ frames[4].T_wc) @ found.T_ab)
    assert np.abs(error).max() < 0.01


def test_points_are_where_the_depth_says(extractor, frames):
    features = extractor.extract(frames[0])
    u, v = np.rint(features.pixels).astype(int).T
    truth = OFFICE.camera.back_project(features.pixels[:, 0], features.pixels[:, 1], frames[0].depth[v, u])
    assert np.median(np.abs(features.points - truth)) < 1e-3
    np.testing.assert_allclose(OFFICE.camera.project(features.points)[0], features.pixels, atol=1e-6)


def test_depth_of_another_size_is_looked_up_where_the_picture_is(frames):
    """A sensor's depth of half the picture's size; nothing else changes."""
    small = OFFICE.camera.resized(OFFICE.camera.width // 2, OFFICE.camera.height // 2)
    depth = frames[0].depth[: 2 * small.height : 2, : 2 * small.width : 2].copy()
    halved = dataclasses.replace(frames[0], sensor_depth=depth)
    whole = FeatureExtractor(OFFICE.camera, OFFICE.camera).extract(frames[0])
    found = FeatureExtractor(OFFICE.camera, small).extract(halved)
    assert len(found) > 0.5 * len(whole)
    known = {tuple(p): x[2] for p, x in zip(whole.pixels, whole.points, strict=True)}
    found_at = {tuple(p): x[2] for p, x in zip(found.pixels, found.points, strict=True)}
    assert np.median([abs(known[p] - found_at[p]) for p in known.keys() & found_at.keys()]) < 0.02


def test_without_depth_or_texture_there_are_no_features(extractor, frames):
    frame = frames[0]
    assert len(extractor.extract(dataclasses.replace(frame, depth=None))) == 0
    assert len(extractor.extract(dataclasses.replace(frame, depth=np.zeros_like(frame.depth)))) == 0
    blank = extractor.extract(dataclasses.replace(frame, rgb=np.full_like(frame.rgb, 90)))
    assert len(blank) == 0 and match_features(blank, blank).shape == (0, 2)


def test_the_picture_of_the_same_place_is_the_most_alike(extractor, frames):
    features = {i: extractor.extract(frame) for i, frame in frames.items()}
    for i in (4, 44, 84, 104):
        others = [j for j in frames if j != i]
        order = [*others, i]
        looks = VisualIndex(lambda number, order=order: features[order[number]].descriptors)
        for _ in order:
            looks.add()
        similar = looks.similarities()
        assert len(similar) == len(others)
        best = others[int(similar.argmax())]
        assert abs(best - i) == 4, (i, best)


def test_an_index_without_words_finds_nothing_alike():
    looks = VisualIndex(lambda number: np.zeros((0, 128), np.uint8))
    assert looks.similarities().shape == (0,)
    for _ in range(20):
        looks.add()
    assert (looks.similarities() == 0.0).all() and len(looks) == 20


def test_similarities_are_those_of_bags_of_words(extractor, frames):
    """Against the definition, word by word, in dense float64."""
    all_of_them = [extractor.extract(frame).descriptors for frame in frames.values()]
    all_of_them.insert(3, np.zeros((0, 128), np.uint8))
    looks = VisualIndex(lambda number: all_of_them[number])
    for _ in all_of_them:
        looks.add()
    words = looks._words.astype(np.float64)
    assert len(words) > 100
    counts = np.zeros((len(all_of_them), len(words)))
    for picture, descriptors in enumerate(all_of_them):
        for row in descriptors.astype(np.float64):
            counts[picture, np.linalg.norm(words - row, axis=1).argmin()] += 1.0 / len(descriptors)
    vectors = counts * np.log(len(counts) / np.maximum((counts > 0).sum(axis=0), 1))
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    np.testing.assert_allclose(looks.similarities(), vectors[:-1] @ vectors[-1], atol=1e-9)
    np.testing.assert_allclose(looks.similarities_to(all_of_them[0])[0], 1.0, atol=0.05)
    assert looks.similarities()[3] == 0.0, "a picture without features"
