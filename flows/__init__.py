"""Prefect flows and the command line: what runs in which order, and nothing else."""

import os

os.environ.setdefault("DO_NOT_TRACK", "1")  # read when Prefect is imported; with a server, prefect.toml says the same
