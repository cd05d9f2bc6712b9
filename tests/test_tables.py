"""Markdown tables, compared with ones written by hand."""

from hnerf.tables import head, line, pick, shown


def test_a_table() -> None:
    assert [
        *head(["method", "dB"]),
        line(["fast", shown(32.678, "{:.2f}")]),
        line(["nerf", shown(None, "{:.2f}")]),
    ] == ["| method | dB |", "|---|---|", "| fast | 32.68 |", "| nerf | - |"]


def test_a_value_deep_in_a_tree() -> None:
    tree = {"geometry": {"iou": 0.9}, "curve": None}
    assert pick(tree, "geometry.iou") == 0.9
    assert pick(tree, "geometry.nc") is None
    assert pick(tree, "curve.end.psnr") is None
