import errno
import json
import logging
import shutil
import time
from pathlib import Path

import pytest
from prefect import flow, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.context import FlowRunContext

from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tasks.bucket import VARIABLE
from tasks.policy import LOGGERS
from tasks.source import Source, read_capture
from tasks.stage import RETRIES, Stage, image_count, retried, stage
from tasks.store import Artifact, Store


@stage("copied", version="1")
def copy(out: Path, source: Source, settings: CaptureSettings) -> dict[str, float]:
    """Write the source's text in capitals."""
    _count(out)
    (out / "text").write_text((source.root / "text").read_text().upper())
    return {}


@stage("doubled", version="1")
def double(out: Path, copied: Artifact) -> dict[str, float]:
    """Write the text twice."""
    _count(out)
    (out / "text").write_text(2 * (copied.root / "text").read_text())
    return {}


@stage("flaky", version="1")
def flaky(out: Path, source: Source) -> dict[str, float]:
    """Fail on the first call, with the error that the source names."""
    _count(out)
    if len(calls(out.parent.parent)) == 1:
        error = {"io": OSError("disk"), "bad": InputError("a.jpg: bad"), "gone": FileNotFoundError("a.jpg")}
        raise error[(source.root / "text").read_text()]
    return {}


def _count(out: Path) -> None:
    with (out.parent.parent / "calls").open("a") as counted:
        counted.write(f"{out.parent.name}\n")


def calls(store: Path) -> list[str]:
    """Return the names of the stages that did work in a store, in order."""
    counted = store / "calls"
    return counted.read_text().split() if counted.exists() else []


@pytest.fixture
def source(tmp_path: Path) -> Source:
    (tmp_path / "ada").mkdir()
    (tmp_path / "ada" / "text").write_text("ab")
    return read_capture(tmp_path / "ada")[0]


@flow
def chain(store: Path, source: Source) -> tuple[str, str]:
    """Run two fake stages in a flow; return the resulting text and the id of the flow run."""
    doubled = double(Store(store), copy(Store(store), source, CaptureSettings()))
    context = FlowRunContext.get()
    return (doubled.root / "text").read_text(), str(context.flow_run.id) if context and context.flow_run else ""


def states(flow_run_id: str) -> list[str]:
    """Return the names of the states in which the two tasks of a flow run ended, in order of their start. The server
    learns of them from events, a little later."""
    chosen = FlowRunFilter(id=FlowRunFilterId(any_=[flow_run_id]))
    deadline = time.monotonic() + 60
    with get_client(sync_client=True) as client:
        runs = client.read_task_runs(flow_run_filter=chosen)
        while sum(bool(run.state and run.state.is_final()) for run in runs) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
            runs = client.read_task_runs(flow_run_filter=chosen)
    return [run.state_name or "" for run in sorted(runs, key=lambda run: run.start_time or run.expected_start_time)]


def test_without_a_server_each_stage_runs_once(tmp_path: Path, source: Source) -> None:
    assert chain.fn(tmp_path, source) == ("ABAB", "")
    assert chain.fn(tmp_path, source) == ("ABAB", "")
    assert calls(tmp_path) == ["copied", "doubled"]


def test_other_settings_repeat_a_stage_but_not_later_ones_if_its_result_is_equal(
    tmp_path: Path, source: Source
) -> None:
    store = Store(tmp_path)
    first = double(store, copy(store, source, CaptureSettings()))
    second = double(store, copy(store, source, CaptureSettings(max_side_px=64)))
    assert calls(tmp_path) == ["copied", "doubled", "copied"]
    assert first == second


def test_the_image_count_is_that_of_the_largest_recording(tmp_path: Path) -> None:
    """Two recordings with two cameras each and 2 and 5 frames: 10 images."""
    recordings = []
    for frames in (2, 5):
        (tmp_path / str(frames)).mkdir()
        described = {"cameras": ["a", "b"], "train_frames": list(range(frames - 1)), "novel_pose_frames": [frames - 1]}
        (tmp_path / str(frames) / "capture.json").write_text(json.dumps(described))
        recordings.append(Artifact(stage="capture", root=tmp_path / str(frames), files={}))
    assert image_count([*recordings, None]) == image_count([None, tuple(recordings)]) == 10
    assert image_count([CaptureSettings()]) == image_count([None]) == 1


def test_machines_that_share_a_bucket_run_each_stage_once(
    tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bucket").mkdir()
    monkeypatch.setenv(VARIABLE, f"file://{tmp_path}/bucket")
    assert chain.fn(tmp_path / "here", source) == chain.fn(tmp_path / "there", source) == ("ABAB", "")
    assert calls(tmp_path / "here") == ["copied", "doubled"]
    assert calls(tmp_path / "there") == []


def test_an_installed_network_changes_the_artifact(
    tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the network is absent, the artifact stays the same."""
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "networks"))
    store, scored = Store(tmp_path), Stage(copy.write, "copied", "1", False, networks=("eye.ckpt",))
    without = scored(store, source, CaptureSettings())
    assert scored(store, source, CaptureSettings()) == without
    (tmp_path / "networks").mkdir()
    (tmp_path / "networks" / "eye.ckpt").touch()
    assert scored(store, source, CaptureSettings()).root != without.root
    assert calls(tmp_path) == ["copied", "copied"]


def test_prefect_and_plain_calls_share_the_store(prefect_api: str, tmp_path: Path, source: Source) -> None:
    chain.fn(tmp_path, source)
    text, run = chain(tmp_path, source)
    assert text == "ABAB"
    assert states(run) == ["Completed", "Completed"]
    assert calls(tmp_path) == ["copied", "doubled"]


def test_second_flow_run_is_cached_until_an_artifact_is_damaged(
    prefect_api: str, tmp_path: Path, source: Source
) -> None:
    chain(tmp_path, source)
    _, again = chain(tmp_path, source)
    assert states(again) == ["Cached", "Cached"]
    (copied,) = (tmp_path / "copied").glob("*/text")
    copied.write_text("XX")
    text, repaired = chain(tmp_path, source)
    assert (text, copied.read_text()) == ("ABAB", "AB")
    assert states(repaired) == ["Completed", "Cached"]
    assert calls(tmp_path) == ["copied", "doubled", "copied"]


def test_a_flow_run_uploads_artifacts_that_the_bucket_lacks(
    prefect_api: str, tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain(tmp_path, source)
    (tmp_path / "bucket").mkdir()
    monkeypatch.setenv("HNERF_BUCKET", f"file://{tmp_path}/bucket")
    chain(tmp_path, source)
    assert len(list((tmp_path / "bucket").rglob("*.tar"))) == 2
    assert calls(tmp_path) == ["copied", "doubled"]


def test_an_artifact_recomputed_outside_prefect_replaces_its_record(
    prefect_api: str, tmp_path: Path, source: Source
) -> None:
    chain(tmp_path, source)
    shutil.rmtree(tmp_path / "copied")
    (source.root / "text").write_text("cd")  # as if the stage were not deterministic: `source` keeps its old digest
    copy(Store(tmp_path), source, CaptureSettings())
    assert chain(tmp_path, source)[0] == "CDCD"


def test_stores_do_not_share_prefect_records(prefect_api: str, tmp_path: Path, source: Source) -> None:
    for store in (tmp_path / "a", tmp_path / "b", tmp_path / "a"):
        store.mkdir(exist_ok=True)
        chain(store, source)
    assert calls(tmp_path / "a") == calls(tmp_path / "b") == ["copied", "doubled"]


@flow
def flow_with_flaky_stage(store: Path, source: Source) -> None:
    """Run a stage that fails once."""
    flaky(Store(store), source)


@pytest.mark.parametrize(
    ("fault", "error", "attempts"), [("io", None, 2), ("bad", InputError, 1), ("gone", FileNotFoundError, 1)]
)
def test_only_transient_errors_are_retried(
    prefect_api: str,
    tmp_path: Path,
    source: Source,
    monkeypatch: pytest.MonkeyPatch,
    fault: str,
    error: type[Exception] | None,
    attempts: int,
) -> None:
    monkeypatch.setattr(flaky.task, "retry_delay_seconds", 0)
    (source.root / "text").write_text(fault)
    if error:
        with pytest.raises(error):
            flow_with_flaky_stage(tmp_path, read_capture(source.root)[0])
    else:
        flow_with_flaky_stage(tmp_path, read_capture(source.root)[0])
    assert calls(tmp_path) == attempts * ["flaky"]


def test_reading_a_recording_is_retried_in_a_flow_run(prefect_api: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RETRIES, "retry_delay_seconds", 0)
    tried = []

    def read(folder: str) -> str:
        tried.append(folder)
        if len(tried) < 3:
            raise OSError(errno.ESTALE, "Stale file handle")
        return folder

    assert flow(lambda: retried(read)("ada"), name="reading")() == "ada" and len(tried) == 3
    tried.clear()
    with pytest.raises(OSError, match="Stale"):
        retried(read)("ada")


def test_a_refusal_is_logged_without_a_traceback(
    prefect_api: str, tmp_path: Path, source: Source, capfd: pytest.CaptureFixture[str]
) -> None:
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(logging.Formatter().format(record))
    (source.root / "text").write_text("bad")
    loggers = [logging.getLogger(name) for name in LOGGERS]
    for logger in loggers:
        logger.addHandler(handler)
    try:
        with pytest.raises(InputError):
            flow_with_flaky_stage(tmp_path, read_capture(source.root)[0])
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
    assert any("a.jpg: bad" in line for line in lines)
    assert "Traceback" not in "\n".join(lines) + capfd.readouterr().err
