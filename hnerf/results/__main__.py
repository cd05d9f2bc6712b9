"""`python -m hnerf.results FOLDER` writes the JSON schema of each file, as in docs/schemas/."""

import argparse
from pathlib import Path

from hnerf.results.files import write_schemas


def main(argv: list[str] | None = None) -> None:
    """Write the schemas to the folder given on the command line."""
    parser = argparse.ArgumentParser(prog="python -m hnerf.results", description="Write a JSON schema of each result.")
    parser.add_argument("folder", type=Path, help="where to, like docs/schemas")
    write_schemas(parser.parse_args(argv).folder)


if __name__ == "__main__":
    main()
