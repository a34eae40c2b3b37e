"""Solves every scene of scenarios/published and writes docs/published.md: published value, ours, its error, and the cost of a
control that was flown. Usage: published.py PATH/TO/costate [SCENE ...]. Python 3.8, standard library only."""
import csv
import json
import os
import subprocess
import sys
import tempfile
import time

HERE = os.path.dirname(os.path.abspath(__file__))
SCENES = os.path.join(HERE, "..", "scenarios", "published")
LIMIT = 1800  # seconds a scene may take
STATES = 16  # rows shown of a scene


def table(name):
    with open(os.path.join(SCENES, name), newline="") as file:
        return list(csv.DictReader(file))


def published(scene):
    """States of a scene (names, rows of texts) and for each {"reference", "published", "tolerance", "source"}."""
    rows = table(scene + ".csv")
    names = [n for n in rows[0] if n != "V_published"]
    values = [v for v in table("values.csv") if v["scene"] == scene]
    known = []
    for k, row in enumerate(rows):
        value = next((v for v in values if v["state"] in ("*", str(k))), {})
        known.append({
            "reference": row.get("V_published") or value.get("V", ""),
            "published": row.get("V_published") or value.get("published", ""),
            "tolerance": value.get("tolerance", ""),
            "source": value.get("source", ""),
        })
    return names, [[row[n] for n in names] for row in rows], known


def solve(binary, scene, names, states):
    """The summary of `costate solve --json`, the seconds taken and, where it failed, the reason."""
    with tempfile.TemporaryDirectory() as folder:
        points = os.path.join(folder, "points.csv")
        with open(points, "w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(names)
            writer.writerows(states)
        command = [binary, "solve", os.path.join(SCENES, scene + ".toml"), "--points", points, "--json",
                   "--out", os.path.join(folder, "out.h5")]
        start = time.monotonic()
        try:
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, timeout=LIMIT)
        except subprocess.TimeoutExpired:
            return None, LIMIT, "no answer in %d s" % LIMIT
        seconds = time.monotonic() - start
        if done.returncode != 0:
            words = " ".join(done.stderr.decode(errors="replace").replace("│", " ").replace("×", " ").split())
            return None, seconds, "refused: " + words[:300]
        return json.loads(done.stdout), seconds, ""


def digits(value, count=12):
    return "" if value is None else "%.*g" % (count, value)


def difference(value, reference):
    """Relative to the reference."""
    if value is None or reference == "":
        return ""
    reference = float(reference)
    return "%+.1e" % ((value - reference) / (abs(reference) or 1.0))


def supports(point, known):
    """Which of the published value and ours a flown control's cost supports."""
    flown, ours, theirs = point.get("flown"), point.get("V"), known["published"]
    if flown is None or ours is None:
        return ""
    tolerance = 1e-6 * max(abs(ours), 1e-12)
    if flown < ours - tolerance:
        return "**neither: it costs less than ours**"
    if flown > ours + 1e-3 * abs(ours):
        return "ours only as far as it comes"
    if theirs and float(theirs) < ours - tolerance:
        return "ours: the published value is below the cost of the simulated control"
    if theirs and float(theirs) > flown + tolerance:
        return "ours: a simulated control costs less than the published value"
    return "ours" + (" and the published" if theirs else "")


def section(binary, scene):
    """Lines of the page for a scene, and the row of the overview."""
    names, states, known = published(scene)
    summary, seconds, failure = solve(binary, scene, names, states)
    with open(os.path.join(SCENES, scene + ".toml")) as file:
        title = next((line.split("=", 1)[1].strip().strip('"') for line in file if line.startswith("title")), scene)
    if summary is None:
        return title, ["%s: %s" % (scene, failure)], "| %s | %d | – | – | %.1f | %s |" % (title, len(states), seconds, failure[:80])
    error = ((summary.get("homotopy") or {}).get("error_estimate") or {}).get("V") or {}
    error = error.get("max")
    points = summary["points"]
    lines = ["| %s | published | reference | V | ours to reference | flown | supports | sheets | u |" % ", ".join(names),
             "|" + " --- |" * 9]
    worst = 0.0
    for state, row, point in list(zip(states, known, points)):
        if point["V"] is not None and row["reference"]:
            worst = max(worst, abs(point["V"] / float(row["reference"]) - 1))
    for state, row, point in list(zip(states, known, points))[:STATES]:
        x = ", ".join("%.6g" % float(v) for v in state)
        v = digits(point["V"], 13) if point["V"] is not None else point["status"].replace("_", " ")
        if point["status"] != "converged" and point["V"] is not None:
            v += " (%s)" % point["status"].replace("_", " ")
        u = ", ".join("%.6g" % value for value in point["u"] or [])
        lines.append("| %s | %s | %s | %s | %s | %s | %s | %d | %s |" % (
            x, row["published"], row["reference"], v, difference(point["V"], row["reference"]),
            digits(point.get("flown"), 10), supports(point, row) or (point.get("support") or ""), point["sheets"], u))
    if len(points) > STATES:
        lines.append("")
        lines.append("and %d more states." % (len(points) - STATES))
    solved = sum(p["status"] == "converged" for p in points)
    source = known[0]["source"]
    lines[0:0] = ["Source: %s. Error estimate of V: %s (relative). %s %s; %.1f s." % (
        source, "%.1e" % error if error is not None else "none", summary["backend"], summary["precision"], seconds), ""]
    row = "| %s | %d | %d | %s | %.1f | %s |" % (
        title, len(points), solved, "%.1e" % worst if solved else "–", seconds, "%.1e" % error if error is not None else "–")
    return title, lines, row


def main():
    binary = sys.argv[1]
    every = sorted(f[:-5] for f in os.listdir(SCENES) if f.endswith(".toml"))
    version = subprocess.run([binary, "--version"], stdout=subprocess.PIPE).stdout.decode().strip()
    overview, body = [], []
    for scene in sys.argv[2:] or every:
        print(scene, file=sys.stderr, flush=True)
        title, lines, row = section(binary, scene)
        overview.append(row)
        body += ["", "## %s" % title, "", "`scenarios/published/%s.toml`" % scene, ""] + lines
    head = [
        "# Published problems, solved again", "",
        "Made by `docs/published.sh` with %s. *Reference* is the value that the tests require: the" % version,
        "published one, or one computed by another program to more digits. *Flown* is the cost that a simulated",
        "control attains from the state: an upper bound of the least cost, however the control was found. The column",
        "*supports* names the values, ours and the published one, that agree with that cost. Differences are",
        "relative.", "",
        "| problem | states | converged | largest difference from the reference | seconds | error estimate of V |",
        "|" + " --- |" * 6]
    with open(os.path.join(HERE, "published.md"), "w") as file:
        file.write("\n".join(head + overview + body) + "\n")


main()
