"""Study files, and the parts of a capture that their variants select."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hnerf.config import load_settings
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import STUDIES, BenchmarkStudy, Variant, load_study, snapshot_times_s
from tests.shared_data import SHARED_DATA

RECORDED: Any = SimpleNamespace(name="ada", train_cameras=("a", "b", "c", "d"), train_frames=(0, 2, 4, 6, 8))


def write(folder: Path, text: str) -> str:
    (folder / "study.yaml").write_text(text)
    return str(folder / "study.yaml")


def test_the_expected_studies_exist_and_are_valid() -> None:
    studies = {path.stem: load_study(path.stem) for path in STUDIES.glob("*.yaml")}
    of_the_paper = {"cameras", "view-angle", "frames", "pose-distance", "monocular", "nerfies"}
    to_convergence = {"static-converged", "dynamic-converged"}
    assert set(studies) == {"quick", "dynamic", "static"} | of_the_paper | to_convergence
    assert all(studies[name].until_flat and studies[name].seconds == 3 * 3600 for name in to_convergence)
    assert all(studies[name].claims for name in of_the_paper)
    assert all(studies[name].scoring.images == 48 for name in ("view-angle", "pose-distance"))
    assert set(studies["quick"].methods) == {"fast", "paper-small", "nerf"}
    assert studies["quick"].variants["one frame"].methods == ("fast", "nerf")
    assert [v.cameras for v in studies["cameras"].variants.values()] == [2, 4, 8, 16, 32]
    assert [v.frames for v in studies["frames"].variants.values()] == [1, 5, 10, 20, 40]


def test_claims_quote_sentences_of_the_paper() -> None:
    """Quotes omit parentheses, mark other omissions by an ellipsis, and may begin and end within a sentence."""
    paper = SHARED_DATA.parent / "reference" / "h-nerf-paper.tex"
    if not paper.exists():
        pytest.skip("the paper is not beside this checkout")
    plain = re.sub(r"\\cite\{[^}]*\}|\([^)]*\)|[~\\]", " ", paper.read_text())
    sentences = [" ".join(sentence.split()).lower() for sentence in re.split(r"(?<=[.:])\s+(?=[A-Z])", plain)]
    for path in STUDIES.glob("*.yaml"):
        for claim in load_study(path.stem).claims:
            parts = [part.strip(" .").lower() for part in claim.says.split("...")]
            assert any(all(part in sentence for part in parts) for sentence in sentences), claim.says


def test_methods_of_committed_studies_have_valid_settings() -> None:
    for path in STUDIES.glob("*.yaml"):
        study = load_study(path.stem)
        for method in study.methods:
            training = study.settings(method).training
            assert training.seconds == study.seconds
            assert study.settings(method, 20.0).training.seconds == 20.0
            assert len(training.snapshots_s) == study.snapshots


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: t\nmethods: [a]\nvariants: {all: {}}\nspeed: 3", "speed: no such key; remove it"),
        ("title: t\nmethods: [a]\nvariants: {all: {views: 3}}", "variants.all.views: no such key"),
        ("title: t\nmethods: [a]\nvariants: {all: {methods: [b]}}", "variants.all: no method b; there"),
        ("title: t\nmethods: [a]\nvariants: {a: {}}\nuntil_flat: true\nsnapshots: 0", "until_flat: requires"),
        ("title: t\nmethods: [a]\nvariants: {a: {}}\nuntil_flat: true\nseconds: 60", "until_flat: requires"),
        ("title: t\nmethods: [a]\nvariants: {}", "variants: Dictionary should have at least 1"),
        ("title: t\nmethods: [a]\nvariants: {a: {}}\nclaims: [{says: a, check: more_is_better}]", "requires a sweep"),
        ("title: t\nmethods: [a]\nvariants: {a: {}}\nclaims: [{says: a, check: faith}]", "claims.0.check: Input"),
    ],
)
def test_bad_studies_are_refused_by_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_study(write(tmp_path, text))


def test_wide_methods_differ_from_small_ones_only_in_their_networks() -> None:
    for name, widths in {"nerf": 256, "idr": 512, "neural-body": 256, "nerfies": 256}.items():
        small, wide = load_settings(name).training, load_settings(f"{name}-wide").training
        own = wide.field
        assert own.width == widths
        assert wide == small.model_copy(update={"field": own})


def test_unknown_studies_are_refused() -> None:
    with pytest.raises(InputError, match="speed: no such study or file; there are cameras, dynamic"):
        load_study("speed")


def test_parts_are_selected_by_number_or_by_name() -> None:
    assert Variant().select(RECORDED) == (None, None, None)
    assert Variant(cameras=2, frames=3, novel_poses=False).select(RECORDED) == (("a", "c"), (0, 4, 8), ())
    assert Variant(cameras=3, frames=1).select(RECORDED) == (("a", "b", "c"), (0,), None)
    assert Variant(cameras=("d",), frames=(2,)).select(RECORDED) == (("d",), (2,), None)


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        (Variant(cameras=8), "the capture has 4 training cameras, not 8"),
        (Variant(frames=6), "the capture has 5 training frames, not 6"),
        (Variant(cameras=("a", "e")), "ada: no training camera e; there are a, b, c, d"),
        (Variant(frames=(3,)), "ada: no training frame 3; there are 0, 2, 4, 6, 8"),
    ],
)
def test_cameras_and_frames_that_were_not_recorded_are_refused(variant: Variant, message: str) -> None:
    with pytest.raises(InputError, match=message):
        variant.select(RECORDED)


def test_snapshots_halve_the_limit_or_double_from_a_quarter_minute() -> None:
    assert snapshot_times_s(80.0, 3) == (10.0, 20.0, 40.0)
    assert snapshot_times_s(None, 3) == (15.0, 30.0, 60.0)
    assert snapshot_times_s(80.0, 0) == ()


def test_restricting_keeps_methods_in_their_variants_and_adds_presets_to_all() -> None:
    study = BenchmarkStudy(
        title="t", seconds=60, methods=("a", "b"), variants={"all": Variant(methods=("b",)), "one": Variant(frames=1)}
    )
    assert study.restricted_to([], None) == study.model_copy(
        update={"variants": {"all": Variant(methods=("b",)), "one": Variant(frames=1, methods=("a", "b"))}}
    )
    narrowed = study.restricted_to(["a", "demo"], 5.0)
    assert narrowed.methods == ("a", "demo")
    assert {title: variant.methods for title, variant in narrowed.variants.items()} == {
        "all": ("demo",),
        "one": ("a", "demo"),
    }
    assert narrowed.seconds == 5.0


def test_less_time_than_the_first_training_until_flat_is_refused() -> None:
    study = load_study("static-converged")
    assert study.restricted_to([], 10.0).seconds == 10.0
    with pytest.raises(InputError, match="--seconds 5: the first training of this study takes 10 s; give more"):
        study.restricted_to([], 5.0)


def test_methods_keep_the_order_of_the_study_and_own_presets_are_recognised() -> None:
    study = load_study("cameras").restricted_to(["idr", "demo", "nerf", "fast", "idr"], None)
    assert study.methods == ("fast", "nerf", "idr", "demo")
    assert all(variant.methods == study.methods for variant in study.variants.values())
    assert study.own_methods() == ["fast", "demo"]
    assert load_study("cameras").restricted_to(["nerf"], None).own_methods() == []


def test_compared_methods_end_by_time_not_by_steps() -> None:
    study = load_study("dynamic")
    steps = {name: study.settings(name).training.steps for name in ("fast", "paper", "neural-body", "nerfies")}
    assert steps == {"fast": 0, "paper": 10_000, "neural-body": 1_000_000, "nerfies": 1_000_000}
    forever = study.model_copy(update={"seconds": None})
    assert forever.settings("nerfies").training.steps == load_settings("nerfies").training.steps
