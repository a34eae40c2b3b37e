"""What benches/mechanisms.sh measured, as a table in Markdown."""

import json
import sys

rows = {}
for line in open(sys.argv[1]):
    row = json.loads(line)
    rows.setdefault(row["links"], {}).update(row)
print("| N | operations of q'' | us a state | pinocchio ABA, us | operations of x', p' | us a state | in f32 | pinocchio derivatives, us | ratio | compiled in, ms | code, kB |")
print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
for n, row in sorted(rows.items()):
    forward, adjoint, single = row["forward_f64"], row["adjoint_f64"], row["adjoint_f32"]
    cells = [
        n,
        forward["operations"],
        f"{forward['us']:.3f}",
        f"{row['aba_us']:.2f}",
        adjoint["operations"],
        f"{adjoint['us']:.3f}",
        f"{single['us']:.3f}",
        f"{row['adjoint_us']:.2f}",
        f"{row['adjoint_us'] / adjoint['us']:.0f}",
        f"{adjoint['compile_ms']:.0f}",
        f"{adjoint['code_bytes'] / 1000:.0f}",
    ]
    print("| " + " | ".join(str(c) for c in cells) + " |")
