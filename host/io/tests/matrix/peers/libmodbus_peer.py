"""libmodbus, the C library, by its own shared object: as a client of ours and as a server for ours.

Same words as pymodbus_peer.py.
"""

import ctypes
import ctypes.util
import json
import socket
import sys
import threading

LIBRARY = ctypes.CDLL(ctypes.util.find_library("modbus") or "libmodbus.so.5", use_errno=True)
LIBRARY.modbus_new_tcp.restype = ctypes.c_void_p
LIBRARY.modbus_mapping_new.restype = ctypes.c_void_p
LIBRARY.modbus_strerror.restype = ctypes.c_char_p
# libmodbus numbers exceptions from here on (modbus.h, MODBUS_ENOBASE).
ERRNO_BASE = 112345678


def client(port, unit):
    device = ctypes.c_void_p(LIBRARY.modbus_new_tcp(b"127.0.0.1", port))
    LIBRARY.modbus_set_slave(device, unit)
    LIBRARY.modbus_set_response_timeout(device, 5, 0)
    if LIBRARY.modbus_connect(device) == -1:
        sys.exit("no connection")

    def words(values):
        return (ctypes.c_uint16 * len(values))(*values)

    def octets(values):
        return (ctypes.c_uint8 * len(values))(*values)

    def ask(op):
        what, args = op[0], op[1:]
        buffer = None
        if what == "read":
            table, start, count = args
            if table in ("coil", "discrete"):
                buffer = octets([0] * count)
                name = "modbus_read_bits" if table == "coil" else "modbus_read_input_bits"
            else:
                buffer = words([0] * count)
                name = "modbus_read_registers" if table == "holding" else "modbus_read_input_registers"
            got = getattr(LIBRARY, name)(device, start, count, buffer)
        elif what == "write-coil":
            got = LIBRARY.modbus_write_bit(device, args[0], int(args[1]))
        elif what == "write-register":
            got = LIBRARY.modbus_write_register(device, args[0], ctypes.c_uint16(args[1]))
        elif what == "write-coils":
            got = LIBRARY.modbus_write_bits(device, args[0], len(args[1]), octets([int(v) for v in args[1]]))
        elif what == "write-registers":
            got = LIBRARY.modbus_write_registers(device, args[0], len(args[1]), words(args[1]))
        elif what == "mask":
            got = LIBRARY.modbus_mask_write_register(
                device, args[0], ctypes.c_uint16(args[1]), ctypes.c_uint16(args[2])
            )
        elif what == "read-write":
            buffer = words([0] * args[1])
            got = LIBRARY.modbus_write_and_read_registers(
                device, args[2], len(args[3]), words(args[3]), args[0], args[1], buffer
            )
        else:
            return {"missing": True}
        if got == -1:
            number = ctypes.get_errno()
            if ERRNO_BASE < number < ERRNO_BASE + 12:
                return {"exception": number - ERRNO_BASE}
            return {"error": LIBRARY.modbus_strerror(number).decode()}
        return {"values": list(buffer)} if buffer is not None else {"done": True}

    for line in sys.stdin:
        print(json.dumps(ask(json.loads(line))), flush=True)


def server():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    device = ctypes.c_void_p(LIBRARY.modbus_new_tcp(b"127.0.0.1", port))
    mapping = ctypes.c_void_p(LIBRARY.modbus_mapping_new(2048, 2048, 300, 300))
    listening = ctypes.c_int(LIBRARY.modbus_tcp_listen(device, 4))
    if listening.value == -1 or not mapping:
        sys.exit("it cannot listen")

    def serve():
        query = (ctypes.c_uint8 * 260)()
        while LIBRARY.modbus_tcp_accept(device, ctypes.byref(listening)) != -1:
            while True:
                count = LIBRARY.modbus_receive(device, query)
                if count == -1:
                    break
                if count > 0:
                    LIBRARY.modbus_reply(device, query, count, mapping)
            LIBRARY.modbus_close(device)

    threading.Thread(target=serve, daemon=True).start()
    print(port, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(int(sys.argv[2]), int(sys.argv[3]))
    else:
        server()
