//! Requests end: with a reply, a refusal, a time-out, or because nobody is there.

use std::time::Duration;

use bumpless_cell::{Arrival, Error, Responder, limits::REQUESTS_IN_FLIGHT_MAX};

use crate::{PATIENCE, Peer, nouns::host, pair};

async fn next_request(peer: &mut Peer) -> (Vec<u8>, Responder) {
    peer.wait_for("a request", |arrival| match arrival {
        Arrival::Request { payload, responder, .. } => Some((payload, responder)),
        _ => None,
    })
    .await
}

#[tokio::test]
async fn a_reply_and_its_asker() {
    let (a, mut b) = pair("reply").await;
    let to = b.name().clone();
    let asked = a.session.request(&to, b"which revision?".to_vec(), PATIENCE);
    let answered = async {
        let (from, payload, responder) = b
            .wait_for("a request", |arrival| match arrival {
                Arrival::Request {
                    from,
                    payload,
                    responder,
                } => Some((from, payload, responder)),
                _ => None,
            })
            .await;
        assert_eq!((from, payload.as_slice()), (host("a"), b"which revision?".as_slice()));
        // From a thread that has nothing to do with the runtime.
        std::thread::spawn(move || responder.reply(Ok(b"five".to_vec())))
            .join()
            .unwrap();
    };
    let (reply, ()) = tokio::join!(asked, answered);
    assert_eq!(reply.unwrap(), b"five");
}

#[tokio::test]
async fn a_refusal_and_a_request_that_is_dropped() {
    let (a, mut b) = pair("refuse").await;
    let to = b.name().clone();
    for (reply, reason) in [
        (Some(Err("no such digest".to_owned())), "host b refused: no such digest"),
        (None, "host b refused: the host dropped the request without a reply"),
    ] {
        let asked = a.session.request(&to, vec![], PATIENCE);
        let answered = async {
            let (payload, responder) = next_request(&mut b).await;
            assert!(payload.is_empty());
            match reply {
                Some(reply) => responder.reply(reply),
                None => drop(responder),
            }
        };
        let (reply, ()) = tokio::join!(asked, answered);
        let error = reply.expect_err(reason);
        assert!(matches!(error, Error::Refused { .. }), "{error:?}");
        assert_eq!(error.to_string(), reason);
    }
}

#[tokio::test]
async fn silence_is_a_time_out() {
    let (a, mut b) = pair("silence").await;
    let to = b.name().clone();
    let asked = a.session.request(&to, vec![], Duration::from_millis(200));
    // Held until the asker has given up.
    let (reply, held) = tokio::join!(asked, next_request(&mut b));
    let error = reply.expect_err("nobody replied");
    assert!(matches!(error, Error::Timeout { timeout_ms: 200, .. }), "{error:?}");
    drop(held);
}

#[tokio::test]
async fn nobody_there_is_said_at_once() {
    let (a, _b) = pair("nobody").await;
    // A time-out that would fail the test if it were waited for.
    let nobody = host("nobody");
    let asked = a.session.request(&nobody, vec![], Duration::from_secs(600));
    let error = tokio::time::timeout(PATIENCE, asked)
        .await
        .expect("an end without a time-out")
        .expect_err("no host");
    assert!(matches!(error, Error::NoSuchHost { .. }), "{error:?}");
    assert!(error.to_string().contains("no host nobody answers"), "{error}");
}

#[tokio::test]
async fn a_host_that_goes_while_it_is_asked() {
    let (a, mut b) = pair("going").await;
    let to = b.name().clone();
    let asked = a.session.request(&to, vec![], Duration::from_secs(600));
    let going = async {
        let (_, responder) = next_request(&mut b).await;
        // Nothing can be sent any more when the responder refuses.
        b.session.clone().close().await;
        drop(responder);
    };
    let (reply, ()) = tokio::time::timeout(PATIENCE, async { tokio::join!(asked, going) })
        .await
        .expect("an end");
    let error = reply.expect_err("the host went");
    assert!(matches!(error, Error::NoSuchHost { .. }), "{error:?}");
}

#[tokio::test]
async fn a_component_of_16_mib_goes_there_and_back() {
    let (a, mut b) = pair("component").await;
    let to = b.name().clone();
    let component: Vec<u8> = (0..16 * 1024 * 1024u32)
        .map(|i| u8::try_from(i.wrapping_mul(2_654_435_761) >> 24).unwrap())
        .collect();
    let asked = a.session.request(&to, component.clone(), PATIENCE);
    let answered = async {
        let (payload, responder) = next_request(&mut b).await;
        responder.reply(Ok(payload));
    };
    let (reply, ()) = tokio::join!(asked, answered);
    assert!(reply.unwrap() == component, "the component came back changed");
    let error = a
        .session
        .request(&to, vec![0; 40 * 1024 * 1024], PATIENCE)
        .await
        .expect_err("too large");
    assert!(matches!(error, Error::TooLarge { .. }), "{error:?}");
}

#[tokio::test]
async fn a_reply_that_is_too_large_is_a_refusal() {
    let (a, mut b) = pair("fat-reply").await;
    let to = b.name().clone();
    let asked = a.session.request(&to, vec![], PATIENCE);
    let answered = async {
        let (_, responder) = next_request(&mut b).await;
        responder.reply(Ok(vec![0; 40 * 1024 * 1024]));
    };
    let (reply, ()) = tokio::join!(asked, answered);
    let error = reply.expect_err("too large").to_string();
    assert!(error.contains("41943040 bytes"), "{error}");
}

#[tokio::test]
async fn more_than_a_host_can_hold_is_refused_as_busy_and_room_comes_back() {
    let (a, mut b) = pair("busy").await;
    let to = b.name().clone();
    let mut asking = Vec::new();
    let mut held = Vec::new();
    for _ in 0..REQUESTS_IN_FLIGHT_MAX {
        let (session, to) = (a.session.clone(), to.clone());
        asking.push(tokio::spawn(
            async move { session.request(&to, vec![], PATIENCE).await },
        ));
        held.push(next_request(&mut b).await.1);
    }
    let error = a
        .session
        .request(&to, vec![], PATIENCE)
        .await
        .expect_err("busy")
        .to_string();
    assert!(error.contains("busy with 64 requests"), "{error}");
    assert_eq!(b.session.counters().requests_busy, 1);
    for responder in held {
        responder.reply(Ok(vec![1]));
    }
    for asked in asking {
        assert_eq!(asked.await.unwrap().unwrap(), [1]);
    }
    let (reply, ()) = tokio::join!(a.session.request(&to, vec![], PATIENCE), async {
        next_request(&mut b).await.1.reply(Ok(vec![2]));
    });
    assert_eq!(reply.unwrap(), [2]);
}

#[tokio::test]
async fn a_host_may_ask_itself() {
    let (mut a, _b) = pair("itself").await;
    let (session, name) = (a.session.clone(), a.name().clone());
    let (reply, ()) = tokio::join!(session.request(&name, vec![4], PATIENCE), async {
        let (payload, responder) = next_request(&mut a).await;
        responder.reply(Ok(payload));
    });
    assert_eq!(reply.unwrap(), [4]);
}
