"""Markdown tables, compared with ones written by hand."""

from hnerf.tables import pick, shown, table


def test_a_table() -> None:
    rows = [["method", "dB"], ["fast", shown(32.678, "{:.2f}")], ["nerf", shown(None, "{:.2f}")]]
    assert table(rows) == ["| method | dB |", "|---|---|", "| fast | 32.68 |", "| nerf | - |"]


def test_a_row_with_an_error_has_the_table_s_cells() -> None:
    rows = [["method", "dB", "s"], ["fast", "no | surface"]]
    assert table(rows) == ["| method | dB | s |", "|---|---|---|", "| fast | no / surface |  |"]


def test_a_value_deep_in_a_tree() -> None:
    tree = {"geometry": {"iou": 0.9}, "curve": None}
    assert pick(tree, "geometry.iou") == 0.9
    assert pick(tree, "geometry.nc") is None
    assert pick(tree, "curve.end.psnr") is None
