"""Distance of a map's equal-cost line from the exact one: python equal_cost.py MAP.h5 LINE.h5 VALUE_MAX [COSTATE] (numpy, h5py)
Exact points: /equal_cost of LINE.h5 with V <= VALUE_MAX. From each the place along p1 - p2 where the map's p changes from one
side to the other is bisected, with `costate value`."""
import csv, subprocess, sys, tempfile, os
import h5py, numpy as np
MAP, LINE, VMAX = sys.argv[1], sys.argv[2], float(sys.argv[3])
C = sys.argv[4] if len(sys.argv) > 4 else 'target/release/costate'
e = h5py.File(LINE)['equal_cost']
V, X, P = e['V'][:], e['x'][:], e['p'][:]
keep = (V < VMAX)
V, X, P = V[keep], X[keep], P[keep]
J = P[:, 0] - P[:, 1]; size = np.linalg.norm(J, axis=1); N = J / size[:, None]
names = [s.decode() if isinstance(s, bytes) else s for s in e['state'][:]]
tmp = tempfile.mkdtemp()
def ask(x):
    a, b = os.path.join(tmp, 'a.csv'), os.path.join(tmp, 'b.csv')
    np.savetxt(a, x, delimiter=',', header=','.join(names), comments='', fmt='%.17g')
    subprocess.run([C, 'value', MAP, '--points', a, '--out', b, '--quiet'], check=False, stdout=subprocess.DEVNULL)
    rows = list(csv.DictReader(open(b)))
    g = lambda k: np.array([float(r[k]) if r[k] else np.nan for r in rows])
    return g('V'), np.stack([g('p_' + n) for n in names], 1), g('V_error')
def side(x):  # > 0: like the side of p2
    v, p, err = ask(x)
    return np.linalg.norm(p - P[:, 0], axis=1) - np.linalg.norm(p - P[:, 1], axis=1), v, err
D = 1e-2
lo, hi = np.full(len(V), -D), np.full(len(V), D)
sl, sh = side(X + lo[:, None] * N), side(X + hi[:, None] * N)
ok = (sl[0] < 0) & (sh[0] > 0)
print(f'{len(V)} exact points with V < {VMAX}; jump |p1 - p2| {size.min():.1f} to {size.max():.1f}; {ok.sum()} bracketed within {D}')
for _ in range(40):
    mid = 0.5 * (lo + hi)
    s = side(X + mid[:, None] * N)[0]
    up = s > 0
    hi = np.where(up, mid, hi); lo = np.where(up, lo, mid)
d = np.abs(0.5 * (lo + hi))[ok]
q = lambda f: np.quantile(d, f)
print(f'distance of the lines: median {q(.5):.2e}, 90 % {q(.9):.2e}, 99 % {q(.99):.2e}, largest {d.max():.2e}; above 1e-6: {(d > 1e-6).sum()} of {ok.sum()}')
bound = np.maximum(sl[2], sh[2])[ok]   # absolute error bounds of V on both sides
est = (sl[2] + sh[2])[ok] / size[ok]
print(f'(bound of V1 + bound of V2) / |p1 - p2|: median {np.median(est):.2e}, largest {est.max():.2e}; distance over it: largest {np.max(d / est):.2f}')
for k in np.where(~ok)[0]:
    print('not bracketed', X[k], V[k])
