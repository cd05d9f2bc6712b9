import contextlib
import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import yaml
from prefect import get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterName, FlowFilter, FlowFilterName
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.deployments import run_deployment
from prefect.events import emit_event
from prefect.exceptions import PrefectHTTPStatusError
from prefect.states import Completed, Crashed
from prefect.testing.cli import invoke_and_assert

from flows import restart
from flows.restart import RELEASE, restart_crashed, unfinished_runs
from flows.systemd_units import units

ROOT = Path(__file__).parent.parent.parent
PATIENCE_S = 60.0
AT_ONCE = timedelta(seconds=-5)  # the server tells the time in whole seconds


@pytest.fixture(scope="module")
def deployed(prefect_api: str) -> str:
    """Return the URL of a server that has the deployments of prefect.yaml."""
    with get_client(sync_client=True) as client:
        client.create_work_pool(WorkPoolCreate(name="local", type="process"))
    with contextlib.chdir(ROOT), pytest.MonkeyPatch.context() as patch:
        patch.setenv("PWD", "/tmp")  # as Ansible, cron and subprocess leave it
        invoke_and_assert(["--no-prompt", "deploy", "--all"])
    return prefect_api


def runs_of(flow: str) -> list[FlowRun]:
    with get_client(sync_client=True) as client:
        return client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=[flow])),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=["local"])),
        )


def test_the_worker_has_room_for_all_deployments_at_once() -> None:
    """Otherwise studies would keep the scan waiting, which also restarts lost runs."""
    deployments = yaml.safe_load((ROOT / "prefect.yaml").read_text())["deployments"]
    limits = [one["concurrency_limit"] for one in deployments]
    room = sum(one["limit"] if isinstance(one, dict) else one for one in limits)
    assert f"--limit {room}\n" in units(ROOT, Path("prefect"))["hnerf-worker.service"]


def test_cron_deployment_yields_scheduled_runs_five_minutes_apart(deployed: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while len(runs := runs_of("ingest-captures")) < 2 and time.monotonic() < deadline:
        time.sleep(0.5)
    assert {run.state_name for run in runs} == {"Scheduled"}
    first, second = sorted(run.expected_start_time for run in runs if run.expected_start_time)[:2]
    assert (second - first).total_seconds() == 300


@pytest.mark.parametrize(
    ("flow", "what"),
    [("train-subject", "preset"), ("benchmark", "study"), ("stability", "study"), ("ablate", "preset")],
)
def test_deployments_accept_a_capture_and_a_preset_or_study(deployed: str, flow: str, what: str) -> None:
    before, parameters = unfinished_runs(), {"capture": "/recordings/ada", what: "mine"}
    run_deployment(f"{flow}/local", parameters=parameters, timeout=0)
    (run,) = runs_of(flow)
    assert run.parameters == parameters
    assert unfinished_runs() == before + (flow == "train-subject")


def test_runs_work_in_the_checkout(deployed: str) -> None:
    """Whatever the shell's folder was when Ansible, say, deployed."""
    with get_client(sync_client=True) as client:
        steps = [step for one in client.read_deployments() for step in one.pull_steps or ()]
    assert steps == 5 * [{"prefect.deployments.steps.set_working_directory": {"directory": str(ROOT)}}]


def test_every_parameter_of_every_deployment_has_a_description(deployed: str) -> None:
    with get_client(sync_client=True) as client:
        found = {one.entrypoint: one for one in client.read_deployments()}
    assert len(found) == 5
    for deployment in found.values():
        assert deployment.tags and deployment.parameter_openapi_schema
        assert deployment.parameter_openapi_schema["properties"]["store"]["minLength"] == 1
        for name, parameter in deployment.parameter_openapi_schema["properties"].items():
            assert parameter.get("description"), f"{deployment.entrypoint}: {name}"
    watch = found["flows/ingest_captures.py:ingest_captures"].parameter_openapi_schema["properties"]
    assert (watch["max_unfinished"]["minimum"], watch["max_unfinished"]["maximum"]) == (1, 1000)


@pytest.mark.parametrize(
    ("flow", "parameters", "wrong"),
    [
        ("ingest-captures", {"folder": "captures", "max_unfinished": 0}, "max_unfinished"),
        ("ingest-captures", {"folder": "captures", "store": ""}, "store"),
        ("train-subject", {"capture": "/a", "overrides": 3}, "overrides"),
    ],
)
def test_wrong_parameters_are_refused_before_a_run_is_created(
    flow: str, parameters: dict[str, Any], wrong: str, deployed: str
) -> None:
    with pytest.raises(PrefectHTTPStatusError, match=r"409|422") as refused:
        run_deployment(f"{flow}/local", parameters=parameters, timeout=0)
    assert wrong in refused.value.response.text


def test_a_crashed_run_is_restarted_a_few_times_and_then_fails(deployed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restart, "QUIET", AT_ONCE)
    run = run_deployment("train-subject/local", parameters={"capture": "/recordings/bob"}, timeout=0)
    with get_client(sync_client=True) as client:
        for _ in range(2):
            client.set_flow_run_state(run.id, Crashed(), force=True)
            assert restart_crashed(max_restarts=2) == []
            begins = client.read_flow_run(run.id).next_scheduled_start_time
            assert begins and begins > datetime.now(UTC) + RELEASE / 2
        client.set_flow_run_state(run.id, Crashed(), force=True)
        ((lost, why),) = restart_crashed(max_restarts=2)
        state = client.read_flow_run(run.id).state
        assert lost.id == run.id and state and (state.name, state.message) == ("Failed", why)
        assert why.startswith("its process or machine was lost 3 times")
        assert restart_crashed(max_restarts=2) == []


def test_a_run_that_may_live_is_not_started_a_second_time(deployed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that was away ends all runs when it returns, before their heartbeats reach it. Such a run can still
    complete."""
    run = run_deployment("train-subject/local", parameters={"capture": "/recordings/eve"}, timeout=0).id
    with get_client(sync_client=True) as client:
        client.set_flow_run_state(run, Crashed(), force=True)
        crashed = client.read_flow_run(run)
        ended = restart._last_sign(client, crashed)
        emit_event(restart.HEARTBEAT, resource={"prefect.resource.id": f"prefect.flow-run.{run}"})
        deadline = time.monotonic() + PATIENCE_S
        while (alive := restart._last_sign(client, crashed)) == ended and time.monotonic() < deadline:
            time.sleep(0.5)
        assert crashed.state and ended == crashed.state.timestamp < alive
        for quiet, state in ((restart.QUIET, "Crashed"), (AT_ONCE, "Scheduled")):
            monkeypatch.setattr(restart, "QUIET", quiet)
            assert restart_crashed(max_restarts=2) == []
            assert client.read_flow_run(run).state_name == state
        client.set_flow_run_state(run, Crashed(), force=True)
        client.set_flow_run_state(run, Completed())
        assert client.read_flow_run(run).state_name == "Completed"


@pytest.mark.parametrize("skew", [timedelta(minutes=-5), timedelta(minutes=5)])
def test_a_wrong_clock_of_the_scanning_machine_restarts_no_run_earlier(
    skew: timedelta, deployed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_deployment("train-subject/local", parameters={"capture": "/recordings/joe"}, timeout=0).id
    monkeypatch.setattr(restart, "datetime", Mock(now=lambda zone: datetime.now(zone) + skew))
    with get_client(sync_client=True) as client:
        client.set_flow_run_state(run, Crashed(), force=True)
        for quiet, state in ((restart.QUIET, "Crashed"), (AT_ONCE, "Scheduled")):
            monkeypatch.setattr(restart, "QUIET", quiet)
            assert restart_crashed(max_restarts=2) == []
            assert client.read_flow_run(run).state_name == state
        begins = client.read_flow_run(run).next_scheduled_start_time
        assert begins and RELEASE / 2 < begins - datetime.now(UTC) <= RELEASE


def test_runs_beyond_one_page_of_the_server_are_counted(deployed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = unfinished_runs()
    monkeypatch.setattr(restart, "PAGE", 2)
    begun = [run_deployment("train-subject/local", parameters={"capture": f"/{n}"}, timeout=0) for n in range(5)]
    assert unfinished_runs() == before + 5
    with get_client(sync_client=True) as client:
        for run in begun:
            client.set_flow_run_state(run.id, Crashed(), force=True)
        crashed = [run.id for run in restart._all_runs(client, StateType.CRASHED)]
    assert {run.id for run in begun} <= set(crashed) and len(crashed) == len(set(crashed))


@pytest.mark.parametrize("pool", ["docker", "kubernetes"])
def test_one_changed_word_moves_all_flows_but_the_watch_to_a_container_pool(prefect_api: str, pool: str) -> None:
    """The server accepts the pool's template, too."""
    moved = yaml.safe_load((ROOT / "prefect.yaml").read_text().replace("&pool local", f"&pool {pool}"))
    pools = {one["flow_name"]: one["work_pool"]["name"] for one in moved["deployments"]}
    assert pools.pop("ingest-captures") == "local"
    assert set(pools.values()) == {pool} and len(pools) == 4
    template = json.loads((ROOT / "configs" / "work_pools" / f"{pool}.json").read_text())
    with get_client(sync_client=True) as client:
        client.create_work_pool(WorkPoolCreate(name=pool, type=pool, base_job_template=template))
        assert client.read_work_pool(pool).base_job_template["variables"]["properties"].keys() >= {"time_limit_s"}
