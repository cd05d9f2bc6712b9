import base64
import io
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from PIL import Image
from prefect import Flow, flow, get_client
from prefect.client.schemas.filters import ArtifactFilter, ArtifactFilterFlowRunId
from prefect.context import FlowRunContext

from flows import run_page
from flows.ablations import ablate
from flows.benchmark import benchmark
from flows.run_page import embedded, publish_link, publish_markdown, shown_progress, slug
from flows.stability import stability
from hnerf.errors import InputError
from hnerf.progress import Progress, report


def test_the_page_of_a_run_shows_progress_and_links(
    prefect_api: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_page, "UPDATE_S", 0.05)

    @flow
    def work() -> str:
        with shown_progress():
            report("body fit", 0, 8)
            report("short", 1, 1)
            for done in (1, 2):
                time.sleep(0.1)
                report("body fit", done, 8)
        report("body fit", 8, 8)  # no longer shown
        publish_link(tmp_path / "report.html", "report", "Report")
        context = FlowRunContext.get()
        return str(context.flow_run.id) if context and context.flow_run else ""

    run = work()
    chosen = ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run]))
    with get_client(sync_client=True) as client:
        found = {artifact.key: artifact for artifact in client.read_artifacts(artifact_filter=chosen)}
    assert found.keys() == {"body-fit", "report"}
    assert found["body-fit"].type == "progress" and found["body-fit"].data == 25.0
    assert f"file://{tmp_path}/report.html" in str(found["report"].data)


@pytest.mark.parametrize("study", [ablate, benchmark, stability])
def test_studies_show_their_progress(study: Flow[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: Path) -> None:
        report("ingestion", 1, 2)
        raise InputError("enough")

    shown = Mock()
    monkeypatch.setattr(run_page, "FlowRunContext", Mock())
    monkeypatch.setattr(run_page._ProgressPage, "show", shown)
    monkeypatch.setattr(f"{study.fn.__module__}.read_capture", read)
    with pytest.raises(InputError, match="enough"):
        study.fn(tmp_path, store=tmp_path)
    shown.assert_called_once_with(Progress("ingestion", 1, 2))


def test_a_run_whose_page_cannot_be_written_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(run_page, "FlowRunContext", Mock())
    for create in ("create_markdown_artifact", "create_link_artifact"):
        monkeypatch.setattr(run_page, create, Mock(side_effect=ConnectionError("refused")))
    publish_markdown("# ada", "result", "Result for ada")
    publish_link(tmp_path / "report.html", "report", "Report on ada")
    assert "Result for ada: is not on the page of the run: refused" in caplog.text
    assert "Report on ada: is not on the page of the run: refused" in caplog.text


def test_a_server_that_is_away_delays_the_work_by_a_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect repeats a request for a minute even if the server refuses each at once."""
    clock_s = 0.0

    def create(*_: object, **__: object) -> None:
        nonlocal clock_s
        clock_s += 76.0
        raise ConnectionError("refused")

    monkeypatch.setattr(run_page, "create_progress_artifact", create)
    monkeypatch.setattr(run_page, "time", Mock(monotonic=lambda: clock_s))
    page = run_page._ProgressPage()
    for done in range(4000):
        clock_s += 1.0
        page.show(Progress(f"camera {done // 100}", done % 100, 100))
    assert 4000 + 4 * 76 < clock_s < 1.15 * 4000


def test_images_are_shrunk_and_embedded(tmp_path: Path) -> None:
    Image.new("RGBA", (1280, 320), (255, 0, 0, 255)).save(tmp_path / "a.png")
    text = embedded([("front", tmp_path / "a.png")])
    head, _, uri = text.rstrip(")").partition("data:image/jpeg;base64,")
    assert head == "front\n\n![front]("
    assert Image.open(io.BytesIO(base64.b64decode(uri))).size == (640, 160)


def test_keys_contain_only_letters_digits_and_dashes() -> None:
    assert [slug(text) for text in ("Body fit", "camera Ä_1", "...")] == ["body-fit", "camera-1", "work"]
