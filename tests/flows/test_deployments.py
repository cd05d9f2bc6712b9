import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from prefect import get_client
from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterName, FlowFilter, FlowFilterName
from prefect.client.schemas.objects import FlowRun
from prefect.deployments import run_deployment

from flows.ingest_captures import unfinished_runs

ROOT = Path(__file__).parent.parent.parent
PATIENCE_S = 60.0


def prefect(api: str, *arguments: str) -> str:
    environment = os.environ | {"PREFECT_API_URL": api, "COLUMNS": "200"}
    command = [sys.executable, "-m", "prefect", "--no-prompt", *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def deployed(prefect_api: str) -> str:
    """Return the API of a server with the deployments of prefect.yaml."""
    prefect(prefect_api, "work-pool", "create", "local", "--type", "process")
    prefect(prefect_api, "deploy", "--all")
    return prefect_api


def runs_of(flow: str) -> list[FlowRun]:
    with get_client(sync_client=True) as client:
        return client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=[flow])),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=["local"])),
        )


def test_cron_deployment_yields_scheduled_runs_five_minutes_apart(deployed: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while len(runs := runs_of("ingest-captures")) < 2 and time.monotonic() < deadline:
        time.sleep(0.5)
    assert {run.state_name for run in runs} == {"Scheduled"}
    first, second = sorted(run.expected_start_time for run in runs if run.expected_start_time)[:2]
    assert (second - first).total_seconds() == 300


def test_deployment_run_takes_a_capture(deployed: str) -> None:
    prefect(deployed, "deployment", "run", "train-subject/local", "-p", "capture=/recordings/ada")
    (run,) = runs_of("train-subject")
    assert run.parameters == {"capture": "/recordings/ada"}
    assert unfinished_runs() == 1


@pytest.mark.parametrize(("flow", "what"), [("benchmark", "study"), ("stability", "study"), ("ablate", "preset")])
def test_studies_are_deployed_too(deployed: str, flow: str, what: str) -> None:
    parameters = {"capture": "/recordings/ada", what: "mine"}
    run_deployment(f"{flow}/local", parameters=parameters, timeout=0)
    (run,) = runs_of(flow)
    assert run.parameters == parameters


def test_parameters_are_checked_before_there_is_a_run(deployed: str) -> None:
    with pytest.raises(AssertionError, match="overrides"):
        prefect(deployed, "deployment", "run", "train-subject/local", "-p", "capture=/a", "-p", "overrides=3")
