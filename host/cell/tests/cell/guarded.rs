//! A bus with TLS on both sides: members see each other, and strangers of every sort neither join, hear, nor are heard.

use std::{path::Path, time::Duration};

use bumpless_cell::{Arrival, TlsConfig, certificate_name};
use bumpless_core::CellName;
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use zenoh::Wait as _;

use crate::{
    Peer, config,
    nouns::{host, record},
    same,
};

const CELL: &str = "guarded";
/// How long a stranger's words would need at most: links and declarations take some tens of ms.
const LOOK: Duration = Duration::from_secs(2);

/// An authority in a folder, with the certificates that it made.
struct Authority {
    folder: tempfile::TempDir,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.distinguished_name.push(DnType::CommonName, "an authority");
        let made = params.self_signed(&key).unwrap();
        std::fs::write(folder.path().join("ca.pem"), made.pem()).unwrap();
        Self {
            issuer: Issuer::new(params, key),
            folder,
        }
    }

    /// Certificate and key with this common name.
    fn issue(&self, file: &str, common_name: &str) {
        let mut params = CertificateParams::new(vec!["127.0.0.1".to_owned(), "localhost".to_owned()]).unwrap();
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, common_name);
        let key = KeyPair::generate().unwrap();
        let made = params.signed_by(&key, &self.issuer).unwrap();
        std::fs::write(self.path(&format!("{file}.pem")), made.pem()).unwrap();
        std::fs::write(self.path(&format!("{file}.key")), key.serialize_pem()).unwrap();
    }

    fn path(&self, file: &str) -> std::path::PathBuf {
        self.folder.path().join(file)
    }

    fn tls(&self, file: &str, members: &[&str]) -> TlsConfig {
        TlsConfig {
            ca: self.path("ca.pem"),
            certificate: self.path(&format!("{file}.pem")),
            key: self.path(&format!("{file}.key")),
            members: members.iter().map(|name| host(name)).collect(),
        }
    }
}

fn guarded(name: &str, tls: TlsConfig, connect: &[&Peer]) -> bumpless_cell::Config {
    let mut config = config(CELL, name, connect);
    config.listen = vec!["tls/127.0.0.1:0".to_owned()];
    config.tls = Some(tls);
    config
}

fn common_name(name: &str) -> String {
    certificate_name(&CellName::new(CELL).unwrap(), &host(name))
}

/// The hosts `a` and `b` of a guarded cell.
async fn members(authority: &Authority) -> (Peer, Peer) {
    for name in ["a", "b"] {
        authority.issue(name, &common_name(name));
    }
    let tls = |name| authority.tls(name, &["a", "b"]);
    let mut a = Peer::open(&guarded("a", tls("a"), &[])).await.expect("a joins");
    let mut b = Peer::open(&guarded("b", tls("b"), &[&a])).await.expect("b joins");
    a.wait_up("b").await;
    b.wait_up("a").await;
    (a, b)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn members_say_all_that_they_say_without_tls() {
    let authority = Authority::new();
    let (mut a, mut b) = members(&authority).await;
    b.session.ping(a.name(), 7);
    a.wait_for("a ping", |x| matches!(x, Arrival::Ping { token: 7, .. }).then_some(()))
        .await;
    let sent = record(b.name(), 3, vec![]);
    b.session.publish_record(&sent);
    let got = a
        .wait_for("a record", |x| match x {
            Arrival::Record(record) => Some(record),
            _ => None,
        })
        .await;
    same(&*got, &sent);
    a.session.publish_notice(b"news");
    b.wait_for("a notice", |x| matches!(x, Arrival::Notice { .. }).then_some(()))
        .await;
    let (asker, asked) = (b.session.clone(), a.name().clone());
    let asking = tokio::spawn(async move { asker.request(&asked, b"how".to_vec(), crate::PATIENCE).await });
    let responder = a
        .wait_for("a request", |x| match x {
            Arrival::Request { responder, .. } => Some(responder),
            _ => None,
        })
        .await;
    responder.reply(Ok(b"well".to_vec()));
    assert_eq!(asking.await.unwrap().unwrap(), b"well");
    b.session.clone().close().await;
    a.wait_down("b").await;
}

/// A plain Zenoh session, as a stranger would write it.
fn stranger(locator: &str, tls: Option<(&Path, &Path, &Path)>) -> Result<zenoh::Session, zenoh::Error> {
    let mut config = zenoh::Config::default();
    let mut set = |key: &str, value: String| config.insert_json5(key, &value).unwrap();
    set("mode", "\"client\"".to_owned());
    set("connect/endpoints", format!("[{locator:?}]"));
    set("connect/timeout_ms", "1500".to_owned());
    set("connect/exit_on_failure", "true".to_owned());
    set("scouting/multicast/enabled", "false".to_owned());
    if let Some((ca, certificate, key)) = tls {
        let value = serde_json::json!({
            "root_ca_certificate": ca, "connect_certificate": certificate, "connect_private_key": key, "enable_mtls": true,
        });
        set("transport/link/tls", value.to_string());
    }
    zenoh::open(config).wait()
}

/// Nothing of a stranger has come to the host, and the stranger has heard nothing.
async fn says_and_hears_nothing(a: &mut Peer, b: &Peer, strange: zenoh::Session) {
    let heard = strange
        .declare_subscriber("bumpless/**")
        // Its own words come to itself.
        .allowed_origin(zenoh::sample::Locality::Remote)
        .wait()
        .unwrap();
    let alive = strange
        .liveliness()
        .declare_subscriber("bumpless/**")
        .history(true)
        .wait()
        .unwrap();
    let token = strange
        .liveliness()
        .declare_token(format!("bumpless/{CELL}/alive/eve/{}", "0".repeat(32)))
        .wait();
    let to_a = strange
        .declare_publisher(format!("bumpless/{CELL}/notice/b"))
        .wait()
        .unwrap();
    let until = tokio::time::Instant::now() + LOOK;
    let mut number = 0_u8;
    while tokio::time::Instant::now() < until {
        // A stranger's word as a member's, and words of members among themselves.
        to_a.put(vec![0xee, number]).wait().unwrap();
        strange
            .put(format!("bumpless/{CELL}/record/p1"), vec![0xee])
            .wait()
            .unwrap();
        strange
            .put(format!("bumpless/{CELL}/host/a/ping/b"), vec![0xee])
            .wait()
            .unwrap();
        b.session.publish_notice(&[number]);
        number = number.wrapping_add(1);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let asked = strange
        .get(format!("bumpless/{CELL}/host/a/request/b"))
        .payload(vec![1])
        .timeout(LOOK)
        .wait()
        .unwrap();
    let told = tokio::task::spawn_blocking(move || asked.recv().ok().map(|reply| reply.result().is_ok()))
        .await
        .unwrap();
    assert_ne!(told, Some(true), "nobody answered it");
    b.session.publish_notice(b"last");
    let before = a.everything_before(b"last").await;
    let of_stranger = |arrival: &&Arrival| match arrival {
        Arrival::Notice { payload, .. } => payload.first() == Some(&0xee),
        Arrival::Record(_) | Arrival::Ping { .. } | Arrival::Request { .. } => true,
        _ => false,
    };
    assert_eq!(before.iter().filter(of_stranger).count(), 0, "{before:?}");
    assert!(
        before.iter().any(|arrival| matches!(arrival, Arrival::Notice { .. })),
        "the members went on"
    );
    let read = heard.try_recv().ok().flatten();
    assert!(read.is_none(), "it read something: {read:?}");
    // Its own token it does see.
    while let Ok(Some(seen)) = alive.try_recv() {
        assert!(seen.key_expr().contains("/alive/eve/"), "it saw who is there: {seen:?}");
    }
    assert_eq!(a.session.hosts(), [host("a"), host("b")], "it did not join");
    drop(token);
    strange.close().wait().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn strangers_do_not_get_a_link() {
    let authority = Authority::new();
    let (a, _b) = members(&authority).await;
    let locator = a.session.locators().remove(0);
    let other = Authority::new();
    other.issue("a", &common_name("a"));
    let ca = authority.path("ca.pem");
    let opened = tokio::task::spawn_blocking(move || {
        let plain = stranger(&locator.replace("tls/", "tcp/"), None).is_ok();
        let bare = stranger(&locator, None).is_ok();
        let (certificate, key) = (other.path("a.pem"), other.path("a.key"));
        let of_another_authority = stranger(&locator, Some((&ca, &certificate, &key))).is_ok();
        [plain, bare, of_another_authority]
    });
    assert_eq!(
        opened.await.unwrap(),
        [false; 3],
        "plain, without a certificate, with one of another authority"
    );
    assert_eq!(a.session.hosts().len(), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_of_the_authority_without_a_membership_is_worth_nothing() {
    let authority = Authority::new();
    let (mut a, b) = members(&authority).await;
    for (file, name) in [
        ("eve", common_name("eve")),
        ("other-cell", "a.other.bumpless".to_owned()),
    ] {
        authority.issue(file, &name);
        let (locator, ca) = (a.session.locators().remove(0), authority.path("ca.pem"));
        let (certificate, key) = (
            authority.path(&format!("{file}.pem")),
            authority.path(&format!("{file}.key")),
        );
        let opened = tokio::task::spawn_blocking(move || stranger(&locator, Some((&ca, &certificate, &key))));
        // A link may be there; nothing passes over it.
        if let Ok(strange) = opened.await.unwrap() {
            says_and_hears_nothing(&mut a, &b, strange).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_member_speaks_as_itself_alone() {
    let authority = Authority::new();
    let (mut a, b) = members(&authority).await;
    let (locator, ca) = (a.session.locators().remove(0), authority.path("ca.pem"));
    let (certificate, key) = (authority.path("b.pem"), authority.path("b.key"));
    let strange = tokio::task::spawn_blocking(move || stranger(&locator, Some((&ca, &certificate, &key))))
        .await
        .unwrap()
        .expect("a member's certificate gives a link");
    // As itself it is heard, so the words below would be heard, too, if they were let through.
    let (own, as_a_third) = (format!("bumpless/{CELL}/notice/b"), format!("bumpless/{CELL}/notice/c"));
    let mut number = 0_u8;
    let heard = loop {
        strange.put(as_a_third.clone(), vec![0xcc]).wait().unwrap();
        strange.put(own.clone(), vec![0xbb]).wait().unwrap();
        b.session.publish_notice(&[number]);
        number += 1;
        assert!(number < 200);
        let next = a.wait_for("a notice", |x| match x {
            Arrival::Notice { from, payload } => Some((from, payload.to_vec())),
            _ => None,
        });
        let (from, payload) = next.await;
        assert_ne!(from, host("c"), "it spoke as another");
        if payload == [0xbb] {
            break from;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert_eq!(heard, host("b"));
    strange.close().wait().unwrap();
}
