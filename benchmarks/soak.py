"""Train many small recordings through server, schedule, two workers and a bucket, while processes are killed.

usage: python benchmarks/soak.py [--subjects 50] [--kill-every 180]

What happens, and what counts as a fault: tests/soak.py. Writes `benchmarks/results/soak.json` and `.md`.
"""

import sys
from pathlib import Path

from provenance import arguments, provenance, provenance_line, table, write_result

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.soak import under_fire


def main() -> None:
    """Train, kill, print and write."""
    parser = arguments(__doc__)
    parser.add_argument("--subjects", type=int, default=50)
    parser.add_argument("--kill-every", type=float, default=180.0, metavar="S")
    options = parser.parse_args()
    result = provenance() | {"kill_every_s": options.kill_every}
    result["figures"] = figures = under_fire(options.subjects, options.kill_every)
    before_mib, after_mib = figures["server_mib"]
    kills = ", ".join(f"{count} x {what}" for what, count in figures["kills"].items()) or "none"
    states = ", ".join(f"{count} {state.lower()}" for state, count in figures["runs"].items())
    rows = [
        ["what", "figure"],
        ["recordings with results", f"{figures['finished']} of {figures['subjects']}"],
        ["seconds", str(figures["seconds"])],
        ["kills, about every", f"{options.kill_every:.0f} s: {kills}"],
        ["workers that ended by themselves", str(figures["workers_that_ended_by_themselves"])],
        ["runs", states],
        ["artifacts in the bucket; of these put there twice", f"{figures['artifacts']}; {figures['made_twice']}"],
        ["fetched by a machine that lacked them", str(figures["fetched_by_another_machine"])],
        ["memory of the server, before and after", f"{before_mib} and {after_mib} MiB ({figures['database']})"],
        ["faults", "; ".join(figures["faults"]) or "none"],
    ]
    text = "\n".join(["# Soak", "", provenance_line(result), "", *table(rows), ""])
    write_result("soak", result, text)


if __name__ == "__main__":
    main()
