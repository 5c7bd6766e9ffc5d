# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.geometry.boxes import Extents
from ggwarp.objects.inventory import ObjectRecord, inventory, refreshed
from ggwarp.objects.visibility import ObjectVisibility

C0 = 0.28209479177387814


def test_objects_are_listed_by_id(rng):
    means = rng.uniform(0, 1, (600, 3)).astype(np.float32)
    ids = np.repeat([0, 300, 7], 200)
    means[ids == 7] += 5.0
    colours = np.zeros((600, 3), np.float32)
    colours[ids == 7] = (np.array([1.0, 0.5, 0.0]) - 0.5) / C0
    chair, other = inventory(means, colours, ids, names={7: "chair"}, probabilities=ids / np.float32(1000))
    assert (chair.id, other.id) == (7, 300) and chair.source_ids == (7,)
    assert chair.count == 200 and chair.class_name == "chair" and other.class_name is None
    assert chair.colour == (255, 128, 0) and chair.name == "chair" and other.name == "object 300"
    np.testing.assert_allclose(chair.box.low, [5, 5, 5], atol=0.05)
    np.testing.assert_allclose(chair.box.high, [6, 6, 6], atol=0.05)
    np.testing.assert_allclose(chair.centre, means[ids == 7].mean(0), atol=1e-5)
    assert chair.confidence == pytest.approx(0.007) and other.confidence == pytest.approx(0.3)
    assert chair.views is None and chair.first_frame is None


def test_what_the_keyframes_showed():
    visibility = ObjectVisibility()
    mask = np.zeros((100, 200), np.int32)
    mask[:10], mask[20:30, :50], mask[50, 50] = 7, 8, 9  # 9: a dot
    visibility.add(30, mask)
    visibility.add(4, np.where(mask == 7, 7, 0).astype(np.int32))
    visibility.add(11, np.where(mask == 8, 70, -1).astype(np.int32))
    means = np.zeros((3, 3), np.float32)
    names = np.arange(71)
    names[70] = 8
    visibility = visibility.renamed(names)
    records = inventory(means, means, np.array([7, 8, 9]), visibility=visibility, sources={8: (8, 70)})
    assert [(r.first_frame, r.last_frame, r.views) for r in records] == [
        (4, 30, 2),
        (11, 30, 2),
        (None, None, None),
    ]
    assert records[1].source_ids == (8, 70)


def test_the_file_keeps_the_record(rng):
    means = rng.normal(size=(100, 3)).astype(np.float32)
    ids = np.repeat([3, 4], 50)
    probabilities = rng.uniform(0.3, 1.0, 100).astype(np.float32)
    quats, logits = rng.normal(size=(100, 4)), rng.normal(size=100)
    extents = Extents.of(quats, np.full((100, 3), -3.0), logits)
    options = {"names": {3: "globe"}, "probabilities": probabilities}
    known = inventory(means, means, ids, **options, extents=extents)
    assert all(record.oriented_box.sigmas is not None for record in known)
    for record in [*known, *inventory(means, means, ids, **options)]:
        entry = json.loads(json.dumps(record.to_json()))
        assert {"id", "count", "box", "colour", "class"} <= set(entry)
        again = ObjectRecord.from_json(entry)
        assert json.loads(json.dumps(again.to_json())) == entry
        assert (again.id, again.class_name, again.count) == (record.id, record.class_name, record.count)
        np.testing.assert_allclose(again.oriented_box.centre, record.oriented_box.centre, atol=1e-4)


def test_a_stray_gaussian_does_not_stretch_the_boxes(rng):
    means = rng.uniform(0, 1, (1000, 3)).astype(np.float32)
    means[:2] = [[100.0, 0.0, 0.0], [0.0, -50.0, 0.0]]
    record = inventory(means, np.zeros_like(means), np.ones(1000, np.int32))[0]
    assert max(record.box.high) <= 1.0 and max(record.oriented_box.half_sizes) < 1.0
    np.testing.assert_allclose(record.centre, 0.5, atol=0.05)


def test_an_edited_map_is_described_anew(rng):
    means = rng.uniform(size=(90, 3)).astype(np.float32)
    ids = np.repeat([1, 2, 3], 30)
    old = inventory(means, means, ids, names={2: "mug"}, probabilities=np.full(90, 0.9, np.float32))
    keep = ids != 1
    new = refreshed(old, means[keep] + 1.0, means[keep], ids[keep])
    assert [r.id for r in new] == [2, 3] and new[0].name == "mug" and new[0].confidence == pytest.approx(0.9)
    np.testing.assert_allclose(np.subtract(new[0].centre, old[1].centre), 1.0, atol=1e-6)


def test_no_objects():
    means = np.zeros((3, 3), np.float32)
    assert inventory(means, means, None) == []
    assert inventory(means, means, np.zeros(3, np.int32)) == []
    assert inventory(means[:0], means[:0], np.zeros(0, np.int32)) == []


def _entry() -> dict:
    means = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    (record,) = inventory(means, means, np.full(20, 3), names={3: "globe"})
    return json.loads(json.dumps(record.to_json()))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("id", "3"),
        ("id", True),
        ("id", 0),
        ("id", 3.0),
        ("id", 10**30),
        ("source_ids", 3),
        ("source_ids", ["a"]),
        ("source_ids", {"a": 1}),
        ("class", [1]),
        ("label", 5),
        ("label", "x" * 1001),
        ("count", None),
        ("count", -1),
        ("box", [0, 1]),
        ("box", {"min": [0, 0, 0]}),
        ("box", {"min": [0, 0, 0], "max": [0, 0, float("nan")]}),
        ("oriented_box", {"centre": [0, 0, 0], "quat": [1, 0, 0], "half_sizes": [1, 1, 1]}),
        ("centre", "abc"),
        ("centre", [0, 0, "1"]),
        ("centre", [0, 0, float("inf")]),
        ("colour", [0, 0, 256]),
        ("colour", [0, 0, -1]),
        ("colour", None),
        ("first_frame", "x"),
        ("views", 1.5),
        ("confidence", "x"),
        ("confidence", float("nan")),
        ("confidence", []),
    ],
)
def test_a_value_of_another_type_is_named(key, value):
    with pytest.raises(ValueError, match=f"^{'min|max|quat' if 'box' in key else key}|^box is"):
        ObjectRecord.from_json(_entry() | {key: value})


@pytest.mark.parametrize("key", ["id", "source_ids", "count", "box", "oriented_box", "centre", "colour"])
def test_a_missing_value_is_named(key):
    entry = _entry()
    del entry[key]
    with pytest.raises(ValueError, match=f"^{key} is missing"):
        ObjectRecord.from_json(entry)


_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["min", "quat"]), inner),
    max_leaves=6,
)


@given(changes=st.dictionaries(st.sampled_from(sorted(_entry())), _values, max_size=3) | _values)
def test_any_json_is_a_record_or_a_value_error(changes):
    entry = _entry() | changes if isinstance(changes, dict) else changes
    try:
        json.dumps(ObjectRecord.from_json(entry).to_json(), allow_nan=False)
    except ValueError as error:
        assert str(error).isprintable()
