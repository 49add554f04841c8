"""The example law in Python: PI(D) with clamping. `examples/rust-pid/src/law.rs` has the formulae and their sources.

Only + - * / and comparisons are used, in the same order as in the other languages, so the numbers are the same to the last bit.
Never: keeps anything between calls outside the state bytes; a step may run twice, on any host.
"""

import math
import struct
from dataclasses import dataclass

from componentize_py_types import Err
from wit_world import exports
from wit_world.exports.control import Cycle, Descriptor, Direction, Kind, Origin, Parameter, Port
from wit_world.imports import io
from wit_world.imports.types import Fault_BadInput, Fault_BadParameter, Fault_BadState, Mode, Quality

NAME = "python-pid"
STATE_LAYOUT = 1
# The same law in other languages: their states are taken over.
FAMILY = (NAME, "rust-pid", "rust-wasip2-pid", "c-pid", "js-pid", "ts-pid")

PORTS = [
    Port("pv", Direction.INPUT, Kind.ANALOG, "", True, "Measurement, in the unit of the setpoint"),
    Port("out", Direction.OUTPUT, Kind.ANALOG, "", True, "To the actuator"),
]
PV, OUT = 0, 1

PARAMETERS = [
    Parameter("gain", "out/pv", 1.0, -1e6, 1e6, [], "Gain; below 0 for direct action"),
    Parameter("ti", "s", 10.0, 0.0, 1e6, [], "Integral time; 0 for none"),
    Parameter("td", "s", 0.0, 0.0, 1e6, [], "Derivative time; 0 for none"),
    Parameter("td-filter", "s", 1.0, 0.0, 1e6, [], "Filter time of the derivative"),
    Parameter("out-low", "out", 0.0, -1e9, 1e9, [], "Least output"),
    Parameter("out-high", "out", 100.0, -1e9, 1e9, [], "Greatest output"),
]


@dataclass
class Memory:
    """What lasts from step to step."""

    running: bool
    integral: float
    derivative: float
    pv: float
    setpoint: float
    output: float

    def step(self, t, pv: float, setpoint: float, held: float, dt_s: float) -> float:
        gain, ti, td, td_filter, low, high = t
        error = setpoint - pv
        if self.running:
            self.derivative = (td_filter * self.derivative + td * (self.pv - pv)) / (td_filter + dt_s)
            change = gain * error * dt_s / ti if ti > 0.0 else 0.0
            rest = gain * (error + self.derivative)
            wanted = self.integral + change + rest
            further = (wanted > high and change > 0.0) or (wanted < low and change < 0.0)
            if not further:
                self.integral += change
            self.output = limited(self.integral + rest, low, high)
        else:
            self.running = True
            self.derivative = 0.0
            self.integral = held - gain * error
            self.output = limited(held, low, high)
        self.pv = pv
        self.setpoint = setpoint
        return self.output

    def follow(self, held: float) -> None:
        """Somebody else decides the output, and it is `held`."""
        self.running = False
        self.output = held

    def retune(self, old, new) -> None:
        """Moves the integral so that the output for the last sample stays what it was."""
        if old == new:
            return
        error = self.setpoint - self.pv
        before = old[0] * (error + self.derivative)
        if new[2] == 0.0:
            self.derivative = 0.0
        self.integral = self.integral + before - new[0] * (error + self.derivative)


def limited(value: float, low: float, high: float) -> float:
    if value > high:
        return high
    if value < low:
        return low
    return value


# The state bytes, all little endian: mark, length and text of the name, layout, number of parameters, their values, memory.
MARK = 0xB1
MEMORY = struct.Struct("<?5d")
TUNING = struct.Struct("<6d")


def encode(tuning, memory: Memory) -> bytes:
    name = NAME.encode()
    front = struct.pack("<BB", MARK, len(name)) + name + struct.pack("<IB", STATE_LAYOUT, len(tuning))
    values = (memory.running, memory.integral, memory.derivative, memory.pv, memory.setpoint, memory.output)
    return front + TUNING.pack(*tuning) + MEMORY.pack(*values)


def decode(state: bytes):
    """The writer's name, its parameters and its memory."""
    try:
        mark, length = state[0], state[1]
        name = state[2 : 2 + length].decode()
        layout, count = struct.unpack_from("<IB", state, 2 + length)
        at = 7 + length
        if mark != MARK or layout != STATE_LAYOUT or count != len(PARAMETERS) or name not in FAMILY:
            raise Err(Fault_BadState("the state is not of this law"))
        if len(state) != at + TUNING.size + MEMORY.size:
            raise Err(Fault_BadState("the state has another length"))
        return name, TUNING.unpack_from(state, at), Memory(*MEMORY.unpack_from(state, at + TUNING.size))
    except (IndexError, UnicodeDecodeError, struct.error) as error:
        raise Err(Fault_BadState("the state does not decode")) from error


def checked(parameters, track):
    """The values, or a fault: a component that is run elsewhere must stand on its own."""
    if len(parameters) != len(PARAMETERS):
        raise Err(Fault_BadParameter("one value per parameter is needed"))
    for spec, value in zip(PARAMETERS, parameters):
        if not spec.minimum <= value <= spec.maximum:
            raise Err(Fault_BadParameter(f"{spec.name} is out of its range"))
    if len(track) != 1 or not math.isfinite(track[0]):
        raise Err(Fault_BadParameter("track needs one finite value per output port"))
    return tuple(parameters)


def is_sane(value: float) -> bool:
    """No plant measures more than this, nor wants it; the law's numbers stay finite for as long."""
    return abs(value) <= 1e12


def usable(reading) -> bool:
    return reading.quality != Quality.BAD and is_sane(reading.value)


class Control(exports.Control):
    """What the host calls."""

    def describe(self) -> Descriptor:
        return Descriptor(
            NAME, "0.1.0", "The example law in Python: PI(D) with clamping", PORTS, PARAMETERS, STATE_LAYOUT
        )

    def start(self, parameters, track) -> bytes:
        tuning = checked(parameters, track)
        return encode(tuning, Memory(False, track[0], 0.0, 0.0, 0.0, track[0]))

    def step(self, cycle: Cycle, state: bytes) -> bytes:
        name, tuning, memory = decode(state)
        if name != NAME:
            raise Err(Fault_BadState("the state belongs to another component"))
        reading = io.read(OUT)
        held = reading.value if usable(reading) else memory.output
        if cycle.mode == Mode.MANUAL:
            memory.follow(held)
            io.write(OUT, held)
            return encode(tuning, memory)
        pv = io.read(PV)
        if not cycle.connected >> PV & 1 or not usable(pv):
            raise Err(Fault_BadInput("pv has no usable value"))
        if not is_sane(cycle.setpoint):
            raise Err(Fault_BadInput("the setpoint is beyond 1e12"))
        io.write(OUT, memory.step(tuning, pv.value, cycle.setpoint, held, cycle.dt_ns * 1e-9))
        return encode(tuning, memory)

    def migrate(self, from_: Origin, state: bytes, parameters, track) -> bytes:
        tuning = checked(parameters, track)
        name, old, memory = decode(state)
        if name != from_.name or from_.state_layout != STATE_LAYOUT:
            raise Err(Fault_BadState("the bytes name another component or layout than their origin does"))
        memory.retune(old, tuning)
        return encode(tuning, memory)
