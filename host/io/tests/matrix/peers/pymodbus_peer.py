"""pymodbus, as a client of ours and as a server for ours.

    pymodbus_peer.py client PORT UNIT [FOLDER NAME]   reads one operation a line (JSON), writes one answer a line (JSON)
    pymodbus_peer.py server [FOLDER]                  prints its port, then serves until its input closes

With a folder of certificates: over TLS.

Operations: ["read", table, start, count], ["write-coil", at, on], ["write-register", at, word], ["write-coils", at, [on]],
["write-registers", at, [word]], ["mask", at, and, or], ["read-write", read at, count, write at, [word]]. Answers:
{"values": [...]}, {"done": true}, {"exception": code}, {"error": text}, {"missing": true}.
"""

import asyncio
import json
import os
import ssl
import sys

from pymodbus.client import ModbusTcpClient, ModbusTlsClient

TABLES = {"coil": "coils", "discrete": "discrete_inputs", "holding": "holding_registers", "input": "input_registers"}


def secured(purpose, folder, name):
    context = ssl.SSLContext(purpose)
    # pymodbus does not tell the name to the handshake; the authority is checked all the same.
    context.check_hostname = False
    context.load_verify_locations(os.path.join(folder, "plant.pem"))
    context.load_cert_chain(os.path.join(folder, name + ".pem"), os.path.join(folder, name + ".key"))
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def client(port, unit, folder=None, name=None):
    if folder:
        context = secured(ssl.PROTOCOL_TLS_CLIENT, folder, name)
        device = ModbusTlsClient("127.0.0.1", port=port, timeout=5, retries=0, sslctx=context)
    else:
        device = ModbusTcpClient("127.0.0.1", port=port, timeout=5, retries=0)
    if not device.connect():
        sys.exit("no connection")

    def ask(op):
        what, args = op[0], op[1:]
        if what == "read":
            table, start, count = args
            got = getattr(device, "read_" + TABLES[table])(start, count=count, device_id=unit)
            values = lambda: (got.bits if table in ("coil", "discrete") else got.registers)[:count]
        elif what == "write-coil":
            got, values = device.write_coil(args[0], bool(args[1]), device_id=unit), None
        elif what == "write-register":
            got, values = device.write_register(args[0], args[1], device_id=unit), None
        elif what == "write-coils":
            got, values = device.write_coils(args[0], [bool(v) for v in args[1]], device_id=unit), None
        elif what == "write-registers":
            got, values = device.write_registers(args[0], args[1], device_id=unit), None
        elif what == "mask":
            got = device.mask_write_register(address=args[0], and_mask=args[1], or_mask=args[2], device_id=unit)
            values = None
        elif what == "read-write":
            got = device.readwrite_registers(
                read_address=args[0], read_count=args[1], write_address=args[2], values=args[3], device_id=unit
            )
            values = lambda: got.registers
        else:
            return {"missing": True}
        if got.isError():
            return {"exception": got.exception_code}
        return {"values": [int(v) for v in values()]} if values else {"done": True}

    for line in sys.stdin:
        try:
            answer = ask(json.loads(line))
        except Exception as error:  # whatever it finds wrong with a request is its own way of saying no
            answer = {"error": str(error) or type(error).__name__}
        print(json.dumps(answer), flush=True)


async def server(folder=None):
    from pymodbus.server import ModbusTcpServer, ModbusTlsServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    bits = lambda: [SimData(0, values=[False] * 2048, datatype=DataType.BITS)]
    words = lambda: [SimData(0, count=300, datatype=DataType.REGISTERS)]
    device = SimDevice(1, simdata=(bits(), bits(), words(), words()))
    if folder:
        context = secured(ssl.PROTOCOL_TLS_SERVER, folder, "device")
        serving = ModbusTlsServer(device, address=("127.0.0.1", 0), sslctx=context)
    else:
        serving = ModbusTcpServer(device, address=("127.0.0.1", 0))
    await serving.serve_forever(background=True)
    print(serving.transport.sockets[0].getsockname()[1], flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    await serving.shutdown()


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:6])
    else:
        asyncio.run(server(*sys.argv[2:3]))
