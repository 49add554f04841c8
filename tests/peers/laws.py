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
| ratio | python-control: zero-order hold of the filter; numpy for proportion, limits and the fading difference |
| split-range | numpy: the PI as a sum of increments, both curves by interp |
| gain-schedule | numpy: the PI as a sum of increments, gains by interp |
| override-selector | scipy: the differential equations of both blocks, numpy's minimum or maximum, and both lags |
| on-off | the positions by the rule's words; period and amplitude of the swing in closed form (Astrom and Hagglund 2006, ch. 8) |
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
    r, d = np.array(case["setpoint"]), np.array(case["load"])
    # Between two samples the reference is straight where the process saw a step: half a sample later it is the same in the mean.
    # So is the law's output, which goes out at the sample that saw the setpoint, and holds.
    half = lambda x: np.interp(t - dt / 2, t, x)
    from_setpoint = control.forced_response(control.ss(c_r * loop), t, half(r)).outputs
    from_load = control.forced_response(loop, t, half(d)).outputs
    # A derivative of the setpoint makes of half a sample a kick of its size.
    bound = 0.012 if p["gamma"] == 0.0 else 0.03
    span = np.ptp(r)
    lines = [tell(case, "continuous", worst(y, from_setpoint + from_load) / span, bound)]
    if p["beta"] in (0.0, 1.0) and p["gamma"] in (0.0, 1.0):
        lines.append(tell(case, "simple-pid", simple_pid(case, y, t, r, d) / span, 0.03))
    return lines


def simple_pid(case, y, t, r, d):
    p, dt, plant = case["parameters"], case["dt"], case["plant"]
    # The derivative has no filter there, so ours is compared with its own time constant as the difference that it is.
    peer = PID(
        p["k"],
        p["k"] / p["ti"],
        p["k"] * p["td"],
        setpoint=0,
        sample_time=None,
        proportional_on_measurement=p["beta"] == 0.0,
        differential_on_measurement=p["gamma"] == 0.0,
    )
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
        control.minreal(control.feedback(g * c, 1), verbose=False), t, np.array(case["setpoint"])
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
        r = case["setpoint"][min(int(now / dt + 1e-9), len(t) - 1)]
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


def ratio(case):
    p, dt, wild = case["parameters"], case["dt"], np.array(case["wild"])
    if p["wild-filter"] > 0:
        # The law's filter has seen the newest value when it answers: one sample ahead of a hold.
        wild = zero_order_hold(0.0, p["wild-filter"], dt, np.append(wild, wild[-1]), wild[0])[1:]
    natural = np.clip(case["ratio"], p["ratio-low"], p["ratio-high"]) * wild + p["bias"]
    left = (case["held"] - natural[0]) * np.exp(-np.arange(len(wild)) * dt / p["balance-time"])
    expected = np.clip(natural + left, p["out-low"], p["out-high"])
    assert np.ptp(expected) > 20 and (expected == p["out-high"]).any()
    return [tell(case, "proportion", worst(case["out"], expected), 1e-9)]


def increments(gains, ti, dt, error, first):
    """A PI as the sum of its increments, with gains that may differ from step to step: u moves by what P and I move by."""
    gains, ti, error = np.broadcast_to(gains, error.shape), np.broadcast_to(ti, error.shape), error
    steps = gains[1:] * (np.diff(error) + (1 - np.exp(-dt / ti[1:])) * error[:-1])
    return first + np.concatenate([[0.0], np.cumsum(steps)])


def split_range(case):
    p = case["parameters"]
    u = increments(p["k"], p["ti"], case["dt"], np.array(case["setpoint"]) - np.array(case["pv"]), case["u"])
    a_end, b_end = p["split"] - p["gap"] / 2, p["split"] + p["gap"] / 2
    assert 0 < u.min() < a_end - 2 and b_end + 2 < u.max() < 100, (u.min(), u.max(), a_end, b_end)
    a = np.interp(u, [0, a_end], [p["a-low"], p["a-split"]])
    b = np.interp(u, [b_end, 100], [p["b-split"], p["b-high"]])
    return [tell(case, "A", worst(case["a"], a), 1e-6), tell(case, "B", worst(case["b"], b), 1e-6)]


def gain_schedule(case):
    p = case["parameters"]
    by = np.array(case["schedule"] if p["by"] == 0.0 else case["pv"])
    points = [p["x1"], p["x2"], p["x3"], p["x4"]]
    gains = np.interp(by, points, [p["k"], p["k2"], p["k3"], p["k4"]])
    ti = np.interp(by, points, [p["ti"], p["ti2"], p["ti3"], p["ti4"]])
    assert len(set(np.searchsorted(points, by))) >= 2, "the gains move from one stretch to another"
    error = np.array(case["setpoint"]) - np.array(case["pv"])
    expected = increments(gains, ti, case["dt"], error, case["base"])
    return [tell(case, "increments with gains by interp", worst(case["out"], expected), 1e-7)]


def override_selector(case):
    p, dt = case["parameters"], case["dt"]
    t = np.arange(len(case["y"])) * dt
    pick = np.maximum if p["select"] == 1.0 else np.minimum
    free, g = case["free"], case["limit_gain"]

    def slope(now, state):
        y, x, main, limit = state
        r = case["beyond"] if case["turns"][0] <= now < case["turns"][1] else free
        u = pick(p["k"] * (r - y) + main, p["limit-k"] * (p["limit-sp"] - x) + limit)
        return [
            (u - y) / case["lag"],
            (g * u - x) / case["limit_lag"],
            (u - main) / p["ti"],
            (u - limit) / p["limit-ti"],
        ]

    # At rest both integrals are the actuator's value less what P wants.
    begin = [free, g * free, free, free - p["limit-k"] * (p["limit-sp"] - g * free)]
    answer = solve_ivp(slope, (0, t[-1]), begin, t_eval=t, max_step=0.02, rtol=1e-8, atol=1e-9)
    reached = abs(p["limit-sp"] - answer.y[1]).min()
    assert reached < 0.05 * p["limit-sp"], "the limit is met"
    span = abs(case["beyond"] - free)
    return [
        tell(case, "main", worst(case["y"], answer.y[0]) / span, 0.01),
        tell(case, "limit", worst(case["x"], answer.y[1]) / (g * span), 0.01),
    ]


def on_off(case):
    p, dt = case["parameters"], case["dt"]
    on_value, off_value = p.get("on-value", 100.0), p.get("off-value", 0.0)
    sign = -1.0 if p["action"] == 1.0 else 1.0
    cold = sign * (case["setpoint"] - np.array(case["pv"])) > p["hysteresis"] / 2
    hot = sign * (np.array(case["pv"]) - case["setpoint"]) > p["hysteresis"] / 2
    on, since, expected = False, -1, []
    for i in range(len(cold)):
        shortest = p.get("on-min", 0.0) if on else p.get("off-min", 0.0)
        # The first cycle of a law keeps the position.
        if i > 0 and (i - since) * dt >= shortest - 1e-9 and (hot[i] if on else cold[i]):
            on, since = not on, i
        expected.append(on_value if on else off_value)
    wrong = int(np.sum(np.array(expected) != np.array(case["out"])))
    lines = [tell(case, "positions that differ", wrong, 0)]
    if "plant" in case:
        gain, lag, delay = case["plant"]["gain"], case["plant"]["lags"][1], case["plant"]["delay"]
        swing, band = gain * (on_value - off_value) / 2, p["hysteresis"] / 2
        half = lag * np.log((2 * np.exp(delay / lag) - 1 + band / swing) / (1 - band / swing))
        amplitude = swing * (1 - np.exp(-delay / lag)) + band * np.exp(-delay / lag)
        ups = np.flatnonzero(np.diff(case["out"]) > 0)
        assert len(ups) > 5
        period = float(np.mean(np.diff(ups[2:]))) * dt
        settled = np.array(case["pv"])[ups[2] :] - case["setpoint"]
        lines += [
            tell(case, "period", abs(period / (2 * half) - 1), 0.02),
            tell(case, "amplitude", abs(np.ptp(settled) / (2 * amplitude) - 1), 0.02),
        ]
    return lines


LAWS = {
    "ratio": ratio,
    "split-range": split_range,
    "gain-schedule": gain_schedule,
    "override-selector": override_selector,
    "on-off": on_off,
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
