import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from flows.cli import CACHES, CAMERA_FORMATS, ORBIT_PICTURES, PICTURES, SIZES_PX, STATURE_M, main
from flows.commands import _frame_counts
from flows.train_subject import Trained, train_subject
from hnerf import synthetic
from hnerf.body.bvh import read_bvh
from hnerf.calibration.diagnosis import BODY_HEIGHT_M
from hnerf.capture.formats.export import WRITERS
from hnerf.config import AssetSettings, SyntheticSettings
from hnerf.errors import InvalidAsset
from hnerf.geometry.camera import Camera
from hnerf.render.subject import MAX_SIZE_PX, MIN_SIZE_PX, OUTPUT_KINDS, RenderOptions
from hnerf.render.subject import ORBIT_PICTURES as PICTURES_OF_AN_ORBIT
from tasks.bucket import BucketError
from tasks.launcher import LostWorkerError, RankFailedError
from tasks.limits import StalledError, current_limits
from tasks.store import Store
from tests.asset.figure import FRAMES, bending_body
from tests.capture.recordings import write_easymocap
from tests.shared_data import shared_capture


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("run absent", "absent: no such folder or video; give the capture folder, or one video"),
        ("check-cameras absent", "absent: no such folder"),
        ("stability absent", "absent: no such folder"),
        ("render absent", "absent: no such folder; give <store>/subjects/<name> of a finished `hnerf run`"),
        ("calibrate absent", "absent: no such folder"),
        (f"calibrate {__file__}", "test_cli.py: is not a folder; give the capture folder"),
        ("calibrate . --lens absent.yml", "absent.yml: no such file; give --lens another"),
        ("calibrate . --height 1.8", "hnerf: --height: has no effect with --from boards; leave it out, or give"),
        ("calibrate . --from person --ground-frame 0", "--ground-frame: has no effect with --from person"),
        ("export absent", "absent: no such folder; give <store>/subjects/<name> of a finished `hnerf run`"),
        ("export . --motion a.bvh", "a.bvh: no such file; give a BVH file, an AMASS .npz, another"),
        ("export . --blender absent", "absent: no such program; give --blender Blender 4.5 or newer, or a"),
        ("render . --motion a.npz", "a.npz: no such file; give a BVH file, an AMASS .npz, another"),
        ("export . --set asset.bones=up", "hnerf: --set asset.bones=up: asset.bones: Input should be 'along'"),
        (
            "export . --set training.steps=3",
            "hnerf: --set training.steps=3: this command takes settings of the section `asset`",
        ),
        ("synchronise . --set asset.bones=up", "this command takes settings of the section `limits` only; remove it"),
        ("run http://example.com/x.mp4", "http://example.com/x.mp4: is no bucket; download it and give the file"),
        ("run s3://", "hnerf: s3://: names no bucket; give a URL like s3://bucket/folder"),
        ("run s3:///captures/ada", "hnerf: s3:///captures/ada: names no bucket; give a URL like"),
        ("run absent --preset best", "best: no such preset or file; there are "),
        ("run absent --set steps=1", "steps: no such key; it belongs in another section"),
        ("run absent --set training.stepz=1", "training.stepz: no such key; did you mean steps?"),
        ("run absent --set training.noise=.inf", "training.noise: Input should be a finite number"),
        ("run absent --set training.field.colour_cells=[8,-3]", "training.field.colour_cells.1"),
        ("run absent --set training.field.colour_cells=8,16", "colour_cells: is not a list; write it like [8,16]"),
        ("run absent --set training=8", "training: is a section; give its keys, each with a value"),
        ("run absent --set training.field=8", "training.field: is a section; give its keys, each with"),
        ("fit . --store results --out results", "results: lies in the store, where stages write; give another"),
        ("fit . --store results --out results/fit", "results/fit: lies in the store, where stages write; give another"),
        ("synth .", "exists; give the name of a new folder"),
        ("synth ring --set cameras=32", "cameras: no such key; did you mean test_cameras?"),
    ],
)
def test_the_error_of_bad_input_is_one_line_with_exit_code_2(
    command: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hnerf: ")
    assert message in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (RankFailedError("the surface is empty: check masks"), "the surface is empty: check masks"),
        (InvalidAsset("avatar.usdz: there is no mesh;\nno skeleton"), "avatar.usdz: there is no mesh; no skeleton"),
        (LostWorkerError("hnerf.training.run: rank 0 was killed"), "hnerf.training.run: rank 0 was killed"),
        (StalledError("fit: ended, no progress for 9 s", retryable=False), "fit: ended, no progress for 9 s"),
        (BucketError("s3://x/fit/k.tar: no answer"), "s3://x/fit/k.tar: no answer"),
        (
            OSError(errno.EIO, "Input/output error", "a.jpg"),
            "[Errno 5] Input/output error: 'a.jpg'; give the same command again",
        ),
        (
            OSError(errno.ENOSPC, "No space left", "b"),
            "[Errno 28] No space left: 'b'; make room and give the same command again",
        ),
        (
            OSError("a.png: cannot be written; is the disk full?"),
            "a.png: cannot be written; is the disk full?; make room and give the same command again",
        ),
    ],
)
def test_the_error_of_a_failed_run_is_one_line_with_exit_code_1(
    error: Exception, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_subject, "fn", Mock(side_effect=error))
    assert main(["run", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"hnerf: {line}\n"


def test_the_error_of_a_store_that_cannot_be_created_is_one_line_with_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ada").mkdir()
    (tmp_path / "plain").touch()
    for store, why in ((tmp_path / "plain" / "x", "Not a directory"), (tmp_path / ("x" * 300), "File name too long")):
        assert main(["check-cameras", str(tmp_path / "ada"), "--store", str(store)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"hnerf: {store}") and why in line


@pytest.mark.parametrize(
    ("variable", "missing", "cache"),
    [
        ("HOME", "", "/.cache"),
        ("HOME", "/.cache/warp/1", "/.cache"),
        ("WARP_CACHE_PATH", "/1", ""),
        ("TMPDIR", "", None),
    ],
)
def test_the_error_of_a_cache_that_cannot_be_used_names_its_variable(
    variable: str, missing: str, cache: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    place = f"{tmp_path}/absent"
    for other in CACHES:
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(variable, place)
    lost = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), place + missing)
    monkeypatch.setattr(train_subject, "fn", Mock(side_effect=lost))
    assert main(["run", str(tmp_path)]) == 2
    remedy = f"it is needed for the cache {place}{cache}; mend it, or let {variable} name another folder"
    remedy = remedy if cache is not None else "give another path, or mend this one"
    assert capsys.readouterr().err == f"hnerf: {place}{missing}: No such file or directory; {remedy}\n"


def test_an_unexpected_error_keeps_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (OSError(errno.EBADF, "Bad file descriptor", "a.jpg"), RuntimeError("a shape is wrong")):
        monkeypatch.setattr(train_subject, "fn", Mock(side_effect=error))
        with pytest.raises(type(error), match=str(error.args[-1])):
            main(["run", str(tmp_path)])


def test_a_loop_of_links_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop").symlink_to("loop")
    assert main(["store", "list", "--store", str(tmp_path / "loop")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "loop" in line and line.endswith("give another path, or mend this one")


def test_an_empty_path_is_not_taken_for_the_current_folder(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["store", "list", "--store", ""])
    assert capsys.readouterr().err.endswith("error: argument --store: is empty; give a path\n")
    assert main(["run", ""]) == 2


def test_a_current_folder_that_was_removed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Torch's library ends the process there, even if all paths are absolute."""
    (tmp_path / "ada").mkdir()
    monkeypatch.chdir(tmp_path / "ada")
    (tmp_path / "ada").rmdir()
    assert main(["store", "list"]) == 2
    assert capsys.readouterr().err == "hnerf: the current folder was removed; change to another one\n"


def test_a_path_that_is_not_utf8_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """OpenCV, which gets no name for it, would write to address 0."""
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    with pytest.raises(SystemExit, match="2"):
        main(["synth", str(folder / "ada")])
    assert capsys.readouterr().err.endswith("caf\ufffd/ada is not UTF-8; rename it\n")
    folder.mkdir()
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="2"):
        main(["store", "list"])
    assert "caf\ufffd/store is not UTF-8; rename it" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):  # not later, when the name has been logged
        main(["run", str(folder)])
    assert capsys.readouterr().err.endswith("caf\ufffd is not UTF-8; rename it\n")


def test_commands_that_read_a_recording_accept_its_memory_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error message about too little memory advises users to raise this setting."""
    found = []
    monkeypatch.setattr("tasks.cage.run_caged", lambda *_, **__: found.append(current_limits().reader_gib))
    for command in (["calibrate"], ["synchronise"], ["export-cameras", "--format", "colmap"]):
        where = [] if command == ["synchronise"] else ["--out", str(tmp_path / command[0])]
        (tmp_path / "ada").mkdir(exist_ok=True)
        assert main([*command, str(tmp_path / "ada"), *where, "--set", "limits.reader_gib=20"]) == 0
    assert found == [20, 20, 20]


def test_commands_that_write_cameras_never_overwrite_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ada").mkdir()
    for command in (
        ["export-cameras", str(tmp_path / "ada"), "--format", "easymocap"],
        ["calibrate", str(tmp_path / "ada")],
    ):
        assert main([*command, "--out", str(tmp_path / "ada")]) == 2
        assert "exists; give the name of a new folder" in capsys.readouterr().err
    assert main(["export-cameras", str(tmp_path / "ada"), "--format", "colmap", "--out", str(tmp_path / "new")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["ada"]


def test_cameras_are_not_exported_into_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """That would change the recording's digest, and with it the key of every result."""
    folder = write_easymocap(tmp_path / "ada")
    before = sorted(folder.iterdir())
    monkeypatch.chdir(folder)
    assert main(["export-cameras", str(folder), "--format", "colmap", "--out", "cameras"]) == 2
    assert "cameras: lies in the recording" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before
    assert main(["fit", str(folder)]) == 2
    assert "motion: lies in the recording" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before
    assert main(["export-cameras", str(folder), "--format", "colmap", "--out", "../ada-cameras"]) == 0


@pytest.mark.parametrize("command", ["render .", "export ../ada", "store export ada --store ../.."])
def test_nothing_new_is_written_into_the_recording(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The subject's folder records where its recording is."""
    store, recording = Store(tmp_path / "store"), tmp_path / "recordings" / "ada"
    recording.mkdir(parents=True)
    store.claim("ada", "d" * 64, recording)
    monkeypatch.chdir(store.subject_folder("ada"))
    assert main([*command.split(), "--out", f"{recording}/new"]) == 2
    assert f"hnerf: {recording}/new: lies in the recording" in capsys.readouterr().err
    assert main([*command.split(), "--out", "new"]) == 2  # refused, but only because there are no results
    assert "lies in the recording" not in capsys.readouterr().err
    assert list(recording.iterdir()) == []


@pytest.mark.parametrize("command", ["render ada", "export ada", "store export ada"])
def test_nothing_new_is_written_into_an_artifact(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise `hnerf store verify` would report a fault from then on."""
    monkeypatch.chdir(tmp_path)
    artifact = Store(tmp_path / "store").get_or_compute("asset", "ab" * 16, lambda _: {})
    Path("ada").mkdir()
    Path("ada/asset").symlink_to(artifact.root)
    assert main([*command.split(), "--out", "ada/asset/new"]) == 2
    assert "hnerf: ada/asset/new: lies in the results of a run" in capsys.readouterr().err


def test_unreadable_capture_leaves_nothing_half_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ada").mkdir()
    (tmp_path / "ada" / "notes.txt").write_text("no cameras here")
    assert main(["run", str(tmp_path / "ada"), "--store", str(tmp_path / "store")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ada"]


@pytest.mark.parametrize("command", ["run", "check-cameras"])
@pytest.mark.parametrize("key", ["fit.body_model", "segmentation.model", "detection.model"])
def test_a_file_that_a_setting_names_is_missed_before_any_stage(
    command: str, key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_easymocap(tmp_path / "ada")
    section, name = key.split(".")
    Path("mine.yaml").write_text(f"{{based_on: fast, {section}: {{{name}: absent.npz}}}}")
    assert main([command, "ada", "--preset", "mine.yaml"]) == 2
    why = "no such file; correct the path, or leave it out"
    assert capsys.readouterr().err == f"hnerf: {key}: absent.npz: {why}\n"
    assert not Path("store").exists()


def test_check_cameras_prints_every_camera_and_the_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for drawn in ("cameras", "evidence"):  # drawing takes seconds
        monkeypatch.setattr(f"hnerf.calibration.report.draw_{drawn}", lambda *_: None)
    chosen = [
        f"--set={setting}" for setting in ("detection.hands=none", "capture.max_frames=4", "capture.max_side_px=128")
    ]
    assert main(["check-cameras", str(shared_capture("valid-wave")), "--store", str(tmp_path), *chosen]) == 0
    lines = capsys.readouterr().out.splitlines()
    table = lines[next(i for i, line in enumerate(lines) if line.startswith("camera ")) :]
    report = json.loads(next(tmp_path.glob("calibration/*/report.json")).read_text())
    assert [line.split()[0] for line in table[1 : 1 + len(report["cameras"])]] == list(report["cameras"])
    assert f"verdict: {report['verdict']}" in table
    for name in ("05", "06"):
        assert f"{name:<12} not judged: a camera for testing" in table


def test_fit_writes_the_motion_and_says_how_good_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The frames 3, 4, 5 and 8 are fitted. The camera is 4 m in front of the body, so a pixel spans 20 mm."""
    monkeypatch.chdir(tmp_path)
    intrinsics = np.array([[200.0, 0, 32], [0, 200, 32], [0, 0, 1]])
    camera = Camera("01", intrinsics, np.eye(3), np.array([0, 0, 3.5]), 64, 64)
    capture = Mock(up="z", fps=10.0, frames=FRAMES, cameras={"01": camera}, train_cameras=("01",))
    report = {
        "stature_m": 1.7, "poor_frames": [5], "doubts": ["one camera does not determine depth"],
        "frames": FRAMES, "keypoint_residual_px": [1.0, 2.0, 6.0, None],
    }  # fmt: skip
    cameras = {"01": {"status": "ok", "median_px": 1.25}, "02": {"status": "rejected", "median_px": None}}
    checked = {"doubts": ["the light changes"], "cameras": cameras}
    prepared = fitted(monkeypatch, tmp_path, capture, calibration=checked, body=report)
    bending_body().save(prepared.body.root)
    assert main(["fit", str(write_easymocap(tmp_path / "ada")), "--set", "asset.joint_names=ue5"]) == 0
    assert capsys.readouterr().out.splitlines()[-9:] == [
        "the light changes",
        "one camera does not determine depth",
        "cameras: 01 ok (1.2 px), 02 rejected; `hnerf check-cameras` says more",
        "keypoints: 2.0 px from the body's, about 40 mm; most in frame 5: 6.0 px",
        "stature: 1.70 m",
        "fitted poorly: [5]",
        "frames: 3 to 8, 10 a second: 4 fitted, 2 interpolated; for a pose in every frame, raise capture.max_frames",
        f"report: {tmp_path / 'body' / 'report.json'}",
        "motion: motion/motion.bvh, motion/motion.trc",
    ]
    assert read_bvh(Path("motion/motion.bvh")).names[0] == "pelvis"
    assert sorted(path.name for path in Path("motion").iterdir()) == ["motion.bvh", "motion.trc"]


def test_fit_refuses_frames_far_apart_before_it_looks_at_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four frames, 3 to 8, at 1 a second lie 5 / 3 s apart on average."""
    monkeypatch.chdir(tmp_path)
    fitted(monkeypatch, tmp_path, Mock(fps=1.0, frames=FRAMES))
    monkeypatch.setattr("flows.preparation.with_detections", Mock(side_effect=AssertionError))
    assert main(["fit", str(write_easymocap(tmp_path / "ada"))]) == 2
    why = "frames are more than 0.7 s apart on average; give --set capture.max_frames=100000, or list more frames"
    assert why in capsys.readouterr().err
    assert not Path("motion").exists()


def fitted(monkeypatch: pytest.MonkeyPatch, folder: Path, capture: Mock, **reports: dict[str, Any]) -> Mock:
    """Let all stages of `hnerf fit` find a capture and these reports in a folder; return the results."""
    prepared = Mock()
    for stage, report in reports.items():
        getattr(prepared, stage).root = folder / stage
        (folder / stage).mkdir()
        (folder / stage / "report.json").write_text(json.dumps(report))
    for name in ("ingest_recording", "with_detections"):
        monkeypatch.setattr(f"flows.preparation.{name}", Mock())
    monkeypatch.setattr("flows.preparation.prepare_training", lambda *_: prepared)
    monkeypatch.setattr("hnerf.capture.capture.Capture.load", lambda _: capture)
    monkeypatch.setattr("tasks.calibration.calibrated_capture", lambda *_: capture)
    return prepared


@pytest.mark.parametrize(
    ("fps", "counts"),
    [(30, "5 fitted, 18 interpolated;"), (20, "5 fitted, 3 interpolated, 15 held in gaps over 0.7 s;")],
)
def test_fit_counts_the_frames_that_it_made_up(fps: float, counts: str) -> None:
    """Frames 2 to 4 lie between two poses, and 8 to 22 between two that are 16 frames apart: 0.53 or 0.8 s."""
    assert f"a second: {counts}" in _frame_counts((1, 5, 6, 7, 23), fps)
    assert _frame_counts((5, 6, 7), fps).endswith("a second: 3 fitted")


def test_synth_takes_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[SyntheticSettings] = []
    monkeypatch.setattr(synthetic, "write_synthetic_capture", lambda out, settings: written.append(settings))
    assert main(["synth", str(tmp_path / "ring"), "--set", "train_cameras=32", "--set", "train_frames=1"]) == 0
    assert main(["synth", str(tmp_path / "ada")]) == 0
    assert written == [SyntheticSettings(train_cameras=32, train_frames=1), SyntheticSettings()]


def test_an_interrupted_synth_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(out: Path, settings: object) -> None:
        (out / "half").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(synthetic, "write_synthetic_capture", interrupted)
    assert main(["synth", str(tmp_path / "ada")]) == 130
    assert capsys.readouterr().err == "hnerf: interrupted\n"
    assert list(tmp_path.iterdir()) == []


def test_help_and_refusals_import_no_heavy_libraries() -> None:
    code = """
import sys
from contextlib import suppress
from flows.cli import main
other_section = ["export", ".", "--set", "training.steps=3"]
taken = [[command, ".", "--out", "."] for command in ("render", "export")]
for arguments in (["--help"], ["run", "--help"], ["run", "absent"], ["run"], ["settings"], other_section, *taken):
    with suppress(SystemExit):
        main(arguments)
    heavy = {"torch", "prefect", "warp", "cv2", "numpy", "scipy", "rich"} & set(sys.modules)
    assert not heavy, (arguments, heavy)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_the_first_output_line_names_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_subject, "fn", lambda *_: Trained(tmp_path, tmp_path, tmp_path))
    assert main(["run", str(tmp_path)]) == 0
    first, *_ = capsys.readouterr().out.splitlines()
    assert first.endswith(f" hnerf: run {tmp_path}")


def test_a_closed_output_pipe_ends_a_command_quietly() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    code = "import sys; from flows.cli import main; sys.exit(main(['settings']))"
    ended = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, b"")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("render . --size 0", "--size: give a whole number from 2 to 8000"),
        ("render . --size 8001", "--size: give a whole number from 2 to 8000"),
        ("render . --size nan", "--size: give a whole number from 2 to 8000"),
        ("render . --pictures 0", "--pictures: give a whole number from 1 to 999999"),
        ("render . --pictures 10000000000", "--pictures: give a whole number from 1 to 999999"),
        ("render . --radius nan", "--radius: give a number from 0.1 to 1000"),
        ("render . --radius -1", "--radius: give a number from 0.1 to 1000"),
        ("render . --height inf", "--height: give a number from -1000 to 1000"),
        ("render . --volume -101", "--volume: give a number from -100 to 1000"),
        ("render . --between 0 -1", "--between: give a whole number from 0 to 999999"),
        ("calibrate . --fov 0", "--fov: give a number from 1 to 170"),
        ("calibrate . --height 1e9", "--height: give a number from 0.5 to 2.3"),
        ("calibrate . --ground-frame x", "--ground-frame: give a whole number from 0 to 999999"),
        ("benchmark . --seconds -3", "--seconds: give a number from 0.1 to 1000000"),
        ("benchmark . --methods ,", "--methods: give one name or more"),
        ("render . --what ,", "--what: give one name or more"),
        ("store gc --keep 0", "--keep: give a whole number from 1 to 999999"),
    ],
)
def test_the_error_of_an_invalid_option_value_states_the_valid_range(
    arguments: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments.split())
    assert capsys.readouterr().err.endswith(f"error: argument {message}\n")


def test_the_module_can_be_run_as_the_command() -> None:
    command = [sys.executable, "-m", "flows.cli", "settings", "--preset", "nope"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2 and "nope: no such preset" in ended.stderr


def test_choices_and_ranges_match_the_library() -> None:
    assert tuple(WRITERS) == CAMERA_FORMATS
    assert OUTPUT_KINDS == PICTURES
    assert (MIN_SIZE_PX, MAX_SIZE_PX) == SIZES_PX
    assert BODY_HEIGHT_M == STATURE_M
    assert PICTURES_OF_AN_ORBIT == ORBIT_PICTURES


def test_the_list_of_image_kinds_may_contain_spaces_and_duplicates(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[RenderOptions] = []
    monkeypatch.setattr("hnerf.render.subject.render_subject", lambda _, wanted, __: asked.append(wanted) or 1)
    for given in ([], ["--what", "colour, mask,colour"]):
        assert main(["render", str(tmp_path), "--out", str(tmp_path / "new"), *given]) == 0
    assert [wanted.what for wanted in asked] == [("colour",), ("colour", "mask")]


@pytest.mark.parametrize(("flags", "allowed"), [([], False), (["--allow-poor"], True)])
def test_a_flag_accepts_a_poor_asset(
    flags: list[str], allowed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[AssetSettings] = []

    def export(_subject: Path, settings: AssetSettings, *_: object) -> dict[str, dict[str, object]]:
        given.append(settings)
        return {"motions": {}}

    monkeypatch.setattr("hnerf.asset.subject.export_subject", export)
    monkeypatch.setattr("tasks.store.require_intact", lambda folder: None)
    monkeypatch.setattr("tasks.store.recording_digest", lambda folder: "01ab")
    assert main(["export", str(tmp_path), *flags]) == 0
    assert [settings.allow_poor for settings in given] == [allowed]
