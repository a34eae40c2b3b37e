"""Medians of several runs of the same work by several tools, side by side.

    python benches/peers/table.py RUNS.jsonl [ERROR ...]

Each line is one setting of one run (benches/shoot_out.rs, benches/peers/shoot_out.py). For each ERROR
(worst over all trajectories) the fastest setting of each tool that is at most so wrong, with its own
error, and how many times as fast the first tool is. Errors are never rounded up: a setting that misses
an ERROR does not count for it.
"""

import json
import statistics
import sys
from collections import defaultdict


def name(row):
    return row.get("peer") or f"costate, {row['adapter'].replace(', compiled', '')}"


def label(row):
    if "peer" in row:
        return row["setting"]
    return f"{row['precision']} {row['method']} {row['setting']}"


def main():
    runs = defaultdict(list)
    with open(sys.argv[1]) as lines:
        for line in lines:
            if line.startswith("{"):
                row = json.loads(line)
                runs[name(row), label(row)].append(row)
    medians = defaultdict(list)
    for (tool, setting), rows in runs.items():
        rate = statistics.median(r["traj_per_s"] for r in rows)
        error = max(r["max_rel_err"] for r in rows)
        medians[tool].append((rate, error, setting))
    tools = sorted(medians, key=lambda t: (not t.startswith("costate"), t))
    wanted = [float(e) for e in sys.argv[2:]] or [1e-3, 1e-6, 1e-9, 1e-11]
    for tool in tools:
        counts = {len(rows) for (of, _), rows in runs.items() if of == tool}
        print(f"{tool}: {', '.join(map(str, sorted(counts)))} runs of a setting")
    print()
    print("| worst error at most | tool | setting | its error | trajectories/s | costate is faster by |")
    print("| --- | --- | --- | --- | --- | --- |")
    for most in wanted:
        best = {t: max((m for m in medians[t] if m[1] <= most), default=None) for t in tools}
        own = max((b[0] for t, b in best.items() if b and t.startswith("costate")), default=None)
        for tool in tools:
            if best[tool] is None:
                print(f"| {most:.0e} | {tool} | none is so accurate | | | |")
                continue
            rate, error, setting = best[tool]
            ratio = f"{own / rate:.1f}" if own else ""
            print(f"| {most:.0e} | {tool} | {setting} | {error:.1e} | {rate:,.0f} | {ratio} |")


main()
