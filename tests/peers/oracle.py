"""Seven processes under PI in continuous time: what a unit step of the setpoint and of the load costs, and Ms.

Prints the rows that host/lab/tests/it/oracle.rs holds, with one digit more than its tolerances need. Independent of the project:
the differential equations by the classical Runge-Kutta method with the dead time as a stored past (numpy), and Ms from the
frequency response (python-control for the rational part). It checks itself by the theorem IE = Ti/K.
"""

import control
import numpy as np

# Numerator and denominator of the rational part, dead time, K, Ti, step and length of the simulation.
PROCESSES = [
    ("1/((s+1)(0.2s+1))", [1], np.polymul([1, 1], [0.2, 1]), 0.0, 5.5, 0.8, 2e-4, 20.0),
    ("e^-s/(s+1)", [1], [1, 1], 1.0, 0.5, 1.0, 5e-4, 30.0),
    ("e^-s/(4s+1)", [1], [4, 1], 1.0, 2.0, 4.0, 5e-4, 60.0),
    ("e^-s/(0.1s+1)", [1], [0.1, 1], 1.0, 0.05, 0.1, 5e-4, 30.0),
    ("1/(s+1)^4", [1], np.poly([-1] * 4), 0.0, 0.3, 1.5, 1e-3, 100.0),
    ("(1-s)/(s+1)^3", [-1, 1], np.poly([-1] * 3), 0.0, 0.3, 1.5, 1e-3, 100.0),
    ("e^-s/s", [1], [1, 0], 1.0, 0.5, 8.0, 1e-3, 250.0),
]


def simulate(num, den, delay, k, ti, h, length, setpoint, load):
    """IAE, IE, TV of the controller's output after its first jump is counted in, greatest y, greatest |e|."""
    g = control.tf2ss(control.tf(num, den))
    a, b, c = g.A, g.B[:, 0], g.C[0]
    n, late = int(round(length / h)), int(round(delay / h))
    x, i = np.zeros(len(a)), 0.0
    past = np.zeros(n + 1)
    iae = ie = tv = 0.0
    top, worst, before, last = 0.0, 0.0, None, 0.0

    def wanted(x, i):
        return k * (setpoint - c @ x) + i

    for step in range(n + 1):
        e = setpoint - c @ x
        u = wanted(x, i)
        past[step] = u
        tv += abs(u - last)
        last = u
        top, worst = max(top, c @ x), max(worst, abs(e))
        if before is not None:
            ie += 0.5 * h * (e + before)
            # Where the error changes its sign the area is that of two triangles.
            same = e * before >= 0
            iae += 0.5 * h * (abs(e) + abs(before)) if same else 0.5 * h * (e * e + before * before) / (abs(e) + abs(before))
        before = e

        def slope(x, i, part):
            if late == 0:
                v = wanted(x, i)
            else:
                # The past between two of its samples, straight; before the start nothing was sent.
                at = step - late
                v = past[at] + part * (past[at + 1] - past[at]) if at >= 0 else 0.0
            return a @ x + b * (v + load), k / ti * (setpoint - c @ x)

        x1, i1 = slope(x, i, 0.0)
        x2, i2 = slope(x + h / 2 * x1, i + h / 2 * i1, 0.5)
        x3, i3 = slope(x + h / 2 * x2, i + h / 2 * i2, 0.5)
        x4, i4 = slope(x + h * x3, i + h * i3, 1.0)
        x = x + h / 6 * (x1 + 2 * x2 + 2 * x3 + x4)
        i = i + h / 6 * (i1 + 2 * i2 + 2 * i3 + i4)
    return iae, ie, tv, top, worst


def sensitivity(num, den, delay, k, ti):
    w = np.logspace(-3, 3, 400_001)
    s = 1j * w
    loop = np.polyval(num, s) / np.polyval(den, s) * np.exp(-s * delay) * k * (1 + 1 / (ti * s))
    return float(np.max(1 / np.abs(1 + loop)))


def main():
    print("process: setpoint IAE, TV, peak; load IAE, peak; Ms")
    for name, num, den, delay, k, ti, h, length in PROCESSES:
        iae, _, tv, top, _ = simulate(num, den, delay, k, ti, h, length, 1.0, 0.0)
        load_iae, load_ie, _, _, load_peak = simulate(num, den, delay, k, ti, h, length, 0.0, 1.0)
        assert abs(-load_ie / (ti / k) - 1) < 1e-5, (name, load_ie)
        ms = sensitivity(num, den, delay, k, ti)
        print(f"{name}: [{iae:.5f}, {tv:.4f}, {top:.5f}]; [{load_iae:.6f}, {load_peak:.6f}]; {ms:.5f}", flush=True)


if __name__ == "__main__":
    main()
