"""Works the stock laws out anew, by other people's code, and compares.

The file of cases holds parameters, inputs and what the laws gave. Prints one line per case, `NAME: what, deviation ok` or `NO`;
ends with 1 where one is NO.

| law | reference |
|---|---|
| pid, pidplus | python-control, continuous closed loop, dead time as Pade of order 10; simple-pid on a plant of python-control |
| smith | python-control: the loop without dead time, shifted by it |
| cascade | scipy: the differential equations of both blocks and both lags |
| lead-lag, feedforward | python-control: zero-order hold of the transfer function |
| kalman-pid | filterpy |
| mpc | scipy for the predictions, OSQP for the plan |
| fuzzy | scikit-fuzzy |
| autotune | python-control: margins and parameters of the true process |
"""

import json
import sys
import warnings

warnings.filterwarnings("ignore")

import control
import numpy as np
import osqp
import scipy.sparse as sparse
import skfuzzy as fuzz
from filterpy.kalman import KalmanFilter
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete
from simple_pid import PID
from skfuzzy import control as fuzzy_control

BAD = []


def tell(case, what, deviation, bound):
    good = bool(deviation <= bound)
    if not good:
        BAD.append(case["name"])
    return f"{what} {deviation:.2g} of {bound:.2g}", good


def worst(a, b):
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


def transfer(plant):
    g = control.tf([plant["gain"]], [1])
    for lag in plant["lags"]:
        if lag > 0:
            g = g * control.tf([1], [lag, 1])
    return g


def dead_time(delay):
    if delay <= 0:
        return control.tf([1], [1])
    return control.tf(*control.pade(delay, 10))


def pid(case):
    p, dt = case["parameters"], case["dt"]
    y = np.array(case["y"]) - case["y"][0]
    t = np.arange(len(y)) * dt
    k, ti, td, tf = p["k"], p["ti"], p["td"], p["td"] / p["n"]
    integral = control.tf([k], [ti, 0])
    derivative = control.tf([k * td, 0], [tf, 1]) if td > 0 else control.tf([0], [1])
    c_y = control.ss(k + integral + derivative)
    c_r = control.ss(p["beta"] * k + integral + p["gamma"] * derivative)
    g = control.ss(transfer(case["plant"]) * dead_time(case["plant"]["delay"]))
    # u = c_r·r − c_y·y; the load comes in before the process.
    loop = control.feedback(g, c_y)
    r = np.where(t >= 1.0 - 1e-9, case["step"], 0.0)
    # The law's step goes out at the sample that saw it, and holds: in the mean half a sample late.
    d = np.where(t >= t[len(t) // 2] - 1e-9, case["load"], 0.0)
    from_setpoint = control.forced_response(control.ss(c_r * loop), t, np.interp(t - dt / 2, t, r)).outputs
    from_load = control.forced_response(loop, t, d).outputs
    lines = [tell(case, "continuous", worst(y, from_setpoint + from_load) / case["step"], 0.012)]
    if p["beta"] == 1.0 and p["gamma"] == 0.0:
        lines.append(tell(case, "simple-pid", simple_pid(case, y, t, r, d) / case["step"], 0.03))
    return lines


def simple_pid(case, y, t, r, d):
    p, dt, plant = case["parameters"], case["dt"], case["plant"]
    # The derivative has no filter there, so ours is compared with its own time constant as the difference that it is.
    peer = PID(p["k"], p["k"] / p["ti"], p["k"] * p["td"], setpoint=0, sample_time=None)
    g = control.sample_system(control.ss(transfer(plant)), dt, "zoh")
    x = np.zeros((g.nstates, 1))
    line = [0.0] * round(plant["delay"] / dt)
    deviation = 0.0
    for i in range(len(t)):
        now = float((g.C @ x)[0, 0])
        deviation = max(deviation, abs(now - y[i]))
        peer.setpoint = r[i]
        line.append(peer(now, dt=dt) + d[i])
        x = g.A @ x + g.B * line.pop(0)
    return deviation


def smith(case):
    p, dt = case["parameters"], case["dt"]
    y = np.array(case["y"]) - case["y"][0]
    t = np.arange(len(y)) * dt
    g = control.tf([p["model-gain"]], [p["model-lag"], 1])
    c = p["k"] * control.tf([p["ti"], 1], [p["ti"], 0])
    prompt = control.forced_response(
        control.minreal(control.feedback(g * c, 1), verbose=False), t, np.where(t >= 1.0 - 1e-9, case["step"], 0.0)
    ).outputs
    late = np.interp(t - p["model-delay"], t, prompt, left=0.0)
    return [tell(case, "without dead time, then late", worst(y, late) / case["step"], 0.012)]


def cascade(case):
    p, dt = case["parameters"], case["dt"]
    y = np.array(case["y"]) - case["base"]
    t = np.arange(len(y)) * dt
    t1, t2 = case["inner"], case["outer"]
    k, ti, ki, tii = p["k"], p["ti"], p["inner-k"], p["inner-ti"]

    def slope(now, x):
        inner, outer, reset, integral = x
        r = case["step"] if now >= 1.0 else 0.0
        wanted = k * (r - outer) + reset
        u = ki * (wanted - inner) + integral
        # The outer integral follows the inner measurement; the inner one is a plain PI.
        return [(u - inner) / t1, (inner - outer) / t2, (inner - reset) / ti, ki * (wanted - inner) / tii]

    answer = solve_ivp(slope, (0, t[-1]), [0, 0, 0, 0], t_eval=t, max_step=0.02, rtol=1e-8, atol=1e-9)
    return [tell(case, "differential equations", worst(y, answer.y[1]) / case["step"], 0.01)]


def zero_order_hold(lead, lag, dt, signal, first):
    system = control.sample_system(control.ss(control.tf([lead, 1], [lag, 1])), dt, "zoh")
    t = np.arange(len(signal)) * dt
    return control.forced_response(system, t, np.asarray(signal) - first).outputs + first


def lead_lag(case):
    p, signal = case["parameters"], case["input"]
    y = zero_order_hold(p["lead"], p["lag"], case["dt"], signal, signal[0])
    expected = p["gain"] * y + p["bias"]
    # The first output is what the actuator held.
    return [tell(case, "zero-order hold", worst(case["out"][1:], expected[1:]), 1e-8)]


def feedforward(case):
    p, n = case["parameters"], int(case["delay_steps"])
    late = ([case["input"][0]] * n + case["input"])[: len(case["input"])]
    y = zero_order_hold(p["ff-lead"], p["ff-lag"], case["dt"], late, late[0])
    expected = case["base"] + p["ff-gain"] * (y - y[0])
    return [tell(case, "zero-order hold, late", worst(case["out"], expected), 1e-7)]


def kalman(case):
    p, dt = case["parameters"], case["dt"]
    a, b, _, _, _ = cont2discrete(
        (np.array([[-1 / p["model-lag"]]]), np.array([[1 / p["model-lag"]]]), np.eye(1), np.zeros((1, 1))), dt
    )
    peer = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    peer.F = np.array([[a[0, 0], b[0, 0]], [0, 1]])
    peer.B = np.array([[b[0, 0] * p["model-gain"]], [0]])
    peer.H = np.array([[1.0, 0.0]])
    peer.Q = np.diag([p["unrest"] ** 2 * dt, p["drift"] ** 2 * dt])
    peer.R = np.array([[p["noise"] ** 2]])
    peer.P = np.diag([p["noise"] ** 2, p["noise"] ** 2])
    peer.x = np.array([[case["pv"][0]], [case["pv"][0] - p["model-gain"] * case["held"][0]]])
    x, d = [peer.x[0, 0]], [peer.x[1, 0]]
    for pv, fresh, held in list(zip(case["pv"], case["fresh"], case["held"]))[1:]:
        peer.predict(u=np.array([[held]]))
        if fresh:
            peer.update(np.array([[pv]]))
        x.append(peer.x[0, 0])
        d.append(peer.x[1, 0])
    return [
        tell(case, "estimate", worst(case["estimate"], x), 1e-8),
        tell(case, "load", worst(case["load"], d), 1e-8),
    ]


def mpc(case):
    p, dt = case["parameters"], case["dt"]
    gain, lag, delay, interval = p["gain"], p["lag"], p["delay"], p["interval"]
    horizon, moves, steps = int(p["horizon"]), int(p["moves"]), round(delay / dt)
    per = round(interval / dt)
    a = np.exp(-dt / lag)
    # Everything on the grid of the cycles, by recursion; the law itself uses closed forms.
    line, x = [case["base"]] * steps, gain * case["base"]

    def respond(x, line, inputs):
        line, out = list(line), []
        for u in inputs:
            line.append(u)
            x = a * x + (1 - a) * gain * line.pop(0)
            out.append(x)
        return x, line, out

    unit = np.array(respond(0.0, [0.0] * steps, [1.0] * (horizon * per))[2])[per - 1 :: per]
    s = np.zeros((horizon, moves))
    for j in range(moves):
        s[j:, j] = unit[: horizon - j]
    soft = "pv-high" in p
    held, since, planned, deviation, plans = case["base"], interval, False, 0.0, 0
    for i, (pv, r, out) in enumerate(zip(case["pv"], case["setpoint"], case["out"])):
        if i == 0:
            expected, load = held, pv - x
        else:
            x, line, _ = respond(x, line, [held])
            load = pv - x
            since += 0 if i == 1 else dt
            if since + dt / 2 < interval and planned:
                expected = held
            else:
                free = np.array(respond(x, line, [held] * (horizon * per))[2])[per - 1 :: per] + load
                ahead = np.arange(1, horizon + 1) * interval
                decay = np.exp(-ahead / p["reference-time"]) if p["reference-time"] > 0 else 0 * ahead
                wanted = r - (r - pv) * decay
                expected = held + plan(p, s, free, wanted, held, soft)
                expected = min(max(expected, p["out-low"]), p["out-high"])
                since, planned, plans = 0.0, True, plans + 1
        deviation = max(deviation, abs(expected - out))
        # The next plan goes on from what our law sent: each plan is compared by itself.
        held = out
    assert plans > 60
    return [tell(case, f"{plans} plans by OSQP", deviation, 1e-3)]


def plan(p, s, free, wanted, held, soft):
    horizon, moves = s.shape
    gain = p["gain"]
    n = moves + (1 if soft else 0)
    h = np.zeros((n, n))
    g = np.zeros(n)
    h[:moves, :moves] = s.T @ s / gain**2 + p["move-weight"] * np.eye(moves)
    g[:moves] = -s.T @ (wanted - free) / gain**2
    rows = [np.eye(moves, n), np.hstack([np.tril(np.ones((moves, moves))), np.zeros((moves, n - moves))])]
    reach = p["out-rate"] * p["interval"]
    low = [np.full(moves, -reach), np.full(moves, p["out-low"] - held)]
    high = [np.full(moves, reach), np.full(moves, p["out-high"] - held)]
    if soft:
        h[moves, moves] = 1e4
        seen = np.abs(s[:, 0]) > 0
        up = np.hstack([s[seen] / abs(gain), -np.ones((seen.sum(), 1))])
        down = np.hstack([-s[seen] / abs(gain), -np.ones((seen.sum(), 1))])
        rows += [up, down]
        low += [np.full(seen.sum(), -np.inf)] * 2
        high += [(p["pv-high"] - free[seen]) / abs(gain), (free[seen] - p["pv-low"]) / abs(gain)]
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(h),
        g,
        sparse.csc_matrix(np.vstack(rows)),
        np.concatenate(low),
        np.concatenate(high),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=200000,
        polishing=True,
    )
    return solver.solve().x[0]


class Surface:
    """Mamdani rules by scikit-fuzzy: five triangles, the diagonal rule base, the centroid."""

    def __init__(self):
        names = ["nb", "ns", "ze", "ps", "pb"]
        grid = np.round(np.arange(-1.5, 1.5 + 1e-9, 0.01), 6)
        error, rate = (fuzzy_control.Antecedent(grid, name) for name in ("error", "rate"))
        out = fuzzy_control.Consequent(grid, "out", defuzzify_method="centroid")
        for i, name in enumerate(names):
            peak = -1 + 0.5 * i
            for variable in (error, rate, out):
                variable[name] = fuzz.trimf(grid, [peak - 0.5, peak, peak + 0.5])
        rules = [
            fuzzy_control.Rule(error[names[i]] & rate[names[j]], out[names[min(max(i + j - 2, 0), 4)]])
            for i in range(5)
            for j in range(5)
        ]
        self.simulation = fuzzy_control.ControlSystemSimulation(fuzzy_control.ControlSystem(rules))

    def at(self, error, rate):
        self.simulation.input["error"] = min(max(error, -1), 1)
        self.simulation.input["rate"] = min(max(rate, -1), 1)
        self.simulation.compute()
        return self.simulation.output["out"]


SURFACE = []


def fuzzy(case):
    if not SURFACE:
        SURFACE.append(Surface())
    p, dt = case["parameters"], case["dt"]
    sign = -1 if p["action"] == 1 else 1
    f, before = [], None
    for pv in case["pv"]:
        rate = 0.0 if before is None else (before - pv) / dt
        f.append(SURFACE[0].at(sign * (case["setpoint"] - pv) / p["error-span"], sign * rate / p["rate-span"]))
        before = pv
    expected = case["base"] + p["out-span"] * (np.array(f) - f[0])
    return [tell(case, "scikit-fuzzy", worst(case["out"], expected) / p["out-span"], 2e-3)]


def autotune(case):
    plant, found = case["plant"], case["found"]
    assert case["stage"] == 2.0, case["name"]
    gain, lag, delay = plant["gain"], plant["lags"][1], plant["delay"]
    if case["parameters"]["tune"] == 1.0:
        margin, _, omega, _ = control.margin(transfer(plant) * dead_time(delay))
        # A relay's swing is no pure sine: its describing function is that far from the margin.
        return [
            tell(case, "gain against the margin", abs(found[0] / (0.45 * margin) - 1), 0.2),
            tell(case, "time against the margin", abs(found[1] / (2 * np.pi / omega / 1.2) - 1), 0.1),
        ]
    return [
        tell(case, "gain by SIMC of the process", abs(found[0] / (lag / (gain * 2 * delay)) - 1), 0.15),
        tell(case, "time by SIMC of the process", abs(found[1] / min(lag, 8 * delay) - 1), 0.1),
    ]


LAWS = {
    "pid": pid,
    "smith": smith,
    "cascade": cascade,
    "lead-lag": lead_lag,
    "feedforward": feedforward,
    "kalman-pid": kalman,
    "mpc": mpc,
    "fuzzy": fuzzy,
    "autotune": autotune,
}


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        cases = json.load(file)
    for case in cases:
        lines = LAWS[case["law"]](case)
        good = all(line[1] for line in lines)
        print(f"{case['name']}: {', '.join(line[0] for line in lines)}", "ok" if good else "NO", flush=True)
    if BAD:
        sys.exit(f"these do not agree with their reference: {', '.join(BAD)}")


if __name__ == "__main__":
    main()
