"""What a flow shows on its run's page."""

from prefect.artifacts import create_markdown_artifact
from prefect.context import FlowRunContext


def publish_markdown(markdown: str, key: str, description: str) -> None:
    """A text, with its pictures inside it, on the page of the flow run; where there is no run, nothing."""
    if FlowRunContext.get():
        create_markdown_artifact(markdown, key=key, description=description)
