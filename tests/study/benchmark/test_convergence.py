"""Flat curves, worked out by hand."""

import pytest

from hnerf.study.benchmark.convergence import is_flat, training_limits_s


def test_training_times_double_up_to_the_limit() -> None:
    assert training_limits_s(10.0) == [10.0]
    assert training_limits_s(45.0) == [10.0, 20.0, 40.0]
    assert training_limits_s(10_800.0)[-3:] == [2560.0, 5120.0, 10_240.0]


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        ([(320.0, 20.0), (640.0, 20.09)], True),
        ([(320.0, 20.0), (640.0, 20.11)], False),
        ([(320.0, 20.0), (640.0, 18.0)], True),  # falling is no gain
        ([(160.0, 20.0), (320.0, 20.0)], False),  # too short
        ([(160.0, 22.0), (320.0, 20.0), (640.0, 21.0)], True),  # the best earlier value counts
        ([(100.0, 20.0), (500.0, 20.5), (640.0, 20.55)], False),  # 500 s is in the last third, too
        ([(100.0, 20.0), (400.0, 20.5), (640.0, 20.55)], True),  # 400 s is not
        ([(640.0, 20.0)], False),
        ([], False),
    ],
)
def test_a_curve_is_flat_if_its_last_third_gains_less_than_a_tenth_of_a_decibel(
    curve: list[tuple[float, float]], expected: bool
) -> None:
    assert is_flat(curve) == expected
