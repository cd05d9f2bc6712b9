"""Copies of captures without some folders, and sizes of parts of captures."""

from pathlib import Path

import pytest
from scaling import parts_of
from score_shared import lacking


def test_a_copy_lacks_only_the_folders_that_are_left_out(tmp_path: Path) -> None:
    """Leave out `background`, then `masks`; `ground_truth` has a folder of that name, too."""
    capture, store = tmp_path / "ada", tmp_path / "store"
    for folder in ("images", "background", "masks", "ground_truth/masks"):
        (capture / folder).mkdir(parents=True)
    for left_out in ("background", "masks"):
        copy = lacking(capture, [left_out], store)
        assert sorted(path.name for path in copy.iterdir()) == sorted(
            {"images", "background", "masks", "ground_truth"} - {left_out}
        )
        assert (copy / "ground_truth" / "masks").is_dir()
    assert lacking(capture, [], store) == capture


@pytest.mark.parametrize(("whole", "parts"), [(1, []), (2, [1]), (3, [1, 2]), (4, [1, 2]), (24, [6, 12])])
def test_parts_of_a_number_of_cameras_or_frames(whole: int, parts: list[int]) -> None:
    """Halves are rounded to even numbers: a quarter of two is none, and half of one is none."""
    assert parts_of(whole) == parts
