# SPDX-License-Identifier: Apache-2.0
"""Numbers that no option takes, from files and from the command line."""

import pytest

from ggwarp.config import ConfigError, RunConfig
from ggwarp.config.command_line import parse
from ggwarp.config.run_config import check_numbers


def test_the_defaults_pass() -> None:
    check_numbers(RunConfig())


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("[slam.mapper.pose_rates]\n", "pose_rates"),
        ("[slam.mapper]\npose_rates = [-inf, 0.0]", "--mapper.pose-rates"),
        ("[slam.mapper]\ndepth_weight = nan", "--mapper.depth-weight"),
        ("[slam.mapper]\niterations = -3", "--mapper.iterations"),
        ("[slam.mapper]\nseed = 9000000000", "--mapper.seed"),
        ("[slam.gicp]\npoints = inf", "points = inf"),
        ("[built_in]\ndepth_noise = -1.0", "--built-in.depth-noise"),
        ("refine = 3000000000", "--refine"),
        ("scale = 1" + "0" * 400, "no number is that large"),
        ("intrinsics = [nan]", "intrinsics"),
    ],
)
def test_a_number_out_of_range_names_its_option(tmp_path, text: str, name: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError) as error:
        parse(["--seq", "office", "--config", str(tmp_path / "c.toml")])
    assert name in str(error.value) and str(error.value).isprintable()


@pytest.mark.parametrize(
    "words",
    [
        "--refine -1",
        "--refine " + "9" * 5000,
        "--scale 1e999",
        "--scale nan",
        "--fps -inf",
        "--mapper.depth-weight -inf",
        "--mapper.iterations 1e9",
        "--mapper.iterations 99999999999",
        "--frames " + "9" * 5000 + ":",
    ],
)
def test_the_command_line_passes_the_same_checks(words: str) -> None:
    with pytest.raises(ConfigError):
        parse(["--seq", "office", *words.split(" ")])
