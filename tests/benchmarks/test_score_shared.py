"""Tables of the whole pipeline's cost."""

from typing import Any

from score_shared import _cost_table


def test_seconds_of_rendering_are_a_share_not_the_time_of_one_image() -> None:
    """With two threads, two images are rendered at a time: a share of 0.38 s each means that one takes longer."""
    training = {"setup_seconds": 5.0, "seconds": 122.0, "field_seconds": 87.0, "device": "CPU, 2 threads"}
    figures: dict[str, Any] = {"score": None, "run_seconds": 271.0, "training": training}
    figures["own_metrics"] = {"seconds_per_image": 0.38}
    header, _, row = _cost_table({"ada": figures})
    columns = [cell.strip() for cell in header.split("|")]
    assert row.split("|")[columns.index("rendering, s per image")].strip() == "0.38"
    assert "one image, s" not in columns
