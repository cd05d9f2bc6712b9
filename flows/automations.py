"""Set up what the Prefect server does by itself: python -m flows.automations [--webhook URL].

It ends lost runs and, with a webhook, tells the operator when something is wrong. Repeat the command to update what it
has set up.
"""

import argparse
from collections.abc import Iterator
from datetime import timedelta
from typing import Any, cast
from uuid import UUID

import httpx
from prefect import get_client
from prefect.automations import AutomationCore, EventTrigger
from prefect.blocks.webhook import Webhook
from prefect.client.schemas.objects import StateType
from prefect.events.actions import CallWebhook, ChangeFlowRunState
from prefect.events.schemas.automations import Posture
from prefect.settings import PREFECT_API_URL
from prefect.types import SecretDict
from pydantic import SecretStr

from flows.ingest_captures import DISK_EVENT

SILENCE_S = 150  # five heartbeats of prefect.toml
MIN_SILENCE_S = 60
BLOCK = "hnerf-operator"
# Any event of a run ends the wait for a sign of life, so every event before its heartbeats must start the wait again.
STARTING = ("Pending", "Submitting", "InfrastructurePending", "pull-step.executed")
SIGNS_OF_LIFE = {f"prefect.flow-run.{sign}" for sign in ("heartbeat", *STARTING)}
RUNS = {"prefect.resource.id": "prefect.flow-run.*"}
SCANS = {"prefect.resource.role": "flow", "prefect.resource.name": "ingest-captures"}  # trainings wait as a rule


def lost_runs(silence_s: int) -> AutomationCore:
    """Return the automation that ends runs that give no sign of life. Their process and worker were lost together, at
    work or while the worker started them; `ingest-captures` then starts them again."""
    message = f"no sign of life for {silence_s} s: its process or its machine was lost"
    return AutomationCore(
        name="hnerf: lost runs",
        description="Runs that were seen alive and then gave no sign of life become Crashed.",
        trigger=EventTrigger(
            match=RUNS,  # type: ignore[arg-type]
            for_each={"prefect.resource.id"},
            after=SIGNS_OF_LIFE,
            expect={"prefect.flow-run.*"},
            posture=Posture.Proactive,
            within=timedelta(seconds=silence_s),
        ),
        actions=[ChangeFlowRunState(name="Crashed", state=StateType.CRASHED, message=message, force=False)],
    )


def notices(block: UUID, pool: str) -> Iterator[AutomationCore]:
    """Yield the automations that call a webhook, with a JSON object whose `text` is one line."""
    run = "flow.name ~ ' ' ~ flow_run.name ~ ' is ' ~ flow_run.state.name ~ ': ' ~ (flow_run.state.message or '')"
    ended = {f"prefect.flow-run.{state}" for state in ("Failed", "Crashed", "TimedOut")}
    yield _notice("failed runs", "A run failed, crashed or took too long.", RUNS, ended, run, block)
    late = "flow.name ~ ' ' ~ flow_run.name ~ ' is late: no worker takes it'"
    yield _notice("late runs", "A scan waits for a worker.", RUNS, {"prefect.flow-run.Late"}, late, block, SCANS)
    yield _notice(
        "no worker",
        "The work pool has no worker any more.",
        {"prefect.resource.id": "prefect.work-pool.*", "prefect.resource.name": pool},
        {"prefect.work-pool.not-ready"},
        f"'work pool {pool} has no worker'",
        block,
    )
    yield _notice(
        "disk nearly full",
        "Nothing more is started for lack of space.",
        {"prefect.resource.id": "hnerf.store.*"},
        {DISK_EVENT},
        "'store ' ~ event.resource.name ~ ': ' ~ event.payload.free_gib ~ ' GiB are free; nothing is started'",
        block,
    )


def _notice(
    name: str,
    what: str,
    match: dict[str, Any],
    expect: set[str],
    text: str,
    block: UUID,
    related: dict[str, Any] | None = None,
) -> AutomationCore:
    trigger = EventTrigger(
        match=match,  # type: ignore[arg-type]
        match_related=related or {},  # type: ignore[arg-type]
        for_each={"prefect.resource.id"},
        expect=expect,
        posture=Posture.Reactive,
    )
    payload = '{"text": {{ (' + text + ") | tojson }}}"
    call = CallWebhook(block_document_id=block, payload=payload)
    return AutomationCore(name=f"hnerf: {name}", description=what, trigger=trigger, actions=[call])


def set_up(webhook: str | None, pool: str, silence_s: int) -> list[str]:
    """Create the automations, or update those with the same names; return the names."""
    wanted = [lost_runs(silence_s)]
    if webhook:
        headers = SecretDict({"Content-Type": "application/json"})
        block = Webhook(url=SecretStr(webhook), headers=headers).save(BLOCK, overwrite=True)
        wanted += notices(cast(UUID, block), pool)
    with get_client(sync_client=True) as client:
        for automation in wanted:
            known = client.read_automations_by_name(automation.name)
            if known:
                client.update_automation(known[0].id, automation)
            else:
                client.create_automation(automation)
    return [automation.name for automation in wanted]


def main(argv: list[str] | None = None) -> None:
    """Set up what the command line requests."""
    parser = argparse.ArgumentParser(prog="python -m flows.automations", description=__doc__)
    parser.add_argument("--webhook", metavar="URL", help="called, with a line of text, when the operator is needed")
    parser.add_argument("--pool", default="local", help="whose workers are watched (default: local)")
    parser.add_argument(
        "--silence", type=int, default=SILENCE_S, metavar="S", help=f"after which a run is lost (default: {SILENCE_S})"
    )
    options = parser.parse_args(argv)
    if options.webhook == "":
        parser.exit(2, "--webhook is empty; give a URL, or leave the option out\n")
    if options.silence < MIN_SILENCE_S:
        parser.exit(2, f"--silence {options.silence}: healthy runs would be ended; give {MIN_SILENCE_S} or more\n")
    if not PREFECT_API_URL.value():  # Prefect would start its own server, which ends with this command
        parser.exit(2, "no server is set; give this command in the folder of prefect.toml, or set PREFECT_API_URL\n")
    try:
        print("\n".join(set_up(options.webhook, options.pool, options.silence)))
    except httpx.HTTPError as error:
        what = type(error).__name__
        parser.exit(2, f"{PREFECT_API_URL.value()}: {what}; is the server running, and the password in .env right?\n")


if __name__ == "__main__":
    main()
