// The example law in TypeScript: PI(D) with clamping. `examples/rust-pid/src/law.rs` has the formulae and their sources.
//
// Only + - * / and comparisons are used, in the same order as in the other languages, so the numbers are the same to the last
// bit. Never: keeps anything between calls outside the state bytes; a step may run twice, on any host.

import io from "bumpless:control/io@0.1.0";
import type { Control, Fault, Parameter, Port, Reading } from "bumpless:types";

const NAME = "ts-pid";
const STATE_LAYOUT = 1;
// The same law in other languages: their states are taken over.
const FAMILY = [NAME, "rust-pid", "rust-wasip2-pid", "c-pid", "js-pid", "python-pid"];

const PORTS: Port[] = [
  { name: "pv", direction: "input", kind: "analog", unit: "", required: true, text: "Measurement, in the unit of the setpoint" },
  { name: "out", direction: "output", kind: "analog", unit: "", required: true, text: "To the actuator" },
];
const PV = 0;
const OUT = 1;

function number(name: string, unit: string, value: number, minimum: number, maximum: number, text: string): Parameter {
  return { name, unit, default: value, minimum, maximum, choices: [], text };
}
const PARAMETERS: Parameter[] = [
  number("gain", "out/pv", 1, -1e6, 1e6, "Gain; below 0 for direct action"),
  number("ti", "s", 10, 0, 1e6, "Integral time; 0 for none"),
  number("td", "s", 0, 0, 1e6, "Derivative time; 0 for none"),
  number("td-filter", "s", 1, 0, 1e6, "Filter time of the derivative"),
  number("out-low", "out", 0, -1e9, 1e9, "Least output"),
  number("out-high", "out", 100, -1e9, 1e9, "Greatest output"),
];

interface Tuning {
  gain: number;
  ti: number;
  td: number;
  tdFilter: number;
  low: number;
  high: number;
}

// What lasts from step to step.
interface Memory {
  running: boolean;
  integral: number;
  derivative: number;
  pv: number;
  setpoint: number;
  output: number;
}

interface Decoded {
  name: string;
  t: Tuning;
  m: Memory;
}

function limited(t: Tuning, value: number): number {
  if (value > t.high) return t.high;
  if (value < t.low) return t.low;
  return value;
}

function step(t: Tuning, m: Memory, pv: number, setpoint: number, held: number, dtS: number): number {
  const error = setpoint - pv;
  if (m.running) {
    m.derivative = (t.tdFilter * m.derivative + t.td * (m.pv - pv)) / (t.tdFilter + dtS);
    const change = t.ti > 0 ? (t.gain * error * dtS) / t.ti : 0;
    const rest = t.gain * (error + m.derivative);
    const wanted = m.integral + change + rest;
    const further = (wanted > t.high && change > 0) || (wanted < t.low && change < 0);
    if (!further) m.integral += change;
    m.output = limited(t, m.integral + rest);
  } else {
    m.running = true;
    m.derivative = 0;
    m.integral = held - t.gain * error;
    m.output = limited(t, held);
  }
  m.pv = pv;
  m.setpoint = setpoint;
  return m.output;
}

// Moves the integral so that the output for the last sample stays what it was.
function retune(m: Memory, old: Tuning, next: Tuning): void {
  const names = ["gain", "ti", "td", "tdFilter", "low", "high"] as const;
  if (names.every((name) => old[name] === next[name])) return;
  const error = m.setpoint - m.pv;
  const before = old.gain * (error + m.derivative);
  if (next.td === 0) m.derivative = 0;
  m.integral = m.integral + before - next.gain * (error + m.derivative);
}

// The state bytes, all little endian: mark, length and text of the name, layout, number of parameters, their values, memory.
const MARK = 0xb1;
const TUNING_BYTES = 8 * 6;
const MEMORY_BYTES = 1 + 8 * 5;

function encode(t: Tuning, m: Memory): Uint8Array {
  const at = 7 + NAME.length;
  const bytes = new Uint8Array(at + TUNING_BYTES + MEMORY_BYTES);
  const view = new DataView(bytes.buffer);
  bytes[0] = MARK;
  bytes[1] = NAME.length;
  for (let i = 0; i < NAME.length; i++) bytes[2 + i] = NAME.charCodeAt(i);
  view.setUint32(2 + NAME.length, STATE_LAYOUT, true);
  bytes[6 + NAME.length] = PARAMETERS.length;
  [t.gain, t.ti, t.td, t.tdFilter, t.low, t.high].forEach((value, i) => view.setFloat64(at + 8 * i, value, true));
  bytes[at + TUNING_BYTES] = m.running ? 1 : 0;
  const rest = at + TUNING_BYTES + 1;
  [m.integral, m.derivative, m.pv, m.setpoint, m.output].forEach((value, i) => view.setFloat64(rest + 8 * i, value, true));
  return bytes;
}

function badState(val: string): Fault {
  return { tag: "bad-state", val };
}

function decode(given: Uint8Array): Decoded {
  const bytes = Uint8Array.from(given);
  const view = new DataView(bytes.buffer);
  if (bytes.length < 2 || bytes[0] !== MARK) throw badState("the state is not of this form");
  const length = bytes[1]!;
  const at = 7 + length;
  if (bytes.length !== at + TUNING_BYTES + MEMORY_BYTES) throw badState("the state has another length");
  const name = String.fromCharCode(...bytes.subarray(2, 2 + length));
  const known = FAMILY.includes(name) && bytes[6 + length] === PARAMETERS.length;
  if (!known || view.getUint32(2 + length, true) !== STATE_LAYOUT) throw badState("the state is not of this law");
  const f64 = (offset: number) => view.getFloat64(offset, true);
  const rest = at + TUNING_BYTES + 1;
  return {
    name,
    t: { gain: f64(at), ti: f64(at + 8), td: f64(at + 16), tdFilter: f64(at + 24), low: f64(at + 32), high: f64(at + 40) },
    m: {
      running: bytes[rest - 1] === 1,
      integral: f64(rest),
      derivative: f64(rest + 8),
      pv: f64(rest + 16),
      setpoint: f64(rest + 24),
      output: f64(rest + 32),
    },
  };
}

// The values, or a fault: a component that is run elsewhere must stand on its own.
function checked(parameters: ArrayLike<number>, track: ArrayLike<number>): Tuning {
  const bad = (val: string): Fault => ({ tag: "bad-parameter", val });
  if (parameters.length !== PARAMETERS.length) throw bad("one value per parameter is needed");
  PARAMETERS.forEach((spec, i) => {
    const value = parameters[i]!;
    if (!(value >= spec.minimum && value <= spec.maximum)) throw bad(`${spec.name} is out of its range`);
  });
  if (track.length !== 1 || !Number.isFinite(track[0])) throw bad("track needs one finite value per output port");
  const [gain, ti, td, tdFilter, low, high] = Array.from(parameters) as [number, number, number, number, number, number];
  return { gain, ti, td, tdFilter, low, high };
}

// No plant measures more than 1e12, nor wants it; the law's numbers stay finite for as long.
function isSane(value: number): boolean {
  return value >= -1e12 && value <= 1e12;
}

function usable(reading: Reading): boolean {
  return reading.quality !== "bad" && isSane(reading.value);
}

// What the host calls. A fault is thrown.
export const control: Control = {
  describe() {
    return {
      name: NAME,
      version: "0.1.0",
      text: "The example law in TypeScript: PI(D) with clamping",
      ports: PORTS,
      parameters: PARAMETERS,
      stateLayout: STATE_LAYOUT,
    };
  },

  start(parameters, track) {
    const held = track[0]!;
    const t = checked(parameters, track);
    return encode(t, { running: false, integral: held, derivative: 0, pv: 0, setpoint: 0, output: held });
  },

  step(cycle, state) {
    const { name, t, m } = decode(state);
    if (name !== NAME) throw badState("the state belongs to another component");
    const reading = io.read(OUT);
    const held = usable(reading) ? reading.value : m.output;
    if (cycle.mode === "manual") {
      m.running = false;
      m.output = held;
      io.write(OUT, held);
      return encode(t, m);
    }
    const pv = io.read(PV);
    // The lowest bit of `connected` is the port 0.
    if (Number(cycle.connected) % 2 !== 1 || !usable(pv)) {
      throw { tag: "bad-input", val: "pv has no usable value" } satisfies Fault;
    }
    if (!isSane(cycle.setpoint)) {
      throw { tag: "bad-input", val: "the setpoint is beyond 1e12" } satisfies Fault;
    }
    io.write(OUT, step(t, m, pv.value, cycle.setpoint, held, Number(cycle.dtNs) * 1e-9));
    return encode(t, m);
  },

  migrate(from, state, parameters, track) {
    const next = checked(parameters, track);
    const { name, t, m } = decode(state);
    if (name !== from.name || from.stateLayout !== STATE_LAYOUT) {
      throw badState("the bytes name another component or layout than their origin does");
    }
    retune(m, t, next);
    return encode(next, m);
  },
};
