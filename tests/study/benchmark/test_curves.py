"""Pareto fronts and crossings worked out by hand."""

import pytest

from hnerf.study.benchmark.curves import bin_edges, bin_means, pareto_front, seconds_to_reach, value_at


def test_the_pareto_front_lists_unbeaten_points_cheapest_first() -> None:
    points = {
        "slow and good": (4.0, 30.0),
        "fast and fair": (1.0, 25.0),
        "slower, no better": (5.0, 30.0),
        "between, worse than the fast one": (2.0, 24.0),
        "between": (2.0, 26.0),
    }
    assert pareto_front(points) == ["fast and fair", "between", "slow and good"]


def test_equal_points_are_both_on_the_front() -> None:
    assert pareto_front({"a": (1.0, 20.0), "b": (1.0, 20.0), "c": (1.0, 19.0)}) == ["a", "b"]


def test_the_time_to_reach_a_level_is_interpolated_in_log_time() -> None:
    # 20 dB at 10 s, 24 dB at 1000 s: half the rise at the geometric mean of the times, a quarter at 10 * 100^(1/4)
    curve = [(10.0, 20.0), (1000.0, 24.0)]
    assert seconds_to_reach(curve, 22.0) == pytest.approx(100.0)
    assert seconds_to_reach(curve, 21.0) == pytest.approx(31.6228, rel=1e-5)
    assert seconds_to_reach(curve, 24.0) == pytest.approx(1000.0)


def test_a_level_below_the_first_point_is_reached_there_and_one_above_all_points_never() -> None:
    curve = [(10.0, 20.0), (20.0, 25.0), (40.0, 23.0)]
    assert seconds_to_reach(curve, 15.0) == 10.0
    assert seconds_to_reach(curve, 25.5) is None
    assert seconds_to_reach([], 1.0) is None


def test_the_value_of_a_curve_before_between_and_after_its_points() -> None:
    curve = [(10.0, 20.0), (1000.0, 24.0)]
    assert value_at(curve, 100.0) == pytest.approx(22.0)
    assert value_at(curve, 9.9) is None and value_at([], 10.0) is None
    assert value_at(curve, 10.0) == 20.0 and value_at(curve, 5000.0) == 24.0


def test_bins_are_equally_wide_and_empty_ones_are_left_out() -> None:
    points = [(9.0, 8.0), (0.0, 2.0), (1.0, 6.0), (2.0, 4.0)]
    assert bin_edges([points[:2], points[2:]], 3) == [0.0, 3.0, 6.0, 9.0]
    assert bin_means(points, [0.0, 3.0, 6.0, 9.0]) == {0: (1.0, 4.0, 3), 2: (9.0, 8.0, 1)}
    assert bin_means([(3.0, 1.0)], [0.0, 3.0, 6.0]) == {1: (3.0, 1.0, 1)}  # an edge belongs to the next bin
    assert bin_means(points[:1], bin_edges([points[:1]], 5)) == {4: (9.0, 8.0, 1)}
    assert bin_edges([], 3) == []
