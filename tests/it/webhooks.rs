//! Alarms POSTed to a receiver that is there, slow, away, and back; told once each by their home, over its death too.

use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::{TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use bumpless_tests::{Api, Binary, Cell, CellOptions, wait_until};
use serde_json::{Value, json};

/// A body that was taken, its signature, and its bytes.
type Taken = (Value, String, Vec<u8>);

/// A receiver of a few lines. While it is shut it takes connections and gives 503.
struct Receiver {
    port: u16,
    shut: Arc<AtomicBool>,
    slow: Arc<AtomicBool>,
    got: Arc<Mutex<Vec<Taken>>>,
}

impl Receiver {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let receiver = Self {
            port: listener.local_addr().unwrap().port(),
            shut: Arc::default(),
            slow: Arc::default(),
            got: Arc::default(),
        };
        let (shut, slow, got) = (
            Arc::clone(&receiver.shut),
            Arc::clone(&receiver.slow),
            Arc::clone(&receiver.got),
        );
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                answer(&stream, &shut, &slow, &got);
            }
        });
        receiver
    }

    /// Ids of the bodies that were taken.
    fn ids(&self) -> Vec<String> {
        self.got
            .lock()
            .unwrap()
            .iter()
            .map(|(body, ..)| body["id"].as_str().unwrap().to_owned())
            .collect()
    }

    /// Waits for a body that says this; gives it.
    fn body(&self, what: &str) -> Value {
        wait_until(&format!("{what} is told"), Duration::from_secs(30), || {
            let got = self.got.lock().unwrap();
            let found = got
                .iter()
                .find(|(body, ..)| body["what"] == what)
                .map(|(body, ..)| body.clone());
            found.ok_or_else(|| format!("{:?}", got.iter().map(|(body, ..)| body).collect::<Vec<_>>()))
        })
        .unwrap()
    }
}

fn answer(stream: &TcpStream, shut: &AtomicBool, slow: &AtomicBool, got: &Mutex<Vec<Taken>>) {
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    let mut reader = BufReader::new(stream);
    let (mut length, mut signature) = (0, String::new());
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line).unwrap_or(0) == 0 {
            return;
        }
        let Some((name, value)) = line.trim_end().split_once(':') else {
            if line.trim().is_empty() {
                break;
            }
            continue;
        };
        match name.to_lowercase().as_str() {
            "content-length" => length = value.trim().parse().unwrap(),
            "x-bumpless-signature" => signature = value.trim().to_owned(),
            _ => {}
        }
    }
    let mut body = vec![0; length];
    if reader.read_exact(&mut body).is_err() {
        return;
    }
    if slow.swap(false, Ordering::SeqCst) {
        // Longer than the sender waits: it must come again.
        std::thread::sleep(Duration::from_millis(600));
        return;
    }
    let status = if shut.load(Ordering::SeqCst) {
        "503 Service Unavailable"
    } else {
        got.lock()
            .unwrap()
            .push((serde_json::from_slice(&body).unwrap(), signature, body));
        "204 No Content"
    };
    let _gone =
        (&*stream).write_all(format!("HTTP/1.1 {status}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n").as_bytes());
}

fn hook(api: &Api) -> Value {
    api.get("/v1/webhooks").unwrap()["webhooks"][0].clone()
}

/// Waits until the host looks at its clock, its disk and the signatures of what it runs.
fn own_alarms(api: &Api) {
    api.wait_until("the host's own alarms", |api| -> Result<(), String> {
        let list = api
            .get("/v1/alarms?all=true&loop=host.plant")
            .map_err(|error| error.to_string())?;
        let count = list["alarms"].as_array().map_or(0, Vec::len);
        if count == 3 { Ok(()) } else { Err(list.to_string()) }
    })
    .unwrap();
}

/// Makes one happening: the alarm `disk` of the host is taken out of service, or put back.
fn act(api: &Api, act: &str) {
    let request = json!({ "act": act, "reason": "drill", "by": "ann" });
    api.post("/v1/loops/host.plant/alarms/disk", &request).unwrap();
}

#[test]
fn alarms_are_told_in_order_once_and_by_their_home() {
    let receiver = Receiver::start();
    let folder = tempfile::tempdir().unwrap();
    let secret = folder.path().join("secret");
    std::fs::write(&secret, "a secret of some length\n").unwrap();
    let mut options = CellOptions::first_order("{ count = 1, tau_s = 0.5 }");
    options.controllers = 1;
    options.plant_tables = format!(
        "[[webhook]]\nname = \"pager\"\nurl = \"http://127.0.0.1:{}/alarms?token=secret\"\nquiet = true\ntimeout_ms = 300\n\
         what = [\"taken-out\", \"put-back\"]\nsecret_file = {:?}\n",
        receiver.port,
        secret.display().to_string()
    );
    let mut cell = Cell::start(options).unwrap();
    let api = cell.plant.api();
    own_alarms(&api);
    act(&api, "take-out");
    let told = receiver.body("taken-out");
    assert_eq!(
        (&told["loop"], &told["alarm"], &told["by"], &told["kind"]),
        (&json!("host.plant"), &json!("disk"), &json!("ann"), &json!("disk"))
    );
    let (_, signature, body) = receiver.got.lock().unwrap()[0].clone();
    let output = std::process::Command::new("python3")
        .args(["-c", "import hmac,sys;print('sha256='+hmac.new(b'a secret of some length',sys.stdin.buffer.read(),'sha256').hexdigest())"])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .and_then(|mut child| {
            child.stdin.take().unwrap().write_all(&body)?;
            child.wait_with_output()
        })
        .unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap().trim(), signature);
    assert_eq!(hook(&api)["to"], format!("http://127.0.0.1:{}/alarms", receiver.port));

    // A receiver that answers too late gets it again, under the same id.
    receiver.slow.store(true, Ordering::SeqCst);
    act(&api, "put-back");
    receiver.body("put-back");
    assert!(hook(&api)["failed"].as_u64().unwrap() >= 1);

    // One that is away gets all of it later; the host dies meanwhile.
    receiver.shut.store(true, Ordering::SeqCst);
    act(&api, "take-out");
    act(&api, "put-back");
    api.wait_until("a try that failed", |api| match hook(api)["trouble"].as_str() {
        Some(why) if why.contains("503") => Ok(()),
        other => Err(format!("{other:?}")),
    })
    .unwrap();
    assert_eq!(hook(&api)["waiting"], 2);
    cell.plant.kill9();
    receiver.shut.store(false, Ordering::SeqCst);
    cell.restart("plant").unwrap();
    wait_until("all of it is told", Duration::from_secs(30), || {
        let ids = receiver.ids();
        if ids.len() >= 4 { Ok(()) } else { Err(ids) }
    })
    .unwrap();
    let ids = receiver.ids();
    let mut sorted = ids.clone();
    sorted.sort_by_key(|id| id.rsplit('-').next().unwrap().parse::<u64>().unwrap());
    sorted.dedup();
    assert_eq!(ids, sorted, "in order, and none twice");
    let text = cell.plant.api().send("GET", "/metrics", &[], b"").unwrap().text();
    assert!(
        text.contains("bumpless_webhook_told_total{webhook=\"pager\"} 2"),
        "{text}"
    );
}

#[test]
fn any_host_tells_what_happens_to_the_alarms_of_another() {
    let mut options = CellOptions::first_order("{ count = 1, tau_s = 0.5 }");
    options.controllers = 1;
    let mut cell = Cell::start(options).unwrap();
    let api = cell.plant.api();
    own_alarms(&api);
    let other = cell.host("a").unwrap().api.clone();
    let mut watcher = Binary::find()
        .unwrap()
        .command()
        .args([
            "alarm",
            "watch",
            "--loop",
            "host.plant",
            "--count",
            "1",
            "--json",
            "--api",
            &other,
        ])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut next = ["take-out", "put-back"].into_iter().cycle();
    // Until the watcher is there nobody hears; it ends with the first that it hears.
    let ended = wait_until("the watcher hears of it", Duration::from_secs(30), || {
        act(&api, next.next().unwrap());
        watcher.try_wait().unwrap().ok_or("it waits")
    });
    let _gone = watcher.kill();
    let output = watcher.wait_with_output().unwrap();
    assert!(ended.unwrap().success());
    let event: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&event["host"], &event["loop"], &event["by"]),
        (&json!("plant"), &json!("host.plant"), &json!("ann"))
    );
}
