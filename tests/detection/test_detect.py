"""Detection adds keypoints to a capture without any; tested on the shared capture too if the networks are installed."""

import dataclasses
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings, DetectionSettings
from hnerf.detection import detect as module
from hnerf.detection.detect import detect, find_in_camera, with_keypoints
from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region
from hnerf.errors import InputError
from hnerf.models import SHA256, has_model
from tests.calibration.synthetic import edited_keypoints
from tests.capture.recordings import write_easymocap
from tests.detection.made_up import MadeUp
from tests.detection.orphans import processor_limits_s
from tests.shared_data import shared_capture

NETWORK, BOTH = DetectionSettings(source="network"), DetectionSettings(source="both")
LIMBS = [2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14]


def test_keypoints_come_from_the_network_and_the_rest_from_the_recording(recording: Capture, tmp_path: Path) -> None:
    report = detect(recording, NETWORK, tmp_path / "out")
    found = Capture.load(tmp_path / "out")
    keypoints = found.keypoints("01")
    assert keypoints is not None and keypoints.shape == (5, 1, 25, 3)
    assert keypoints[:, 0, 1].tolist() == [[5, 4, 0.5]] * 5
    assert keypoints[:, 0, [22, 20]].max() == 0  # outside the image; the network has no small toe
    assert found.keypoints("02") is None
    assert np.array_equal(found.image("02", 3), recording.image("02", 3))
    assert report["cameras"]["01"]["seen"] == 5
    mask = module.cv2.imread(str(tmp_path / "out" / "person" / "01" / "000002.png"), module.cv2.IMREAD_GRAYSCALE)
    assert mask.shape == (16, 24) and mask[4, 5] == 255 and mask[15, 23] == 0


def test_with_source_both_the_recordings_own_keypoints_are_kept_and_completed(
    recording: Capture, tmp_path: Path
) -> None:
    """Its person is where the network sees one, surer of all points but the right ankle, which it lacks."""
    with edited_keypoints(recording.root) as own:
        own["01"][:] = 5, 4, 0.9
        own["01"][:, :, 11] = 0
    detect(recording, BOTH, tmp_path / "out")
    kept = Capture.load(tmp_path / "out").keypoints("01")
    assert kept is not None and kept.shape == (5, 1, 25, 3)
    assert kept[:, 0, 11].tolist() == [[5, 4, 0.5]] * 5 and (np.delete(kept, 11, 2) == [5, 4, 0.9]).all()


def test_only_cameras_without_keypoints_get_those_of_the_network(recording: Capture, tmp_path: Path) -> None:
    """As when cameras are found from the person, where `detection.source` has no effect."""
    both = dataclasses.replace(recording, train_cameras=("01", "02"), test_cameras=())
    both.save()
    assert with_keypoints(both, tmp_path / "out") is both
    with edited_keypoints(recording.root) as own:
        del own["02"]
    found = with_keypoints(both, tmp_path / "out")
    kept, added = found.keypoints("01"), found.keypoints("02")
    assert kept is not None and np.array_equal(kept, own["01"]) and MadeUp.seen == 5
    assert added is not None and added[:, 0, 1].tolist() == [[5, 4, 0.5]] * 5


def test_recorded_hands_are_kept_with_the_recorded_people_only(recording: Capture, tmp_path: Path) -> None:
    np.savez(recording.root / "given_hands.npz", **{"01": np.ones((5, 1, 2, 21, 3))})
    for settings, kept in ((NETWORK, False), (BOTH, True)):
        detect(recording, settings, tmp_path / str(settings.source))
        assert Capture.load(tmp_path / str(settings.source)).has_given_hands is kept


def test_cameras_that_are_done_are_not_processed_again(recording: Capture, tmp_path: Path) -> None:
    detect(recording, NETWORK, tmp_path / "out")
    detect(recording, NETWORK, tmp_path / "out")
    assert MadeUp.seen == 5


@pytest.mark.parametrize("damage", [lambda whole: b"", lambda whole: whole[:60] + whole[61:]])
def test_a_camera_with_damaged_landmarks_is_processed_again(
    recording: Capture, tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    detect(recording, NETWORK, tmp_path / "out")
    landmarks = tmp_path / "out" / "landmarks" / "01.npz"
    whole = landmarks.read_bytes()
    landmarks.write_bytes(damage(whole))
    detect(recording, NETWORK, tmp_path / "out")
    assert MadeUp.seen == 10 and landmarks.read_bytes() == whole


def test_detection_is_reproducible_and_its_files_contain_no_timings(recording: Capture, tmp_path: Path) -> None:
    first, second = (detect(recording, NETWORK, tmp_path / name) for name in "ab")
    assert first["ms"].keys() == {"01"} and first["ms"] != second["ms"]
    one, other = (
        {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (tmp_path / "a", tmp_path / "b")
    )
    assert "detection.json" in one and "landmarks/01.npz" in one and one == other


def test_finding_nobody_is_a_one_line_error(
    recording: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LandmarkNetwork", lambda size: lambda image, region: None)
    with pytest.raises(InputError, match="folder: nobody found in any image of the training cameras; "):
        detect(recording, NETWORK, tmp_path / "out")


def test_a_network_that_finds_nobody_leaves_the_recordings_own_keypoints(
    recording: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LandmarkNetwork", lambda size: lambda image, region: None)
    detect(recording, DetectionSettings(), tmp_path / "out")
    kept, own = Capture.load(tmp_path / "out").keypoints("01"), recording.keypoints("01")
    assert kept is not None and own is not None and np.array_equal(kept, own)


def test_missing_networks_are_a_one_line_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "none"))
    capture = ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    with pytest.raises(InputError, match=r"pose_detection\.tflite: not there; run `hnerf models`"):
        detect(capture, NETWORK, tmp_path / "out")


def test_detected_joints_are_close_to_the_ground_truth(tmp_path: Path) -> None:
    """One frame of two cameras, each processed by its own worker. The median error of limb joints is below 8 px, for a
    person 333 px tall."""
    if not all(has_model(name) for name in SHA256):
        pytest.skip("the networks are not in the cache: `hnerf models` fetches them")
    source, folder = shared_capture("valid-walk"), tmp_path / "folder"
    folder.mkdir()
    for name in ("intri.yml", "extri.yml"):
        shutil.copyfile(source / name, folder / name)
    for path in source.glob("images/0[12]/000000.*"):
        write_image(folder / path.relative_to(source), read_rgb(path))
    (folder / "capture.toml").write_text('[cameras]\ntrain = ["01", "02"]\n')
    capture = ingest(folder, CaptureSettings(), tmp_path / "capture")
    detect(capture, NETWORK, tmp_path / "out")
    joints_m = np.load(source / "ground_truth" / "joints.npz")["positions"][0, LIMBS]
    for camera in capture.train_cameras:
        found = Capture.load(tmp_path / "out").keypoints(camera)
        assert found is not None
        true_px, _ = capture.cameras[camera].project(joints_m)
        assert np.median(np.linalg.norm(found[0, 0, LIMBS, :2] - true_px, axis=-1)) < 8


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_worker_outlives_a_stage_that_is_killed_or_interrupted(how: signal.Signals, tmp_path: Path) -> None:
    """The stage does not wait for its workers to finish either."""
    command = [sys.executable, "-m", "tests.detection.orphans", str(tmp_path)]
    stage = subprocess.Popen(command, cwd=Path(__file__).parents[2], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(list(tmp_path.iterdir())) < min(2, len(os.sched_getaffinity(0))):
        assert time.monotonic() < deadline and stage.poll() is None
        time.sleep(0.05)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    stage.send_signal(how)
    stage.wait(60)
    while any(Path(f"/proc/{worker}/exe").exists() for worker in workers):
        assert time.monotonic() < deadline, f"{workers} are still running"
        time.sleep(0.05)


def test_workers_do_not_keep_the_processor_time_that_a_reader_had_when_they_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reader's own progress raises its limit, but not that of its workers, which it would kill in the end."""
    monkeypatch.setattr(module, "find_in_camera", processor_limits_s)
    cameras: Any = SimpleNamespace(train_cameras=("01", "02"), frames=(0,))
    before = _, hard_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (100_000, hard_s))
    try:
        found: Any = module._find_people(cameras, NETWORK, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_CPU, before)
    assert found == dict.fromkeys(("01", "02"), (hard_s, hard_s))


def test_masks_are_stored_only_of_images_with_several_people(
    recording: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The five images of camera 01 show 1, 2, 0, 3 and 1 people; the nth person's mask has the value n of 255."""
    counts, number = [1, 2, 0, 3, 1], iter(range(1, 8))
    region = Region(np.array([5.0, 4.0]), 8.0, 0.0)

    def person() -> Person:
        return Person(np.ones((33, 3)), np.zeros((33, 3)), np.full((256, 256), next(number) / 255), region, region)

    monkeypatch.setattr(module, "track", lambda images, *_: [[person() for _ in range(count)] for count in counts])
    find_in_camera(recording, "01", NETWORK, tmp_path)
    with np.load(tmp_path / "landmarks" / "01.npz") as found:
        assert found["points_px"].shape == (5, 3, 33, 3)
        assert found["mask_rows"].tolist() == [0, 0, 2, 2, 5]
        assert found["masks"].dtype == np.uint8 and found["masks"].max((1, 2)).tolist() == [2, 3, 4, 5, 6]
