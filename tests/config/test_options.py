# SPDX-License-Identifier: Apache-2.0
"""The table of options: few, explained, and all in the documentation."""

from __future__ import annotations

from ggwarp.config.options import GROUPS, option_table, run_options

MOST = 70


def test_there_are_few_options():
    flags = [o.flag for o in option_table()]
    assert len(flags) == len(set(flags))
    decisive = [o.flag for o in run_options()]
    assert len(decisive) <= MOST, decisive
    assert set(flags) - set(decisive) == {
        "--config",
        "--resume",
        "--start-from",
        "--checkpoint-every",
        "--viewer",
        "--viewer-at",
    }


def test_each_is_explained_in_whole_sentences():
    for option in option_table():
        assert option.help and option.help.endswith(".") and option.help[0].isupper(), option
        assert option.group, f"{option.flag}: give it its place in GROUPS"


def test_groups_and_defaults():
    options = {o.flag: o for o in option_table()}
    for title, names in GROUPS.items():
        for name in names:
            assert options[f"--{name}"].group == title
    assert options["--preset"].default == "gg-slam" and "fast" in options["--preset"].choices
    assert options["--mono"].default == "no" and options["--mono"].choices == ("yes", "no")
    assert options["--seq"].default == "" and options["--built-in.disparity-constant"].default == "43.5"
    assert options["--mapper.iterations"].group == "mapper"
