"""Prefect flows and the command line. They only define the order in which stages run."""

import os

os.environ.setdefault("DO_NOT_TRACK", "1")  # read when Prefect is imported; with a server, prefect.toml says the same
