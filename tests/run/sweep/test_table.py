"""What is told of the members of a sweep, from their summaries."""

from __future__ import annotations

import json

from warpflag.run.sweep.table import mean_speed


def test_a_mean_speed_has_an_error_and_so_takes_two_members(tmp_path):
    for name, speed in (("a", 2.0), ("b", 4.0), ("c", None)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps({"rates": {"net_speed": speed}}))
    first, second, without = (tmp_path / name for name in "abc")
    assert mean_speed([first, second, without]) == "net_speed 3 +- 1 um/s (standard error of 2)"
    assert mean_speed([first, without]) == mean_speed([]) == ""
