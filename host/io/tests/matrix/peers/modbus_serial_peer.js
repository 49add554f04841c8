// modbus-serial for Node.js, as a client of ours and as a server for ours. Same words as pymodbus_peer.py.
"use strict";

const net = require("net");
const path = require("path");
const readline = require("readline");
const home = process.env.PEER_MODULES;
const Modbus = require(path.join(home, "modbus-serial"));

async function ask(device, op) {
    const [what, a, b, c, d] = op;
    const values = (got, count) => ({ values: got.data.slice(0, count).map(Number) });
    switch (what) {
        case "read":
            if (a === "coil") return values(await device.readCoils(b, c), c);
            if (a === "discrete") return values(await device.readDiscreteInputs(b, c), c);
            if (a === "holding") return values(await device.readHoldingRegisters(b, c), c);
            return values(await device.readInputRegisters(b, c), c);
        case "write-coil":
            await device.writeCoil(a, Boolean(b));
            return { done: true };
        case "write-register":
            await device.writeRegister(a, b);
            return { done: true };
        case "write-coils":
            await device.writeCoils(a, b.map(Boolean));
            return { done: true };
        case "write-registers":
            await device.writeRegisters(a, b);
            return { done: true };
        case "mask":
            await device.maskWriteRegister(a, b, c);
            return { done: true };
        case "read-write":
            return values(await device.readWriteRegisters(a, b, c, d.length, d), b);
        default:
            return { missing: true };
    }
}

async function client(port, unit) {
    const device = new Modbus();
    await device.connectTCP("127.0.0.1", { port });
    device.setID(unit);
    device.setTimeout(5000);
    for await (const line of readline.createInterface({ input: process.stdin })) {
        let answer;
        try {
            answer = await ask(device, JSON.parse(line));
        } catch (error) {
            answer = error.modbusCode ? { exception: error.modbusCode } : { error: error.message };
        }
        console.log(JSON.stringify(answer));
    }
    device.close(() => process.exit(0));
}

function server() {
    const held = {
        coils: new Array(2048).fill(false),
        discretes: new Array(2048).fill(false),
        holding: new Array(300).fill(0),
        input: new Array(300).fill(0),
    };
    const at = (list, address) => {
        if (address >= list.length) throw { modbusErrorCode: 2, msg: "no such address" };
        return list[address];
    };
    const put = (list, address, value) => {
        at(list, address);
        list[address] = value;
    };
    const vector = {
        getCoil: (address) => at(held.coils, address),
        getDiscreteInput: (address) => at(held.discretes, address),
        getHoldingRegister: (address) => at(held.holding, address),
        getInputRegister: (address) => at(held.input, address),
        setCoil: (address, value) => put(held.coils, address, value),
        setRegister: (address, value) => put(held.holding, address, value),
    };
    // The library does not tell which free port it took.
    const free = net.createServer().listen(0, "127.0.0.1", () => {
        const port = free.address().port;
        free.close(() => {
            const serving = new Modbus.ServerTCP(vector, { host: "127.0.0.1", port, unitID: 1 });
            serving.on("initialized", () => console.log(port));
            serving.on("socketError", () => {});
        });
    });
    process.stdin.resume().on("end", () => process.exit(0));
}

if (process.argv[2] === "client") client(Number(process.argv[3]), Number(process.argv[4]));
else server();
