"""The pendulum that the other tools shoot out: seeds and rates as in benches/shoot_out.rs."""

import numpy as np

q, r, g, xf = 5.55, 1.85, 9.81, -1.5
# Plain numbers: those of NumPy would make all of it f64.
steady = float(g * np.sin(xf))
a = float(-g * np.cos(xf))
p12 = r * (a + (a * a + q / r) ** 0.5)
p22 = (r * (2 * p12 + q)) ** 0.5
P = np.array([[p22 * (p12 / r - a), p12], [p12, p22]])


def seeds(count, c=1e-4):
    """(theta, omega, p1, p2, V) on s'Ps/2 = c, at equal angles where P is the identity."""
    w, U = np.linalg.eigh(P)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    s = U @ (np.array([np.cos(angle), np.sin(angle)]) * np.sqrt(2 * c) / np.sqrt(w)[:, None])
    return np.vstack([xf + s[0], s[1], P @ s, np.full(count, c)])


def rate_with(numbers):
    """The rates backward in time, by NumPy or something like it."""

    def rate(t, y, _):
        x1, x2, p1, p2, _ = y
        u = steady - p2 / r
        cost = 0.5 * (q * (x1 - xf) ** 2 + q * x2**2 + r * (u - steady) ** 2)
        return numbers.array(
            [-x2, g * numbers.sin(x1) - u, q * (x1 - xf) - g * numbers.cos(x1) * p2, q * x2 + p1, cost]
        )

    return rate
