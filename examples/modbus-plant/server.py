"""An oven behind Modbus TCP: a stand-in for a field device, by an independent Modbus implementation.

The process runs in its own thread: first order with dead time, from heater output to temperature.

    tau * dT/dt + T = ambient + gain * u(t - dead time)      u = 0 while the contactor is open

Addresses count from 0, as on the wire.

    input    0      temperature, i16, 0.1 degC
    input    1      temperature as a 4-20 mA card shows it, u16, uA; 4000 to 20000 are 0 to 200 degC
    input    10-11  temperature, f32, high word first
    holding  0      heater output, u16, 0.01 % (0 to 10000)
    holding  10-11  ambient temperature, f32, high word first: write it for a disturbance
    coil     0      contactor of the heater
    discrete 0      over-temperature: above 180 degC

Nothing lies between: a read across a gap is refused with exception 2, as many devices do.
"""

import argparse
import asyncio
import collections
import random
import signal
import struct
import threading
import time

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

STEP_S = 0.02
OVER_TEMPERATURE_C = 180.0


class Oven(threading.Thread):
    """The process. Its numbers are read and written under its lock."""

    def __init__(self, options):
        super().__init__(daemon=True, name="oven")
        self.options = options
        self.lock = threading.Lock()
        self.ending = threading.Event()
        self.random = random.Random(options.seed)
        self.output = 0.0
        self.contactor = True
        self.ambient = 20.0
        self.temperature = 20.0
        self.shown = 20.0
        self.written_at = time.monotonic()
        steps = max(1, round(options.dead_time / STEP_S))
        self.on_its_way = collections.deque([0.0] * steps, maxlen=steps)

    def run(self):
        due = time.monotonic()
        while not self.ending.is_set():
            with self.lock:
                self.step()
            due += STEP_S / self.options.speed
            self.ending.wait(max(0.0, due - time.monotonic()))

    def step(self):
        """20 ms of the oven's time."""
        if 0 < self.options.watchdog < time.monotonic() - self.written_at:
            self.output = 0.0
        arrived = self.on_its_way[0]
        self.on_its_way.append(self.output if self.contactor else 0.0)
        rest = self.ambient + self.options.gain * arrived
        self.temperature += (rest - self.temperature) * STEP_S / self.options.tau
        self.shown = self.temperature + self.random.gauss(0.0, self.options.noise)


def limited(value, low, high):
    return max(low, min(high, round(value)))


def float_words(value):
    return list(struct.unpack(">HH", struct.pack(">f", value)))


def words_float(words):
    return struct.unpack(">f", struct.pack(">HH", *words))[0]


class Registers:
    """The oven as a Modbus device sees it."""

    def __init__(self, oven):
        self.oven = oven

    async def access(self, function, start, address, _count, registers, values):
        """Called before each read and write; `registers` begins at `start`."""
        if self.oven.options.delay:
            await asyncio.sleep(self.oven.options.delay)
        with self.oven.lock:
            if values is not None:
                return self.write(function, address, values)
            if function == 4:
                shown = self.oven.shown
                registers[0 - start] = limited(shown * 10, -32768, 32767) & 0xFFFF
                registers[1 - start] = limited(4000 + shown * 80, 0, 65535)
                registers[10 - start : 12 - start] = float_words(shown)
            elif function == 3:
                registers[0 - start] = limited(self.oven.output * 100, 0, 10000)
                registers[10 - start : 12 - start] = float_words(self.oven.ambient)
            elif function == 1:
                registers[0] = int(self.oven.contactor)
            elif function == 2:
                registers[0] = int(self.oven.shown > OVER_TEMPERATURE_C)
        return None

    def write(self, function, address, values):
        if function in (5, 15) and address == 0 and len(values) == 1:
            self.oven.contactor = bool(values[0])
        elif function in (6, 16) and address == 0 and len(values) == 1:
            if values[0] > 10000:
                return ExcCodes.ILLEGAL_VALUE
            self.oven.output = values[0] / 100
            self.oven.written_at = time.monotonic()
        elif function in (6, 16) and address == 10 and len(values) == 2:
            self.oven.ambient = words_float(values)
        else:
            return ExcCodes.ILLEGAL_ADDRESS
        return None


def device(unit, registers):
    coils = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
    discretes = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
    holding = [SimData(0, datatype=DataType.REGISTERS), SimData(10, count=2, datatype=DataType.REGISTERS)]
    inputs = [SimData(0, count=2, datatype=DataType.REGISTERS), SimData(10, count=2, datatype=DataType.REGISTERS)]
    return SimDevice(unit, simdata=(coils, discretes, holding, inputs), action=registers.access)


async def serve(options):
    oven = Oven(options)
    server = ModbusTcpServer(device(options.unit, Registers(oven)), address=(options.host, options.port))
    await server.serve_forever(background=True)
    oven.start()
    port = server.transport.sockets[0].getsockname()[1]
    # One line that a script can wait for; with --port 0 it is how to learn the port.
    print(f"listening on {options.host}:{port}", flush=True)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for name in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(name, ended.set)
    await ended.wait()
    oven.ending.set()
    await server.shutdown()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020, help="0 for any free one")
    parser.add_argument("--unit", type=int, default=1, help="unit identifier")
    parser.add_argument("--gain", type=float, default=1.5, help="degC per %%")
    parser.add_argument("--tau", type=float, default=20.0, help="time constant, s")
    parser.add_argument("--dead-time", type=float, default=2.0, help="s")
    parser.add_argument("--noise", type=float, default=0.05, help="standard deviation, degC")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=1.0, help="oven seconds per second")
    parser.add_argument("--delay", type=float, default=0.0, help="wait before each answer, s")
    parser.add_argument("--watchdog", type=float, default=0.0, help="output goes to 0 when nobody writes it for so long, s; 0 for never")
    asyncio.run(serve(parser.parse_args()))


if __name__ == "__main__":
    main()
