"""The committed studies, and tables and charts of synthetic runs."""

import itertools
from pathlib import Path
from typing import Any

import cv2
import pytest

from hnerf.config import load_settings
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import CapturePart
from hnerf.study.degradations.catalogue import KINDS
from hnerf.study.stability.charts import SHADES, curve_chart, matrix_chart
from hnerf.study.stability.plan import StabilityStudy, load_stability
from hnerf.study.stability.report import as_markdown, tolerated_strength


def test_the_full_study_tries_everything_at_four_or_five_strengths_and_three_seeds() -> None:
    full = load_stability("full")
    assert set(full.degradations) == set(KINDS)
    assert {len(s) for name, s in full.degradations.items() if name != "cameras_left"} <= {4, 5}
    assert len(full.seeds) == 3
    assert full.left_out() == []


def test_brief_has_all_strengths_and_further_seeds_near_borders() -> None:
    full, brief = load_stability("full"), load_stability("brief")
    assert (brief.methods, brief.degradations) == (("fast",), full.degradations)
    assert (*brief.seeds, *brief.border_seeds) == full.seeds
    assert "2 of 3 seeds, except where a verdict is near a border" in brief.left_out()


def test_studies_of_other_methods_and_of_full_training() -> None:
    full, fast = load_stability("full"), load_stability("fast")
    assert (fast.methods, fast.degradations) == (("fast",), full.degradations | {"large_images": (1.5, 2)})
    assert [name for name in fast.overrides if name.startswith("training")] == ["training.novel_pose_steps=0"]
    milder = {name: strengths[:2] for name, strengths in full.degradations.items()}
    moving, still = load_stability("methods"), load_stability("one-moment")
    assert moving.degradations == milder
    assert still.degradations == {k: v for k, v in milder.items() if k not in ("frames_left", "camera_out_of_step")}
    assert still.part == CapturePart(frames=1, novel_poses=False)
    assert {*moving.methods, *still.methods} == {"fast", "neural-body", "nerfies", "nerf", "idr"}
    published = load_stability("published")
    assert published.methods == ("paper-small", "neural-body")
    assert published.degradations == {name: milder[name] for name in published.degradations}
    assert {KINDS[name].target for name in published.degradations} == {"capture", "masks", "fit", "poses"}
    for study in (fast, moving, still, published):
        for method in study.methods:
            load_settings(method, list(study.overrides))


def test_the_quick_study_has_the_two_mildest_strengths_and_lists_what_it_leaves_out() -> None:
    full, quick = load_stability("full"), load_stability("quick")
    assert quick.degradations == {name: full.degradations[name][:2] for name in quick.degradations}
    for method in quick.methods:
        load_settings(method, list(quick.overrides))
    left_out = quick.left_out()
    assert "`paper` as a method" in left_out
    assert "2 of 3 seeds: too few to know the variance" in left_out
    assert "the preset's own value: `training.steps=100` instead" in left_out
    assert "one camera turned, °: 2, 3" in left_out
    assert "blur, % of image width: 0.25, 0.5, 1, 2" in left_out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("methods: [fast]\nseeds: [0]\ndegradations: {mask_holes: [5]}\nspeed: 3", "speed: no such key"),
        ("methods: []\nseeds: [0]\ndegradations: {}", "methods: "),
        ("methods: [fast]\nseeds: [0]\ndegradations: {hats: [5]}", "degradation hats: no such degradation"),
        ("methods: [fast]\nseeds: [0]\ndegradations: {mask_holes: [5, 2, 3]}", "the mildest first"),
    ],
)
def test_bad_studies_are_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        load_stability(str(tmp_path / "mine.yaml"))
    assert "\n" not in str(raised.value)


def test_unknown_studies_and_degradations_are_refused() -> None:
    with pytest.raises(InputError, match="slow: no such study or file; there are brief, fast, full, methods, "):
        load_stability("slow")
    with pytest.raises(InputError, match="--only hats: not in this study; it has cameras_left, "):
        load_stability("quick").restricted_to(["hats"])
    assert list(load_stability("quick").restricted_to(["pose_noise"]).degradations) == ["pose_noise"]


def run(method: str, kind: str, strength: float | None, seed: int, verdict: str, psnr: float | None) -> dict[str, Any]:
    """Return a row of results, with scores if the verdict is ok or degraded."""
    row = {"method": method, "kind": kind, "strength": strength, "seed": seed, "verdict": verdict, "reason": ""}
    if verdict in ("ok", "degraded"):
        good = {"psnr": 30.0 + seed, "ssim": 0.9, "chamfer_mm": 6.0 - seed}
        return row | {"psnr": psnr, "ssim": 0.9, "chamfer_mm": None if psnr is None else 36 - psnr, "reference": good}
    return row | {"reason": "too | bad"}


RESULT = {
    "subject": "ada",
    "study": "mine",
    "plan": StabilityStudy(
        methods=("fast", "nerf"), seeds=(0, 1), degradations={"pose_noise": (1, 2, 5), "mask_holes": (5, 10)}
    ).model_dump(mode="json"),
    "left_out": ["hats"],
    "protocol": "By eye.",
    "runs": [
        *(run("fast", "as recorded", None, seed, "ok", 30 + seed) for seed in (0, 1)),
        *(run("fast", "pose_noise", 1, seed, "ok", 29.5 + seed) for seed in (0, 1)),
        run("fast", "pose_noise", 2, 0, "degraded", 27.0),
        run("fast", "pose_noise", 2, 1, "failed", None),
        run("fast", "pose_noise", 5, 0, "refused", None),
        run("fast", "mask_holes", 5, 0, "ok", 30.0),
        run("nerf", "as recorded", None, 0, "refused", None),
    ],
}


def noisy(strength: float, verdict: str) -> dict[str, Any]:
    return run("fast", "pose_noise", strength, 0, verdict, 30.0)


GOOD, UNSCORED = (run("fast", "as recorded", None, 0, verdict, 30.0) for verdict in ("ok", "unscored"))


@pytest.mark.parametrize(
    ("runs", "expected"),
    [
        ([GOOD, noisy(1, "degraded"), noisy(2, "ok"), noisy(5, "failed")], "degraded at 1, failed at 5"),
        ([GOOD, noisy(1, "ok"), noisy(2, "degraded"), noisy(5, "failed")], "holds to 1, degraded at 2, failed at 5"),
        ([GOOD, run("fast", "as recorded", None, 1, "failed", None), noisy(1, "ok")], "holds to 1"),
        ([GOOD], "-"),
        ([UNSCORED, noisy(1, "unscored")], "unscored"),
        ([GOOD, noisy(1, "ok"), noisy(2, "unscored")], "holds to 1"),
        ([GOOD | {"verdict": "failed"}], "failed at 1"),
    ],
    ids=["degraded, then ok", "degraded, then failed", "a seed without reference", "never run", "unscored",
         "unscored, then", "no reference, though with scores"],
)  # fmt: skip
def test_the_strength_to_which_a_method_holds(runs: list[dict[str, Any]], expected: str) -> None:
    assert tolerated_strength(RESULT | {"runs": runs}, "fast", "pose_noise") == expected


def test_the_tables_by_hand() -> None:
    lines = as_markdown(RESULT, ["a (b).png"]).splitlines()
    start = lines.index("## How far each method holds")
    assert lines[start + 2 : start + 10] == [
        "| degradation | fast | nerf |",
        "|---|---|---|",
        "| pose noise, ° a joint | holds to 1, failed at 2 | refused at 1 |",
        "| holes, % of each mask | holds to 5 | refused at 5 |",
        "",
        "![a (b).png](<a (b).png>)",
        "",
        "## Runs",
    ]
    figures = "27.00 (-3.00) | - | - | 0.900 (+0.000) | 9.00 (+3.00)"
    assert f"| fast | pose noise, ° a joint | 2 | 0 | degraded | {figures} |" in lines
    assert "| fast | as recorded |  | 1 | ok | 31.00 | - | - | 0.900 | 5.00 |" in lines
    assert "| fast | pose noise, ° a joint | 2 | 1 | failed: too / bad | - | - | - | - | - |" in lines
    assert "- hats" in lines
    assert lines[-1] == "By eye."


def test_the_matrix_has_a_shade_for_each_verdict(tmp_path: Path) -> None:
    matrix_chart(RESULT, tmp_path / "matrix.png")
    picture = cv2.imread(str(tmp_path / "matrix.png"))
    assert picture is not None
    colours = {tuple(bgr) for bgr in picture.reshape(-1, 3).tolist()}
    assert {tuple(int(shade[k : k + 2], 16) for k in (5, 3, 1)) for shade in SHADES.values()} <= colours
    luma = [(1, 0.3), (3, 0.59), (5, 0.11)]  # ITU-R BT.601, red, green, blue
    greys = sorted(sum(int(shade[k : k + 2], 16) * weight for k, weight in luma) for shade in SHADES.values())
    assert all(lighter - darker > 15 for darker, lighter in itertools.pairwise(greys))


def test_curves_are_drawn_only_if_there_are_scores(tmp_path: Path) -> None:
    assert curve_chart(RESULT, "psnr", tmp_path / "psnr.png")
    assert (tmp_path / "psnr.png").stat().st_size > 10_000
    nothing = RESULT | {"runs": [r for r in RESULT["runs"] if "psnr" not in r]}  # type: ignore[union-attr, operator]
    assert not curve_chart(nothing, "psnr", tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
