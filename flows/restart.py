"""Runs of the training deployment: the number that have not ended, and restarts of those that crashed."""

import logging
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import Any

from prefect import get_client
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas import filters
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.events.filters import EventFilter, EventNameFilter, EventOccurredFilter, EventResourceFilter
from prefect.states import Failed, Scheduled

FLOW, NAME = "train-subject", "local"
DEPLOYMENT = f"{FLOW}/{NAME}"
UNFINISHED = (StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING, StateType.PAUSED, StateType.CANCELLING)

AGAIN = "crashed; begun again"
# A worker with a limit ends if it is offered a run that it has not released yet. Before it releases one, it imports the
# flow once more, for its hooks, which takes a minute on a busy machine.
RELEASE = timedelta(minutes=2)
# Two heartbeats of 30 s (prefect.toml), and 15 s for delivery. A server that was away for longer than the automation's
# silence takes living runs for lost before their heartbeats reach it.
QUIET = timedelta(seconds=75)
HEARTBEAT = "prefect.flow-run.heartbeat"
PAGE = 100  # runs per request; the server returns at most 200

log = logging.getLogger("hnerf.restart")


def unfinished_runs() -> int:
    """Return how many runs of the deployment have not ended."""
    with get_client(sync_client=True) as client:
        return client.count_flow_runs(**_filters(*UNFINISHED))


def restart_crashed(max_restarts: int) -> list[tuple[FlowRun, str]]:
    """Put crashed runs of the deployment, whose machine or process was lost, back into the queue, to start after
    RELEASE. Each is restarted at most `max_restarts` times, because the run itself may be what ends the process, even
    before the server counts it as running. Runs that crash once more become failed; return these, with the reason.

    A run whose process may still be running is left alone until it has been silent for QUIET. It stays Crashed unless
    it completes: set back to Running, it would finally release a slot that it no longer holds."""
    given_up = []
    with get_client(sync_client=True) as client:
        now = parsedate_to_datetime(client.hello().headers["Date"])  # by the clock that dates runs and heartbeats
        for run in _all_runs(client, StateType.CRASHED):
            if now - _last_sign(client, run) < QUIET:
                log.info("%s crashed, but its process may still be running: not restarted yet", run.name)
                continue
            before = [state.message == AGAIN for state in client.read_flow_run_states(run.id)].count(True)
            if before < max_restarts:
                again: State[None] = Scheduled(scheduled_time=now + RELEASE, message=AGAIN)
                client.set_flow_run_state(run.id, again, force=True)
                log.warning("%s crashed and is restarted, attempt %d of %d", run.name, before + 1, max_restarts)
            else:
                lost = f"its process or machine was lost {before + 1} times; the run itself may end it"
                failed: State[None] = Failed(message=lost)
                client.set_flow_run_state(run.id, failed, force=True)
                log.error("%s failed: %s", run.name, lost)
                given_up.append((run, lost))
    return given_up


def _last_sign(client: SyncPrefectClient, run: FlowRun) -> datetime:
    """Return when the server received the run's latest heartbeat, or ended the run, whichever was later."""
    assert run.state is not None
    heartbeats = EventFilter(
        event=EventNameFilter(name=[HEARTBEAT]),
        resource=EventResourceFilter(id=[f"prefect.flow-run.{run.id}"]),
        # By the clock of the run's machine, which may be fast.
        occurred=EventOccurredFilter(until=datetime.now(UTC) + timedelta(days=1)),  # type: ignore[arg-type]
    )
    received = [event.received for event in client.read_events(heartbeats, limit=1).events]
    return max([run.state.timestamp, *received])


def _all_runs(client: SyncPrefectClient, *states: StateType) -> list[FlowRun]:
    """Return all runs of the deployment in these states, oldest first; the server returns them in pages."""
    found: list[FlowRun] = []
    while some := client.read_flow_runs(
        **_filters(*states), sort=FlowRunSort.EXPECTED_START_TIME_ASC, limit=PAGE, offset=len(found)
    ):
        found += some
    return found


def _filters(*states: StateType) -> dict[str, Any]:
    return {
        "flow_filter": filters.FlowFilter(name=filters.FlowFilterName(any_=[FLOW])),
        "deployment_filter": filters.DeploymentFilter(name=filters.DeploymentFilterName(any_=[NAME])),
        "flow_run_filter": filters.FlowRunFilter(
            state=filters.FlowRunFilterState(type=filters.FlowRunFilterStateType(any_=list(states)))
        ),
    }
