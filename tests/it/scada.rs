//! The cell as a Modbus device: a SCADA system reads points of another host and commands a loop.

use std::{
    io::{Read as _, Write as _},
    net::{TcpListener, TcpStream},
    time::Duration,
};

use bumpless_tests::{Cell, CellOptions, pressure_loop};

use crate::{settle, text};

/// A client of a few lines, written from the protocol's text.
struct Scada(TcpStream);

impl Scada {
    fn connect(port: u16) -> Self {
        let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        Self(stream)
    }

    /// One request, as function and data; the answer likewise.
    fn ask(&mut self, pdu: &[u8]) -> Vec<u8> {
        let length = u16::try_from(pdu.len() + 1).unwrap().to_be_bytes();
        let header = [0, 1, 0, 0, length[0], length[1], 1];
        self.0.write_all(&[&header, pdu].concat()).unwrap();
        let mut header = [0; 7];
        self.0.read_exact(&mut header).unwrap();
        let mut answer = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
        self.0.read_exact(&mut answer).unwrap();
        answer
    }

    /// A float in two registers of function 3 or 4.
    fn float(&mut self, function: u8, address: u8) -> Result<f32, u8> {
        let answer = self.ask(&[function, 0, address, 0, 2]);
        match answer.as_slice() {
            [_, 4, a, b, c, d] => Ok(f32::from_be_bytes([*a, *b, *c, *d])),
            [_, code] => Err(*code),
            other => panic!("{other:?}"),
        }
    }

    fn write_float(&mut self, address: u8, value: f32) -> Vec<u8> {
        let [a, b, c, d] = value.to_be_bytes();
        self.ask(&[16, 0, address, 0, 2, 4, a, b, c, d])
    }
}

fn tables(port: u16) -> String {
    let mut tables = format!("[[modbus_server]]\nlisten = \"127.0.0.1:{port}\"\nrefresh_ms = 50\n");
    for entry in [
        "table = \"input\"\naddress = 0\npoint = \"plant.pit129\"\ntype = \"f32\"",
        "table = \"input\"\naddress = 2\npoint = \"plant.pit129\"\nitem = \"quality\"",
        "table = \"holding\"\naddress = 0\nloop = \"pressure\"\ntype = \"f32\"\nwritable = true\nlow = 0.0\nhigh = 1.5",
        "table = \"holding\"\naddress = 2\nloop = \"pressure\"\nitem = \"mode\"\nwritable = true",
        "table = \"holding\"\naddress = 3\nloop = \"pressure\"\nitem = \"output\"\ntype = \"f32\"",
        "table = \"coil\"\naddress = 0\nloop = \"pressure\"\nitem = \"mode\"\nwritable = true",
    ] {
        tables.push_str("[[modbus_server.map]]\n");
        tables.push_str(entry);
        tables.push('\n');
    }
    tables
}

#[test]
fn a_scada_system_reads_and_commands_a_loop_of_another_host() {
    // A port that was free a moment ago; the host says so if somebody else was quicker.
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let options = CellOptions {
        controllers: 1,
        controller_tables: tables(port),
        ..CellOptions::default()
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut scada = Scada::connect(port);
    // No loop yet: nothing is made up for it.
    assert_eq!(scada.float(3, 0), Err(4));
    api.apply(&pressure_loop("pid", 50.0)).unwrap();
    settle(&api, "pressure", 0.05);
    api.wait_until("a good quality", |_| match scada.ask(&[4, 0, 2, 0, 1]).as_slice() {
        [4, 2, 0, 2] => Ok(()),
        other => Err(other.to_vec()),
    })
    .unwrap();
    let measured = f64::from(scada.float(4, 0).unwrap());
    let setpoint = api.loop_view("pressure").unwrap()["setpoint"].as_f64().unwrap();
    assert!(
        (measured - setpoint).abs() < 0.2,
        "{measured} at a setpoint of {setpoint}"
    );
    assert_eq!(f64::from(scada.float(3, 0).unwrap()), f64::from(setpoint as f32));

    // A write is answered when a record holds it, so it is read back at once, here and over the API.
    assert_eq!(scada.write_float(0, 1.25), [16, 0, 0, 0, 2]);
    assert_eq!(scada.float(3, 0), Ok(1.25));
    assert_eq!(api.loop_view("pressure").unwrap()["setpoint"], 1.25);
    for (answer, wanted) in [
        (scada.write_float(0, 1.75), [0x90, 3]),
        (scada.write_float(0, f32::NAN), [0x90, 3]),
        (scada.write_float(3, 1.0), [0x90, 4]),
        (scada.ask(&[6, 0, 9, 0, 1]), [0x86, 2]),
        (scada.ask(&[6, 0, 0, 0, 1]), [0x86, 3]),
        (scada.ask(&[6, 0, 2, 0, 7]), [0x86, 3]),
        (scada.ask(&[4, 0, 9, 0, 1]), [0x84, 2]),
        (scada.ask(&[7]), [0x87, 1]),
    ] {
        assert_eq!(answer, wanted);
    }
    assert_eq!(api.loop_view("pressure").unwrap()["setpoint"], 1.25);
    assert_eq!(scada.ask(&[5, 0, 0, 0, 0]), [5, 0, 0, 0, 0]);
    assert_eq!(text(&api.loop_view("pressure").unwrap()["mode"]), "manual");
    assert_eq!(scada.ask(&[6, 0, 2, 0, 1]), [6, 0, 2, 0, 1]);
    assert_eq!(scada.ask(&[1, 0, 0, 0, 1]), [1, 1, 1]);
    // Who did it is in the log.
    let own = scada.0.local_addr().unwrap().to_string();
    let log = cell.host("a").unwrap().stderr();
    let line = log
        .lines()
        .find(|line| line.contains("written over Modbus") && line.contains("setpoint of pressure"));
    assert!(line.is_some_and(|line| line.contains(&own)), "{own}: {log}");
    assert!(log.contains("must be 0 to 1.5"), "{log}");

    // Its source is gone: what was read last is not shown for ever.
    cell.plant.kill9();
    until_silence(&mut scada);
}

/// Waits until the measurement and the setpoint of a host that died are no values any more.
fn until_silence(scada: &mut Scada) {
    bumpless_tests::wait_until("exceptions instead of values", bumpless_tests::WAIT_MAX, || {
        let (point, setpoint) = (scada.float(4, 0), scada.float(3, 0));
        if (point, setpoint) == (Err(4), Err(4)) {
            Ok(())
        } else {
            Err((point, setpoint))
        }
    })
    .unwrap();
}
