# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.objects.inventory import inventory

C0 = 0.28209479177387814


def test_objects_are_listed_by_id(rng):
    means = rng.uniform(0, 1, (600, 3)).astype(np.float32)
    ids = np.repeat([0, 300, 7], 200)
    means[ids == 7] += 5.0
    colours = np.zeros((600, 3), np.float32)
    colours[ids == 7] = (np.array([1.0, 0.5, 0.0]) - 0.5) / C0
    entries = inventory(means, colours, ids, names={7: "chair"})
    assert [e["id"] for e in entries] == [7, 300]
    chair = entries[0]
    assert chair["count"] == 200 and chair["class"] == "chair" and entries[1]["class"] is None
    assert chair["colour"] == [255, 128, 0]
    np.testing.assert_allclose(chair["box"]["min"], [5, 5, 5], atol=0.05)
    np.testing.assert_allclose(chair["box"]["max"], [6, 6, 6], atol=0.05)


def test_a_stray_gaussian_does_not_stretch_the_box(rng):
    means = rng.uniform(0, 1, (1000, 3)).astype(np.float32)
    means[0] = 100.0
    box = inventory(means, np.zeros_like(means), np.ones(1000, np.int32))[0]["box"]
    assert max(box["max"]) <= 1.0


def test_no_objects():
    means = np.zeros((3, 3), np.float32)
    assert inventory(means, means, None) == []
    assert inventory(means, means, np.zeros(3, np.int32)) == []
    assert inventory(means[:0], means[:0], np.zeros(0, np.int32)) == []
