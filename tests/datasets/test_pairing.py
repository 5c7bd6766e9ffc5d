# SPDX-License-Identifier: Apache-2.0
"""Which files belong together: names as recorders write them, times in any unit, names that do not tell."""

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.datasets import DatasetError
from ggwarp.datasets.pairing import Pairing, frame_numbers, in_order, pair_files, pair_times, unit_of_times


def paired(colour: list[str], depth: list[str]) -> Pairing:
    files = [
        in_order([Path(folder) / f"{name}.png" for name in names])
        for folder, names in (("color", colour), ("depth", depth))
    ]
    return pair_files(files[0], files[1], "colour images", "depth images")


SAME = [
    ("equal names", "{i:05d}", "{i:05d}", "name"),
    ("unpadded", "{i}", "{i}", "name"),
    ("other prefixes", "frame{i:06d}", "depth{i:06d}", "number"),
    ("padding differs", "rgb_{i}", "{i:04d}", "number"),
    ("a number follows", "rgb_{i:05d}_cam0", "depth_{i:05d}_cam0", "number"),
    ("another one follows", "rgb_{i:05d}_cam0", "depth_{i:05d}_cam1", "number"),
    ("a number goes before", "scan7_{i}", "d7_{i}", "number"),
    ("a size follows", "{i:04d}_640x480", "{i:04d}_320x240", "number"),
    ("index, then its own time", "{i:07d}-{t0}", "{i:07d}-{t1}", "number"),
    ("a date goes before", "20240105_1530_{i}", "20240105_1530_{i}_depth", "number"),
    ("seconds", "{s0:.6f}", "{s1:.6f}", "time"),
    ("seconds with a prefix", "rgb_{s0:.6f}", "depth_{s1:.6f}", "time"),
    ("short decimals", "{short0}", "{short1}", "time"),
    ("milliseconds", "{ms0}", "{ms1}", "time"),
    ("microseconds", "{us0}", "{us1}", "time"),
    ("nanoseconds", "c{ns0}", "{ns1}", "time"),
    ("dates", "{date0}", "depth_{date1}", "time"),
    ("dates with punctuation", "{iso0}", "{iso1}", "time"),
    ("seconds and nanoseconds", "{sec0}", "{sec1}", "time"),
]  # fmt: skip


def named(pattern: str, i: int) -> str:
    """Return the name of frame ``i``, of whose images the second is taken 6 ms later."""
    first = 1_700_000_000_000_000_000 + i * 503_000_000
    second = first + 6_000_000
    values: dict[str, object] = {"i": i, "t0": i * 33_333, "t1": i * 33_333 + 20}
    for n, stamp in enumerate((first, second)):
        short = 100 + 0.503 * i + 0.006 * n
        values |= {f"s{n}": stamp / 1e9, f"short{n}": f"{short:.3f}", f"ns{n}": stamp}
        date = datetime.fromtimestamp(stamp // 10**9 + 7190, timezone.utc)  # an hour ends on the way
        values |= {f"date{n}": f"{date:%Y%m%d_%H%M%S}_{stamp // 10**6 % 1000:03d}"}
        values |= {f"iso{n}": f"{date:%Y-%m-%dT%H-%M-%S}.{stamp // 10**3 % 10**6:06d}"}
        values |= {f"sec{n}": f"{stamp // 10**9}_{stamp % 10**9:09d}"}
        values |= {f"us{n}": stamp // 10**3, f"ms{n}": stamp // 10**6}
    return pattern.format(**values)


@pytest.mark.parametrize(("colour", "depth", "by"), [row[1:] for row in SAME], ids=[row[0] for row in SAME])
def test_the_files_of_a_frame_are_found(colour: str, depth: str, by: str) -> None:
    pairing = paired([named(colour, i) for i in range(14)], [named(depth, i) for i in range(14)])
    assert pairing.partners == list(range(14)) and pairing.by == by and not pairing.notes
    if by == "time":
        assert pairing.worst_gap == pytest.approx(0.006, abs=1e-6) and pairing.stamps is not None
        np.testing.assert_allclose(np.diff(pairing.stamps[0]), 0.503, atol=1e-6)
        assert pairing.summary("colour images", "depth images") == "14 pairs by time, at most 6.0 ms apart"


@pytest.mark.parametrize(("colour", "depth", "by"), [row[1:] for row in SAME], ids=[row[0] for row in SAME])
def test_a_file_that_is_missing_leaves_one_without_a_partner(colour: str, depth: str, by: str) -> None:
    pairing = paired([named(colour, i) for i in range(14)], [named(depth, i) for i in range(14) if i != 5])
    assert pairing.partners == [*range(5), -1, *range(5, 13)] and pairing.by == by
    assert pairing.summary("colour images", "depth images").endswith("1 colour images without a partner")


def test_a_file_of_another_make_stands_alone() -> None:
    pairing = paired(["cover", *(f"f{i}" for i in range(9))], [f"d{i}" for i in range(9)])
    assert sorted(pairing.partners) == [-1, *range(9)]


@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        (["left_1", "right_1", "left_2", "right_2"], ["depth_1", "depth_2"]),
        (["a", "b", "c"], ["x", "y", "z"]),
        ([f"{i}" for i in range(5)], [f"{i}" for i in range(100, 105, 2)]),
    ],
    ids=["two pictures of a number", "no numbers", "no number in common"],
)
def test_names_that_do_not_tell_are_refused(colour: list[str], depth: list[str]) -> None:
    with pytest.raises(DatasetError, match=r"depth: the names do not tell which depth images"):
        paired(colour, depth)


def test_the_seconds_of_many_minutes_are_no_time() -> None:
    """They come again every minute: the depth of another minute is as near."""
    minutes = [f"{minute:02d}m{second:06.3f}" for minute in range(3) for second in (1.0, 21.0, 41.0)]
    late = [f"{minute:02d}m{second:06.3f}" for minute in range(1, 4) for second in (1.006, 21.006, 41.006)]
    with pytest.raises(DatasetError, match="the names do not tell"):
        paired(minutes, late)


def test_two_ways_of_counting_are_told() -> None:
    pairing = paired([f"{i}" for i in range(1, 15)], [f"{i}" for i in range(14)])
    assert pairing.partners == list(range(14)) and pairing.by == "order"
    assert "differ by 1 (1.png, 0.png) though there are 14 of each" in pairing.notes[0]


def test_a_late_start_is_not_another_way_of_counting() -> None:
    pairing = paired([f"{i}" for i in range(100, 130)], [f"{i}" for i in range(103, 127)])
    assert pairing.partners == [-1] * 3 + list(range(24)) + [-1] * 3 and not pairing.notes


def test_half_as_many_of_the_same_numbers_are_told() -> None:
    pairing = paired([f"{i:04d}" for i in range(40)], [f"{i:04d}" for i in range(20)])
    assert (
        pairing.paired == 20
        and "40 colour images and 20 depth images, both numbered from 0" in pairing.notes[0]
    )


def test_numbers_are_in_order_and_decimals_may_count() -> None:
    for names in (
        ["1", "2", "10"],
        ["1.9", "1.10", "1.11"],
        ["a2_1", "a2_10", "a10_1"],
        ["9.75", "10.5", "10.625"],
    ):
        assert [p.stem for p in in_order([Path(f"{n}.png") for n in reversed(names)])] == names


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["f3_cam0", "f7_cam0"], [3, 7]),
        (["7_3", "7_4"], [3, 4]),
        (["cover", "f1", "f2", "f3"], [None, 1, 2, 3]),
        (["a", "b"], [None, None]),
        (["rgb_12"], [12]),
        ([], []),
    ],
)
def test_a_frames_number_is_what_varies(names: list[str], numbers: list[int | None]) -> None:
    assert frame_numbers([Path(f"{name}.png") for name in names]) == numbers


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        ([1.7e9, 1.7e9 + 1], 1.0),
        ([1.7e12], 1e3),
        ([1.7e15], 1e6),
        ([1.7e18], 1e9),
        ([0.0, 0.033], 1.0),
        ([0.0, 33.0], None),
        ([float("nan")], None),
        ([], None),
    ],
)
def test_the_unit_of_times(times: list[float], unit: float | None) -> None:
    assert unit_of_times(np.array(times)) == unit


def test_what_two_are_nearest_to_goes_to_the_nearer_one() -> None:
    colour, depth = np.arange(8) / 60.0, np.arange(4) / 30.0 + 0.002
    assert pair_times(colour, depth).partners == [0, -1, 1, -1, 2, -1, 3, -1]
    # The second is nearest to depth 0 as well, and takes the next.
    assert pair_times(np.array([1.0, 1.004]), np.array([1.001, 1.012])).partners == [0, 1]


stamps = st.lists(st.floats(0, 1), max_size=9).map(np.array)


@settings(max_examples=100)
@given(colour=stamps, depth=stamps, tolerance=st.floats(0, 0.3))
def test_pairs_in_time_are_those_of_brute_force(
    colour: np.ndarray, depth: np.ndarray, tolerance: float
) -> None:
    """As the benchmark's own script does it: all pairs by distance, the nearest first, each once."""
    pairing = pair_times(colour, depth, tolerance=tolerance)
    expected: dict[int, int] = {}
    pairs = sorted((abs(a - b), i, j) for i, a in enumerate(colour) for j, b in enumerate(depth))
    for distance, i, j in pairs:
        if distance <= tolerance and i not in expected and j not in expected.values():
            expected[i] = j
    found = [p for p in pairing.partners if p >= 0]
    assert len(set(found)) == len(found)
    gaps = sorted(abs(colour[i] - depth[p]) for i, p in enumerate(pairing.partners) if p >= 0)
    np.testing.assert_allclose(gaps, sorted(abs(colour[i] - depth[j]) for i, j in expected.items()))
