import json
from pathlib import Path
from typing import Any

import pytest
import torch

from hnerf.asset import subject as exported
from hnerf.asset.subject import export_subject
from hnerf.capture.masks import Masks
from hnerf.config import AssetSettings, load_settings
from hnerf.errors import InputError
from hnerf.render.motion import Motion
from tests.asset.figure import bending_body, capture
from tests.asset.stand_in import StandInAvatar
from tests.asset.test_blender import write_program
from tests.asset.test_export import TINY


def made(folder: Path) -> Path:
    """Return a subject's folder with the files that an export reads first, all of them empty."""
    for name in exported.NEEDED:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    with_model(folder, "fast")
    return folder


def with_model(folder: Path, preset: str) -> None:
    stored = {"static": True, "training": load_settings(preset).training.model_dump()}
    (folder / "training" / "settings.json").write_text(json.dumps(stored))


def test_motions_are_named_after_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = Motion(bending_body(), 25.0, "z")
    given: list[Any] = []
    monkeypatch.setattr(exported, "read_motion", lambda path: read)
    monkeypatch.setattr(exported, "recording_of", lambda subject: "capture")
    monkeypatch.setattr(exported.Masks, "load", lambda folder: "masks")
    monkeypatch.setattr(exported, "avatar_of", lambda subject: "avatar")
    monkeypatch.setattr(exported, "export_asset", lambda *arguments: given.extend(arguments) or {"frames": 4})
    motions = [tmp_path / "01 slow-walk.bvh", tmp_path / "ben", tmp_path / "take.001", tmp_path / "take.002"]
    for folder in motions[2:]:
        folder.mkdir()
    assert export_subject(made(tmp_path / "ada"), AssetSettings(), motions, tmp_path / "out", "01ab") == {"frames": 4}
    assert given[0] == "capture" and given[1] == "masks" and given[5] == "01ab"
    assert given[6] == dict.fromkeys(("01_slow_walk", "ben", "take_001", "take_002"), read)
    assert (tmp_path / "out").is_dir()


@pytest.mark.parametrize(
    "names", [["a.bvh", "sub/A.npz"], ["captured_24.bvh"], ["Captured.bvh"], ["!.bvh"], [f"{240 * 'a'}.bvh"]]
)
def test_names_that_clash_are_refused(names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported, "read_motion", lambda path: Motion(bending_body(), 25.0, "z"))
    with pytest.raises(InputError, match="rename the file"):
        export_subject(made(tmp_path / "ada"), AssetSettings(), [tmp_path / n for n in names], tmp_path / "out", "")
    assert not (tmp_path / "out").exists()


def test_an_unfinished_subject_is_refused(tmp_path: Path) -> None:
    made(tmp_path / "ada")
    (tmp_path / "ada/training/model.safetensors").unlink()
    with pytest.raises(InputError, match=r"model\.safetensors: missing; give <store>/subjects/<name>"):
        export_subject(tmp_path / "ada", AssetSettings(), [], tmp_path / "out", "")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("preset", ["idr", "nerf", "nerfies", "paper"])
def test_a_model_of_single_moments_cannot_be_exported(preset: str, tmp_path: Path) -> None:
    """In the rest pose, only the part of the recorded moment that lies in the body's box would remain."""
    with_model(made(tmp_path / "ada"), preset)
    with pytest.raises(InputError, match="new poses: train with preset fast, or with paper on several frames"):
        export_subject(tmp_path / "ada", AssetSettings(), [], tmp_path / "out", "")


def test_damaged_masks_are_reported_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported, "recording_of", lambda subject: "capture")
    monkeypatch.setattr(exported, "avatar_of", lambda subject: "avatar")
    with pytest.raises(InputError, match=r"ada/segmentation: damaged, or written by another version \("):
        export_subject(made(tmp_path / "ada"), AssetSettings(), [], tmp_path / "out", "")
    assert not (tmp_path / "out").exists()


def test_a_missing_blender_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported, "recording_of", lambda subject: pytest.fail("the subject was read"))
    with pytest.raises(InputError, match="absent: no such program"):
        export_subject(made(tmp_path / "ada"), AssetSettings(), [], tmp_path / "out", "", "absent")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("small_report")
@pytest.mark.parametrize("fails", [False, True])
def test_blender_adds_its_files_or_nothing_is_written(
    fails: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stand-in is asked first without a frame rate whether it can; then it gets the capture's, 10."""
    monkeypatch.setattr(exported, "recording_of", lambda subject: capture())
    monkeypatch.setattr(exported, "avatar_of", lambda subject: StandInAvatar(bending_body()))
    monkeypatch.setattr(exported.Masks, "load", lambda folder: Masks({}, {}))
    write = f"test -s avatar.usdz && printf %s $3 > avatar.fbx && echo points > avatar_cache.abc && exit {int(fails)}"
    program = write_program(tmp_path / "python", f'shift; test "$2" = -- || exit 3; test $# = 2 || {{ {write}; }}')
    subject, before = made(tmp_path / "ada"), sorted(tmp_path.iterdir())
    if fails:
        with pytest.raises(InputError, match="python: exit code 1"):
            export_subject(subject, TINY, [], tmp_path / "out", "", program)
        assert sorted(tmp_path.iterdir()) == before
    else:
        report = export_subject(subject, TINY, [], tmp_path / "out", "", program)
        assert (tmp_path / "out" / "avatar.fbx").read_text() == "10.0"
        assert report["bytes"]["avatar.fbx"] == 4 and report["bytes"]["avatar_cache.abc"] == 7
        assert "blender" in report["seconds"]


def test_the_t_pose_is_that_of_the_subjects_own_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    for name, value in (("recording_of", "capture"), ("avatar_of", "avatar")):
        monkeypatch.setattr(exported, name, lambda subject, value=value: value)
    monkeypatch.setattr(exported.Masks, "load", lambda folder: "masks")
    monkeypatch.setattr(exported, "export_asset", lambda *arguments: given.extend(arguments) or {})
    subject = made(tmp_path / "ada")
    bending_body().save(subject / "training")
    export_subject(subject, AssetSettings(), [Path("t-pose")], tmp_path / "out", "")
    assert list(given[6]) == ["t_pose"] and given[6]["t_pose"].body.frames == (0,)
    torch.testing.assert_close(given[6]["t_pose"].body.rig.vertices_m, bending_body().rig.vertices_m)
