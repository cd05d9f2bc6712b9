"""Prefect flows and the command line: only the order in which stages run."""

import os

os.environ.setdefault("DO_NOT_TRACK", "1")  # read when Prefect is imported; with a server, prefect.toml says the same
