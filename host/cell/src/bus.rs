//! Zenoh from below: what a session runs on, and the links that there are.
//!
//! Owns: the runtime of a session, and a handle to each link. Never: decides when to make or to close one; that is `roll`.
//!
//! This is the only file that uses what Zenoh calls internal: the public interface neither makes a link nor closes one. The version
//! is pinned (D49).

use std::sync::Arc;

use parking_lot::Mutex;
use zenoh::{
    Wait,
    config::Locator,
    internal::runtime::{DynamicRuntime, Runtime, RuntimeBuilder, ZRuntime},
    session::ZenohId,
};
use zenoh_transport::{
    DummyTransportMulticastEventHandler, DummyTransportPeerEventHandler, TransportEventHandler,
    TransportMulticastEventHandler, TransportPeer, TransportPeerEventHandler, multicast::TransportMulticast,
    unicast::TransportUnicast,
};

use crate::keys::Instance;

/// What a session runs on. Clones are the same.
#[derive(Clone)]
pub(crate) struct Bus {
    runtime: Runtime,
    links: Arc<Links>,
}

/// The links that there are, as Zenoh tells of them; those that are gone leave when the next one comes.
#[derive(Default)]
struct Links(Mutex<Vec<TransportUnicast>>);

impl TransportEventHandler for Links {
    fn new_unicast(
        &self,
        _: TransportPeer,
        link: TransportUnicast,
    ) -> zenoh::Result<Arc<dyn TransportPeerEventHandler>> {
        let mut links = self.0.lock();
        links.retain(|link| link.get_zid().is_ok());
        links.push(link);
        // It is told of links and nothing else: messages do not pass here.
        Ok(Arc::new(DummyTransportPeerEventHandler))
    }

    fn new_multicast(&self, _: TransportMulticast) -> zenoh::Result<Arc<dyn TransportMulticastEventHandler>> {
        Ok(Arc::new(DummyTransportMulticastEventHandler))
    }
}

impl Bus {
    /// Opens a session: what `zenoh::open` does, in its order. That one keeps the runtime to itself.
    pub(crate) fn open(config: zenoh::Config) -> zenoh::Result<(zenoh::Session, Self)> {
        ZRuntime::Application.block_in_place(async {
            let mut runtime = RuntimeBuilder::new(config).build().await?;
            let links = Arc::<Links>::default();
            let shared: DynamicRuntime = runtime.clone().into();
            shared.new_handler(Arc::clone(&links) as Arc<dyn TransportEventHandler>);
            let session = zenoh::session::init(shared).await?;
            runtime.start().await?;
            Ok((session, Self { runtime, links }))
        })
    }

    /// Closes the session and what it runs on. Waits.
    pub(crate) fn close(&self, session: &zenoh::Session) -> zenoh::Result<()> {
        let said = session.close().wait();
        self.runtime.close().wait()?;
        said
    }

    /// Tries a link to a life at these places, and tells whether one is there then. The attempt ends by Zenoh's own time-outs and is
    /// never dropped half-way: Zenoh would think that it still ran, and make no further one.
    pub(crate) fn link(&self, to: &Instance, locators: &[String], told: impl FnOnce(bool) + Send + 'static) {
        let Some(id) = identity(to) else { return };
        let locators: Vec<Locator> = locators.iter().filter_map(|text| text.parse().ok()).collect();
        let runtime = self.runtime.clone();
        drop(ZRuntime::Net.spawn(async move {
            told(runtime.connect_peer(&id.into(), &locators).await);
        }));
    }

    /// Closes the link to a life, for both sides.
    pub(crate) fn unlink(&self, to: &Instance) {
        let Some(id) = identity(to) else { return };
        let is_to = |link: &&TransportUnicast| link.get_zid().is_ok_and(|zid| ZenohId::from(zid) == id);
        let Some(link) = self.links.0.lock().iter().find(is_to).cloned() else {
            return;
        };
        drop(ZRuntime::Net.spawn(async move {
            if let Err(error) = link.close().await {
                tracing::debug!(%error, "a link was not closed cleanly");
            }
        }));
    }
}

/// One life: the random identity that Zenoh drew for the session.
pub(crate) fn instance(id: ZenohId) -> Instance {
    let (low, high) = id
        .to_le_bytes()
        .into_iter()
        .enumerate()
        .fold((0, 0), |(low, high), (place, byte)| {
            if place < 8 {
                (low << 8 | u64::from(byte), high)
            } else {
                (low, high << 8 | u64::from(byte))
            }
        });
    Instance::new(high, low)
}

/// The way back.
fn identity(instance: &Instance) -> Option<ZenohId> {
    let half = |digits: std::ops::Range<usize>| u64::from_str_radix(instance.as_str().get(digits)?, 16).ok();
    let (high, low) = (half(0..16)?, half(16..32)?);
    ZenohId::try_from([low.to_be_bytes(), high.to_be_bytes()].concat().as_slice()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instance_leads_back_to_its_identity() {
        let id = ZenohId::default();
        assert_eq!(identity(&instance(id)), Some(id));
        assert_eq!(identity(&Instance::new(0, 0)), None);
    }
}
