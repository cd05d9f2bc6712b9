"""Text on the page of a flow run."""

from prefect.artifacts import create_markdown_artifact
from prefect.context import FlowRunContext


def publish_markdown(markdown: str, key: str, description: str) -> None:
    """Publish a text, with its pictures embedded, on the page of the flow run; do nothing outside a run."""
    if FlowRunContext.get():
        create_markdown_artifact(markdown, key=key, description=description)
