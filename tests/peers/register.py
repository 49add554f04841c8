"""Looks at a holding register of a Modbus device, by an independent Modbus implementation.

Prints the value now; then, until its input closes, reads on, and prints the least and the greatest value that it saw.
Times at which the device does not answer are passed over.
"""

import argparse
import select
import sys

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("address", type=int)
    options = parser.parse_args()
    client = ModbusTcpClient("127.0.0.1", port=options.port, timeout=2, retries=0)

    def read():
        try:
            if not client.connected and not client.connect():
                return None
            answer = client.read_holding_registers(options.address, count=1, device_id=1)
        except ModbusException:
            return None
        return None if answer.isError() else answer.registers[0]

    value = read()
    if value is None:
        sys.exit(f"the device on port {options.port} does not answer")
    print(value, flush=True)
    low = high = value
    while not select.select([sys.stdin], [], [], 0.01)[0]:
        value = read()
        if value is not None:
            low, high = min(low, value), max(high, value)
    print(low, high, flush=True)


if __name__ == "__main__":
    main()
