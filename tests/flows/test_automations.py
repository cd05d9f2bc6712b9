import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from prefect import State, flow, get_client
from prefect.events import emit_event
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.states import Pending, Submitting

from flows.automations import lost_runs, main, set_up
from flows.ingest_captures import DISK_EVENT

PATIENCE_S = 90.0


@pytest.fixture
def webhook_calls() -> Iterator[tuple[str, list[Any]]]:
    """Yield the URL of a webhook, and the list of messages that it receives."""
    heard: list[Any] = []

    class Webhook(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            heard.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Webhook) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/", heard
        server.shutdown()


def test_setting_up_twice_makes_each_automation_once_and_calls_the_webhook(
    prefect_api: str, webhook_calls: tuple[str, list[Any]]
) -> None:
    url, heard = webhook_calls
    for _ in range(2):
        names = set_up(url, "local", 150)
    with get_client(sync_client=True) as client:
        known = {one.name: one for one in client.read_automations()}
        assert len(known) == len(names) == 5 and known.keys() == set(names)
        assert known["hnerf: late runs"].trigger.match_related.root["prefect.resource.name"] == "ingest-captures"
        deadline = time.monotonic() + PATIENCE_S
        while not heard and time.monotonic() < deadline:  # the server rereads automations only from time to time
            resource = {"prefect.resource.id": "hnerf.store./store", "prefect.resource.name": 'the "store"'}
            emit_event(DISK_EVENT, resource=resource, payload={"free_gib": 1.5})
            time.sleep(1)
        for automation in known.values():
            client.delete_automation(automation.id)
    assert heard[0] == {"text": 'store the "store": 1.5 GiB are free; nothing is started'}


def test_without_a_webhook_only_lost_runs_are_ended(prefect_api: str) -> None:
    assert set_up(None, "local", 150) == ["hnerf: lost runs"]
    with get_client(sync_client=True) as client:
        (automation,) = client.read_automations_by_name("hnerf: lost runs")
        assert automation.trigger.within.total_seconds() == 150
        client.delete_automation(automation.id)


def test_every_sign_of_life_of_a_run_resets_the_silence() -> None:
    trigger = lost_runs(150).trigger
    signs = ("heartbeat", "Pending", "Submitting", "InfrastructurePending", "pull-step.executed")
    assert trigger.after == {f"prefect.flow-run.{sign}" for sign in signs} and trigger.posture == "Proactive"


@pytest.mark.soak
@pytest.mark.parametrize("pulled", [False, True])
@pytest.mark.parametrize("state", [Pending, Submitting])
def test_a_run_crashes_if_its_worker_is_lost_before_the_run_begins(
    prefect_api: str, state: Callable[[], State], pulled: bool
) -> None:
    """Without a heartbeat, such a run would otherwise stay pending forever."""
    with get_client(sync_client=True) as client:
        automation = client.create_automation(lost_runs(10))
        time.sleep(5)  # until the server has read it
        run = client.create_flow_run(flow(lambda: None, name="begun"))
        client.set_flow_run_state(run.id, state())
        if pulled:  # its process lived long enough to change into the folder of the deployment
            emit_event(
                "prefect.flow-run.pull-step.executed", resource={"prefect.resource.id": f"prefect.flow-run.{run.id}"}
            )
        deadline = time.monotonic() + PATIENCE_S
        while not (now := client.read_flow_run(run.id).state).is_crashed() and time.monotonic() < deadline:
            time.sleep(1)
        client.delete_automation(automation)
    assert now.is_crashed() and now.message == "no sign of life for 10 s: its process or its machine was lost"


def test_the_error_of_a_missing_server_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with temporary_settings({PREFECT_API_URL: "http://127.0.0.1:9/api"}), pytest.raises(SystemExit, match="2"):
        main([])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("http://127.0.0.1:9/api: ") and "is the server running" in line


@pytest.mark.parametrize(
    ("option", "told"), [("--silence=30", "give 60 or more"), ("--webhook=", "--webhook is empty")]
)
def test_a_silence_of_healthy_runs_and_an_empty_webhook_are_refused(
    option: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([option])
    assert told in capsys.readouterr().err


def test_no_automations_are_set_up_in_a_temporary_server(capsys: pytest.CaptureFixture[str]) -> None:
    with temporary_settings(restore_defaults={PREFECT_API_URL}), pytest.raises(SystemExit, match="2"):
        main([])
    assert capsys.readouterr().err.startswith("no server is set; give this command in the folder of prefect.toml")
